"""Implants lie in the femur that they were drawn for, and nowhere else."""

import pytest
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from training.implants import _KINDS, add_implants

HEAD = torch.tensor([70.0, 60.0])
AXIS = torch.tensor([0.25, 1.0]) / 1.0625**0.5


def picture(side: str) -> tuple[Tensor, Tensor]:
    """Labels (1, 96, 96) of one femur, a band from its head down, and landmarks (1, L, 2) in image pixels."""
    row, column = torch.meshgrid(torch.arange(96) * 2 + 0.5, torch.arange(96) * 2 + 0.5, indexing="ij")
    away = torch.stack([column, row], -1) - HEAD
    along = away @ AXIS
    across = away @ torch.stack([AXIS[1], -AXIS[0]])
    labels = torch.zeros(1, 96, 96, dtype=torch.uint8)
    labels[0][(along > -15) & (across.abs() < 14)] = HIP.classes((f"femur_{side}",))[0]
    landmarks = torch.full((1, len(HIP.landmarks), 2), -50.0)
    landmarks[0, HIP.landmark_names.index(f"FH-{side[0]}")] = HEAD
    return labels, landmarks


@pytest.mark.parametrize("side", ["left", "right"])
def test_implants_follow_the_bone(side: str) -> None:
    labels, landmarks = picture(side)
    bone = labels[0].repeat_interleave(2, 0).repeat_interleave(2, 1) > 0
    near_head = torch.zeros(192, 192, dtype=torch.bool)
    near_head[20:100, 30:110] = True
    generator = torch.Generator().manual_seed(1)
    for _ in range(12):
        added = add_implants(torch.zeros(1, 192, 192), labels, landmarks, 1.0, generator)[0]
        assert added.min() >= 0
        assert added.max() > 0.4
        metal = added > 0.2
        assert int(metal.sum()) > 200
        assert int((metal & ~bone & ~near_head).sum()) < 0.45 * int(metal.sum())  # plates lie beside the shaft


def test_there_are_as_many_as_were_asked_for_and_the_image_stays_otherwise() -> None:
    labels, landmarks = picture("left")
    count = 200
    before = torch.rand((count, 192, 192), generator=torch.Generator().manual_seed(2))
    generator = torch.Generator().manual_seed(3)
    after = add_implants(before, labels.expand(count, -1, -1), landmarks.expand(count, -1, -1), 0.3, generator)
    changed = (after != before).flatten(1).any(1)
    assert 0.2 < float(changed.double().mean()) < 0.4
    assert len(_KINDS) == 3


def test_a_femur_of_which_no_shaft_is_seen_gets_none() -> None:
    labels, landmarks = picture("left")
    labels[0, 50:] = 0
    added = add_implants(torch.zeros(1, 192, 192), labels, landmarks, 1.0, torch.Generator().manual_seed(4))
    assert not added.any()
