"""Device shadows: metal where the device is, laid over the chosen images and nowhere else."""

from pathlib import Path

import pytest
import torch

from femoreg_torch.detect import network_camera
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import load_carm
from sim.physics.materials import metal_density
from training.augmentation import AugmentationSettings, add_devices
from training.devices import read_devices, render_devices


def test_shadows_are_of_metal_and_differ(tmp_path: Path) -> None:
    camera = network_camera(load_carm("cios_fusion").camera).downsampled(2)
    path = render_devices(tmp_path / "devices.safetensors", 4, camera, 1)
    shadows = read_devices(path).float()
    assert shadows.shape == (4, *camera.shape)
    assert (shadows.amin((1, 2)) == 0).all()
    least, most = (
        length * metal_density(5000.0) / 10 * 0.77 for length in (8.0, 60.0)
    )  # mm of titanium at its thickest
    assert (shadows.amax((1, 2)) > least).all()
    assert (shadows.amax((1, 2)) < most).all()
    assert len({tuple(shadow.sum(0).tolist()) for shadow in shadows}) == 4
    assert render_devices(path, 4, camera, 1) == path
    with pytest.raises(InputError, match="other settings"):
        render_devices(path, 5, camera, 1)


def test_a_device_covers_the_chosen_share_of_the_images() -> None:
    devices = torch.zeros((3, 20, 20))
    devices[:, 2:6, 8:17] = 2.0
    settings = AugmentationSettings(device_share=0.3, device=(0.5, 1.0))
    added = add_devices(torch.zeros((400, 20, 20)), devices, settings, torch.Generator().manual_seed(1))
    chosen = added.amax((1, 2)) > 0
    assert 0.24 < chosen.float().mean() < 0.36
    strength = added[chosen].amax((1, 2))
    assert strength.min() >= 1.0
    assert strength.max() <= 2.0
    assert torch.equal((added[chosen] > 0).sum((1, 2)), torch.full((int(chosen.sum()),), 36))
    assert len({tuple((image > 0).nonzero()[0].tolist()) for image in added[chosen]}) == 8  # quarter turns and mirrors
