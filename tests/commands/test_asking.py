"""What a person types for a new case is asked for again until it is there."""

import io
from pathlib import Path

import pytest
from rich.console import Console

from femoreg_torch.commands import asking
from femoreg_torch.commands.asking import ask_for_missing
from femoreg_torch.errors import InputError
from femoreg_torch.intake import NewCase


def given_answers(monkeypatch: pytest.MonkeyPatch, *answers: str) -> tuple[NewCase, str]:
    """What a case becomes, and what the terminal says, as these lines are typed one after the other."""
    lines = iter(answers)
    monkeypatch.setattr(asking.Prompt, "ask", lambda *_, **__: next(lines))
    said = Console(file=io.StringIO(), width=500)
    asked = ask_for_missing(NewCase(segment=True), said)
    assert next(lines, None) is None  # nothing was typed for nothing
    return asked, said.file.getvalue()


@pytest.fixture
def files(tmp_path: Path) -> Path:
    for name in ("ct.nii.gz", "plan.mrk.json", "a 1.dcm", "b.dcm"):
        (tmp_path / name).write_bytes(b"something")
    return tmp_path


def test_a_misspelt_path_is_told_and_asked_for_again(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, said = given_answers(
        monkeypatch,
        f"{files}/ct.nii",
        f"{files}/ct.nii.gz",
        f"{files}/plan.mrk.json",
        "",
        f"'{files}/a 1.dcm {files}/b.dcm",
        f"'{files}/a 1.dcm' {files}/c.dcm",
        f"'{files}/a 1.dcm' {files}/b.dcm",
        "nosuch",
        "",
    )
    assert asked.ct == files / "ct.nii.gz"
    assert asked.images == (files / "a 1.dcm", files / "b.dcm")
    assert (asked.device, asked.carm) == (None, None)
    lines = said.splitlines()
    assert len(lines) == 4
    assert lines[0].startswith(f"{files}/ct.nii: ")
    assert "ct.nii.gz" in lines[0]
    assert "quotation" in lines[1]
    assert lines[2].startswith(f"{files}/c.dcm: ")
    assert "nosuch" in lines[3]


def test_what_must_be_there_is_asked_for_until_it_is(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(files))
    asked, said = given_answers(monkeypatch, "", "~/ct.nii.gz", "~/plan.mrk.json", "", "~/b.dcm", "")
    assert asked.ct == files / "ct.nii.gz"
    assert said == ""


def test_an_input_that_ends_is_told_with_what_was_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def at_its_end(*_: object, **__: object) -> str:
        raise EOFError

    monkeypatch.setattr(asking.Prompt, "ask", at_its_end)
    with pytest.raises(InputError, match=r"the input ended where this was asked for: .*CT"):
        ask_for_missing(NewCase(), Console(file=io.StringIO()))
