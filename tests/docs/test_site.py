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
VISITED = ("index.html", "docs/concepts/frames-drawn.html", "docs/reference/api.html", "notebooks/own_parts.html")


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
    (tmp_path / "b.html").write_text('<h1 id="here">b</h1>')
    (tmp_path / "a.html").write_text('<a href="b.html#here">b</a><a href="https://example.org">out</a>')
    assert checked(tmp_path).returncode == 0
    for wrong in (
        '<a href="c.html">c</a>',
        '<a href="b.html#there">b</a>',
        '<script src="//cdn.example/x.js"></script>',
    ):
        (tmp_path / "a.html").write_text(wrong)
        found = checked(tmp_path)
        assert found.returncode == 1
        assert len(found.stderr.splitlines()) == 1


@pytest.mark.long
def test_no_link_is_broken_and_nothing_comes_from_elsewhere(site: Path) -> None:
    found = checked(site)
    assert found.returncode == 0, found.stderr


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")
def test_a_browser_asks_nobody_else(site: Path, address: str) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    asked: list[str] = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=PLAIN)
        page = browser.new_page()
        page.on("request", lambda request: asked.append(request.url))
        for place in VISITED:
            page.goto(f"{address}/{place}", wait_until="networkidle")
        page.goto(f"{address}/search.html?q=pelvis", wait_until="networkidle")
        page.wait_for_selector("#search-results a")
        browser.close()
    assert len(asked) > 20
    assert not [url for url in asked if not url.startswith((address, "data:"))]
