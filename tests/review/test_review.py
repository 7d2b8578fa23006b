"""The server of a review: who is let in, what is written and when not, and a server that is killed."""

import multiprocessing
import os
import re
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
import torch
from starlette.testclient import TestClient

from femoreg_torch.case import Case, read_case, read_result, result_content, write_json
from femoreg_torch.case.review import REVIEW_NAME, Review, read_review, result_sha256, write_review
from femoreg_torch.commands.main import main
from femoreg_torch.commands.register import register_into
from femoreg_torch.commands.review import register_order
from femoreg_torch.errors import InputError
from femoreg_torch.registration import Scene
from femoreg_torch.review import LOOPBACK, Desk, Order, only_review, review_app, serve

TOKEN = "the-token"
ACCEPT = {"decision": "accepted", "reviewer": "A. Surgeon", "note": "edges lie on the bone", "before": ""}
DrawnScene = tuple[Case, Scene]


@pytest.fixture
def desk(drawn_scene: DrawnScene, order: Order, run: Path) -> Desk:
    """Of a run with a result."""
    assert run == order.out
    return Desk(*drawn_scene, order, register_order)


@pytest.fixture
def client(desk: Desk) -> TestClient:
    return client_of(desk)


def client_of(desk: Desk, host: str = "127.0.0.1") -> TestClient:
    return TestClient(review_app(desk, TOKEN), base_url=f"http://{host}:8123", follow_redirects=False)


def accepting(run: Path) -> dict[str, str]:
    return {**ACCEPT, "result": result_sha256(run)}


def test_the_page_shows_verdict_form_images_and_report_and_loads_nothing_else(client: TestClient) -> None:
    answer = client.get(f"/{TOKEN}/")
    assert answer.status_code == 200
    assert "Trusted" in answer.text
    assert "Nobody has reviewed this result." in answer.text
    loaded = re.findall(r'(?:src|href|action)="([^"]*)"', answer.text)
    assert [address for address in loaded if not address.startswith("data:")] == ["decision", "report"]
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "connect-src 'self'" in policy
    assert "unsafe-inline" not in policy.partition("script-src")[2].partition(";")[0]
    report = client.get(f"/{TOKEN}/report")
    assert "Registration of case" in report.text
    assert report.headers["content-security-policy"] == "frame-ancestors 'self'"


@pytest.mark.parametrize(
    "address", ["/wrong/", "/wrong/report", "/wrong/state", "/wrong/drawing", "/", "/the-toke/", "//"]
)
def test_without_the_token_nothing_is_shown(client: TestClient, address: str) -> None:
    answer = client.get(address)
    assert answer.status_code in (403, 404)
    assert len(answer.text) < 100


@pytest.mark.parametrize("what", ["decision", "change", "start", "cancel"])
def test_without_the_token_nothing_is_done(client: TestClient, desk: Desk, run: Path, what: str) -> None:
    assert client.post(f"/wrong/{what}", data=accepting(run)).status_code == 403
    assert not (run / REVIEW_NAME).exists()
    assert desk.state()["revision"] == 0


def test_another_host_name_is_refused(desk: Desk, run: Path) -> None:
    """A web page that points a name of its own to 127.0.0.1 is a stranger."""
    stranger = client_of(desk, "evil.example")
    assert stranger.get(f"/{TOKEN}/").status_code == 400
    assert stranger.post(f"/{TOKEN}/decision", data=accepting(run)).status_code == 400
    assert not (run / REVIEW_NAME).exists()


def test_what_comes_from_another_page_is_refused(client: TestClient, desk: Desk, run: Path) -> None:
    evil = {"origin": "http://evil.example"}
    assert client.post(f"/{TOKEN}/decision", data=accepting(run), headers=evil).status_code == 403
    reset = {"revision": 0, "do": "reset"}
    assert client.post(f"/{TOKEN}/change", json=reset, headers=evil).status_code == 403
    text = {"content-type": "text/plain"}  # what a page elsewhere may send without asking first
    assert client.post(f"/{TOKEN}/change", content='{"revision": 0, "do": "reset"}', headers=text).status_code == 415
    assert not (run / REVIEW_NAME).exists()
    assert desk.state()["revision"] == 0


def test_a_decision_is_written_and_shown(client: TestClient, run: Path) -> None:
    answer = client.post(f"/{TOKEN}/decision", data=accepting(run), headers={"origin": "http://127.0.0.1:8123"})
    assert answer.status_code == 303
    found = read_review(run)
    assert found is not None
    assert (found.decision, found.reviewer, found.note) == ("accepted", "A. Surgeon", "edges lie on the bone")
    assert found.result_sha256 == result_sha256(run)
    assert found.time.endswith("+00:00")
    page = client.get(answer.headers["location"]).text
    assert "<b>Accepted</b> by A. Surgeon" in page
    assert read_result(run).verdict.trusted


