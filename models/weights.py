"""Weights on disk: safetensors, with the network's kind and settings in the file's metadata. Nothing is unpickled."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

SHIPPED_WEIGHTS = "hip14.safetensors"
SHIPPED_BONES = "bones6.safetensors"  # of the network that labels bones in a CT

# What files without `kind` call their network: its kind, and the settings that it has.
_ARCHITECTURES = {
    "compact": ("multitask_unet", ("channels", "convolutions", "residual", "patch", "classes", "landmarks")),
    "grupp2020": ("grupp2020", ("channels", "classes", "landmarks")),
}
# and the standard deviation of the peak that they were trained to show: that of the shipped weights
_SIGMA_PX = 1.25


@dataclass(frozen=True, eq=False)
class Weights:
    """What a weights file holds."""

    kind: str  # of the network
    settings: dict[str, Any]  # of its `Network`
    anatomy: str  # the preset in `configs/anatomy/` that says what its classes and landmarks are
    sigma_px: float  # standard deviation of the peak that its heat maps were trained to show, in their pixels
    state: dict[str, Tensor]  # of the built network


def save_weights(path: Path, weights: Weights, about: Mapping[str, str]) -> None:
    """Write weights, and the texts `about` (how they came to be) into the metadata. Raises `OSError`."""
    state = {name: tensor.detach().contiguous() for name, tensor in weights.state.items()}
    metadata = {
        "kind": weights.kind,
        "settings": json.dumps(weights.settings),
        "anatomy": weights.anatomy,
        "sigma_px": repr(weights.sigma_px),
    }
    path.write_bytes(save(state, {**about, **metadata}))  # safetensors' own writer lets its owner alone read the file


def read_weights(path: Path | None = None) -> Weights:
    """The content of a weights file; without a path, of the shipped one.

    Raises `FileNotFoundError` if there is no such file and `ValueError` if it holds something else.
    """
    if path is None:
        return shipped_weights(SHIPPED_WEIGHTS)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. Give a weights file (safetensors) that `femoreg train` wrote.")
    try:
        with safe_open(path, "pt") as content:
            metadata = content.metadata() or {}
            state = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, RuntimeError, TypeError) as error:
        raise ValueError(f"{path}: cannot be read as safetensors ({error}).") from error
    try:
        if "kind" not in metadata:
            return _without_kind(json.loads(metadata["config"]), state)
        settings, sigma_px = json.loads(metadata["settings"]), float(metadata["sigma_px"])
        return Weights(metadata["kind"], settings, metadata["anatomy"], sigma_px, state)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: its metadata does not say the kind and the settings of a network (at {error}), so these are no "
            "weights that `femoreg train` wrote."
        ) from error


def shipped_weights(name: str) -> Weights:
    """The content of a weights file that is installed with this package. Raises as `read_weights`."""
    with as_file(files("models").joinpath("weights", name)) as shipped:
        return read_weights(shipped)


def _without_kind(config: dict[str, Any], state: dict[str, Tensor]) -> Weights:
    """Weights of a file whose metadata have `config`, the settings of both architectures in one."""
    kind, keys = _ARCHITECTURES[config["architecture"]]
    return Weights(kind, {key: config[key] for key in keys}, "hip", _SIGMA_PX, state)
