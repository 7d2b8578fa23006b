"""Checkpoints of a run that is resumed: the newest that is whole and fits the network."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError

_STATE = ("epoch", "loops", "optimizer_states", "lr_schedulers")  # what Lightning goes on from, beside the weights


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint, plain values alone. Raises `InputError` if it is cut off or another file."""
    try:
        with quiet():
            content = torch.load(path, map_location="cpu", weights_only=True)  # plain containers and tensors alone
    except Exception as error:  # of zip, pickle, or torch, by where the file is damaged
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: is cut off, damaged, or no checkpoint ({reason}).") from error
    if not isinstance(content, dict) or not {"state_dict", "global_step"} <= set(content):
        raise InputError(f"{path}: holds no state of a training run.")
    return content


def last_good_checkpoint(folder: Path, module: nn.Module, report: Callable[[str], None]) -> Path:
    """The newest checkpoint in `folder` that is whole; each that is passed over is told to `report`.

    Raises `InputError` if there is none, or if it is of another network than `module`.
    """
    found = sorted(folder.glob("*.ckpt"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in found:
        try:
            content = read_checkpoint(path)
        except InputError as error:
            report(f"passed over: {error}")
            continue
        _check_fits(content["state_dict"], module, path)
        if missing := [name for name in _STATE if name not in content]:
            report(f"passed over: {path}: holds weights, but not the state of a run ({missing[0]} is missing).")
            continue
        return path
    raise InputError(
        f"{folder}: holds no whole checkpoint, so there is nothing to resume. Train anew into another folder."
    )


def _check_fits(state: Any, module: nn.Module, path: Path) -> None:
    expected = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
    there = {name: tuple(tensor.shape) for name, tensor in state.items()} if isinstance(state, dict) else {}
    for name, shape in expected.items():
        if there.get(name) != shape:
            raise InputError(
                f"{path}: is of another network than the settings name ({name} is {there.get(name, 'missing')}, not "
                f"{shape}). Resume with the settings of that run, settings.json beside it."
            )
