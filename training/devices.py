"""Shadows of drilling devices, to be laid over training images: the device covers landmarks where it is used."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import temporary_file
from femoreg_torch.geometry import Camera
from femoreg_torch.tensors import read_metadata, read_tensors, write_tensors
from sim.labelled.devices_in_view import device_pose
from sim.labelled.settings import DeviceRanges
from sim.physics.line_integrals import device_density
from sim.theatre.device import make_device

# Wider than where `sim.labelled.physics_views` puts the devices that a network is measured with, and other devices.
_RANGES = DeviceRanges(share=1.0, count=24, hu=5000.0, depth_mm=(450.0, 700.0), shift_mm=90.0, angle_deg=35.0)
_FIRST_SEED = 1000
_STEP_MM = 1.0
_CM2_PER_G = 0.77  # of titanium at 60 keV, which a beam of 80 kVp comes near to (NIST XCOM)


def render_devices(path: Path, count: int, camera: Camera, seed: int) -> Path:
    """Attenuation (N, H, W) float16 of `count` devices in random poses, written to `path` unless it is there.

    Raises `InputError` if the file holds others.
    """
    source = f"{count} devices on {camera.shape}, seed {seed}, {_RANGES}"
    if path.exists():
        found = read_metadata(path).get("source")
        if found != source:
            raise InputError(
                f"{path}: rendered with other settings ({shortened(found, 300)}). Choose an empty cache folder."
            )
        return path
    rng = np.random.default_rng(seed)
    made = [make_device(_FIRST_SEED + n) for n in range(_RANGES.count)]
    densities = [device_density(mesh, _STEP_MM, _RANGES.hu) for mesh, _ in made]
    shadows = []
    for n in range(count):
        which = n % _RANGES.count
        pose = device_pose(*made[which], _RANGES, rng)
        shadows.append(project([densities[which]], pose[None, None], camera, _STEP_MM)[0] / 10 * _CM2_PER_G)
    with temporary_file(path) as part:
        write_tensors(part, {"shadows": torch.stack(shadows).half()}, {"source": source})
    return path


def read_devices(path: Path) -> Tensor:
    """The attenuation images (N, H, W) of a file of `render_devices`."""
    return read_tensors(path, ("shadows",))[1]["shadows"]
