"""Nothing half-written is left behind, whenever a run is killed, and nothing else is touched."""

import errno
import json
import os
import random
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from fuzz_faults import FAULT, fault, full_after

from femoreg_torch import files
from femoreg_torch.errors import InputError
from femoreg_torch.files import (
    check_new_folder,
    clear_leftovers,
    new_folder,
    read_json,
    temporary_file,
    temporary_files,
    write_json,
    write_text,
)


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_a_new_folder_appears_only_when_complete(tmp_path: Path) -> None:
    with new_folder(tmp_path / "a" / "run") as built:
        (built / "result.json").write_text("{}", encoding="utf-8")
        assert not (tmp_path / "a" / "run").exists()
    assert names(tmp_path / "a") == ["run"]
    assert names(tmp_path / "a" / "run") == ["result.json"]


def fail_while_building(folder: Path) -> None:
    with new_folder(folder) as built:
        (built / "result.json").write_text("half", encoding="utf-8")
        raise RuntimeError


def test_a_failed_build_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        fail_while_building(tmp_path / "run")
    assert names(tmp_path) == []
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "result.json").write_text("old", encoding="utf-8")
    with pytest.raises(RuntimeError):
        fail_while_building(tmp_path / "run")
    assert names(tmp_path) == ["run"]
    assert (tmp_path / "run" / "result.json").read_text(encoding="utf-8") == "old"


def test_a_full_disk_is_told_with_the_name(tmp_path: Path) -> None:
    with full_after(100), pytest.raises(OSError, match="File too large") as raised:
        write_text(tmp_path / "a.txt", "a" * 1000)
    assert raised.value.filename == str(tmp_path / "a.txt")
    assert names(tmp_path) == []


def test_what_a_file_left_behind_in_a_new_folder_does_not_come_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed: list[Path | str] = []
    unlink, rmdir = os.unlink, os.rmdir

    def fails_once(real: Callable[..., None]) -> Callable[..., None]:
        def remove(path: Path | str, **where: int) -> None:
            if not failed:
                failed.append(path)
                raise OSError(errno.EIO, os.strerror(errno.EIO), str(path))
            real(path, **where)

        return remove

    for name, real in (("unlink", unlink), ("rmdir", rmdir)):
        failed.clear()
        monkeypatch.setattr(os, name, fails_once(real))
        with new_folder(tmp_path / "run") as built:
            (built / "deep").mkdir()
            write_text(built / "deep" / "result.json", "{}")
            assert failed
        monkeypatch.setattr(os, name, real)
        assert [str(p.relative_to(tmp_path)) for p in sorted(tmp_path.rglob("*"))] == [
            "run", "run/deep", "run/deep/result.json"
        ]  # fmt: skip


def test_only_what_was_built_is_replaced(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "pictures").mkdir(parents=True)
    (run / "pictures" / "old.png").write_text("old", encoding="utf-8")
    (run / "result.json").write_text("old", encoding="utf-8")
    (run / "notes.txt").write_text("mine", encoding="utf-8")
    with new_folder(run) as built:
        (built / "result.json").write_text("new", encoding="utf-8")
        (built / "pictures").mkdir()
        (built / "pictures" / "new.png").write_text("new", encoding="utf-8")
    assert names(run) == ["notes.txt", "pictures", "result.json"]
    assert (run / "notes.txt").read_text(encoding="utf-8") == "mine"
    assert (run / "result.json").read_text(encoding="utf-8") == "new"
    assert names(run / "pictures") == ["new.png"]
    assert names(tmp_path) == ["run"]


