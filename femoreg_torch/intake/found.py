"""What is wrong with a case, collected: each fault once, and none hides another."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from femoreg_torch.case.fields import Fields
from femoreg_torch.errors import InputError

_T = TypeVar("_T")


@dataclass
class Found:
    """Collects what is wrong, each once."""

    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    facts: list[str] = field(default_factory=list)

    def attempt(self, read: Callable[[], _T]) -> _T | None:
        """What `read` gives, or None if it raises `InputError`, which is then a problem."""
        try:
            return read()
        except InputError as error:
            self.problem(str(error))
            return None

    def problem(self, told: str) -> None:
        """Keep a problem, in one line, unless it is known."""
        line = " ".join(told.split())
        if line not in self.problems:
            self.problems.append(line)

    def unknown_keys(self, fields: Fields, known: Sequence[str]) -> None:
        """Every key that is not known is a problem."""
        for key in fields.content:
            if key not in known:
                self.attempt(lambda key=key: fields.inside({key: 0}).only(*known))  # type: ignore[misc]


def alike_together(problems: Sequence[str]) -> list[str]:
    """The problems, those that say the same of several files (`FILE: …`) as one that names the others at its end."""
    files: dict[str, list[str]] = {}
    for problem in problems:
        file, _, said = problem.partition(": ")
        files.setdefault(said or problem, []).append(file)
    return [_of_all(said, of) if said != of[0] else said for said, of in files.items()]


def _of_all(said: str, files: Sequence[str]) -> str:
    first, *others = files
    more = f" The same of {', '.join(Path(file).name for file in others)}." if others else ""
    return f"{first}: {said}{more}"
