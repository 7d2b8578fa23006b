"""Weights on disk: safetensors, with the network's shape in the file's metadata. Nothing is unpickled."""

import json
from dataclasses import asdict
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from models.build import make_network
from models.reference import ReferenceUNet
from models.unet import UNet, UNetConfig

SHIPPED_WEIGHTS = "hip14.safetensors"


def save_weights(path: Path, network: UNet | ReferenceUNet, about: dict[str, str]) -> None:
    """Write the weights, the `UNetConfig` and the texts `about` (how they came to be)."""
    state = {name: tensor.detach().contiguous() for name, tensor in network.state_dict().items()}
    save_file(state, path, metadata={"config": json.dumps(asdict(network.config)), **about})


def load_weights(path: Path | None = None) -> UNet | ReferenceUNet:
    """The network of a weights file in evaluation mode; without a path, the shipped one.

    Raises `FileNotFoundError` if there is no such file and `ValueError` if it holds something else.
    """
    if path is None:
        with as_file(files("models").joinpath("weights", SHIPPED_WEIGHTS)) as shipped:
            return load_weights(shipped)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    try:
        with safe_open(path, "pt") as content:
            metadata = content.metadata() or {}
            state = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118 (not a dict)
    except SafetensorError as error:
        raise ValueError(f"{path}: cannot be read as safetensors ({error}).") from error
    if "config" not in metadata:
        raise ValueError(f"{path}: its metadata has no `config`, so these are no weights of this network.")
    try:
        network = make_network(_config(json.loads(metadata["config"])))
        network.load_state_dict(state)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: weights and `config` do not fit this network ({error}).") from error
    return network.eval()


def _config(values: dict[str, Any]) -> UNetConfig:
    fields: dict[str, Any] = {k: tuple(value) if isinstance(value, list) else value for k, value in values.items()}
    return UNetConfig(**fields)
