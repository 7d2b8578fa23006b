"""The command line: what it finds, how it parses, and that bad input ends in one line and exit status 2."""

import os
import subprocess
import sys
import time
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import pytest
from rich.console import Console

import femoreg_torch
from femoreg_torch.commands import main as module
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.files import new_folder

FEMOREG = Path(sys.executable).with_name("femoreg")


def measure(
    images: list[Path],
    *,
    out: Path,
    carm: str = "cios_fusion",
    preset: Literal["paper", "fast"] = "paper",
    spacing_mm: float = 1.0,
    seed: int = 0,
    overlay: bool = False,
) -> None:
    """Measure the images, in words.

    It takes its time.

    Args:
        images: What to measure.
        out: Where to write.
        carm: The C-arm.
        preset: How well.
        spacing_mm: How coarse.
        overlay: Draw it, too.
    """
    print(images, out, carm, preset, spacing_mm, overlay)


def fail(kind: str, out: Path) -> None:
    """End in the way of `kind`."""
    with new_folder(out) as built:
        (built / "half.txt").write_text("half", encoding="utf-8")
        if kind == "bad":
            raise InputError("case.yaml, side: left or right\nwas expected.")
        if kind == "missing":
            (built / "no.txt").read_text(encoding="utf-8")
        if kind == "forbidden":
            raise PermissionError(13, "Permission denied", "locked.tif")
        if kind == "full":
            raise OSError(28, "No space left on device", "half.txt")
        if kind == "nameless":
            raise OSError(28, "No space left on device")
        if len(kind) > 1000:
            raise InputError(f"{kind}: is no kind.")
        if kind == "interrupted":
            raise KeyboardInterrupt
        raise ZeroDivisionError


def read(what: Literal["ct", "image", "case", "landmarks", "mesh"], path: Path) -> None:
    """Read a file of that kind."""
    from femoreg_torch import case, fluoro, volume

    {
        "ct": volume.read_ct,
        "image": fluoro.read_image,
        "case": case.read_case,
        "landmarks": volume.read_landmarks,
        "mesh": volume.read_mesh,
    }[what](path)


def train(config: Path) -> None:
    """A command that has a CONFIG of its own."""
    print(config)


def untyped(run) -> None:  # type: ignore[no-untyped-def]
    """A command whose parameter has no type."""


@pytest.fixture(autouse=True)
def commands(monkeypatch: pytest.MonkeyPatch) -> None:
    """The commands of this file in place of the installed ones, for this process."""
    points = [EntryPoint(name, f"{__name__}:{name}", module.GROUP) for name in ("measure", "fail", "read", "train")]
    monkeypatch.setattr(module, "entry_points", lambda group: points if group == module.GROUP else [])


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (
            "no_such_module:run",
            "the command own, no_such_module:run, cannot be imported (No module named 'no_such_module')",
        ),
        (f"{__name__}:gone", f"the command own, {__name__}:gone, cannot be imported (module"),
        (f"{__name__}:untyped", "the command own: its parameter `run` needs a type"),
    ],
)
def test_faults_of_a_command_of_another_package_are_told_by_its_name(
    value: str, says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "entry_points", lambda group: [EntryPoint("own", value, group)])
    assert main(["own", "x"]) == 2
    assert says in capsys.readouterr().err


def test_arguments_reach_the_function(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["measure", "a.png", "b.png", "--out", "run"]) == 0
    assert capsys.readouterr().out == f"{[Path('a.png'), Path('b.png')]} run cios_fusion paper 1.0 False\n"
    assert main(["measure", "a.png", "--out", "run", "--preset", "fast", "--spacing-mm", "2", "--overlay"]) == 0
    assert capsys.readouterr().out == f"{[Path('a.png')]} run cios_fusion fast 2.0 True\n"


def test_the_command_line_overrides_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "options.yaml").write_text("out: run\npreset: fast\nspacing_mm: 3\n", encoding="utf-8")
    assert main(["measure", "a.png", "--config", str(tmp_path / "options.yaml"), "--spacing-mm", "4"]) == 0
    assert capsys.readouterr().out == f"{[Path('a.png')]} run cios_fusion fast 4.0 False\n"


def test_aliases_in_a_text_of_the_file_are_not_followed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "options.yaml").write_text("out: run\nspacing_mm: '[&a [x], *a]'\n", encoding="utf-8")
    assert main(["measure", "a.png", "--config", str(tmp_path / "options.yaml")]) == 2
    assert "spacing_mm: '[&a [x], *a]' holds aliases" in capsys.readouterr().err.replace("'spacing_mm'", "spacing_mm")


def test_a_command_may_have_a_config_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", "small.yaml"]) == 0
    assert capsys.readouterr().out == "small.yaml\n"


