"""Asking in the terminal for what a new case lacks."""

import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.prompt import Prompt

from femoreg_torch.geometry import load_carm
from femoreg_torch.intake import NewCase
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


def ask_for_missing(given: NewCase, console: Console) -> NewCase:
    """What was given, with answers for the rest. An empty answer leaves out what may be left out."""
    for name, question in _QUESTIONS.items():
        if given.segment and name in ("labels", "landmarks"):
            continue
        if getattr(given, name) or (name in ("device_points", "device_images") and given.device is None):
            continue
        answer = _answer(question, console, name in _MAY_BE_EMPTY)
        if answer:
            paths = tuple(Path(word) for word in shlex.split(answer))
            answered: dict[str, Any] = {name: paths if name in ("images", "device_images") else Path(answer)}
            given = replace(given, **answered)
    if given.bones is None and given.labels is not None and given.labels.exists() and not has_names(given.labels):
        given = replace(
            given, bones=_answer("Label table of the map (totalsegmentator_v2, femoreg, …)", console, False)
        )
    if given.carm is None:
        name = _answer("C-arm: preset or YAML file (empty: by the tags of the first DICOM image)", console, True)
        if name:
            load_carm(name)
            given = replace(given, carm=name)
    return given


def _answer(question: str, console: Console, may_be_empty: bool) -> str:
    while True:
        answer = (Prompt.ask(question, console=console, default="", show_default=False) or "").strip()
        if answer or may_be_empty:
            return answer
