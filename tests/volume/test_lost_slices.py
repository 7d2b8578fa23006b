"""A slice that a CT lacks is told, of bones that run askew through soft tissue, with noise."""

import pytest
import torch

from femoreg_torch.volume import Volume, axis_aligned
from femoreg_torch.volume.lost_slices import lost_slice, told_of_lost_slice

SLICES = 60
IDS = (1, 2)


def ct_and_labels(kept: list[int], noise_hu: float = 20.0) -> tuple[Volume, Volume]:
    """Eight tubes of bone that lean each its own way, in a trunk; slices of 1 mm, of which some are kept."""
    z, y, x = torch.meshgrid(*(torch.arange(n).float() for n in (SLICES, 220, 320)), indexing="ij")
    hu = torch.where(((x - 160) / (150 - 0.3 * z)) ** 2 + ((y - 110) / (100 - 0.2 * z)) ** 2 < 1, 40.0, -1000.0)
    labels = torch.zeros(hu.shape, dtype=torch.uint8)
    for n in range(8):
        middle_x = 55 + 70 * (n % 4) + (0.4 + 0.1 * n) * (z - 30) * (-1) ** n
        middle_y = 75 + 70 * (n // 4) + 0.5 * (z - 30) * (-1) ** (n // 2)
        away = ((x - middle_x) ** 2 + (y - middle_y) ** 2).sqrt()
        hu = torch.where(away < 18, torch.where(away < 13, 100.0, 900.0), hu)
        labels[away < 18] = 1 + n % 2
    hu += noise_hu * torch.randn(hu.shape, generator=torch.Generator().manual_seed(0))
    affine = axis_aligned((1.0, 1.0, 1.0), (-160.0, -110.0, 500.0))
    return Volume(hu[kept], affine), Volume(labels[kept], affine)


@pytest.mark.parametrize("noise_hu", [0.0, 20.0, 60.0])
def test_nothing_is_missing_where_all_slices_are_there(noise_hu: float) -> None:
    assert lost_slice(*ct_and_labels(list(range(SLICES)), noise_hu), IDS) is None


@pytest.mark.parametrize("missing", [[22], [30, 31]])
def test_a_slice_that_is_missing_is_told(missing: list[int]) -> None:
    ct, labels = ct_and_labels([n for n in range(SLICES) if n not in missing])
    assert lost_slice(ct, labels, IDS) == missing[0] - 1
    assert "from slice" in str(told_of_lost_slice(ct, labels, IDS))


def test_every_other_slice_is_a_ct_of_thick_slices() -> None:
    assert lost_slice(*ct_and_labels(list(range(0, SLICES, 2))), IDS) is None


@pytest.mark.parametrize("shape", [(60, 1, 1), (1, 220, 320), (5, 60, 60), (6, 40, 40), (60, 40, 2), (7, 8, 14)])
def test_of_a_small_ct_nothing_is_asked(shape: tuple[int, int, int]) -> None:
    ct, labels = ct_and_labels(list(range(SLICES)))
    part = (slice(shape[0]), slice(70, 70 + shape[1]), slice(50, 50 + shape[2]))
    for spacing in (0.05, 1.0, 3.0):
        affine = axis_aligned((spacing,) * 3, (0.0, 0.0, 0.0))
        bone = torch.ones_like(labels.data[part])
        assert lost_slice(Volume(ct.data[part], affine), Volume(bone, affine), (1,)) is None
