"""Classes that a preset names by `kind`: those built in, and those that other packages register by entry point.

A package adds a similarity, say, by these lines of its `pyproject.toml`; presets then say `kind: mine`:

    [project.entry-points."femoreg_torch.similarities"]
    mine = "my_package:MySimilarity"

The class is a frozen dataclass of settings; the other keys beside `kind` are its fields.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import entry_points
from types import FunctionType
from typing import Any, Literal, TypeVar

from femoreg_torch.errors import InputError, defect_in_one_line, shortened
from femoreg_torch.settings import read_record

_T = TypeVar("_T")
Group = Literal[
    "femoreg_torch.similarities",
    "femoreg_torch.optimisers",
    "femoreg_torch.steps",
    "femoreg_torch.networks",
    "femoreg_torch.losses",
]


def find(group: Group, kind: str, builtin: Mapping[str, Any], where: str) -> Any:
    """The class of a kind: one of `builtin` (by kind), or one that an entry point of the group names.

    Raises `InputError` that starts with `where` for an unknown kind, with those known, and for one that cannot be
    imported, with the reason.
    """
    if kind in builtin:
        return builtin[kind]
    others = {entry.name: entry for entry in entry_points(group=group)}
    if kind not in others:
        known = ", ".join([*builtin, *sorted(others.keys() - builtin.keys())])
        raise InputError(
            f"{where}: unknown kind {shortened(kind)}. Known kinds: {known}. Others are added by the entry-point "
            f"group {group}."
        )
    try:
        return others[kind].load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"{where}: kind {shortened(kind)}, {others[kind].value}, cannot be imported ({error})."
        ) from error


def name_of(group: Group, thing: Any) -> str:
    """How a message calls an object of another package: `module:class`, after its kind if an entry point names that."""
    named = thing if isinstance(thing, FunctionType) else type(thing)
    value = f"{named.__module__}:{named.__qualname__}"
    kinds = [entry.name for entry in entry_points(group=group) if entry.value == value]
    return f"{kinds[0]} ({value})" if kinds else value


def is_built_in(thing: Any) -> bool:
    """Whether an object is of a class of this package."""
    return type(thing).__module__.startswith("femoreg_torch.")


def guarded(what: str, group: Group, thing: Any, work: Callable[[], _T]) -> _T:
    """What `work`, a call of `thing`, gives.

    Raises `InputError` that names an object of another package, `what` it is and its class, for whatever goes wrong in
    it. Only what is out of memory stays what it is.
    """
    if is_built_in(thing):
        return work()
    import torch  # here, as much of what reads presets needs none of it

    try:
        return work()
    except (InputError, MemoryError, torch.cuda.OutOfMemoryError):
        raise
    except Exception as error:  # the code of others raises whatever it runs into
        raise InputError(f"{what} {name_of(group, thing)}: raised {defect_in_one_line(error)}.") from error


def pop_kind(content: Any, where: str) -> tuple[str, dict[str, Any]]:
    """The `kind` of a mapping, and all its other keys. Raises `InputError` that starts with `where` if it has none."""
    if not isinstance(content, dict) or not isinstance(content.get("kind"), str):
        raise InputError(f"{where}: a mapping with the key `kind` was expected, found {shortened(content)}.")
    return content["kind"], {key: value for key, value in content.items() if key != "kind"}


def read_kind(group: Group, builtin: Mapping[str, Any], content: Any, where: str) -> Any:
    """An object of the class that `kind` in a mapping names, its fields read from the other keys.

    Raises `InputError` that starts with `where`, see `find` and `read_record`.
    """
    kind, rest = pop_kind(content, where)
    record, where = record_of(find(group, kind, builtin, where), where), f"{where}, {kind}"
    fields = [field.name for field in dataclasses.fields(record)]
    if unknown := [key for key in rest if key not in fields]:
        raise InputError(
            f"{where}: unknown key {shortened(unknown[0])}. Known keys: {', '.join(fields)}. If it stands in a preset "
            "that this one extends, null in place of its value takes it away."
        )
    return read_record(record, rest, where)


def check_has(thing: Any, group: Group, methods: Sequence[str], where: str) -> None:
    """Raises `InputError` that starts with `where` for an object of another package that lacks a method of its kind."""
    lacking = [method for method in methods if not callable(getattr(thing, method, None))]
    if lacking and not is_built_in(thing):
        raise InputError(f"{where}: {name_of(group, thing)} has no method `{lacking[0]}`, which this kind needs.")


def record_of(found: Any, where: str) -> Any:
    """The same class. Raises `InputError` that starts with `where` if it is no dataclass."""
    if not (isinstance(found, type) and dataclasses.is_dataclass(found)):
        raise InputError(f"{where}: {shortened(found)} was expected to be a dataclass of settings.")
    return found
