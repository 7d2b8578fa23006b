"""Beads in a CT, found beside cortical bone and measured to a fraction of a voxel."""

from functools import cache

import numpy as np
import pytest
import torch
from scipy import ndimage

from femoreg_torch.beads import find_beads
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import rigid, rotation_angle
from femoreg_torch.geometry.rigid import exp_so3
from femoreg_torch.volume import Volume, axis_aligned

POINTS = torch.tensor(
    [[20.3, 21.7, 52.4], [31.9, 24.2, 44.8], [24.6, 33.3, 37.1], [35.2, 35.9, 29.6], [27.7, 19.8, 18.5]]
).double()


@cache
def scan(
    spacing: tuple[float, float, float], diameter_mm: float, turned: bool = False, empty: bool = False
) -> tuple[Volume, torch.Tensor]:
    """A CT of steel beads in trabecular bone with a cortical shell and specks of dense bone, and where they are, LPS.

    Made on voxels of 0.25 mm from the distance to each centre, blurred by 0.5 mm and averaged: no code is shared.
    """
    rng = np.random.default_rng(0)
    size = np.array([50, 50, 60])  # mm
    fine = 0.25
    z, y, x = (np.arange(n / fine) * fine + fine / 2 for n in size[::-1])
    radius = np.hypot(x[None, None] - 28, y[None, :, None] - 28) + 0 * z[:, None, None]
    hu = np.where(radius < 22, 250.0, 40.0)
    hu[(radius > 20) & (radius < 22)] = 1500
    specks = ndimage.gaussian_filter(rng.normal(0, 1, hu.shape).astype(np.float32), 4)
    hu += 250 * specks / specks.std() * (radius < 20)
    for px, py, pz in [] if empty else POINTS.tolist():
        near = tuple(slice(int((c - 2) / fine), int((c + 2) / fine) + 1) for c in (pz, py, px))
        offsets = [(np.arange(5) + 0.5) / 5 * fine - fine / 2] * 3  # a voxel's share of a bead by 125 points
        dz, dy, dx = (
            (axis[part][:, None] + offset).ravel() - c
            for axis, part, offset, c in zip((z, y, x), near, offsets, (pz, py, px), strict=True)
        )
        inside = dz[:, None, None] ** 2 + dy[None, :, None] ** 2 + dx[None, None] ** 2 <= (diameter_mm / 2) ** 2
        shape = [n for count in (len(dz), len(dy), len(dx)) for n in (count // 5, 5)]
        share = inside.reshape(shape).mean((1, 3, 5))
        hu[near] += share * (47_000 - hu[near])
    hu = ndimage.gaussian_filter(hu.astype(np.float32), 0.5 / fine)
    nx, ny, nz = (round(s / fine) for s in spacing)
    part = hu[: hu.shape[0] // nz * nz, : hu.shape[1] // ny * ny, : hu.shape[2] // nx * nx]
    coarse = part.reshape(part.shape[0] // nz, nz, part.shape[1] // ny, ny, part.shape[2] // nx, nx).mean((1, 3, 5))
    coarse = np.clip(coarse + rng.normal(0, 20, coarse.shape), -1024, 3071)
    affine = axis_aligned(spacing, tuple(s / 2 for s in spacing))
    lps_from_scan = torch.eye(4, dtype=torch.float64)
    if turned:
        lps_from_scan = rigid(exp_so3(torch.tensor([0.1, -0.2, 0.15]).double()), torch.tensor([-90.0, 40, 7]).double())
    points = POINTS @ lps_from_scan[:3, :3].T + lps_from_scan[:3, 3]
    return Volume(torch.from_numpy(coarse.astype(np.float32)), lps_from_scan @ affine), points


@pytest.mark.parametrize(
    ("spacing", "diameter_mm", "worst_mm"),
    [((1.0, 1.0, 1.0), 1.0, 0.15), ((1.0, 1.0, 0.5), 1.0, 0.10), ((0.5, 0.5, 0.5), 1.5, 0.06)],
)
def test_centres_are_found_to_a_fraction_of_a_voxel(
    spacing: tuple[float, float, float], diameter_mm: float, worst_mm: float
) -> None:
    ct, points = scan(spacing, diameter_mm)
    found, sure = find_beads(ct, diameter_mm, len(points), None)
    nearest = torch.cdist(points, found).min(1)
    assert sorted(nearest.indices.tolist()) == list(range(len(points)))
    assert nearest.values.max() < worst_mm
    assert ((sure >= 0.01) & (sure < worst_mm)).all()
    assert (nearest.values[nearest.indices.argsort()] < 6 * sure).all()
    assert (found[:-1, 2] > found[1:, 2]).all()  # from head to foot


def test_a_turned_grid_gives_the_same_beads() -> None:
    ct, points = scan((1.0, 1.0, 1.0), 1.0, turned=True)
    assert rotation_angle(ct.lps_from_index[:3, :3]) > 0.2
    assert torch.cdist(points, find_beads(ct, 1.0, len(points), None)[0]).min(1).values.max() < 0.15


def test_only_what_lies_within_is_searched() -> None:
    ct, points = scan((1.0, 1.0, 1.0), 1.0)
    within = torch.zeros(ct.data.shape, dtype=torch.bool)
    within[33:] = True  # above z = 33 mm
    assert (find_beads(ct, 1.0, 3, within)[0][:, 2] > 33).all()
    with pytest.raises(InputError, match="3 beads of 1 mm found, 5 were expected"):
        find_beads(ct, 1.0, len(points), within)


@pytest.mark.parametrize(
    ("count", "diameter_mm", "told"),
    [(7, 1.0, "5 beads of 1 mm found, 7"), (3, 1.0, "5 spots look like"), (5, 0.001, "0.3 to 6 mm")],
)
def test_a_wrong_count_or_size_is_told(count: int, diameter_mm: float, told: str) -> None:
    with pytest.raises(InputError, match=told):
        find_beads(scan((1.0, 1.0, 1.0), 1.0)[0], diameter_mm, count, None, "scan")


def test_bone_without_beads_holds_none() -> None:
    with pytest.raises(InputError, match="0 beads of 1 mm found, 5 were expected"):
        find_beads(scan((1.0, 1.0, 1.0), 1.0, empty=True)[0], 1.0, 5, None)


def test_voxels_too_coarse_are_refused() -> None:
    ct = Volume(torch.zeros(20, 20, 20), axis_aligned((1.0, 1.0, 3.0), (0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="too coarse"):
        find_beads(ct, 1.0, 5, None)