def test_help_of_a_command_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["measure", "--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    for words in ("femoreg measure", "It takes its time.", "What to measure.", "--spacing-mm", "How coarse.", "paper"):
        assert words in text


def test_help_tells_kinds_of_values_in_words(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["measure", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for words in (
        "Where to write. (required; a path)",
        "The C-arm. (text; default: cios_fusion)",
        "(a number; default: 1.0)",
    ):
        assert words in text
    assert text.endswith("Draw it, too.")  # a flag has no value
    for foreign in ("<class", "null", "Literal", "type:"):
        assert foreign not in text


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["paint"], "no command 'paint'. There are: measure, fail, read, train."),
        (["--paint"], "no command '--paint'"),
        (["measure"], "`femoreg measure IMAGES --out OUT` was expected; IMAGES is missing, --out is missing. See"),
        (["measure", "a.png"], "IMAGES --out OUT` was expected; IMAGES is given, --out is missing."),
        (["measure", "a.png", "--out", "run", "--preset", "best"], "best"),
        (["measure", "a.png", "--out", "run", "--spacing-mm", "wide"], "wide"),
        (["measure", "a.png", "--out", "run", "--paint", "1"], "--paint"),
        (["measure", "a.png", "--out", "run", "--config", "no.yaml"], "no.yaml"),
        (["measure", "a.png", "--out", ""], "an argument is empty"),
        (["measure", "a.png", "--out="], "an argument is empty"),
        (["measure", "a.png", "--out", "run", "--spacing-mm", "[&a [x], *a]"], "measure: '[&a [x], *a]' holds aliases"),
        (["measure", "a.png", "--out", "run", "--spacing-mm=[&a [x], *a]"], "--spacing-mm: '[&a [x], *a]' holds"),
    ],
)
def test_wrong_arguments_are_one_line(argv: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(argv) == 2
    error = capsys.readouterr().err
    assert error.startswith("femoreg: ")
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("kind", "status", "message"),
    [
        ("bad", 2, "femoreg: case.yaml, side: left or right was expected.\n"),
        ("missing", 2, "no.txt: No such file or directory.\n"),
        ("forbidden", 2, "femoreg: locked.tif: Permission denied.\n"),
        ("interrupted", 130, "femoreg: interrupted.\n"),
    ],
)
def test_a_run_that_ends_early_says_why_and_leaves_nothing(
    tmp_path: Path, kind: str, status: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fail", kind, str(tmp_path / "run")]) == status
    error = capsys.readouterr().err
    assert error.endswith(message)
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_defect_is_one_line_and_keeps_its_traceback_for_who_asks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["fail", "defect", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert "defect: ZeroDivisionError" in error
    assert "test_main.py, line" in error
    assert error.count("\n") == 1
    monkeypatch.setenv("FEMOREG_TRACEBACK", "1")
    with pytest.raises(ZeroDivisionError):
        main(["fail", "defect", str(tmp_path / "run")])


@pytest.mark.parametrize("kind", ["full", "nameless"])
def test_a_full_disk_is_one_line(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fail", kind, str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert error.endswith("No space left on device.\n")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_message_is_cut_and_cannot_steer_a_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fail", "\x1b[31m" + "x" * 100_000, str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert len(error) < 2100
    assert "\x1b" not in error


@pytest.mark.parametrize("option", ["seed=-1", "seed=99999999999", "spacing-mm=0"])
def test_options_out_of_range_are_one_line(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["measure", "a.png", "--out", "run", f"--{option}"]) == 2
    error = capsys.readouterr().err
    assert "was expected" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("text", ["[" * 100_000, "out: !!bool abc", "a: &a [*a]", "out: run\nout: walk", "\xe7: [", ""])
def test_broken_option_files_are_one_line_that_names_them(
    tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "options.yaml").write_bytes(text.encode("latin-1"))
    assert main(["measure", "a.png", "--config", str(tmp_path / "options.yaml")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("femoreg: ")
    assert str(tmp_path / "options.yaml") in error
    assert error.count("\n") == 1
    assert len(error) < 2100


@pytest.mark.parametrize("what", ["ct", "image", "case", "landmarks", "mesh"])
@pytest.mark.parametrize("kind", ["missing", "garbage", "folder"])
def test_unreadable_files_are_one_line(tmp_path: Path, what: str, kind: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / {"ct": "ct.nii.gz", "image": "view.tif", "landmarks": "points.json", "mesh": "a.stl"}.get(
        what, "case"
    )
    if kind == "garbage":
        path.write_bytes(b"\x00garbage\xff" * 50)
    elif kind == "folder":
        path.mkdir()
    assert main(["read", what, str(path)]) == 2
    error = capfd.readouterr().err
    assert error.startswith(f"femoreg: {path}: ")
    assert error.count("\n") == 1


def test_another_package_replaces_no_command_of_this_one() -> None:
    def command(name: str, package: str) -> SimpleNamespace:
        return SimpleNamespace(name=name, dist=SimpleNamespace(name=package))

    own, theirs, more = command("fail", "femoreg-torch"), command("fail", "other"), command("paint", "other")
    for order in ([own, theirs, more], [theirs, own, more]):
        assert module._commands(cast(Any, order)) == {"fail": own, "paint": more}


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"femoreg {femoreg_torch.__version__}\n"


def test_the_installed_overview_is_quick_and_complete() -> None:
    start = time.perf_counter()
    done = subprocess.run([FEMOREG, "--help"], capture_output=True, encoding="utf-8", check=True)
    assert time.perf_counter() - start < 2  # 0.15 s on an idle machine: no command is imported
    for name in (
        "batch",
        "dataset",
        "demo",
        "detect",
        "evaluate",
        "navigate",
        "phantom",
        "register",
        "replay",
        "simulate",
        "train",
    ):
        (line,) = (line for line in done.stdout.splitlines() if line.startswith(f"  {name} "))
        assert len(line.split()) > 3
        assert "not installed" not in line
    assert done.stderr == ""


def test_a_data_set_is_asked_for_by_the_name_of_its_preset(tmp_path: Path) -> None:
    command = [FEMOREG, "dataset", "nothing", "--out", str(tmp_path / "views.h5")]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 2
    assert "'nothing'" in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("arguments", "status"), [(["--version"], 0), (["no-such-command"], 2)])
def test_the_installed_command_ends_with_its_status_after_all_that_was_registered(
    arguments: list[str], status: int
) -> None:
    code = (
        "import atexit, sys\n"
        "from femoreg_torch.commands import main\n"
        "inner = main.main\n"
        "main.main = lambda: (atexit.register(print, 'registered later'), inner())[1]\n"
        f"sys.argv = ['femoreg', *{arguments!r}]\n"
        "main.console_script()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, encoding="utf-8")
    assert ended.returncode == status
    assert ended.stdout.endswith("registered later\n")
    assert bool(ended.stderr) == (status == 2)


@pytest.mark.parametrize(
    ("redirected", "status", "lines"), [(">&-", 0, 0), ("<&- >&-", 0, 0), ("> /dev/full", 2, 1), ("| true", 0, 0)]
)
def test_streams_that_are_closed_or_full(redirected: str, status: int, lines: int) -> None:
    done = subprocess.run(["bash", "-c", f"'{FEMOREG}' --version {redirected}"], capture_output=True, check=False)
    assert done.returncode == status
    assert done.stderr.count(b"\n") == lines
    assert b"Traceback" not in done.stderr


def test_who_read_the_output_goes_while_a_table_is_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rich ends the process with 1 then, which is the status of a study whose run failed."""
    ours, theirs = os.pipe()
    os.close(ours)
    with os.fdopen(theirs, "w") as out:
        monkeypatch.setattr(sys, "stdout", out)
        monkeypatch.setattr(module, "_carry_out", lambda *_: Console().print("table"))
        assert main(["tables", "study"]) == 2


@pytest.mark.parametrize(("options", "lines"), [("", 0), ("-W default", 1)])
def test_letters_that_the_terminal_lacks_and_warnings_of_libraries(options: str, lines: int) -> None:
    code = (
        "import sys, warnings\n"
        "from femoreg_torch.commands import main\n"
        "main._carry_out = lambda *_: (warnings.warn('of a library'), print('64 \\u00d7 64'), 0)[2]\n"
        "main.console_script()"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, *options.split(), "-c", code]
    done = subprocess.run(command, env=environment, capture_output=True, check=False, encoding="utf-8")
    assert (done.returncode, done.stdout) == (0, "64 \\xd7 64\n")
    assert done.stderr.count("\n") == lines


def test_without_stderr_the_status_tells(tmp_path: Path) -> None:
    for redirected in ("2>&-", "2> /dev/full"):
        command = ["bash", "-c", f"'{FEMOREG}' nosuch {redirected}"]
        assert subprocess.run(command, capture_output=True, check=False).returncode == 2


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--seed", "1e308"], "--seed: a whole number was expected, found '1"),
        (["--seed", "1", "--seed=2"], "measure: '--seed' stands there twice"),
        (["--preset", "rough"], "--preset: one of 'paper', 'fast' was expected, found 'rough'"),
        (["--spacing-mm", ".."], "--spacing-mm: a number was expected, found '"),
    ],
)
def test_wrong_values_are_told_by_option_and_kind(
    arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["measure", "a.tif", "--out", "o", *arguments]) == 2
    assert says in capsys.readouterr().err


def test_a_mistyped_command_is_told_with_the_one_that_was_meant(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mesure"]) == 2
    assert "no command 'mesure'. Did you mean measure? There are: " in capsys.readouterr().err
