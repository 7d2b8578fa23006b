"""What a report is made of, and what its sections are."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from femoreg_torch.case import Case, Result
from femoreg_torch.evaluation.overlay import Drawn
from femoreg_torch.registration import Scene


@dataclass(frozen=True, eq=False)
class Material:
    """What a report is made of."""

    case: Case
    scene: Scene
    result: Result
    errors: dict[str, Any] | None  # against the truth; None where there is none
    drawn: Drawn


@dataclass(frozen=True)
class Table:
    """Cells as text. On a narrow screen every row becomes a block, with the columns' names beside its cells."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""


@dataclass(frozen=True, eq=False)
class Section:
    """A part of a report: words, tables, or what a template of its own draws from `content`."""

    key: str  # of the address within the page
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[Table] = ()
    template: str | None = None  # in the folder `templates`
    content: dict[str, Any] = field(default_factory=dict)
    folded: bool = False  # until it is opened, or printed
