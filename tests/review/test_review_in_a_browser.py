"""The review in a real browser without a window: drag, register, watch, accept, two tabs, and a server that is killed.

The server is the command itself, and the registration a real one of a small case.
"""

import json
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch

from femoreg_torch.case import read_result
from femoreg_torch.case.review import read_review
from femoreg_torch.case.start_files import read_pixels
from femoreg_torch.geometry import project_points, transform_points
from femoreg_torch.registration import Scene
from femoreg_torch.review import Order
from femoreg_torch.review.kept import landmarks_path, start_path

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright here: it comes with the extra `dev`")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: install your distribution's, such as `apt-get install chromium`"
)
SLOW_MS = 180_000  # the longest that anything may take on a machine with much else to do


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield started
        started.close()


class Server:
    """`femoreg review` as a process of its own."""

    def __init__(self, order: Order) -> None:
        command = [sys.executable, "-m", "femoreg_torch.commands.main", "review", str(order.case)]
        options = ["--out", str(order.out), "--preset", order.preset]
        self.process = subprocess.Popen([*command, *options], stdout=subprocess.PIPE, encoding="utf-8")
        assert self.process.stdout is not None
        found = next(filter(None, (re.search(r"http://\S+/", line) for line in self.process.stdout)), None)
        assert found is not None
        self.address = found[0]

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


def ended(process: psutil.Process) -> bool:
    """Whether a process runs no more; nobody may have asked for its exit status yet."""
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


@pytest.fixture
def served(order: Order) -> Iterator[Server]:
    server = Server(order)
    yield server
    server.kill()


def opened(browser: Any, address: str) -> Any:
    """A page that notes what it asks for and complains of, once its edges are drawn."""
    page = browser.new_page(viewport={"width": 1200, "height": 1600})
    page.set_default_timeout(SLOW_MS)
    page.asked, page.complaints = [], []
    page.on("request", lambda request: page.asked.append(request.url))
    page.on("console", lambda message: None if "GL Driver" in message.text else page.complaints.append(message.text))
    page.on("pageerror", lambda error: page.complaints.append(str(error)))
    page.goto(address)
    page.locator("img.edges[src]").first.wait_for()
    return page


def click_at(page: Any, pixel: tuple[float, float], what: str = "click") -> None:
    """Move the mouse to a pixel of the image, and perhaps press it there."""
    box = page.locator(".stack").first.bounding_box()
    scale = box["width"] / 96
    x, y = box["x"] + (pixel[0] + 0.5) * scale, box["y"] + (pixel[1] + 0.5) * scale
    page.mouse.click(x, y) if what == "click" else page.mouse.move(x, y, steps=4)


