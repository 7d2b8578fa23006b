"""Reading fields of a YAML or JSON mapping with errors that name file, key, what was found and what was expected."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.errors import InputError, in_mm, shortened
from femoreg_torch.geometry import check_rigid, read_itk_transform
from femoreg_torch.geometry.rigid import FARTHEST_MM
from femoreg_torch.paths import Expected, why_unreadable
from femoreg_torch.yaml_faults import missing_space

_LONGEST_PATH = 120  # characters of the keys that lead to a value, in messages


@dataclass(frozen=True)
class Fields:
    """A mapping and where it stands: the file, the keys that lead to it, and the lines of all keys of a YAML file."""

    content: dict[str, Any]
    file: str
    path: str = ""
    lines: Mapping[str, int] = field(default_factory=dict)  # by path

    def where(self, key: str) -> str:
        """`file, line 3, path.to.key`, the beginning of every message; the line where it is known."""
        path = f"{self.path}.{key}" if self.path else key
        line = f"line {self.lines[path]}, " if path in self.lines else ""
        return f"{self.file}, {line}{path if len(path) <= _LONGEST_PATH else path[: _LONGEST_PATH - 1] + '…'}"

    def only(self, *known: str) -> "Fields":
        """Itself, if no key stands in it that is not `known`."""
        for key in self.content:
            if key not in known:
                raise InputError(f"{self.where(str(key))}: unknown key. Known keys here: {', '.join(known)}.")
        return self

    def __contains__(self, key: str) -> bool:
        return self.content.get(key) is not None

    def value(self, key: str, expected: str) -> Any:
        """What stands under `key`; `expected` says in words what should."""
        if key not in self:
            raise InputError(f"{self.where(key)}: is missing, {expected} was expected.")
        return self.content[key]

    def mapping(self, key: str) -> "Fields":
        """The mapping under `key`."""
        value = self.value(key, "a mapping")
        if not isinstance(value, dict):
            raise InputError(
                f"{self.where(key)}: a mapping of keys and values was expected, found {shortened(value)}."
                f"{_mended(value)}"
            )
        return self.inside(value, key)

    def inside(self, content: dict[str, Any], key: str = "") -> "Fields":
        """A mapping that stands under `key`; without a key other content in its own place."""
        return replace(self, content=content, path=f"{self.path}.{key}" if self.path and key else self.path or key)

    def mappings(self, key: str) -> list["Fields"]:
        """The list of mappings under `key`."""
        value = self.value(key, "a list")
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise InputError(
                f"{self.where(key)}: a list of mappings was expected, found {shortened(value)}."
                f"{_mended(value, _AS_LIST)}"
            )
        return [self.inside(item, f"{key}[{n}]") for n, item in enumerate(value)]

    def choice(self, key: str, allowed: Sequence[str]) -> str:
        """One of the `allowed` words under `key`."""
        value = self.value(key, " or ".join(allowed))
        if value not in allowed:
            raise InputError(
                f"{self.where(key)}: {' or '.join(allowed)} was expected, found {shortened(value)}.{_mended(value)}"
            )
        return value

    def text(self, key: str, expected: str) -> str:
        """The text under `key`; `expected` says in words what should stand there."""
        value = self.value(key, expected)
        if not isinstance(value, str) or not value:
            raise InputError(f"{self.where(key)}: {expected} was expected, found {shortened(value)}.{_mended(value)}")
        return value

    def texts(self, key: str, expected: str) -> list[str]:
        """One text, or a list of texts, under `key`."""
        value = self.value(key, expected)
        items = value if isinstance(value, list) else [value]
        if not items or not all(isinstance(item, str) and item for item in items):
            raise InputError(f"{self.where(key)}: {expected} was expected, found {shortened(value)}.")
        return items

    def number(self, key: str) -> float:
        """The finite number under `key`."""
        return self._numbers(key, (), "a number").item()

    def whole(self, key: str, low: int, high: int) -> int:
        """The whole number from `low` to `high` under `key`."""
        value = self.value(key, "a whole number")
        if type(value) is not int or not low <= value <= high:
            raise InputError(
                f"{self.where(key)}: a whole number from {low} to {high} was expected, found {shortened(value)}."
            )
        return value

    def numbers(self, key: str, count: int) -> list[float]:
        """So many finite numbers under `key`."""
        return self._numbers(key, (count,), f"{count} numbers").tolist()

    def point(self, key: str) -> Tensor:
        """The point (3,), float64, under `key`."""
        point = self._numbers(key, (3,), "a point [x, y, z] in mm")
        if point.abs().max() > FARTHEST_MM:
            raise InputError(
                f"{self.where(key)}: {in_mm(float(point.abs().max()))} is farther than any room. Is it in mm?"
            )
        return point

    def matrix(self, key: str, shape: tuple[int, int]) -> Tensor:
        """The matrix of finite numbers of this shape, float64, under `key`. Raises `InputError`."""
        return self._numbers(key, shape, f"a matrix of {shape[0]} × {shape[1]} numbers")

    def transform(self, key: str) -> Tensor:
        """The rigid transform (4, 4), float64, under `key`. Raises `InputError`."""
        return check_rigid(self._numbers(key, (4, 4), "a 4×4 matrix of numbers"), self.where(key))

    def transform_or_file(self, key: str, folder: Path) -> Tensor:
        """The rigid transform (4, 4), float64, under `key`, or of the ITK or Slicer file there. Raises `InputError`."""
        if isinstance(self.value(key, "a 4×4 matrix, or a transform of 3D Slicer (.tfm, .h5)"), str):
            return read_itk_transform(self.file_path(key, folder))
        return self.transform(key)

    def transforms(self, key: str) -> Tensor:
        """The list of rigid transforms under `key` as (V, 4, 4), float64."""
        value = self.value(key, "a list of 4×4 matrices")
        if not isinstance(value, list) or not value:
            raise InputError(f"{self.where(key)}: a list of 4×4 matrices was expected, found {shortened(value)}.")
        items = self.inside({f"{key}[{n}]": item for n, item in enumerate(value)})
        return torch.stack([items.transform(name) for name in items.content])

    def file_path(self, key: str, folder: Path, may_be_folder: bool = False) -> Path:
        """The file under `key` that can be read, relative to `folder` unless absolute."""
        value = self.value(key, "the path of a file")
        if not isinstance(value, str):
            raise InputError(
                f"{self.where(key)}: the path of a file was expected, found {shortened(value)}.{_mended(value)}"
            )
        path = folder / value
        expected: Expected = "file or folder" if may_be_folder else "file"
        if (why := why_unreadable(path, f"Paths are relative to {self.file}.", expected)) is not None:
            raise InputError(f"{self.where(key)}: {shortened(value, 200)}: {why}")
        return path

    def _numbers(self, key: str, shape: tuple[int, ...], expected: str) -> Tensor:
        value = self.value(key, expected)
        numbers = torch.empty(0)
        if _fits(value, shape):
            numbers = torch.tensor(value, dtype=torch.float64)
        if numbers.shape != shape or not torch.isfinite(numbers).all():
            raise InputError(f"{self.where(key)}: {expected} was expected, found {shortened(value)}.")
        return numbers


_AS_LIST = " Begin each of its entries with `- `."


def _mended(value: Any, otherwise: str = "") -> str:
    """A sentence on how to mend a value of the wrong kind, where it is known."""
    if isinstance(value, str) and (found := missing_space(value)) is not None:
        return f" Is it {found[1].partition('Write ')[2].rstrip('.')}, with a space?"
    if isinstance(value, list) and not otherwise:
        return " Write the value without brackets or dash."
    return otherwise if isinstance(value, dict) else ""


def _fits(value: Any, shape: tuple[int, ...]) -> bool:
    """Whether a value is a number, or lists of numbers of this shape."""
    if not shape:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return isinstance(value, list) and len(value) == shape[0] and all(_fits(item, shape[1:]) for item in value)
