"""Settings from YAML into frozen dataclasses, every key and type checked."""

import functools
from collections.abc import Mapping
from typing import Any, TypeVar

from jsonargparse import ArgumentError, ArgumentParser

from femoreg_torch.errors import InputError

_T = TypeVar("_T")


def read_record(kind: type[_T], content: dict[str, Any], where: str, ready: Mapping[str, Any] | None = None) -> _T:
    """An object of the dataclass `kind` from a mapping; records, lists and unions inside follow their annotations.

    Keys with a default may be left out. `ready` holds fields that were read already. Raises `InputError` that starts
    with `where` for what is not a mapping, a key that is unknown or missing, and a value of another type or one that
    the record itself refuses.
    """
    if not isinstance(content, dict):
        raise InputError(f"{where}: a mapping of keys and values was expected, found {type(content).__name__}.")
    known = kind.__dataclass_fields__  # type: ignore[attr-defined]
    for key in content:
        if key not in known:
            raise InputError(f"{where}: unknown key {str(key)[:60]!r}. Known keys: {', '.join(known)}.")
    ready = ready or {}
    parser = _parser(kind, frozenset(ready))  # type: ignore[arg-type]  # a class can be hashed
    try:
        return kind(**vars(parser.instantiate(parser.parse_object(content))), **ready)
    except (ArgumentError, TypeError, InputError) as error:
        raise InputError(f"{where}: {' '.join(str(error).split())}") from error


@functools.cache
def _parser(kind: type[Any], without: frozenset[str]) -> ArgumentParser:
    """The parser of a record's fields but for some; made once, as a preset holds many records of one kind."""
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(kind, skip=set(without))
    return parser
