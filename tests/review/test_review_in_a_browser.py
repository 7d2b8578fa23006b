"""The review in a real browser without a window: reject, reload, and two tabs."""

import multiprocessing
import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from femoreg_torch.case import ObjectQuality, Result, read_result, result_content, write_json
from femoreg_torch.case.review import read_review, result_sha256
from femoreg_torch.geometry import first_view_only
from femoreg_torch.review import review_app, serve
from femoreg_torch.review.server import LOOPBACK

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright here: it comes with the extra `dev`")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: install your distribution's, such as `apt-get install chromium`"
)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[str]:
    """The address of the review of the run in `tmp_path`."""
    good = ObjectQuality((), 0.1, (0.1, 0.1), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1), None, True, "all views agree")
    poses = first_view_only({"pelvis": torch.eye(4, dtype=torch.float64)}, 1)
    write_json(tmp_path / "result.json", result_content(Result(poses, {"pelvis": good})))
    app = review_app(tmp_path, read_result(tmp_path), "<p>the report</p>", result_sha256(tmp_path), "the-token")
    with socket.socket() as listening:
        listening.bind((LOOPBACK, 0))
        listening.listen()
        port = listening.getsockname()[1]
        server = multiprocessing.get_context("fork").Process(target=serve, args=(app, listening))
        server.start()
    yield f"http://{LOOPBACK}:{port}/the-token/"
    server.kill()
    server.join()


def test_a_person_rejects_and_a_second_tab_is_told(served: str, tmp_path: Path) -> None:
    asked, complaints = [], []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        first, second = browser.new_page(), browser.new_page()
        first.on("request", lambda request: asked.append(request.url))
        first.on("console", lambda message: complaints.append(message.text))
        for tab in (first, second):
            tab.goto(served)
            assert tab.frame_locator("iframe").get_by_text("the report").is_visible()
        first.get_by_label("Your name").fill("A. Surgeon")
        first.get_by_label("Note").fill("the device is off")
        first.get_by_role("button", name="Reject").click()
        first.get_by_text("by A. Surgeon").wait_for()
        first.reload()
        assert first.get_by_text("the device is off").is_visible()
        second.get_by_label("Your name").fill("B. Surgeon")
        second.get_by_role("button", name="Accept").click()
        second.get_by_text("somebody has decided meanwhile").wait_for()
        browser.close()
    assert complaints == []
    assert all(address.startswith((served, "data:")) for address in asked)
    found = read_review(tmp_path)
    assert found is not None
    assert (found.decision, found.reviewer) == ("rejected", "A. Surgeon")