@pytest.fixture(params=["exchange", "two renames"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """How a folder is replaced: as this system can, or as where two folders cannot be exchanged."""
    if request.param == "two renames":
        monkeypatch.setattr(files, "exchange", lambda first, second: False)
    return request.param


def test_what_is_kept_is_linked_and_looks_as_before(tmp_path: Path, way: str) -> None:
    run = tmp_path / "run"
    (run / "deep" / "er").mkdir(parents=True)
    large = run / "deep" / "er" / "ct.nii.gz"
    large.write_bytes(bytes(1 << 20))
    (run / "deep" / "to the large one").symlink_to("er/ct.nii.gz")
    (run / "elsewhere").symlink_to(tmp_path / "no such file")
    (run / "a folder").symlink_to("deep")
    (run / "report.html").write_text("of the old result", encoding="utf-8")
    run.chmod(0o750)
    inode = large.stat().st_ino
    with new_folder(run, without=["report.html", "not there"]) as built:
        (built / "result.json").write_text("new", encoding="utf-8")
        (built / "elsewhere").write_text("a file now", encoding="utf-8")
    assert names(run) == ["a folder", "deep", "elsewhere", "result.json"]
    assert large.stat().st_ino == inode
    assert (run / "deep" / "to the large one").readlink() == Path("er/ct.nii.gz")
    assert (run / "a folder").readlink() == Path("deep")
    assert not (run / "elsewhere").is_symlink()
    assert run.stat().st_mode & 0o777 == 0o750
    assert names(tmp_path) == ["run"]


def test_where_there_are_no_links_files_are_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_link(*_: object, **__: object) -> None:
        raise OSError(1, "Operation not permitted")

    (tmp_path / "run" / "deep").mkdir(parents=True)
    (tmp_path / "run" / "deep" / "ct.nii.gz").write_text("a CT", encoding="utf-8")
    (tmp_path / "run" / "link").symlink_to("deep")
    monkeypatch.setattr(os, "link", no_link)
    with new_folder(tmp_path / "run") as built:
        (built / "result.json").write_text("new", encoding="utf-8")
    assert (tmp_path / "run" / "deep" / "ct.nii.gz").read_text(encoding="utf-8") == "a CT"
    assert (tmp_path / "run" / "link").readlink() == Path("deep")


def test_a_folder_by_another_name_is_replaced_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    (tmp_path / "real" / "run").mkdir(parents=True)
    (tmp_path / "link").symlink_to("real/run")
    monkeypatch.chdir(tmp_path / "real" / "run")
    for number, path in enumerate((Path(), Path("no/.."), tmp_path / "link")):
        with new_folder(path) as built:
            (built / f"{number}.txt").write_text("new", encoding="utf-8")
        assert Path(f"{number}.txt").read_text(encoding="utf-8") == "new"  # a relative path means the new folder
    assert (tmp_path / "link").is_symlink()
    assert names(tmp_path / "real" / "run") == ["0.txt", "1.txt", "2.txt"]
    assert names(tmp_path / "real") == ["run"]


def test_what_cannot_be_replaced_as_a_whole_is_told_before_anything_is_done() -> None:
    with pytest.raises(InputError, match="/proc: is a mount point"), new_folder(Path("/proc")):
        raise AssertionError("not reached")


WRITER = """
import sys
from pathlib import Path
from femoreg_torch import files

if sys.argv[2] == "two renames":
    files.exchange = lambda first, second: False

def write(text):
    with files.new_folder(Path(sys.argv[1])) as built:
        for name in ("result.json", "deep/navigation.json"):
            (built / name).parent.mkdir(exist_ok=True)
            (built / name).write_text(text)
"""
WRITER_OF_TWO = """
import sys
from pathlib import Path
from femoreg_torch import files

def write(text):
    folder = Path(sys.argv[1])
    with files.temporary_files(folder / "a.json", folder / "b.json") as parts:
        for part in parts:
            part.write_text(text)
"""
EVERY_STEP = """
import os, signal

def killed_at(step):
    count = 0
    def hook(event, arguments):
        nonlocal count
        count += 1
        if count == step:
            os.kill(os.getpid(), signal.SIGKILL)
    child = os.fork()
    if child == 0:
        sys.addaudithook(hook)
        write("new")
        os._exit(0)
    return os.waitpid(child, 0)[1] == signal.SIGKILL

step = 1
write("old")
while killed_at(step):
    found = [path.read_text() for path in sorted(Path(sys.argv[1]).glob("**/*.json")) if ".part" not in str(path)]
    print(step, *found, flush=True)
    write("old")
    step += 1
"""
FOR_EVER = (
    WRITER
    + """
for number in range(10**9):
    write(str(number))
    print(number, flush=True)
"""
)


def test_killed_at_every_step_a_writer_leaves_all_old_or_all_new(tmp_path: Path, way: str) -> None:
    """Python tells of each call to the system before it is made: there the writer is killed, one step later each time.

    Between two renames, where folders cannot be exchanged, there is nothing; the next writer finds the old folder.
    """
    run = tmp_path / "run"
    done = subprocess.run(
        [sys.executable, "-c", WRITER + EVERY_STEP, str(run), way], capture_output=True, encoding="utf-8", check=True
    )
    found = [tuple(line.split()[1:]) for line in done.stdout.splitlines()]
    assert found.count(("old", "old")) > 10
    assert found.count(("new", "new")) > 3
    allowed = {("old", "old"), ("new", "new")} | ({()} if way == "two renames" else set())
    assert set(found) == allowed
    assert names(tmp_path) == ["run"]  # the last writer removed what the killed ones had left


def test_killed_at_any_moment_a_writer_leaves_files_that_agree(tmp_path: Path, way: str) -> None:
    run, moments = tmp_path / "run", random.Random(0)
    for _ in range(60):
        with subprocess.Popen([sys.executable, "-c", FOR_EVER, str(run), way], stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            writer.stdout.readline()
            time.sleep(moments.uniform(0, 0.02))
            writer.kill()
        with new_folder(run) as built:  # brings an old folder back that was renamed away
            (built / "notes.txt").write_text("mine", encoding="utf-8")
        assert (run / "result.json").read_text(encoding="utf-8") == (run / "deep" / "navigation.json").read_text(
            encoding="utf-8"
        )
        assert names(tmp_path) == ["run"]


def test_a_folder_is_cleared_of_what_killed_writers_left_of_anything_in_it(tmp_path: Path) -> None:
    (tmp_path / ".gone.abcd1234.part" / "old").mkdir(parents=True)
    (tmp_path / ".gone.abcd1234.part" / "old" / "result.json").write_text("{}", encoding="utf-8")
    (tmp_path / ".kept.abcd1234.part" / "old").mkdir(parents=True)
    (tmp_path / "kept").mkdir()
    (tmp_path / ".notes.part").mkdir()
    with new_folder(tmp_path / "live") as built:
        clear_leftovers(tmp_path)
        (built / "result.json").write_text("{}", encoding="utf-8")
    assert names(tmp_path) == [".notes.part", "gone", "kept", "live"]
    assert names(tmp_path / "gone") == names(tmp_path / "live") == ["result.json"]


def test_what_a_live_writer_builds_is_not_taken_for_a_leftover(tmp_path: Path) -> None:
    with new_folder(tmp_path / "run") as first, temporary_file(tmp_path / "run.json") as file:
        (first / "a.txt").write_text("first", encoding="utf-8")
        file.write_text("{}", encoding="utf-8")
        with new_folder(tmp_path / "run") as second, temporary_file(tmp_path / "run.json") as again:
            (second / "b.txt").write_text("second", encoding="utf-8")
            again.write_text("[]", encoding="utf-8")
    assert names(tmp_path / "run") == ["a.txt", "b.txt"]
    assert (tmp_path / "run.json").read_text(encoding="utf-8") == "{}"
    assert names(tmp_path) == ["run", "run.json"]


@pytest.mark.parametrize("name", ["lock", "new", "old"])
def test_no_name_is_special(tmp_path: Path, name: str) -> None:
    write_text(tmp_path / name, "text")
    assert (tmp_path / name).read_text(encoding="utf-8") == "text"
    with new_folder(tmp_path / "run") as built:
        write_text(built / name, "text")
    assert names(tmp_path / "run") == [name]


def test_a_file_in_the_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file", encoding="utf-8")
    with pytest.raises(InputError, match="is a file, a folder was expected"), new_folder(tmp_path / "run"):
        pass


def test_a_file_in_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder"):
        write_text(tmp_path / "no" / "a.txt", "text")


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text(encoding="utf-8") for path in sorted(folder.iterdir())}


@pytest.mark.parametrize("old", [{}, {"a": "old", "b": "old", "c": "old"}, {"b": "old"}])
def test_files_that_belong_together_are_all_old_or_all_new_whichever_step_fails(
    old: dict[str, str], tmp_path: Path
) -> None:
    for n in range(1, 40):
        for path in tmp_path.iterdir():
            path.unlink()
        for name, text in old.items():
            (tmp_path / name).write_text(text, encoding="utf-8")
        with fault(tmp_path, n):
            try:
                with temporary_files(*(tmp_path / name for name in "abc")) as parts:
                    for part in parts:
                        part.write_text("new", encoding="utf-8")
                found = dict.fromkeys("abc", "new")
            except OSError:
                found = old
            happened = FAULT.left == 0
        assert contents(tmp_path) == found
        if not happened:
            assert n > 8
            return
    raise AssertionError("more steps than expected")


def test_killed_at_every_step_no_file_stands_beside_one_that_it_does_not_describe(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WRITER_OF_TWO + EVERY_STEP, str(tmp_path)],
        capture_output=True,
        encoding="utf-8",
        check=True,
    )
    found = {tuple(line.split()[1:]) for line in done.stdout.splitlines()}
    assert {("old", "old"), ("new", "new")} <= found <= {("old", "old"), ("new", "new"), ("old",), ("new",)}
    assert names(tmp_path) == ["a.json", "b.json"]


@pytest.mark.parametrize("kind", ["folder", "device", "pipe", "long"])
def test_what_is_no_file_is_not_replaced(kind: str, tmp_path: Path) -> None:
    path = {"device": Path("/dev/null"), "long": tmp_path / ("x" * 250)}.get(kind, tmp_path / kind)
    if kind == "folder":
        path.mkdir()
    if kind == "pipe":
        os.mkfifo(path)
    with pytest.raises(InputError, match=r"is not replaced|too long"):
        write_text(path, "text")


def test_json_is_readable_and_exact_to_nine_decimals(tmp_path: Path) -> None:
    content = {
        "T": torch.eye(4, dtype=torch.float64) / 3,
        "names": ["FH-l", "a [b] c"],
        "path": Path("a/b"),
        "n": np.int64(3),
        "nothing": float("nan"),
        "minus": -1e-12,
        "deep": [{"p": [1, 2.5]}],
    }
    write_json(tmp_path / "a.json", content)
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert "  [0.333333333, 0.0, 0.0, 0.0],\n" in text  # one row of a matrix, one line
    assert "-0.0" not in text
    again = read_json(tmp_path / "a.json")
    assert again == json.loads(text)
    assert again["names"] == ["FH-l", "a [b] c"]
    assert (again["path"], again["n"], again["nothing"], again["deep"]) == ("a/b", 3, None, [{"p": [1, 2.5]}])
    assert names(tmp_path) == ["a.json"]


@pytest.mark.parametrize("kind", ["loop", "file", "below a file", "long", "null", "a long name", "deep"])
def test_where_no_folder_can_be_is_told_before_anything_is_computed(tmp_path: Path, kind: str) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    path = {
        "below a file": tmp_path / "file" / "run",
        "long": tmp_path / ("x" * 5000),
        "null": tmp_path / "a\0b",
        "a long name": tmp_path / ("x" * 250),  # that of the hidden folder beside it would be too long
        "deep": tmp_path / ("x/" * 1900),
    }.get(kind, tmp_path / kind)
    with pytest.raises(InputError) as raised:
        check_new_folder(path)
    assert len(str(raised.value)) < 500
    with pytest.raises(InputError), new_folder(path):
        pass
    assert names(tmp_path) == ["file", "loop"]
    assert check_new_folder(tmp_path / "new" / "run") == tmp_path.resolve() / "new" / "run"


def test_the_folder_that_is_read_is_not_written(tmp_path: Path) -> None:
    (tmp_path / "case").mkdir()
    (tmp_path / "link").symlink_to("case")
    for out in (tmp_path / "case", tmp_path / "link", tmp_path / "case" / "run" / ".."):
        with pytest.raises(InputError, match="is the folder that is read"):
            check_new_folder(out, tmp_path / "case")
    check_new_folder(tmp_path / "case" / "run", tmp_path / "case")
    check_new_folder(tmp_path / "case", tmp_path / "nowhere")
