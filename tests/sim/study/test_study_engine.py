"""Every run of a study is made once and kept, whatever happens to the processes that make it."""

import errno
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.compute as pc
import pytest
from cheap_study import Cheap, command, study

from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json, write_json
from sim.study import owner
from sim.study import store as module
from sim.study import study as study_module
from sim.study.executors import OnThisMachine
from sim.study.rows import TABLE_NAME, comparable, read_table
from sim.study.store import Store
from sim.study.study import run_study

HERE = OnThisMachine(1)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """The rows of forty runs that nothing happened to."""
    out = tmp_path_factory.mktemp("undisturbed")
    run_study(study(40, Cheap()), out, HERE)
    return rows(out)


def rows(out: Path) -> list[Any]:
    return comparable(read_table(out / TABLE_NAME))


def test_a_row_for_every_run_in_their_order(undisturbed: list[Any]) -> None:
    assert [row["number"] for row in undisturbed] == list(range(1, 41))
    statuses = {row["number"]: row["status"] for row in undisturbed}
    assert [number for number, status in statuses.items() if status == "refused"] == [7, 17, 27, 37]
    assert set(statuses.values()) == {"done", "refused"}
    assert undisturbed[6]["reason"] == "too few landmarks"
    assert undisturbed[6]["trusted"] is False
    assert undisturbed[6]["pelvis_mm"] is None
    assert len({row["seed"] for row in undisturbed}) == 40


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.long)])
def test_a_command_that_is_killed_three_times_ends_as_an_undisturbed_one(
    jobs: int, tmp_path: Path, undisturbed: list[Any]
) -> None:
    context = get_context("forkserver")
    context.set_forkserver_preload(["cheap_study"])
    for count in (6, 15, 27):
        process = context.Process(target=command, args=(tmp_path, jobs))
        process.start()
        wait_for_runs(tmp_path, count, process)
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        assert process.exitcode == -signal.SIGKILL
        assert count <= len(list((tmp_path / "runs").glob("*.json"))) < 40
        assert not (tmp_path / TABLE_NAME).exists()
    run_study(study(40, Cheap()), tmp_path, OnThisMachine(jobs))
    assert rows(tmp_path) == undisturbed


def wait_for_runs(out: Path, count: int, process: Any) -> None:
    until = time.monotonic() + 600  # on a machine that does much else
    while len(list((out / "runs").glob("*.json"))) < count:
        assert time.monotonic() < until
        assert process.is_alive()
        time.sleep(0.002)


def test_what_is_done_is_not_done_again(tmp_path: Path, undisturbed: list[Any]) -> None:
    made: list[int] = []
    run_study(study(15, Cheap()), tmp_path, HERE)
    told: list[tuple[int, int, int]] = []
    run_study(study(40, Cheap()), tmp_path, HERE, begin=lambda *counts: told.append(counts), progress=made.append)
    assert told == [(25, 15, 0)]
    assert made == [1] * 25
    assert rows(tmp_path) == undisturbed
    assert list((tmp_path / "scratch").iterdir()) == []


