"""`femoreg batch`: processes that die, and input that cannot be a batch."""

import os
import signal
from pathlib import Path

import pytest

from femoreg_torch.commands import batch
from femoreg_torch.commands.batch import Job, Row, run_jobs
from femoreg_torch.commands.main import main


def mortal(job: Job) -> Row:
    """Ends its own process for one of the cases."""
    if job.case.name == "deadly":
        os.kill(os.getpid(), signal.SIGKILL)
    return Row(job.case.name, "done", True, "", 0.0, {})


def test_a_killed_process_loses_its_own_case_alone() -> None:
    jobs = [Job(Path(name), Path(name), "fast", 0, None, 1) for name in ("a", "deadly", "b", "c")]
    rows = {job.case.name: row for job, row in run_jobs(jobs, 2, mortal)}
    assert {name: row.status for name, row in rows.items()} == {
        "a": "done",
        "b": "done",
        "c": "done",
        "deadly": "failed",
    }
    assert "killed" in rows["deadly"].reasons


@pytest.mark.parametrize(
    ("options", "says"),
    [(["--jobs", "0"], "--jobs: 1 to"), (["--preset", "quickest"], "derivative_free"), (["--jobs", "1"], "'case'")],
)
def test_bad_options_are_told_before_any_case(
    options: list[str], says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    cases = [tmp_path / "a" / "case", tmp_path / "b" / "case"]
    assert main(["batch", *map(str, cases), "--out", str(tmp_path / "runs"), *options]) == 2
    assert says in capfd.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_what_a_killed_run_left_of_a_case_that_is_kept_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    left = tmp_path / "runs" / ".case.abcd1234.part"
    (left / "new").mkdir(parents=True)
    monkeypatch.setattr(batch, "kept", lambda job: Row(job.case.name, "kept", True, "", 0.0, {}))
    assert main(["batch", str(tmp_path / "case"), "--out", str(tmp_path / "runs")]) == 0
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["table.csv"]
