"""The site builds without a warning, every link in it leads somewhere, and a browser asks nobody else for anything."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from page_blocks import ROOT

CHECK = ROOT / "docs" / "site" / "check_site.py"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PLAIN = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage"]

SLOW_MS = 180_000  # the longest that a page may take on a machine with much else to do


def checked(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(CHECK), str(folder)], capture_output=True, encoding="utf-8")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("sphinx", reason="no Sphinx here: install the extra `docs`, or run `make docs-test`")
    folder = tmp_path_factory.mktemp("site")
    options = ["-q", "-W", "--keep-going", "-c", str(ROOT / "docs"), "-d", str(folder / "doctrees")]
    command = [sys.executable, "-m", "sphinx", *options, str(ROOT), str(folder / "html")]
    built = subprocess.run(command, capture_output=True, encoding="utf-8")
    assert built.returncode == 0, built.stderr
    return folder / "html"


@pytest.fixture
def address(site: Path) -> Iterator[str]:
    """The site as a server on this machine gives it."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(site))
    handler.log_message = lambda *_: None  # type: ignore[attr-defined]
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_what_leads_nowhere_or_comes_from_elsewhere_is_found(tmp_path: Path) -> None:
    (tmp_path / "b.html").write_text('<h1 id="here">b</h1>', encoding="utf-8")
    (tmp_path / "a.html").write_text(
        '<a href="b.html#here">b</a><a href="https://example.org">out</a>', encoding="utf-8"
    )
    assert checked(tmp_path).returncode == 0
    for wrong in (
        '<a href="c.html">c</a>',
        '<a href="b.html#there">b</a>',
        '<script src="//cdn.example/x.js"></script>',
    ):
        (tmp_path / "a.html").write_text(wrong, encoding="utf-8")
        found = checked(tmp_path)
        assert found.returncode == 1
        assert len(found.stderr.splitlines()) == 1


@pytest.mark.long
def test_no_link_is_broken_and_nothing_comes_from_elsewhere(site: Path) -> None:
    found = checked(site)
    assert found.returncode == 0, found.stderr


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
@pytest.mark.parametrize("door", ["served", "opened from disk"])
def test_a_browser_asks_nobody_else(door: str, site: Path, address: str) -> None:
    """Every page of the site, search and both colour schemes: what is asked for is there, and part of the site."""
    playwright = pytest.importorskip("playwright.sync_api")
    root = address if door == "served" else site.as_uri()
    pages = [path.relative_to(site).as_posix() for path in sorted(site.rglob("*.html"))]
    asked, lost = [], []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=PLAIN)
        context = browser.new_context()  # its requests are those of all pages and workers
        context.on("request", lambda request: asked.append(request.url))
        context.on("requestfailed", lambda request: lost.append(request.url))
        context.on("response", lambda answer: lost.append(answer.url) if answer.status >= 400 else None)
        page = context.new_page()
        page.set_default_timeout(SLOW_MS)
        page.on("pageerror", lambda error: lost.append(f"{page.url}: {error}"))
        page.on("websocket", lambda socket: asked.append(socket.url))
        for place in pages:
            page.goto(f"{root}/{place}", wait_until="load")
            if place == "index.html":  # leads on, and would interrupt the next
                page.wait_for_url(f"{root}/docs/index.html")
            page.mouse.wheel(0, 20_000)  # what is loaded when it comes into view
        page.goto(f"{root}/docs/index.html", wait_until="networkidle")
        schemes = set()
        for _ in range(3):  # as the system has it, light, dark
            page.locator("button.theme-toggle:visible").first.click()
            schemes.add(page.evaluate("document.body.dataset.theme"))
        page.goto(f"{root}/search.html?q=pelvis", wait_until="networkidle")
        page.wait_for_selector("#search-results a")
        browser.close()
    assert schemes == {"auto", "light", "dark"}
    assert len(pages) > 40
    assert len(set(asked)) > len(pages)
    assert not [url for url in asked if not url.startswith((f"{root}/", "data:"))]
    assert not lost
