"""Settings of the simulator in YAML, read into frozen records with errors that name the key."""

from pathlib import Path
from typing import Any, TypeVar

import yaml
from femoreg_torch.configs import load_preset

from femoreg_torch.errors import InputError

_T = TypeVar("_T")


def read_settings(config: str) -> dict[str, Any]:
    """Content of a preset (`configs/simulation/`) or of a YAML file. Raises `InputError` if there is none."""
    if not config.endswith((".yaml", ".yml")):
        return load_preset("simulation", config)
    if not Path(config).is_file():
        raise InputError(f"{config}: no such file. Give a YAML file or a preset such as `paper`.")
    content = yaml.safe_load(Path(config).read_text(encoding="utf-8"))
    if not isinstance(content, dict):
        raise InputError(f"{config}: a YAML mapping with sections was expected. See configs/simulation/paper.yaml.")
    return content


def section(settings: dict[str, Any], name: str, where: str) -> dict[str, Any]:
    """The mapping under `name`. Raises `InputError` that starts with `where` if there is none."""
    if not isinstance(settings.get(name), dict):
        raise InputError(f"{where}: the section `{name}` is missing. See the presets in configs/simulation.")
    return settings[name]


def record(kind: type[_T], values: dict[str, Any], where: str) -> _T:
    """A frozen dataclass of all its `values`. Raises `InputError` for a key that is unknown or missing."""
    known = set(kind.__dataclass_fields__)  # type: ignore[attr-defined]
    for problem, keys in (("unknown key", set(values) - known), ("missing key", known - set(values))):
        if keys:
            raise InputError(f"{where}: {problem} `{min(keys)}`. Known keys: {', '.join(sorted(known))}.")
    return kind(**values)