def test_names_and_notes_stay_text(client: TestClient, run: Path) -> None:
    client.post(f"/{TOKEN}/decision", data={**accepting(run), "reviewer": "<script>alert(1)</script>", "note": "<b>x"})
    page = client.get(f"/{TOKEN}/").text
    assert "<script>alert" not in page
    assert "&lt;b&gt;x" in page


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"decision": "maybe"}, "accept or reject"),
        ({"reviewer": " "}, "your name is missing"),
        ({"decision": "rejected", "note": ""}, "why you reject it"),
    ],
)
def test_an_incomplete_decision_is_not_written(
    client: TestClient, run: Path, change: dict[str, str], says: str
) -> None:
    answer = client.post(f"/{TOKEN}/decision", data={**accepting(run), **change})
    assert answer.status_code == 400
    assert says in answer.text
    assert not (run / REVIEW_NAME).exists()


def test_a_decision_that_is_too_long_is_refused(client: TestClient, run: Path) -> None:
    assert client.post(f"/{TOKEN}/decision", data={**accepting(run), "note": "x" * 50_000}).status_code == 413
    assert not (run / REVIEW_NAME).exists()


def test_of_two_tabs_the_second_is_told_of_the_first(client: TestClient, run: Path) -> None:
    client.post(f"/{TOKEN}/decision", data=accepting(run))
    reject = {**accepting(run), "decision": "rejected", "note": "the device is off"}
    answer = client.post(f"/{TOKEN}/decision", data=reject)  # from a page that was loaded before
    assert answer.status_code == 409
    assert "somebody has decided meanwhile" in answer.text
    first = read_review(run)
    assert first is not None
    assert first.decision == "accepted"
    assert client.post(f"/{TOKEN}/decision", data={**reject, "before": first.time}).status_code == 303
    second = read_review(run)
    assert second is not None
    assert second.decision == "rejected"


def test_a_result_that_changed_is_not_decided_on(client: TestClient, run: Path) -> None:
    looked_at = accepting(run)
    write_json(run / "result.json", result_content(replace(read_result(run), seed=7)))
    assert "The result has changed" in client.get(f"/{TOKEN}/").text
    assert client.post(f"/{TOKEN}/decision", data=looked_at).status_code == 409
    assert client.post(f"/{TOKEN}/decision", data=accepting(run)).status_code == 409
    assert not (run / REVIEW_NAME).exists()


def test_a_review_of_another_result_does_not_count(client: TestClient, run: Path) -> None:
    write_review(run, Review("accepted", "", "A. Surgeon", "2026-01-01T00:00:00+00:00", "0" * 64))
    assert "does not count for this one" in client.get(f"/{TOKEN}/").text


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "cannot be read as JSON"),
        ('{"version": 2}', "version: 1 was expected"),
        ('{"version": 1, "decision": "perhaps"}', "accepted or rejected was expected"),
        ('{"version": 1, "decision": "accepted"}', "reviewer"),
    ],
)
def test_a_file_that_is_no_review_is_one_line(run: Path, content: str, says: str) -> None:
    (run / REVIEW_NAME).write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=says):
        read_review(run)


def test_two_reviews_of_one_run(tmp_path: Path) -> None:
    """Of another process, by whatever name of the folder; the lock goes with that process."""
    run = tmp_path / "deep" / "run"
    code = f"""
import sys, time
from pathlib import Path
from femoreg_torch.review import only_review
with only_review(Path({str(run)!r})):
    print("in", flush=True)
    time.sleep(600)
"""
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"in\n"
        (tmp_path / "link").symlink_to(run.parent)
        with pytest.raises(InputError, match="is being reviewed by another"), only_review(tmp_path / "link" / "run"):
            pass
        with only_review(tmp_path / "other"):
            pass
        other.kill()
    with only_review(run):
        pass
    assert list(run.parent.iterdir()) == []


def started_server(desk: Desk) -> tuple[tuple[str, int], multiprocessing.process.BaseProcess]:
    """A real server in a process of its own: its address, and the process."""
    app = review_app(desk, TOKEN)
    with socket.socket() as listening:
        listening.bind((LOOPBACK, 0))
        listening.listen()  # so that what comes before the server is ready waits for it
        server = multiprocessing.get_context("fork").Process(target=serve, args=(app, listening))
        server.start()
        return listening.getsockname(), server


def test_ctrl_c_ends_a_server_without_complaint(desk: Desk) -> None:
    address, server = started_server(desk)
    assert httpx.get(f"http://{LOOPBACK}:{address[1]}/{TOKEN}/", timeout=60, trust_env=False).status_code == 200
    assert server.pid is not None
    os.kill(server.pid, signal.SIGINT)
    server.join(60)
    assert server.exitcode == 0


