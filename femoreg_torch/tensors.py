"""Files of tensors (safetensors), read without unpickling anything."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.paths import check_readable


def read_tensors(path: Path, names: Sequence[str] | None = None) -> tuple[dict[str, str], dict[str, Tensor]]:
    """The metadata of a safetensors file and its tensors of these names, or all.

    Raises `InputError` if the file is missing, cut off, of another kind, or lacks one of them.
    """
    check_readable(path)
    try:
        with safe_open(path, "pt") as content:
            there = list(content.keys())
            if missing := [name for name in names or () if name not in there]:
                raise InputError(f"{path}: holds no {', '.join(missing)}. It is cut off, or a file of another kind.")
            return content.metadata() or {}, {
                name: content.get_tensor(name) for name in (there if names is None else names)
            }
    except (SafetensorError, OSError, RuntimeError, TypeError, KeyError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read as safetensors ({str(error)[:200]}). Make or copy it anew."
        ) from error


def read_metadata(path: Path) -> dict[str, str]:
    """The texts in a safetensors file beside its tensors. Raises `InputError` as `read_tensors` does."""
    return read_tensors(path, ())[0]


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file, as all files by its bytes: safetensors' own writer lets its owner alone read it."""
    path.write_bytes(save(dict(tensors), dict(metadata)))


def check_shapes(tensors: Mapping[str, Tensor], expected: Mapping[str, tuple[str | int, ...]], where: str) -> None:
    """Raises `InputError` that starts with `where` unless every tensor has its shape and is finite.

    A letter in an expected shape stands for the same number wherever it occurs.
    """
    sizes: dict[str, int] = {}
    for name, shape in expected.items():
        found = tuple(tensors[name].shape)
        told = (
            f"{where}, {name}: shape {' × '.join(map(str, shape))} was expected, found {' × '.join(map(str, found))}."
        )
        if len(found) != len(shape):
            raise InputError(told)
        for size, wanted in zip(found, shape, strict=True):
            if size != (sizes.setdefault(wanted, size) if isinstance(wanted, str) else wanted):
                raise InputError(told)
        if tensors[name].is_floating_point() and not tensors[name].isfinite().all():
            raise InputError(f"{where}, {name}: holds values that are not finite.")
