"""The review of a run: who is let in, what is written and when not, and a server that is killed."""

import multiprocessing
import re
import socket
import time
from dataclasses import replace
from pathlib import Path

import httpx
import pytest
import torch
from starlette.testclient import TestClient

from femoreg_torch.case import ObjectQuality, Result, read_result, result_content, write_json
from femoreg_torch.case.review import REVIEW_NAME, Review, read_review, result_sha256, write_review
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import first_view_only
from femoreg_torch.review import review_app, serve
from femoreg_torch.review.server import LOOPBACK

TOKEN = "the-token"
ACCEPT = {"decision": "accepted", "reviewer": "A. Surgeon", "note": "edges lie on the bone", "before": ""}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run with the result of one object."""
    good = ObjectQuality((), 0.1, (0.1, 0.1), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1), None, True, "all views agree")
    pose = torch.eye(4, dtype=torch.float64)
    write_json(tmp_path / "result.json", result_content(Result(first_view_only({"pelvis": pose}, 1), {"pelvis": good})))
    return tmp_path


def client_of(run: Path, host: str = "127.0.0.1") -> TestClient:
    app = review_app(run, read_result(run), "<p>the report</p>", result_sha256(run), TOKEN)
    return TestClient(app, base_url=f"http://{host}:8123", follow_redirects=False)


def test_the_page_shows_verdict_form_and_report_and_loads_nothing_else(run: Path) -> None:
    client = client_of(run)
    answer = client.get(f"/{TOKEN}/")
    assert answer.status_code == 200
    assert "Trusted: every check of the registration passed." in answer.text
    assert "Nobody has reviewed this result." in answer.text
    assert re.findall(r'(?:src|href|action)="([^"]*)"', answer.text) == ["data:,", "decision", "report"]
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert client.get(f"/{TOKEN}/report").text == "<p>the report</p>"


@pytest.mark.parametrize("address", ["/wrong/", "/wrong/report", "/", "/the-toke/", "//"])
def test_without_the_token_nothing_is_shown(run: Path, address: str) -> None:
    answer = client_of(run).get(address)
    assert answer.status_code in (403, 404)
    assert "rusted" not in answer.text
    assert "the report" not in answer.text


def test_without_the_token_nothing_is_written(run: Path) -> None:
    assert client_of(run).post("/wrong/decision", data=ACCEPT).status_code == 403
    assert not (run / REVIEW_NAME).exists()


def test_another_host_name_is_refused(run: Path) -> None:
    """A web page that points a name of its own to 127.0.0.1 is a stranger."""
    stranger = client_of(run, "evil.example")
    assert stranger.get(f"/{TOKEN}/").status_code == 400
    assert stranger.post(f"/{TOKEN}/decision", data=ACCEPT).status_code == 400
    assert not (run / REVIEW_NAME).exists()


def test_a_decision_from_another_page_is_refused(run: Path) -> None:
    answer = client_of(run).post(f"/{TOKEN}/decision", data=ACCEPT, headers={"origin": "http://evil.example"})
    assert answer.status_code == 403
    assert not (run / REVIEW_NAME).exists()


def test_a_decision_is_written_and_shown(run: Path) -> None:
    client = client_of(run)
    answer = client.post(f"/{TOKEN}/decision", data=ACCEPT, headers={"origin": "http://127.0.0.1:8123"})
    assert answer.status_code == 303
    found = read_review(run)
    assert found is not None
    assert (found.decision, found.reviewer, found.note) == ("accepted", "A. Surgeon", "edges lie on the bone")
    assert found.result_sha256 == result_sha256(run)
    assert found.time.endswith("+00:00")
    page = client.get(answer.headers["location"]).text
    assert "<b>Accepted</b> by A. Surgeon" in page
    assert read_result(run).verdict.trusted


def test_names_and_notes_stay_text(run: Path) -> None:
    client = client_of(run)
    client.post(f"/{TOKEN}/decision", data={**ACCEPT, "reviewer": "<script>alert(1)</script>", "note": "<b>x"})
    page = client.get(f"/{TOKEN}/").text
    assert "<script" not in page
    assert "&lt;b&gt;x" in page


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"decision": "maybe"}, "accept or reject"),
        ({"reviewer": " "}, "your name is missing"),
        ({"decision": "rejected", "note": ""}, "why you reject it"),
    ],
)
def test_an_incomplete_decision_is_not_written(run: Path, change: dict[str, str], says: str) -> None:
    answer = client_of(run).post(f"/{TOKEN}/decision", data={**ACCEPT, **change})
    assert answer.status_code == 400
    assert says in answer.text
    assert not (run / REVIEW_NAME).exists()


def test_a_decision_that_is_too_long_is_refused(run: Path) -> None:
    assert client_of(run).post(f"/{TOKEN}/decision", data={**ACCEPT, "note": "x" * 50_000}).status_code == 413
    assert not (run / REVIEW_NAME).exists()


def test_of_two_tabs_the_second_is_told_of_the_first(run: Path) -> None:
    client = client_of(run)
    client.post(f"/{TOKEN}/decision", data=ACCEPT)
    reject = {**ACCEPT, "decision": "rejected", "note": "the device is off"}
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


def test_a_result_that_changed_is_not_decided_on(run: Path) -> None:
    client = client_of(run)
    write_json(run / "result.json", result_content(replace(read_result(run), seed=7)))
    assert "The result has changed" in client.get(f"/{TOKEN}/").text
    assert client.post(f"/{TOKEN}/decision", data=ACCEPT).status_code == 409
    assert not (run / REVIEW_NAME).exists()


def test_a_review_of_another_result_does_not_count(run: Path) -> None:
    write_review(run, Review("accepted", "", "A. Surgeon", "2026-01-01T00:00:00+00:00", "0" * 64))
    assert "does not count for this one" in client_of(run).get(f"/{TOKEN}/").text


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
    (run / REVIEW_NAME).write_text(content)
    with pytest.raises(InputError, match=says):
        read_review(run)


def test_a_server_that_is_killed_leaves_what_was_there(run: Path) -> None:
    """A real server dies in the middle of a decision that is being sent."""
    write_review(run, Review("rejected", "first", "A. Surgeon", "2026-01-01T00:00:00+00:00", result_sha256(run)))
    before = (run / REVIEW_NAME).read_bytes()
    app = review_app(run, read_result(run), "", result_sha256(run), TOKEN)
    with socket.socket() as listening:
        listening.bind((LOOPBACK, 0))
        listening.listen()  # so that what comes before the server is ready waits for it
        address = listening.getsockname()
        server = multiprocessing.get_context("fork").Process(target=serve, args=(app, listening))
        server.start()
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
