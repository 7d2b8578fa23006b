"""A landmark network from its weights file."""

from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Final

import torch
from torch import nn

from femoreg_torch.anatomy import HIP, Anatomy, load_anatomy
from femoreg_torch.configs import preset_names
from femoreg_torch.drr import CPU
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.extensions import find
from femoreg_torch.paths import check_readable
from femoreg_torch.settings import read_record

NETWORKS_GROUP: Final = "femoreg_torch.networks"  # entry points of other packages' networks, see `models.protocols`
_SIGMA_PX = 1.25  # of the shipped weights


@dataclass(frozen=True, eq=False)
class LandmarkNetwork:
    """A network in evaluation mode, and what its weights say of it."""

    module: nn.Module  # maps images (B, 1, H, W) to a `models.protocols.Prediction`
    anatomy: Anatomy = HIP  # the classes are the background and its bones, the heat maps its landmarks
    sigma_px: float = _SIGMA_PX  # standard deviation of the peak that the heat maps were trained to show

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return next((weight.device for weight in self.module.parameters()), CPU)


def load_network(path: str | Path | None = None, device: torch.device = CPU) -> LandmarkNetwork:
    """The network of a weights file, without a path the shipped one, on a device.

    Raises `InputError` for a file that is missing or holds something else, a kind of network or an anatomy that is not
    known, and weights that do not fit their network, or a network that does not fit its anatomy.
    """
    from models.kinds import NETWORKS
    from models.weights import SHIPPED_WEIGHTS, read_weights

    path = None if path is None else Path(path)
    where = str(path or SHIPPED_WEIGHTS)
    if path is not None:
        check_readable(path, "Give a weights file (safetensors) that `femoreg train` wrote.")
    try:
        weights = read_weights(path)
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from error
    if weights.anatomy != HIP.name and weights.anatomy not in preset_names("anatomy"):
        raise InputError(f"{where}: no anatomy preset {shortened(weights.anatomy)}, of which it says to be.")
    if not (isfinite(weights.sigma_px) and weights.sigma_px > 0):
        raise InputError(f"{where}: its sigma_px, {weights.sigma_px}, is no positive number.")
    if any(not tensor.isfinite().all() for tensor in weights.state.values() if tensor.is_floating_point()):
        raise InputError(f"{where}: holds weights that are not finite. Train or copy it anew.")
    try:
        anatomy = HIP if weights.anatomy == HIP.name else load_anatomy(weights.anatomy)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    settings = read_record(find(NETWORKS_GROUP, weights.kind, NETWORKS, where), weights.settings, where)
    check_counts(settings.classes, settings.landmarks, anatomy, where)
    try:
        module = settings.build()
        module.load_state_dict(weights.state)
    except (RuntimeError, TypeError, ValueError, MemoryError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{where}: the weights do not fit a network {weights.kind} of {settings} ({reason})."
        ) from error
    return LandmarkNetwork(module.eval().to(device), anatomy, weights.sigma_px)


def weights_file(path: Path | None = None) -> Path:
    """A weights file, without a path the shipped one."""
    import models
    from models.weights import SHIPPED_WEIGHTS

    return path or Path(models.__file__).parent / "weights" / SHIPPED_WEIGHTS


def check_counts(classes: int, landmarks: int, anatomy: Anatomy, where: str) -> None:
    """Raise `InputError` that starts with `where` unless a network has the classes and landmarks of an anatomy."""
    expected = (1 + len(anatomy.bones), len(anatomy.landmarks))
    if (classes, landmarks) != expected:
        raise InputError(
            f"{where}: the network has {classes} classes and {landmarks} landmarks, but the anatomy {anatomy.name} has "
            f"{expected[0]} (the background and {len(anatomy.bones)} bones) and {expected[1]}."
        )
