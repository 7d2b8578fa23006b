"""Presets in YAML, and the one function that reads them. Installed as `femoreg_torch.configs`."""

from importlib.resources import files
from typing import Any

import yaml

from femoreg_torch.errors import InputError


def preset_names(group: str) -> list[str]:
    """Names of the presets in `configs/<group>/`, sorted."""
    return sorted(
        p.name.removesuffix(".yaml") for p in files(__name__).joinpath(group).iterdir() if p.name.endswith(".yaml")
    )


def load_preset(group: str, name: str) -> dict[str, Any]:
    """Content of `configs/<group>/<name>.yaml`. Raises `InputError` with the known names if there is no such preset."""
    known = preset_names(group)
    if name not in known:
        raise InputError(f"no {group} preset {name!r}; there are: {', '.join(known)}.")
    return yaml.safe_load(files(__name__).joinpath(group, f"{name}.yaml").read_text(encoding="utf-8"))
