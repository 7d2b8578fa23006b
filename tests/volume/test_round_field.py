"""The round field of a CT is found, and what it cuts is told."""

import pytest
import torch
from torch import Tensor

from femoreg_torch.segment.points import _within_mm
from femoreg_torch.volume import Volume, axis_aligned
from femoreg_torch.volume.borders import cut_bones
from femoreg_torch.volume.round_field import round_field

SPACING, SIZE = (0.8, 0.8, 3.0), (12, 150, 140)
MIDDLE, RADIUS = (68.0, 75.0), 55.0  # voxels, mm


def off_mm() -> Tensor:
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in SIZE[1:])
    return SPACING[0] * torch.hypot(columns - MIDDLE[0], rows[:, None] - MIDDLE[1])


def patient(blank: float = -2000.0) -> Volume:
    """Muscle in noisy air, and `blank` beyond a circle that cuts the muscle."""
    hu = -1000 + 10 * torch.randn(SIZE, generator=torch.Generator().manual_seed(1))
    hu[:, 40:120, 2:-2] += 1040
    return Volume(
        torch.where(off_mm() > RADIUS, blank, hu.double()).float(), axis_aligned(SPACING, (-50.0, -60.0, 7.0))
    )


@pytest.mark.parametrize("blank", [-2000.0, -1024.0, 0.0])
def test_the_circle_is_found(blank: float) -> None:
    field = round_field(patient(blank))
    assert field is not None
    assert field.radius_mm == pytest.approx(RADIUS, abs=0.8)
    assert field.middle_mm == pytest.approx([SPACING[0] * v for v in MIDDLE], abs=0.4)
    assert _within_mm(torch.tensor([-50 + 54.4 + 30, -60 + 60.0, 9.0]).double(), patient(), field) == pytest.approx(
        RADIUS - 30, abs=1
    )


def test_also_where_the_ct_was_cropped_to_a_part_of_it() -> None:
    whole = patient()
    part = Volume(whole.data[:, :70, :80].contiguous(), whole.lps_from_index)
    field = round_field(part)
    assert field is not None
    assert field.radius_mm == pytest.approx(RADIUS, abs=1.5)


def test_a_body_in_air_without_noise_is_no_field() -> None:
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in SIZE[1:])
    ellipse = ((columns - 70) / 60) ** 2 + ((rows[:, None] - 75) / 35) ** 2 < 1
    body = torch.where(ellipse, 40.0, -1000.0).expand(SIZE)
    assert round_field(Volume(body.contiguous(), patient().lps_from_index)) is None
    assert round_field(Volume(torch.full(SIZE, -1000.0), patient().lps_from_index)) is None


def test_a_bone_that_it_cuts_is_told() -> None:
    ct = patient()
    labels = torch.zeros(SIZE, dtype=torch.uint8)
    labels[2:-2, 60:90, 1:40] = 1
    labels[2:-2, 60:90, 60:90] = 2
    labels[:, off_mm() > RADIUS] = 0
    bones = Volume(labels, ct.lps_from_index)
    told = cut_bones(bones, {"hip_right": 1, "hip_left": 2}, ["hip_right", "hip_left"], round_field(ct))
    assert told == ["hip_right is cut by the round field of the CT"]
