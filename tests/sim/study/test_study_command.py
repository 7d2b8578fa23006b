"""`femoreg study` as a command: its help, bad input in one line, and a whole small study."""

from pathlib import Path

import pandas as pd
import pytest
import yaml
from cheap_study import Cheap, study

from femoreg_torch.commands.main import main
from sim.study import study as module
from sim.study.study import Study


@pytest.fixture
def cheap(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs that take no time in place of those of the protocol."""

    def plan(config: str, procedures: int | None, out: Path, data: Path | None, keep_cases: bool) -> Study:
        return study(procedures or 4, Cheap(broken=("brittle",)), (config,))

    monkeypatch.setattr(module, "plan_study", plan)


@pytest.mark.usefixtures("cheap")
def test_a_study_is_made_and_then_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "plain", "-n", "3", "--out", str(tmp_path)]) == 0
    assert "3 done" in capsys.readouterr().out
    assert main(["study", "plain", "--procedures", "5", "--out", str(tmp_path)]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "3 of 5 runs are there already" in told
    assert "5 done" in told
    assert len(pd.read_parquet(tmp_path / "runs.parquet")) == 5


@pytest.mark.usefixtures("cheap")
def test_a_failed_run_is_told_and_the_status_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "brittle", "-n", "3", "--out", str(tmp_path)]) == 1
    told = " ".join(capsys.readouterr().out.split())
    assert "2 done, 1 failed" in told
    assert "brittle, procedure 3: ZeroDivisionError" in told


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["nothing"], "there are: "),
        (["paper", "-n", "0"], "--procedures: 1 to"),
        (["paper", "-n", "many"], "many"),
        (["paper", "--jobs", "0"], "--jobs: 1 to"),
        (["cadaver"], "has no `vary`"),
        (["paper", "--data", "nowhere"], "nowhere/meshes/bmf.npz"),
    ],
)
def test_bad_input_is_one_line(
    options: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", *options, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_place_of_the_folder_is_told_before_any_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").touch()
    assert main(["study", "paper", "-n", "1", "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr()
    assert "out: is a file, a folder was expected. Choose another name" in told.err
    assert told.out == ""


@pytest.mark.long  # two procedures, some minutes each
def test_two_real_procedures_and_their_registration_once_more_as_recorded_ones(tmp_path: Path) -> None:
    out = tmp_path / "simulated"
    assert main(["study", "paper", "-n", "2", "--keep-cases", "--out", str(out)]) == 0
    first = pd.read_parquet(out / "runs.parquet")
    assert list(first.status) == ["done", "done"]
    assert list(first.patient) == ["10001", "10002"]
    assert (first.relative_mm < 4).all()
    assert first.trusted.all()

    content = {"cases": [str(out / "cases" / "*")], "vary": [{"name": "again"}]}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    assert main(["study", str(tmp_path / "own.yaml"), "--out", str(tmp_path / "own")]) == 0
    again = pd.read_parquet(tmp_path / "own" / "runs.parquet")
    assert list(again.kind) == ["recorded", "recorded"]
    assert (again.relative_mm < 4).all()
