"""Weights on disk, those of files without `kind` included."""

import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from models.weights import SHIPPED_WEIGHTS, Weights, read_weights, save_weights

WEIGHTS = Weights(
    "mine", {"channels": [8, 12], "gain": 0.5}, "knee", 1.75, {"layer.weight": torch.arange(6.0).view(2, 3)}
)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "mine.safetensors"
    save_weights(path, WEIGHTS, {"seed": "3"})
    again = read_weights(path)
    assert (again.kind, again.settings, again.anatomy, again.sigma_px) == ("mine", WEIGHTS.settings, "knee", 1.75)
    assert list(again.state) == ["layer.weight"]
    assert again.state["layer.weight"].equal(WEIGHTS.state["layer.weight"])


def test_files_without_a_kind_are_of_the_hip(tmp_path: Path) -> None:
    old = {"channels": [8], "convolutions": [1], "residual": [], "patch": 4, "classes": 7, "landmarks": 14}
    for architecture, kind, settings in (
        ("compact", "multitask_unet", old),
        ("grupp2020", "grupp2020", {"channels": [8], "classes": 7, "landmarks": 14}),
    ):
        path = tmp_path / f"{architecture}.safetensors"
        metadata = {"config": json.dumps({"architecture": architecture, **old})}
        save_file({"a": torch.zeros(1)}, path, metadata=metadata)
        again = read_weights(path)
        assert (again.kind, again.settings, again.anatomy, again.sigma_px) == (kind, settings, "hip", 1.25)


def test_files_of_something_else(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_weights(tmp_path / "missing.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match="does not say the kind"):
        read_weights(tmp_path / "other.safetensors")
    odd = {"config": json.dumps({"architecture": "diffusion"})}
    save_file({"a": torch.zeros(1)}, tmp_path / "odd.safetensors", metadata=odd)
    with pytest.raises(ValueError, match="'diffusion'"):
        read_weights(tmp_path / "odd.safetensors")


def test_the_shipped_weights_are_small() -> None:
    shipped = Path(__file__).resolve().parents[2] / "models" / "weights" / SHIPPED_WEIGHTS
    assert shipped.stat().st_size <= 20e6
    assert read_weights().kind == "multitask_unet"
