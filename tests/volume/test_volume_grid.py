"""What a volume refuses to be."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, axis_aligned


def _affine(row: int, column: int, value: float) -> Tensor:
    affine = axis_aligned((1.0, 1.5, 2.0), (-10.0, 20.0, 600.0))
    affine[row, column] = value
    return affine


@pytest.mark.parametrize(
    ("affine", "says"),
    [
        (_affine(0, 3, math.nan), "not finite"),
        (_affine(1, 1, math.inf), "not finite"),
        (_affine(3, 3, 2.0), "last row"),
        (_affine(3, 0, 0.1), "last row"),
        (_affine(0, 0, 0.0), "edges of 0 × 1.5 × 2 mm"),
        (_affine(0, 0, 1e9), "between 1e-06 and 1e"),
        (_affine(0, 0, 1e-12), "in mm"),
        (_affine(2, 3, 1e12), "farther than"),
        (torch.ones(4, 4, dtype=torch.float64).index_fill_(0, torch.tensor(3), 0) + _affine(0, 0, 0.0) * 0, "last row"),
        (axis_aligned((1, 1, 1), (0, 0, 0))[[0, 0, 2, 3]], "edges of"),
        (axis_aligned((1, 1, 1), (0, 0, 0)).float(), "float64"),
        (np.eye(4), "float64 tensor"),
    ],
    ids=range(12),
)
def test_an_affine_of_no_grid_is_refused(affine: Tensor, says: str) -> None:
    with pytest.raises(InputError, match=says):
        Volume(torch.zeros(3, 4, 5), affine)


def test_axes_in_one_plane_are_refused() -> None:
    affine = axis_aligned((1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    affine[:3, 2] = affine[:3, 0] + affine[:3, 1]
    with pytest.raises(InputError, match="in one plane"):
        Volume(torch.zeros(3, 4, 5), affine)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (torch.zeros(4, 4), r"\(Z, Y, X\)"),
        (torch.zeros(2, 2, 2, dtype=torch.complex64), "complex"),
        (np.zeros((2, 2, 2)), "torch.from_numpy"),
    ],
    ids=["two axes", "complex", "numpy"],
)
def test_data_that_are_no_volume_are_refused(data: Tensor, says: str) -> None:
    with pytest.raises(InputError, match=says):
        Volume(data, torch.eye(4, dtype=torch.float64))


def test_turned_sheared_mirrored_and_rounded_grids_are_grids() -> None:
    sheared = torch.tensor([[0.5, 0.2, 0, 7], [0, -0.6, 0.4, 8], [0.1, 0, 3, 9], [0, 0, 1e-16, 1]], dtype=torch.float64)
    for affine in (sheared, axis_aligned((1e-3, 1e-3, 1e-3), (0, 0, 0)), axis_aligned((500, 500, 500), (0, 0, 0))):
        assert Volume(torch.zeros(3, 4, 5), affine).lps_from_index is affine


def test_points_above_a_value_are_the_centres_of_their_voxels_and_never_too_many() -> None:
    data = torch.zeros(3, 4, 5)
    data[1, 2, 3], data[2, 0, 0] = 2.0, 1.0
    affine = axis_aligned((1.0, 2.0, 3.0), (10.0, 20.0, 30.0))
    volume = Volume(data, affine)
    assert volume.points_above(1.0, 10).tolist() == [[13.0, 24.0, 33.0]]
    assert volume.points_above(0.5, 10).tolist() == [[13.0, 24.0, 33.0], [10.0, 20.0, 36.0]]
    assert len(volume.points_above(5.0, 10)) == 0
    for most in (1, 7, 30, 60, 100):
        assert 0 < len(Volume(torch.ones(3, 4, 5), affine).points_above(0.5, most)) <= most
