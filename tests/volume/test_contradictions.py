"""Grey values and label maps that do not belong to one another, of bones that are balls and shells in soft tissue."""

import math

import pytest
import torch
from scipy import ndimage

from femoreg_torch.geometry import about_point, exp_so3, rigid
from femoreg_torch.volume import (
    Volume,
    axis_aligned,
    densities,
    misplaced_labels,
    shifted_labels,
    soft_bones,
    turned_labels,
)
from femoreg_torch.volume.contradictions import intercept_twice

IDS = (1, 2)
NAMES = {"hip_left": 1, "femur_left": 2}


def ct_and_labels(spacing: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> tuple[Volume, Volume]:
    """Two balls of bone, marrow within, an unlabelled third one beside them, air all around."""
    counts = [round(140 / s) for s in spacing]
    x, y, z = torch.meshgrid(*(torch.arange(n) * s for n, s in zip(counts, spacing, strict=True)), indexing="ij")
    x, y, z = (axis.permute(2, 1, 0) for axis in (x, y, z))
    hu = torch.where((x - 70) ** 2 + (y - 70) ** 2 < 65**2, 40.0, -1000.0)
    labels = torch.zeros(hu.shape, dtype=torch.uint8)
    for label, (cx, cy, cz, radius) in {1: (45, 70, 60, 22), 2: (100, 60, 70, 18), 0: (80, 105, 60, 15)}.items():
        away = ((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2).sqrt()
        hu = torch.where(away < radius, torch.where(away < radius - 4, 120.0, 800.0), hu)
        labels[away < radius] = label
    affine = axis_aligned(spacing, (-70.0, -70.0, 900.0))
    hu += 25 * torch.randn(hu.shape, generator=torch.Generator().manual_seed(0))
    return Volume(hu, affine), Volume(labels, affine)


def unasked(ct: Volume, labels: Volume) -> bool:
    found = densities(ct, labels)
    told = (found.unscaled, found.light, found.elsewhere, soft_bones(ct, labels, NAMES))
    return all(one is None for one in told)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.7, 0.7, 3.0), (3.0, 3.0, 3.0)])
def test_what_belongs_together_is_not_doubted(spacing: tuple[float, float, float]) -> None:
    ct, labels = ct_and_labels(spacing)
    assert unasked(ct, labels)
    assert misplaced_labels(ct, labels, IDS) is None
    bare = ct.with_data(torch.where(labels.data > 0, ct.data, torch.tensor(-1000.0)))  # bones in air, as of a dry femur
    assert unasked(bare, labels)
    assert misplaced_labels(bare, labels, IDS) is None
    assert shifted_labels(ct, labels) is shifted_labels(bare, labels) is None
    assert turned_labels(ct, labels) is turned_labels(bare, labels) is None


@pytest.mark.parametrize("axes", [(0, 1), (0, 2), (1, 2)], ids=str)
def test_a_ct_that_is_turned_against_its_label_map_is_told(axes: tuple[int, ...]) -> None:
    ct, labels = ct_and_labels()
    told = densities(ct.with_data(ct.data.flip(axes)), labels).elsewhere
    assert "is one of the two flipped or turned" in str(told)


@pytest.mark.parametrize("factor", [1.0, 0.3])
@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (3.0, 3.0, 3.0)])
def test_sparse_bone_and_fatty_marrow_are_not_taken_for_another_ct(
    factor: float, spacing: tuple[float, float, float]
) -> None:
    """Marrow that is no denser than the muscle beside it, or lighter, within a shell of little density."""
    ct, labels = ct_and_labels(spacing)
    for fat_hu in (80.0, 200.0):
        marrow = (labels.data > 0) & (ct.data < 400)
        sparse = torch.where(marrow, ct.data - fat_hu, ct.data)
        assert unasked(ct.with_data(torch.where(sparse > 0, factor * sparse, sparse)), labels)


def test_bones_of_foam_with_a_hard_shell_are_not_doubted() -> None:
    """As those that are drilled in courses, in air."""
    ct, labels = ct_and_labels()
    foam = torch.where(labels.data > 0, torch.where(ct.data > 500, ct.data, -800.0), -1000.0)
    assert unasked(ct.with_data(foam), labels)
    assert misplaced_labels(ct.with_data(foam), labels, IDS) is None


def test_an_intercept_that_is_missing_or_there_twice_is_told() -> None:
    ct, labels = ct_and_labels()
    missing, twice = (densities(ct.with_data(ct.data + offset), labels) for offset in (1024, -1024))
    assert "is the rescale of the scanner" in str(missing.unscaled)
    assert missing.light is None
    assert "applied twice" in str(twice.light)
    assert twice.unscaled is None


def test_a_ct_that_was_saved_with_a_window_is_told() -> None:
    ct, labels = ct_and_labels()
    assert densities(ct, labels).windowed is None
    cut = ct.with_data(ct.data.clamp(-160, 240))
    assert "no bone has more than 240 HU" in str(densities(cut, labels).windowed)
    assert densities(ct.with_data(ct.data.clamp_max(1500)), labels).windowed is None
    of_one_density = ct.with_data(torch.where(labels.data > 0, 600.0, ct.data))
    assert densities(of_one_density, labels).windowed is None


def test_a_ct_without_bright_bone_tells_nothing_of_its_labels_place() -> None:
    ct, labels = ct_and_labels()
    assert misplaced_labels(ct.with_data(ct.data.clamp_max(100)), labels, IDS) is None


