"""`RUN/review.json`: what a person decided about a result after looking at it."""

import hashlib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args

from femoreg_torch.case.fields import Fields
from femoreg_torch.case.result_file import RESULT_NAME
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json, write_json

REVIEW_NAME = "review.json"
_VERSION = 1
Decision = Literal["accepted", "rejected"]


@dataclass(frozen=True)
class Review:
    """A decision. It changes nothing of the verdict: a result that is not trusted stays so."""

    decision: Decision
    note: str
    reviewer: str
    time: str  # ISO 8601, UTC
    result_sha256: str  # of the result.json that was looked at


def result_sha256(run: Path) -> str:
    """The digest of the result in a folder. Raises `InputError` if there is none."""
    path = run / RESULT_NAME
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}). Name the folder of a registration.") from error


def read_review(run: Path) -> Review | None:
    """The review in a folder, None if there is none. Raises `InputError` for a file that is something else."""
    path = run / REVIEW_NAME
    if not path.exists():
        return None
    top = Fields(read_json(path), str(path))
    if top.content.get("version") != _VERSION:
        raise InputError(f"{path}, version: {_VERSION} was expected, found {top.content.get('version')!r}.")
    decision = top.choice("decision", get_args(Decision))
    texts = {key: top.text(key, "text") for key in ("reviewer", "time", "result_sha256")}
    return Review("accepted" if decision == "accepted" else "rejected", str(top.content.get("note", "")), **texts)


def write_review(run: Path, review: Review) -> None:
    """Write the review into a folder, whole or not at all; an earlier one is replaced."""
    write_json(run / REVIEW_NAME, {"version": _VERSION, **asdict(review)})