@pytest.fixture
def small_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Path]]:
    """A disk that is full after eleven records."""
    written: list[Path] = []

    def write(path: Path, content: dict[str, Any]) -> None:
        if len(written) == 11:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(path)
        write_json(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(module, "write_json", write)
        yield written


def test_a_full_disk_is_told_in_one_line_and_the_study_goes_on_once_there_is_room(
    tmp_path: Path, small_disk: list[Path], undisturbed: list[Any]
) -> None:
    with pytest.raises(InputError, match=r"No space left on device.*make room") as told:
        run_study(study(40, Cheap()), tmp_path, HERE)
    assert "\n" not in str(told.value)
    assert len(small_disk) == 11
    small_disk.clear()  # room for eleven more
    with pytest.raises(InputError, match="No space left"):
        run_study(study(40, Cheap()), tmp_path, HERE)
    assert len(list((tmp_path / "runs").iterdir())) == 22
    small_disk.extend([tmp_path] * 100)
    run_study(study(40, Cheap()), tmp_path, HERE)
    assert rows(tmp_path) == undisturbed


def test_a_failure_on_a_disk_without_room_is_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Libraries that write images tell it as some error of theirs."""
    full = SimpleNamespace(total=1, used=1, free=1000)
    monkeypatch.setattr("sim.study.engine.shutil.disk_usage", lambda _: full)
    with pytest.raises(InputError, match="No space left"):
        run_study(study(9, Cheap(broken=("plain",))), tmp_path, HERE)
    assert len(list((tmp_path / "runs").iterdir())) == 2  # those before the first that failed


def test_an_interrupted_study_leaves_the_table_of_what_is_done(tmp_path: Path, undisturbed: list[Any]) -> None:
    made: list[int] = []

    def interrupt(done: int) -> None:
        made.append(done)
        if len(made) == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(study(40, Cheap()), tmp_path, HERE, progress=interrupt)
    assert rows(tmp_path) == undisturbed[:5]
    run_study(study(40, Cheap()), tmp_path, HERE)
    assert rows(tmp_path) == undisturbed


def test_the_table_is_renewed_along_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study_module, "_TABLE_S", 0.0)
    monkeypatch.setattr(study_module, "_TABLE_SHARE", 1e9)
    seen: list[int] = []

    def look(_: int) -> None:
        if (tmp_path / TABLE_NAME).exists():
            seen.append(len(rows(tmp_path)))

    run_study(study(5, Cheap()), tmp_path, HERE, progress=look)
    assert seen == [1, 2, 3, 4]


def test_a_run_that_fails_is_told_with_its_place_and_tried_again(tmp_path: Path) -> None:
    names = ("plain", "brittle")
    told = run_study(study(9, Cheap(broken=("brittle",)), names), tmp_path, HERE)
    assert told.status == {"done": 13, "refused": 2, "failed": 3}
    assert told.first_failure is not None
    where, line = told.first_failure.split(", line ")
    assert where == "brittle, procedure 3: ZeroDivisionError: a defect in two lines (cheap_study.py"
    assert line.endswith(")")
    table = read_table(told.table)
    assert table.num_rows == 18
    failed = table.filter(pc.equal(table["status"], "failed")).to_pylist()
    assert [(row["condition"], row["number"], row["trusted"]) for row in failed] == [
        ("brittle", number, False) for number in (3, 6, 9)
    ]
    assert all(row["seed"] and row["patient"] and row["kind"] == "procedural" for row in failed)
    made: list[int] = []
    told = run_study(study(9, Cheap(), names), tmp_path, HERE, progress=made.append)
    assert sum(made) == 3
    assert told.status == {"done": 16, "refused": 2}


def test_runs_of_other_settings_stay_and_do_not_mix(tmp_path: Path) -> None:
    one, other = (study(6, Cheap(), settings=letter * 16) for letter in "ab")
    run_study(one, tmp_path, HERE)
    before = rows(tmp_path)
    told: list[tuple[int, int, int]] = []
    run_study(other, tmp_path, HERE, begin=lambda *counts: told.append(counts))
    assert {row["settings"] for row in rows(tmp_path)} == {"b" * 16}
    run_study(one, tmp_path, HERE, begin=lambda *counts: told.append(counts))
    assert rows(tmp_path) == before
    assert told == [(6, 0, 6), (0, 6, 6)]


def test_runs_of_other_code_are_made_anew_unless_they_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_study(study(6, Cheap()), tmp_path, HERE)
    before = rows(tmp_path)
    monkeypatch.setattr(study_module, "library_and_simulator", lambda: "other code")
    told: list[tuple[int, int, int]] = []
    run_study(study(6, Cheap()), tmp_path, HERE, reuse=True, begin=lambda *counts: told.append(counts))
    assert rows(tmp_path) == before
    run_study(study(6, Cheap()), tmp_path, HERE, begin=lambda *counts: told.append(counts))
    assert told == [(0, 6, 0), (6, 0, 0)]
    assert {row["code"] for row in rows(tmp_path)} == {"other code"}


def test_a_damaged_record_is_made_anew(tmp_path: Path) -> None:
    run_study(study(3, Cheap()), tmp_path, HERE)
    before = rows(tmp_path)
    next((tmp_path / "runs").glob("*-00002-*.json")).write_text("{", encoding="utf-8")
    run_study(study(3, Cheap()), tmp_path, HERE)
    assert rows(tmp_path) == before


def test_two_commands_do_not_share_a_folder(tmp_path: Path) -> None:
    with Store(tmp_path, "code").in_charge(), pytest.raises(InputError, match=r"another command .*process") as told:
        run_study(study(3, Cheap()), tmp_path, HERE)
    assert "\n" not in str(told.value)
    assert list(tmp_path.iterdir()) == []
    run_study(study(3, Cheap()), tmp_path, HERE)
    assert not (tmp_path / owner.NAME).exists()


def test_scratch_of_killed_processes_is_removed_and_that_of_live_ones_is_not(tmp_path: Path) -> None:
    store = Store(tmp_path, "code")
    store.prepare()
    with store.scratch(4) as live:
        for number, changes in ((5, {"process": ended()}), (6, {"started": 0.0}), (7, {"machine": "another"})):
            left = tmp_path / "scratch" / f"{number:05d}-left"
            left.mkdir()
            write_json(left / owner.NAME, read_json(live / owner.NAME) | changes)
        assert store.clear_killed() == {5, 6}
        os.utime(left, (0, 0))
        assert store.clear_killed() == {7}
        assert [path.name for path in (tmp_path / "scratch").iterdir()] == [live.name]


def ended() -> int:
    """The number of a process that has come to its end."""
    process = subprocess.Popen(["true"])
    process.wait()
    return process.pid


def test_a_folder_of_a_killed_command_is_taken_over(tmp_path: Path) -> None:
    store, path = Store(tmp_path, "code"), tmp_path / owner.NAME
    with store.in_charge():
        mine = read_json(path)
    write_json(path, mine | {"process": ended()})
    with store.in_charge():
        assert read_json(path)["process"] == os.getpid()
    write_json(path, mine | {"machine": "another", "host": "another"})
    with pytest.raises(InputError, match=r"on another.* 2 minutes"), store.in_charge():
        pass
    long_ago = time.time() - owner.GONE_S - 1
    os.utime(path, (long_ago, long_ago))
    with store.in_charge():
        assert read_json(path)["machine"] == mine["machine"]
    path.touch()  # just made, and not written yet
    with pytest.raises(InputError, match="another command"), store.in_charge():
        pass


def test_of_many_commands_at_the_same_time_one_gets_the_folder(tmp_path: Path) -> None:
    write_json(tmp_path / owner.NAME, {"machine": owner._machine(), "process": ended(), "started": 0.0})
    inside, most, got = [], [], []
    together = threading.Barrier(8)

    def try_it() -> None:
        together.wait()
        try:
            with Store(tmp_path, "code").in_charge():
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.05)
                inside.pop()
                got.append(1)
        except InputError:
            pass

    threads = [threading.Thread(target=try_it) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert got
    assert max(most) == 1


def test_an_owner_that_lives_is_heard_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(owner, "BEAT_S", 0.01)
    path = tmp_path / owner.NAME
    with Store(tmp_path, "code").in_charge():
        os.utime(path, (0, 0))
        until = time.monotonic() + 60
        while path.stat().st_mtime == 0:
            assert time.monotonic() < until
            time.sleep(0.01)
