"""Presets in YAML, and the one function that reads them. Installed as `femoreg_torch.configs`."""

from importlib.resources import files
from pathlib import Path
from typing import Any

from femoreg_torch.errors import InputError, shortened
from femoreg_torch.paths import check_readable
from femoreg_torch.text import MOST_YAML_BYTES, read_bytes, yaml_mapping

_SUFFIXES = (".yaml", ".yml")


def preset_names(group: str) -> list[str]:
    """Names of the presets in `configs/<group>/`, sorted."""
    return sorted(
        p.name.removesuffix(".yaml") for p in files(__name__).joinpath(group).iterdir() if p.name.endswith(".yaml")
    )


def load_preset(group: str, name: str | Path) -> dict[str, Any]:
    """Content of `configs/<group>/<name>.yaml`, or of the YAML file that `name` is the path of.

    A file may say `extends: other`, the name of a preset or a file beside it: what stands in it is then laid over the
    other's content, see `laid_over`. Raises `InputError` with the known names if there is no such preset, and for a
    file that is missing, is not a YAML mapping, or extends itself.
    """
    return _load(group, str(name), Path(), ())


def _load(group: str, name: str, folder: Path, before: tuple[str, ...]) -> dict[str, Any]:
    if name.endswith(_SUFFIXES):
        path = folder / name
        check_readable(path, f"Give a YAML file or a preset: {', '.join(preset_names(group))}.")
        where, folder = str(path), path.parent
        text = read_bytes(path, MOST_YAML_BYTES)
    elif name in (known := preset_names(group)):
        where = f"{group} preset {name}"
        text = files(__name__).joinpath(group, f"{name}.yaml").read_bytes()
    else:
        raise InputError(
            f"no {group} preset {shortened(name)}; there are: {', '.join(known)}. A file needs the suffix .yaml."
        )
    if where in before:
        raise InputError(f"{where}: extends itself ({' → '.join((*before, where))}).")
    content = yaml_mapping(text, where)
    if (base := content.pop("extends", None)) is None:
        return content
    if not isinstance(base, str):
        raise InputError(f"{where}, extends: the name of a preset or a YAML file was expected.")
    return laid_over(_load(group, base, folder, (*before, where)), content, where)


def laid_over(base: dict[str, Any], change: dict[str, Any], where: str) -> dict[str, Any]:
    """`base` with `change` laid over it: mappings key by key, lists of named entries by name, all else replaced.

    An entry of a list of named entries may stand `before: NAME` or `after: NAME` (else a new one comes last), and
    `remove: true` takes it away. A value of null takes a key away. Raises `InputError` that starts with `where` for a
    name that is not there.
    """
    result = dict(base)
    for key, value in change.items():
        old = base.get(key)
        if value is None:
            result.pop(key, None)
        elif isinstance(value, dict) and isinstance(old, dict):
            result[key] = laid_over(old, value, f"{where}, {key}")
        elif _named(value) and _named(old):
            result[key] = _merged(old, value, f"{where}, {key}")
        else:
            result[key] = value
    return result


def _named(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, dict) and "name" in v for v in value)


def _listed(names: list[Any]) -> str:
    """Names in quotes, as they may hold commas."""
    return ", ".join(f"“{name}”" for name in names)


def _merged(base: list[dict[str, Any]], changes: list[dict[str, Any]], where: str) -> list[dict[str, Any]]:
    entries = list(base)
    told = [change["name"] for change in changes]
    if twice := next((name for name in told if told.count(name) > 1), None):
        raise InputError(f"{where}: {told.count(twice)} entries are named {shortened(twice)}. Rename them.")
    for change in changes:
        entry = dict(change)
        names = [other["name"] for other in entries]
        beside = [(word, entry.pop(word)) for word in ("before", "after") if word in entry]
        remove = entry.pop("remove", False)
        for name in [other for _, other in beside] + ([entry["name"]] if remove else []):
            if name not in names:
                raise InputError(f"{where}: there is no entry named {shortened(name)}; there are: {_listed(names)}.")
        of_kinds = bool(entries) and all("kind" in other for other in entries)
        if entry["name"] not in names and "kind" not in entry and of_kinds:
            raise InputError(
                f"{where}: there is no entry named {shortened(entry['name'])} to change, and a new one needs `kind`; "
                f"there are: {_listed(names)}."
            )
        if entry["name"] in names:
            place = names.index(entry["name"])
            old = entries.pop(place)
            if remove:
                continue
            entry = laid_over(old, entry, f"{where}, {entry['name']}")
        else:
            place = len(entries)
        for word, other in beside:
            place = [e["name"] for e in entries].index(other) + (word == "after")
        entries.insert(place, entry)
    return entries