@pytest.mark.parametrize("shift", [(3, 0, 0), (0, -3, 0), (0, 0, 4), (2, -2, 2)])
def test_a_label_map_some_mm_aside_is_found_by_a_quick_look(shift: tuple[int, int, int]) -> None:
    ct, labels = ct_and_labels()
    aside = labels.with_data(labels.data.roll(shift, (2, 1, 0)))
    found = shifted_labels(ct, aside)
    assert found is not None
    assert (found + torch.tensor(shift)).norm() < 1.1
    near = labels.with_data(labels.data.roll((1, 1, -1), (2, 1, 0)))
    assert shifted_labels(ct, near) is None


@pytest.mark.parametrize("voxels", [-2, -1, 1, 2])
def test_too_large_or_too_small_is_not_aside(voxels: int) -> None:
    ct, labels = ct_and_labels()
    change = ndimage.grey_dilation if voxels > 0 else ndimage.grey_erosion
    other = change(labels.data.numpy(), size=2 * abs(voxels) + 1)
    assert shifted_labels(ct, labels.with_data(torch.from_numpy(other))) is None
    assert turned_labels(ct, labels.with_data(torch.from_numpy(other))) is None


@pytest.mark.parametrize(("axis", "words"), [(1, "front to back"), (2, "head to feet")])
@pytest.mark.parametrize("degrees", [-7, 7])
def test_a_label_map_that_is_turned_is_told(axis: int, words: str, degrees: float) -> None:
    """About the third axis, beside which all balls lie, a turn moves two of them by 1 mm."""
    ct, labels = ct_and_labels()
    of_three_balls = ndimage.binary_fill_holes((ct.data > 400).numpy()).astype("uint8")
    twist = torch.zeros(3, dtype=torch.float64)
    twist[axis] = math.radians(degrees)
    to_index = torch.linalg.inv(labels.lps_from_index)
    index_from_index = to_index @ about_point(rigid(exp_so3(twist)), labels.centre()) @ labels.lps_from_index
    turn, shift = index_from_index[:3, :3].flip(0, 1).numpy(), index_from_index[:3, 3].flip(0).numpy()
    turned = ndimage.affine_transform(of_three_balls, turn, shift, order=0)
    told = turned_labels(ct, labels.with_data(torch.from_numpy(turned)))
    assert told is not None
    assert words in told


@pytest.mark.parametrize("shift", [(4, 0, 0), (0, -8, 0), (3, 3, -11)])
@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.7, 0.7, 3.0)])
def test_labels_beside_their_bones_are_told(shift: tuple[int, int, int], spacing: tuple[float, float, float]) -> None:
    """Rolled by whole voxels, so that the label map lies that far to the left, back and head."""
    ct, labels = ct_and_labels(spacing)
    voxels = [round(mm / s) for mm, s in zip(shift, spacing, strict=True)]
    moved = labels.with_data(labels.data.roll(voxels[::-1], (0, 1, 2)))
    told = str(misplaced_labels(ct, moved, IDS))
    assert "if it were moved by" in told
    found = [float(part) for part in told.partition("moved by (")[2].partition(")")[0].split(", ")]
    asked = [-n * s for n, s in zip(voxels, spacing, strict=True)]
    assert found == pytest.approx(asked, abs=max(2.0, spacing[2] / 2) + 0.5)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.7, 0.7, 3.0), (3.0, 3.0, 3.0)])
@pytest.mark.parametrize("number", [1, 2])
def test_one_bone_of_soft_tissue_is_told_though_the_other_is_right(
    number: int, spacing: tuple[float, float, float]
) -> None:
    """As where its id is that of a muscle."""
    ct, labels = ct_and_labels(spacing)
    other = labels.data * (labels.data != number)
    away = -round(48 / spacing[2]) if number == 1 else round(48 / spacing[2])
    muscle = torch.where(other > 0, other, ((labels.data == number) * number).roll(away, 0))
    wrong = labels.with_data(muscle.to(labels.data.dtype))
    assert densities(ct, wrong).elsewhere is None
    told = soft_bones(ct, wrong, NAMES)
    (name,) = (name for name, n in NAMES.items() if n == number)
    assert told is not None
    assert told.startswith(f"label map: {name} (")
    assert "these labels hold soft tissue" in told
    assert soft_bones(ct, wrong, {n: i for n, i in NAMES.items() if i != number}) is None


def test_a_few_voxels_of_a_bone_say_nothing() -> None:
    ct, labels = ct_and_labels()
    few = torch.zeros_like(labels.data)
    few[60, 20, 70:74] = 2
    assert soft_bones(ct, labels.with_data(few), {"femur_left": 2}) is None


@pytest.mark.parametrize("clipped", [True, False])
def test_an_intercept_that_was_applied_twice_is_named(clipped: bool) -> None:
    """And neither padding about a patient nor a bone in air is taken for that."""
    place = torch.meshgrid(*[torch.arange(60.0) - 30] * 3, indexing="ij")
    noise = 20 * torch.randn(60, 60, 60, generator=torch.Generator().manual_seed(0))
    body, bone = place[1].hypot(place[2]) < 22, place[1].hypot(place[2]) < 6
    hu = torch.where(bone, 500.0, torch.where(body, 40.0, -1000.0)) + noise
    hu = hu.clamp_min(-1024) if clipped else hu
    affine = axis_aligned((3.0, 3.0, 3.0), (0, 0, 0))
    assert intercept_twice(Volume(hu, affine)) is None
    told = intercept_twice(Volume(hu - 1024, affine))
    assert told is not None
    assert "applied twice" in told
    corners = place[1].hypot(place[2]) > 29
    assert intercept_twice(Volume(torch.where(corners, -2000.0, hu), affine)) is None
    assert intercept_twice(Volume(torch.where(bone, hu, -1000.0), affine)) is None
