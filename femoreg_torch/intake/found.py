"""What is wrong with a case, collected: each fault once, and none hides another."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
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
        line = " ".join(told.split())
        if line not in self.problems:
            self.problems.append(line)

    def unknown_keys(self, fields: Fields, known: Sequence[str]) -> None:
        """Every key that is not known is a problem."""
        for key in fields.content:
            if key not in known:
                self.attempt(lambda key=key: Fields({key: 0}, fields.file, fields.path).only(*known))  # type: ignore[misc]
