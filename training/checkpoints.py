"""Checkpoints that are written whole, and of a run that is resumed, the newest that is whole and fits the network.

The best one stays known where the folder of the run was moved.
"""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError
from femoreg_torch.files import temporary_file

_STATE = ("epoch", "loops", "optimizer_states", "lr_schedulers")  # what Lightning goes on from, beside the weights

_PATHS = ("best_model_path", "kth_best_model_path", "last_model_path")  # in the state of `BestCheckpoint`


class WholeCheckpoints(TorchCheckpointIO):
    """Writes checkpoints whole or not at all.

    Lightning itself writes into the system's folder for temporary files. Where that is another disk, the file is then
    copied, and a run that is killed meanwhile leaves half of its only checkpoint.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write `checkpoint` to `path`, a file."""
        content = io.BytesIO()
        torch.save(checkpoint, content)
        file = Path(path)
        file.parent.mkdir(parents=True, exist_ok=True)
        with temporary_file(file) as part:
            part.write_bytes(content.getbuffer())


class BestCheckpoint(ModelCheckpoint):
    """Lightning's, which forgets what was best so far where the folder of a run was moved or copied.

    The first epoch after that would count as the best one, and be exported.
    """

    @property
    def state_key(self) -> str:
        """That of Lightning's own, by which runs of versions before this class know it."""
        return super().state_key.replace(type(self).__qualname__, ModelCheckpoint.__qualname__, 1)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take over the state of the run, with the names that its files have now."""
        folder = Path(str(self.dirpath))

        def here(path: str) -> str:
            return str(folder / Path(path).name) if path else path

        if state_dict["best_model_path"] and Path(here(state_dict["best_model_path"])).is_file():
            paths = {name: here(state_dict[name]) for name in _PATHS}
            models = {here(path): score for path, score in state_dict["best_k_models"].items()}
            state_dict = {**state_dict, **paths, "best_k_models": models, "dirpath": self.dirpath}
        super().load_state_dict(state_dict)


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


def last_good_checkpoint(folder: Path, module: nn.Module, report: Callable[[str], None]) -> tuple[Path, int]:
    """The newest checkpoint in `folder` that is whole, and after how many epochs it was written.

    Each that is passed over is told to `report`.

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
        return path, int(content["epoch"]) + 1
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
