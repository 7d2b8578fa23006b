"""Asking in the terminal for what a new case lacks."""

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.prompt import Prompt

from femoreg_torch.errors import InputError, shortened
from femoreg_torch.geometry import load_carm
from femoreg_torch.intake import NewCase
from femoreg_torch.paths import check_readable
from femoreg_torch.volume import has_names

_QUESTIONS = {
    "ct": "CT: DICOM folder or file",
    "labels": "Segmentation: label map, .seg.nrrd, folder of masks or DICOM SEG (--segment finds the bones)",
    "landmarks": "Landmarks of the CT (.mrk.json, .fcsv, .csv, .json)",
    "plan": "Planned path: a line or points of 3D Slicer",
    "device": "CAD model of the device (empty: none)",
    "device_points": "Points tip and base of the device (.mrk.json, .fcsv, .json)",
    "images": "Images without the device, in order (files with spaces between, or a folder)",
    "device_images": "Images with the device, in the same order (empty: none)",
}
_MAY_BE_EMPTY = ("device", "device_images")
_SEVERAL = ("images", "device_images")
Answer = TypeVar("Answer")


def ask_for_missing(given: NewCase, console: Console) -> NewCase:
    """What was given, with answers for the rest. An empty answer leaves out what may be left out.

    A file that is not there, or a C-arm that nobody knows, is asked for again.
    """
    for name, question in _QUESTIONS.items():
        if given.segment and name in ("labels", "landmarks"):
            continue
        if getattr(given, name) or (name in ("device_points", "device_images") and given.device is None):
            continue
        paths = _asked(question, console, name in _MAY_BE_EMPTY, _several if name in _SEVERAL else _one)
        if paths:
            answered: dict[str, Any] = {name: paths if name in _SEVERAL else paths[0]}
            given = replace(given, **answered)
    if given.bones is None and given.labels is not None and given.labels.exists() and not has_names(given.labels):
        table = "Label table of the map (totalsegmentator_v2, femoreg, …)"
        given = replace(given, bones=_asked(table, console, False, str))
    if given.carm is None:
        carm = "C-arm: preset or YAML file (empty: by the tags of the first DICOM image)"
        given = replace(given, carm=_asked(carm, console, True, _carm))
    return given


def _asked(question: str, console: Console, may_be_empty: bool, read: Callable[[str], Answer]) -> Answer | None:
    """The first answer that can be read; None if it is empty and may be. Others are told, and asked for again.

    Raises `InputError` where the typing ended before an answer.
    """
    while True:
        try:
            answer = (Prompt.ask(question, console=console, default="", show_default=False) or "").strip()
        except EOFError:
            raise InputError(
                f"the input ended where this was asked for: {question}. Type an answer, or give it as an option."
            ) from None
        if not answer and may_be_empty:
            return None
        if answer:
            try:
                return read(answer)
            except InputError as error:
                console.print(str(error), markup=False, highlight=False)


def _one(answer: str) -> tuple[Path, ...]:
    """The path (1,) of one file or folder. Raises `InputError` if there is none."""
    path = Path(answer).expanduser()
    check_readable(path, expected="file or folder")
    return (path,)


def _several(answer: str) -> tuple[Path, ...]:
    """The paths of files or folders with spaces between. Raises `InputError` if one is not there."""
    try:
        words = shlex.split(answer)
    except ValueError as error:  # a quotation mark without its other one
        raise InputError(f"{shortened(answer)}: {error}. Put quotation marks about a name with spaces.") from error
    return tuple(path for word in words for path in _one(word))


def _carm(answer: str) -> str:
    """The name of a C-arm's preset or file. Raises `InputError` for one that cannot be read."""
    load_carm(answer)
    return answer
