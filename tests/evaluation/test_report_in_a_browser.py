"""The report in a real browser without a window: readable at all widths, its controls work, and nothing is loaded."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from femoreg_torch.case import read_case, read_result
from femoreg_torch.evaluation import write_report

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright here: it comes with the extra `dev`")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: install your distribution's, such as `apt-get install chromium`"
)
SOFTWARE_3D = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def report(kept_procedure: tuple[Path, Path]) -> str:
    folder, run = kept_procedure
    write_report(read_case(folder), read_result(run), run)
    return (run / "report.html").as_uri()


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_3D)
        yield started
        started.close()


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """A page that notes what it asks for and complains of."""
    opened = browser.new_page(viewport={"width": 1024, "height": 800})
    opened.asked, opened.complaints = [], []
    opened.on("request", lambda request: opened.asked.append(request.url))
    opened.on("console", lambda message: opened.complaints.append(message.text))
    opened.on("pageerror", lambda error: opened.complaints.append(str(error)))
    yield opened
    opened.close()


def fading(page: Any) -> float:
    return float(page.locator(".drr").first.evaluate("element => getComputedStyle(element).opacity"))


def drawn(page: Any) -> str:
    return str(page.locator("#theatre").evaluate("canvas => canvas.toDataURL()"))


@pytest.mark.parametrize("width", [1600, 1024, 420])
def test_it_fits_and_says_the_verdict_without_scrolling(page: Any, report: str, width: int) -> None:
    page.set_viewport_size({"width": width, "height": 860})
    page.goto(report)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for what in (".verdict", ".warning", ".card li"):
        box = page.locator(what).first.bounding_box()
        assert box is not None
        assert box["y"] + box["height"] < 860
    assert page.locator(".verdict").inner_text().split()[-2:] == ["Not", "trusted"]


def test_it_loads_nothing_and_has_nothing_to_complain_of(page: Any, report: str) -> None:
    page.goto(report)
    page.wait_for_timeout(300)
    assert [address for address in page.asked if not address.startswith("data:")] == [report]
    assert page.complaints == []
    broken = page.evaluate("[...document.images].filter(image => !image.complete || !image.naturalWidth).length")
    assert broken == 0


def test_slider_blink_and_keys_go_from_x_ray_to_rendering(page: Any, report: str) -> None:
    page.goto(report)
    assert fading(page) == 0
    page.locator("#fade").fill("60")
    assert fading(page) == pytest.approx(0.6)
    page.locator("h1").click()
    page.keyboard.press("ArrowRight")
    assert fading(page) == pytest.approx(0.7)
    page.keyboard.press("b")
    assert page.locator("#blink").get_attribute("aria-pressed") == "true"
    seen: set[float] = set()
    for _ in range(100):
        page.wait_for_timeout(50)
        seen.add(fading(page))
        if {0.0, 1.0} <= seen:
            break
    assert {0.0, 1.0} <= seen
    page.keyboard.press("b")
    assert fading(page) == pytest.approx(0.7)


def test_what_is_drawn_can_be_hidden(page: Any, report: str) -> None:
    page.goto(report)
    pelvis = page.locator("img[data-layer=pelvis]").first
    assert pelvis.is_visible()
    page.get_by_label("pelvis", exact=True).uncheck()
    assert not pelvis.is_visible()
    assert page.locator("img[data-layer=femur]").first.is_visible()


def test_the_scene_turns_by_mouse_touch_and_keys(page: Any, report: str) -> None:
    page.goto(report)
    canvas = page.locator("#theatre")
    canvas.scroll_into_view_if_needed()
    if not canvas.evaluate("canvas => Boolean(canvas.getContext('webgl2'))"):
        pytest.skip("this browser has no WebGL 2, not even in software")
    page.wait_for_timeout(300)  # until the images on the detectors are there
    colours = canvas.evaluate(
        """canvas => {
            const gl = canvas.getContext('webgl2'), values = new Uint8Array(4 * canvas.width * canvas.height);
            gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, values);
            const found = new Set();
            for (let i = 0; i < values.length; i += 4) found.add(values[i] << 16 | values[i + 1] << 8 | values[i + 2]);
            return found.size;
        }"""
    )
    assert colours > 50  # shaded surfaces, not an empty canvas
    box = canvas.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = drawn(page)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 120, y + 40)
    page.mouse.up()
    by_mouse = drawn(page)
    assert by_mouse != before
    page.mouse.move(x - 100, y)
    assert drawn(page) == by_mouse  # the button is up
    canvas.focus()
    page.keyboard.press("ArrowLeft")
    by_key = drawn(page)
    assert by_key != by_mouse
    canvas.evaluate(
        """(canvas, [x, y]) => {
            const send = (kind, clientX) => canvas.dispatchEvent(new PointerEvent(kind,
                {pointerId: 1, pointerType: 'touch', clientX, clientY: y, bubbles: true}));
            canvas.setPointerCapture = () => {};
            send('pointerdown', x); send('pointermove', x + 60); send('pointerup', x + 60);
        }""",
        [x, y],
    )
    assert drawn(page) != by_key


def test_what_is_folded_is_printed(page: Any, report: str) -> None:
    page.goto(report)
    assert not page.get_by_text("source to detector").is_visible()
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.get_by_text("source to detector").is_visible()
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert not page.get_by_text("source to detector").is_visible()
