"""`femoreg batch`: processes that die, what is kept of earlier runs, and input that cannot be a batch."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from test_batch_resumed import PRESET, table, write_case

from femoreg_torch.commands import batch
from femoreg_torch.commands.batch import Job, Row, kept, run_job, run_jobs
from femoreg_torch.commands.main import main
from femoreg_torch.files import only_writer


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


def test_fewer_threads_by_the_environment_than_cores_are_no_defect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A queue that sets NUMBA_NUM_THREADS=1 on a machine of many cores: numba takes no larger number."""
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    job = Job(tmp_path / "none", tmp_path / "run", "fast", 0, None, 2)
    ((_, row),) = run_jobs([job], 1)
    assert row.status == "refused"
    assert "none: no such folder" in row.reasons


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


def test_a_log_tells_every_case_as_it_ends(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["batch", str(tmp_path / "none"), "--out", str(tmp_path / "runs")]) == 2
    told = capfd.readouterr().out.splitlines()
    assert told[0] == "1 of 1: none refused"
    assert any("refused" in line and "–" in line for line in told[1:])


def text_as_weights(root: Path) -> Path:
    path = root / "weights.safetensors"
    path.write_text("no weights", encoding="utf-8")
    os.utime(path, (0, 0))
    return path


@pytest.fixture
def job(tmp_path: Path) -> Job:
    """A case that was registered, with its plan elsewhere."""
    case, plan = tmp_path / "case", tmp_path / "plans" / "plan.json"
    write_case(case, 1)
    plan.parent.mkdir()
    plan.write_text(json.dumps({"plan": {"entry_point": [0, 0, 0], "target": [9, 0, 0]}}), encoding="utf-8")
    with (case / "case.yaml").open("a", encoding="utf-8") as file:
        file.write("plan: {object: block, file: ../plans/plan.json}\n")
    preset = tmp_path / "preset.yaml"
    preset.write_text(PRESET.replace("candidates: 40, starts: 2, max_iterations: 8", "max_iterations: 1"))
    done = Job(case, tmp_path / "runs" / "case", str(preset), 0, None, 1)
    assert run_job(done).status == "done"
    return done


def older(path: Path, old: str, new: str) -> None:
    """Change a file, and let its time of change lie far back, as that of a file that is moved here."""
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    os.utime(path, (0, 0))


@pytest.mark.parametrize(
    "change",
    [
        lambda root: older(root / "plans" / "plan.json", "9", "8"),
        lambda root: older(root / "preset.yaml", "max_iterations: 1", "max_iterations: 2"),
        lambda root: older(root / "case" / "case.yaml", "sdd_mm: 1020", "sdd_mm: 1021"),
        lambda root: (root / "case" / "view2.tif").replace(root / "case" / "view1.tif"),
        lambda root: older(root / "runs" / "case" / "result.json", '"inputs"', '"others"'),
    ],
    ids=["plan elsewhere", "preset", "case.yaml", "image", "run of before there were digests"],
)
def test_a_run_of_other_files_is_not_kept(change: Callable[[Path], None], job: Job, tmp_path: Path) -> None:
    row = kept(job)
    assert row is not None
    assert row.status == "kept"
    change(tmp_path)
    assert kept(job) is None


def test_a_run_is_kept_for_its_weights_and_options_alone(job: Job, tmp_path: Path) -> None:
    assert kept(Job(job.case, job.out, job.preset, job.seed, text_as_weights(tmp_path), 1)) is None
    assert kept(Job(job.case, job.out, job.preset, 1, None, 1)) is None
    for path in job.case.iterdir():
        os.utime(path)  # touched, and the same
    assert kept(job) is not None
    start = tmp_path / "start.json"
    start.write_text((job.out / "result.json").read_text(encoding="utf-8"), encoding="utf-8")
    start.write_text(json.dumps({"camera1_from_block": json.loads(start.read_text())["camera_from_block"][0]}))
    order = ["register", str(job.case), "--out", str(job.out), "--preset", job.preset]
    assert main([*order, "--start", str(start)]) == 0
    assert kept(job) is None  # it was registered from another start
    assert main(order) == 0
    assert kept(job) is not None


def test_weights_that_are_none_are_told_once_before_any_case(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    cases = [str(tmp_path / "a"), str(tmp_path / "b"), "--weights", str(text_as_weights(tmp_path))]
    assert main(["batch", *cases, "--out", str(tmp_path / "runs")]) == 2
    told = capfd.readouterr().err
    assert "weights.safetensors: cannot be read as safetensors" in told
    assert told.count("\n") == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("out", "says"),
    [("case", "lies in"), ("case/runs", "lies in"), (".", "lies in"), ("case/case.yaml", "is a file, a folder was")],
)
def test_runs_are_written_neither_into_a_case_nor_over_a_file(
    out: str, says: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_case(tmp_path / "case", 1)
    before = sorted(tmp_path.rglob("*"))
    assert main(["batch", str(tmp_path / "case"), "--out", str(tmp_path / out)]) == 2
    told = capfd.readouterr().err
    assert says in told
    assert told.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_two_commands_do_not_share_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(batch, "kept", lambda job: Row(job.case.name, "kept", True, "", 0.0, {}))
    order = ["batch", str(tmp_path / "case"), "--out", str(tmp_path / "runs")]
    (tmp_path / "runs").mkdir()
    with only_writer(tmp_path / "runs"):
        assert main(order) == 2
    assert "another command is writing there" in capfd.readouterr().err
    assert main(order) == 0
    assert [row["status"] for row in table(tmp_path / "runs")] == ["kept"]
