"""Processes that die take nothing with them but the run that ends them; a Dask cluster gives the same rows."""

import os
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path
from typing import Any

import pytest
from cheap_study import Cheap, study
from joblib import delayed

from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from sim.study.executors import OnCluster, OnThisMachine, _check_packages
from sim.study.processes import in_processes
from sim.study.rows import TABLE_NAME, comparable, read_table
from sim.study.study import run_study


def rows(out: Path) -> list[Any]:
    return comparable(read_table(out / TABLE_NAME))


def test_what_joblib_says_of_its_own_workers_does_not_reach_the_user() -> None:
    replaced = "A worker stopped while some jobs were given to the executor. This can be caused by a too short timeout."
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        list(in_processes(1, [delayed(warnings.warn)(text, UserWarning) for text in (replaced, "something else")]))
    assert [str(warning.message) for warning in told] == ["something else"]


@pytest.mark.long
def test_a_run_that_kills_its_process_is_given_up_and_the_others_are_made(tmp_path: Path) -> None:
    told = run_study(study(6, Cheap(deadly=2)), tmp_path, OnThisMachine(2))
    assert told.status == {"done": 5, "failed": 1}
    assert told.first_failure == "plain, procedure 2: its process was killed, perhaps for lack of memory"
    run_study(study(6, Cheap()), tmp_path, OnThisMachine(1))
    assert {row["status"] for row in rows(tmp_path)} == {"done"}


@pytest.mark.long
def test_a_cluster_gives_the_same_rows_and_survives_a_killed_worker(tmp_path: Path) -> None:
    run_study(study(40, Cheap()), tmp_path / "here", OnThisMachine(1))
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        work = Cheap(deadly=5, once=tmp_path / "killed")
        run_study(study(40, work), tmp_path / "there", OnCluster(cluster.scheduler_address))
    assert (tmp_path / "killed").exists()
    assert rows(tmp_path / "there") == rows(tmp_path / "here")


def test_a_cluster_that_is_not_there_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("sim.study.executors.PATIENCE", "1s")
    with pytest.raises(InputError, match=r"--scheduler tcp://127.0.0.1:9: does not answer"):
        run_study(study(1, Cheap()), tmp_path, OnCluster("tcp://127.0.0.1:9"))


def with_packages(**changed: str | None) -> dict[str, dict[str, str | None]]:
    names = ("dask", "distributed", "cloudpickle", "msgpack", "numpy", "femoreg_torch", "torch")
    return {"packages": {"python": "3.11.7.final.0", **dict.fromkeys(names, "1"), **changed}}


def test_a_cluster_with_other_packages_is_told() -> None:
    same = {"client": with_packages(), "scheduler": with_packages(), "workers": {"tcp://a": with_packages()}}
    _check_packages(same, "tcp://s")
    _check_packages({**same, "scheduler": with_packages(python="3.11.2.final.0", toolz="9")}, "tcp://s")
    says = r"--scheduler tcp://s: the scheduler has other packages .*: python 3\.12\.0\.final\.0 in .*, numpy 2 in"
    with pytest.raises(InputError, match=says):
        _check_packages({**same, "scheduler": with_packages(python="3.12.0.final.0", numpy="2")}, "tcp://s")
    with pytest.raises(
        InputError, match=r"the worker tcp://a has other packages .*: femoreg_torch \(none\) in place of 1"
    ):
        _check_packages({**same, "workers": {"tcp://a": with_packages(femoreg_torch=None)}}, "tcp://s")


@pytest.mark.long
def test_a_scheduler_that_goes_away_is_told_in_one_line_and_what_is_done_is_kept(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("distributed")
    run_study(study(2, Cheap()), tmp_path / "out", OnThisMachine(1))
    (tmp_path / "out" / TABLE_NAME).unlink()
    known = tmp_path / "scheduler.json"
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    command += ["--scheduler-file", str(known)]
    paths = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}  # it opens what it is sent
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, env=paths) as scheduler:
        try:
            for _ in range(300):
                if known.is_file():
                    break
                time.sleep(0.1)
            address = read_json(known)["address"]
            stop = threading.Timer(2.0, scheduler.kill)
            stop.start()
            with pytest.raises(InputError, match=f"--scheduler {address}: has gone"):  # no worker ever comes
                run_study(study(4, Cheap()), tmp_path / "out", OnCluster(address))
            stop.join()
        finally:
            scheduler.kill()
    assert len(rows(tmp_path / "out")) == 2
    assert "Traceback" not in capfd.readouterr().err
