"""Three planes of a CT: which points are named on them."""

import numpy as np
import torch

from femoreg_torch.intake.planes import three_planes
from femoreg_torch.volume import Volume, axis_aligned


def yellow(columns: slice, mark: tuple[float, float, float]) -> int:
    """How many bright yellow pixels a mark leaves in these columns of the picture."""
    grey = Volume(torch.zeros(60, 60, 60), axis_aligned((2.0, 2.0, 2.0), (0.0, 0.0, 0.0)))
    place = torch.tensor(mark, dtype=torch.float64)
    picture = three_planes(grey, None, {}, {"FH-l": place}, torch.full((3,), 59.0, dtype=torch.float64))
    blue, _, red = np.moveaxis(picture[40:-40, columns].astype(int), 2, 0)  # between what stands at the edges
    return int(((red > 150) & (blue < 120)).sum())


def test_a_point_is_named_on_the_plane_that_it_lies_near_and_dim_on_the_others() -> None:
    """One 5 mm above the axial plane, 40 mm before the coronal one, and 30 mm beside the sagittal one."""
    mark = (89.0, 19.0, 64.0)
    axial, coronal, sagittal = (yellow(slice(426 * n, 426 * n + 420), mark) for n in range(3))
    assert axial > 20
    assert coronal == sagittal == 0


def test_ids_are_named_in_their_colours_beside_the_planes() -> None:
    labels = torch.zeros(60, 60, 60, dtype=torch.int32)
    labels[20:40, 20:40, 20:40] = 7
    volume = Volume(labels, axis_aligned((2.0, 2.0, 2.0), (0.0, 0.0, 0.0)))
    without, beside = (three_planes(None, volume, {7: (250, 20, 30)}, {}, names=names) for names in (None, {7: "hip"}))
    np.testing.assert_array_equal(beside[:, : without.shape[1]], without)
    blue, green, red = np.moveaxis(beside[:, without.shape[1] :].astype(int), 2, 0)
    assert ((red > 200) & (green < 60) & (blue < 60)).sum() > 20