def test_a_server_that_is_killed_leaves_what_was_there(desk: Desk, run: Path) -> None:
    """A real server dies in the middle of a decision that is being sent."""
    write_review(run, Review("rejected", "first", "A. Surgeon", "2026-01-01T00:00:00+00:00", result_sha256(run)))
    before = (run / REVIEW_NAME).read_bytes()
    address, server = started_server(desk)
    try:
        assert httpx.get(f"http://{LOOPBACK}:{address[1]}/{TOKEN}/", timeout=60, trust_env=False).status_code == 200
        with socket.create_connection(address) as half:
            head = f"POST /{TOKEN}/decision HTTP/1.1\r\nHost: {LOOPBACK}\r\nContent-Length: 500\r\n\r\n"
            half.sendall(head.encode() + b"decision=accepted&reviewer=B")
            time.sleep(0.1)
            server.kill()
            server.join()
    finally:
        server.kill()
        server.join()
    assert (run / REVIEW_NAME).read_bytes() == before
    assert not [entry for entry in run.iterdir() if entry.name.startswith(".")]


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[1]", "a JSON object was expected"),
        ("{", "cannot be read as JSON"),
        ('{"revision": 0}', "one of move, mark, unmark and do was expected"),
        ('{"revision": 0, "do": "nonsense"}', "nonsense"),
        ('{"revision": 0, "mark": {"name": "nose", "column": 1, "row": 1}}', "no landmark 'nose'"),
        ('{"revision": 0, "mark": {"name": "FH-l", "column": 1e9, "row": 1}}', "column"),
        ('{"revision": 0, "mark": {"name": "FH-l", "column": NaN, "row": 1}}', "NaN"),
        ('{"revision": 0, "mark": {"name": "../../x", "column": 1, "row": 1}}', "no landmark"),
        ('{"revision": 0, "move": {"what": "femur", "view": 0}}', "view 0 is not known"),
        ('{"revision": 0, "move": {"what": "femur", "view": 1, "shift_px": [1]}}', "shift_px"),
        ('{"revision": 0, "path": "/etc/passwd"}', "unknown key"),
    ],
)
def test_a_change_that_makes_no_sense_is_told_and_changes_nothing(
    client: TestClient, desk: Desk, content: str, says: str
) -> None:
    answer = client.post(f"/{TOKEN}/change", content=content, headers={"content-type": "application/json"})
    assert answer.status_code == 400
    assert says in answer.json()["message"]
    assert desk.state()["revision"] == 0


def test_a_request_that_is_too_long_is_refused(client: TestClient) -> None:
    assert client.post(f"/{TOKEN}/change", json={"unmark": "x" * 50_000}).status_code == 413


def test_a_change_on_a_page_that_is_behind_is_refused(client: TestClient) -> None:
    """Of two tabs, the second shows what the first did before it changes anything itself."""
    mark = {"revision": 0, "mark": {"name": "FH-l", "column": 5.0, "row": 6.0}}
    assert client.post(f"/{TOKEN}/change", json=mark).status_code == 200
    answer = client.post(f"/{TOKEN}/change", json={"revision": 0, "unmark": "FH-l"})
    assert answer.status_code == 409
    assert "Somebody changed this on another page" in answer.json()["message"]
    assert answer.json()["drawing"]["landmarks"] == {"FH-l": [5.0, 6.0]}


def test_too_few_landmarks_start_nothing(client: TestClient, run: Path) -> None:
    answer = client.post(f"/{TOKEN}/start", json={"revision": 0, "source": "landmarks"})
    assert answer.status_code == 400
    assert "at least 4 are needed" in answer.json()["message"]
    assert answer.json()["progress"] is None
    assert sorted(path.name for path in run.parent.iterdir()) == ["run"]


def test_there_is_nothing_to_cancel(client: TestClient) -> None:
    answer = client.post(f"/{TOKEN}/cancel", json={})
    assert answer.status_code == 409
    assert "No registration is running" in answer.json()["message"]


def test_a_run_is_not_shown_while_another_folder_is_written_to(
    run: Path, drawn_case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["review", str(run), "--case", str(drawn_case), "--out", str(tmp_path / "new")]) == 2
    assert "--out: " in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_a_new_result_removes_the_scene_of_the_one_before(run: Path, order: Order, true_pose: torch.Tensor) -> None:
    (run / "slicer").mkdir()
    (run / "slicer" / "scene.mrml").write_text("<!-- Trusted -->", encoding="utf-8")
    (run / "notes.txt").write_text("of a person", encoding="utf-8")
    start = run.parent / "start.json"
    write_json(start, {f"camera1_from_{name}": true_pose for name in ("pelvis", "femur")})
    register_into(run, read_case(order.case), order.preset, 0, start=start)
    assert not (run / "slicer").exists()
    assert (run / "notes.txt").exists()


def test_a_port_that_is_none_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["review", str(tmp_path), "--port", "99999"]) == 2
    assert capsys.readouterr().err == "femoreg: --port: 0 to 65535 was expected, found 99999.\n"