def drag(page: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    click_at(page, start, "move")
    page.mouse.down()
    click_at(page, end, "move")
    page.mouse.up()


def state(page: Any) -> Any:
    return page.evaluate("fetch('drawing').then(answer => answer.json())")


def post(page: Any, what: str, content: dict[str, Any]) -> Any:
    """Ask for something as JSON, as the page does. Returns the answer."""
    return page.evaluate(
        """([what, content]) => fetch(what, {method: 'POST', headers: {'Content-Type': 'application/json'},
            body: JSON.stringify(content)}).then(answer => answer.json())""",
        [what, content],
    )


@contextmanager
def halted(pid: int) -> Iterator[None]:
    """The children of a process stand still meanwhile."""
    children = psutil.Process(pid).children(recursive=True)
    assert children
    for child in children:
        child.suspend()
    try:
        yield
    finally:
        for child in children:
            child.resume()


def slowly(route: Any) -> None:
    """Let a request go on after a time in which the page asks again for the state more than once."""
    time.sleep(2.5)
    route.continue_()


def middle(found: Any) -> Any:
    """Where the pelvis is seen."""
    return found["drawing"]["views"][0]["centres"]["pelvis"]


def until(page: Any, holds: Callable[[Any], bool]) -> None:
    """Wait until something holds of the state of the review."""
    if not in_time(page, lambda: holds(state(page))):
        pytest.fail(f"still: {json.dumps({**state(page), 'drawing': None})}")


def in_time(page: Any, holds: Callable[[], bool]) -> bool:
    """Whether something comes to hold, while the page goes on."""
    began = time.monotonic()
    while time.monotonic() - began < SLOW_MS / 1000:
        if holds():
            return True
        page.wait_for_timeout(100)
    return False


def test_landmarks_and_objects_are_dragged_registered_accepted_and_found_again(
    served: Server, browser: Any, order: Order, drawn_scene: tuple[Any, Scene], true_pose: torch.Tensor
) -> None:
    case, scene = drawn_scene
    page = opened(browser, served.address)
    assert page.get_by_text("Not registered yet").is_visible()
    points = torch.stack(list(case.landmarks.values()))
    pixels = project_points(scene.carm.camera, transform_points(true_pose, points)).tolist()
    for name, (column, row) in zip(case.landmarks, pixels, strict=True):
        page.get_by_role("button", name=name, exact=True).click()
        click_at(page, (column, row))
        page.locator(f".mark[data-name={name}]").wait_for()

    # a landmark goes where it is dragged, and back; one is removed
    column, row = pixels[0]
    drag(page, (column, row), (column + 9, row - 6))
    until(page, lambda found: found["revision"] == 8)
    there = state(page)["drawing"]["landmarks"]["FH-l"]
    assert there == pytest.approx([column + 9, row - 6], abs=0.5)
    drag(page, (column + 9, row - 6), (column, row))
    until(page, lambda found: found["revision"] == 9)
    page.get_by_role("button", name="ASIS-l").click()
    page.get_by_role("button", name="Remove").click()
    page.locator(".mark[data-name=ASIS-l]").wait_for(state="detached")
    assert set(read_pixels(landmarks_path(order.out))) == set(case.landmarks) - {"ASIS-l"}

    # landmarks place the bones; then all of them are dragged away, and turned by their handle
    page.get_by_role("button", name="Place objects by landmarks").click()
    until(page, lambda found: found["revision"] == 11)
    before = middle(state(page))
    page.get_by_label("all objects").check()
    drag(page, (48, 70), (50, 69))
    until(page, lambda found: middle(found) == pytest.approx([before[0] + 2, before[1] - 1], abs=0.3))
    assert start_path(order.out).is_file()

    # the registration brings them back, while a second tab watches and can neither start another nor move anything
    second = opened(browser, served.address)
    page.get_by_role("button", name="Start from objects").click()
    page.get_by_text("Registering:").wait_for()
    with halted(served.process.pid):  # or it may have ended before the second tab has looked
        answer = post(second, "start", {"source": "objects", "revision": 0})
        assert "A registration is running, started from this page or from another one" in answer["message"]
        second.get_by_text("Registering:").wait_for()
        assert second.get_by_role("button", name="Start from objects").is_disabled()
    for tab in (page, second):  # both show the result by themselves
        tab.locator(".card.good, .card.bad").wait_for()
    found = read_result(order.out).poses.camera1_from["pelvis"]
    assert float((found - true_pose)[:2, 3].norm()) < 2  # of 5 mm
    assert not landmarks_path(order.out).exists()

    page.get_by_label("Your name").fill("A. Surgeon")
    page.get_by_label("Note").fill("edges lie on the bone")
    page.get_by_role("button", name="Accept").click()
    page.get_by_text("by A. Surgeon").wait_for()
    second.get_by_text("by A. Surgeon").wait_for()  # without being asked
    page.reload()
    assert page.get_by_text("edges lie on the bone").is_visible()
    review = read_review(order.out)
    assert review is not None
    assert review.decision == "accepted"
    for tab in (page, second):
        assert tab.complaints == [
            "Failed to load resource: the server responded with a status of 409 (Conflict)" for _ in tab.complaints
        ]
        assert all(address.startswith((served.address, "data:")) for address in tab.asked)
        tab.close()


def test_answers_that_come_late_take_nothing_back(run: Path, served: Server, browser: Any) -> None:
    assert run.is_dir()  # with a result, so that there is something to decide on
    page = opened(browser, served.address)
    held: list[tuple[Any, Any]] = []
    page.route("**/drawing", lambda route: route.continue_() if held else held.append((route, route.fetch())))
    other = opened(browser, served.address)
    post(other, "change", {"mark": {"name": "FH-l", "column": 40, "row": 40}, "revision": 0})
    assert in_time(page, lambda: bool(held))  # the page has seen that there is something new, and waits for it
    # meanwhile a landmark is put; the first press only brings what is new, which was not shown yet
    page.get_by_role("button", name="ASIS-l").click()
    click_at(page, (60, 60))
    page.get_by_text("Somebody changed this on another page meanwhile").wait_for()
    click_at(page, (60, 60))
    page.locator(".mark[data-name=ASIS-l]").wait_for()
    with page.expect_request("**/state"):  # the next one comes after the late answer was looked at
        held[0][0].fulfill(response=held[0][1])
    assert page.locator(".mark[data-name=ASIS-l]").is_visible()
    page.get_by_role("button", name="IPS-l").click()
    click_at(page, (20, 60))
    page.locator(".mark[data-name=IPS-l]").wait_for()
    assert len(state(page)["drawing"]["landmarks"]) == 3

    # a new page that takes long to come is asked for once
    seen = len(page.asked)
    page.route(served.address, slowly)
    other.get_by_label("Your name").fill("B. Surgeon")
    other.get_by_role("button", name="Accept").click()
    page.get_by_text("by B. Surgeon").wait_for()
    assert page.asked[seen:].count(served.address) == 1
    for tab in (page, other):
        tab.close()


def test_a_server_that_is_killed_in_mid_run_leaves_no_run_and_what_was_placed(
    served: Server, browser: Any, order: Order
) -> None:
    page = opened(browser, served.address)
    page.get_by_label("femur").check()
    column, row = state(page)["drawing"]["views"][0]["centres"]["femur"]
    held: list[Any] = []  # the first part of the motion: the start is pressed before the server knows any of it
    page.route("**/change", lambda route: route.continue_() if held else held.append(route))
    drag(page, (48, 70), (52, 70))
    page.get_by_role("button", name="Start from objects").click()
    held[0].continue_()
    page.get_by_text("Registering:").wait_for()
    kept = json.loads(start_path(order.out).read_text(encoding="utf-8"))
    children = psutil.Process(served.process.pid).children(recursive=True)
    assert children
    served.kill()
    page.get_by_text("The server does not answer").wait_for()
    assert in_time(page, lambda: all(map(ended, children)))  # at the latest when it has something to tell
    assert not order.out.exists()
    again = Server(order)
    try:
        other = opened(browser, again.address)
        assert json.loads(start_path(order.out).read_text(encoding="utf-8")) == kept
        before = state(other)
        assert before["drawing"]["views"][0]["centres"]["femur"] == pytest.approx([column + 4, row], abs=0.3)
        assert before["progress"] is None
        other.get_by_role("button", name="Start from objects").click()
        other.get_by_text("Registering:").wait_for()
        other.get_by_role("button", name="Cancel").click()
        other.get_by_text("Cancelled. Nothing was written.").wait_for()
        assert state(other)["drawing"]["views"] == before["drawing"]["views"]
        assert not order.out.exists()
    finally:
        again.kill()
