"""Landmarks found again on a patient's masks: near those of the smooth bones, and where the bones are."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume
from sim.labelled.attenuation_layers import Layers, split_layers
from sim.labelled.layer_landmarks import landmarks_by_rule
from sim.patient import make_patient


@pytest.fixture(scope="module")
def layers() -> Layers:
    patient = make_patient(3, 2.0)
    return split_layers(patient.ct, patient.labels, patient.landmarks)


@pytest.fixture(scope="module")
def found(layers: Layers) -> Tensor:
    return landmarks_by_rule(layers)


def _moved(volume: Volume, matrix: Tensor) -> Volume:
    return Volume(volume.data, matrix @ volume.lps_from_index)


def test_the_rules_agree_on_voxels_and_on_smooth_bones(layers: Layers, found: Tensor) -> None:
    apart = (found - layers.landmarks).norm(dim=1)
    heads = [HIP.landmark_names.index(name) for name in ("FH-l", "FH-r")]
    assert torch.equal(found[heads], layers.landmarks[heads])
    assert 0.1 < apart.max() < 8
    assert apart.mean() < 2.5


def test_they_move_with_the_bones(layers: Layers, found: Tensor) -> None:
    shift = torch.eye(4, dtype=torch.float64)
    shift[:3, 3] = torch.tensor([11.0, -7.0, 240.0])
    masks = {label: _moved(mask, shift) for label, mask in layers.masks.items()}
    moved = landmarks_by_rule(replace(layers, masks=masks, landmarks=layers.landmarks + shift[:3, 3]))
    assert (moved - found - shift[:3, 3]).abs().max() < 0.3


def test_a_foramen_that_is_closed_leaves_the_known_places(layers: Layers) -> None:
    """As a thin ring may be after it was bent and smoothed."""
    filled = layers.masks["hip_left"]
    low, high = (filled.data > 0.5).nonzero().aminmax(dim=0)
    (z, _, x), (end, _, right) = low.tolist(), high.tolist()
    data = filled.data.clone()
    data[z : (z + end) // 2, :, x:right] = 1.0
    masks = {**layers.masks, "hip_left": filled.with_data(data)}
    assert torch.equal(landmarks_by_rule(replace(layers, masks=masks)), layers.landmarks)


def test_a_lost_rule_keeps_the_known_place_and_tilted_masks_are_refused(layers: Layers, found: Tensor) -> None:
    asis = HIP.landmark_names.index("ASIS-l")
    known = layers.landmarks.clone()
    known[asis, 2] += 40
    assert torch.equal(landmarks_by_rule(replace(layers, landmarks=known))[asis], known[asis])
    tilt = torch.eye(4, dtype=torch.float64)
    tilt[0, 1] = 0.1
    masks = {label: _moved(mask, tilt) for label, mask in layers.masks.items()}
    with pytest.raises(InputError, match="do not run left, back and up"):
        landmarks_by_rule(replace(layers, masks=masks))
