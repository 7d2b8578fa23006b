"""Bones without a network: sheets against analytic shapes, cuts against every assignment, a pelvis of solids."""

from itertools import product

import numpy as np
import pytest
import torch
from hip_scenes import dice
from numpy.typing import NDArray
from pelvis_scene import HEADS, pelvis_scene

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points
from femoreg_torch.segment import Segmentation, segment_bones_without_network, without_network
from femoreg_torch.segment.bones import _averaged
from femoreg_torch.segment.refine import contact
from femoreg_torch.segment.sheets import APART, BONE, OUTSIDE, Links, enclosure, minimum_cut, sheetness
from femoreg_torch.segment.without_network import Head, femoral_heads
from femoreg_torch.volume import Volume, axis_aligned, resample_isotropic

NUMBERS = {name: 1 + n for n, name in enumerate(HIP.bone_names)}


@pytest.mark.parametrize("normal", [(1, 0, 0), (0, 1, 0), (1, 1, 0), (1, -2, 3)])
@pytest.mark.parametrize(("squared", "least", "most"), [("sheet", 0.85, 1.0), ("tube", -0.1, 0.1), ("blob", -0.1, 0.1)])
def test_sheets_alone_are_sheet_like_however_they_lie(
    normal: tuple[int, int, int], squared: str, least: float, most: float
) -> None:
    n = np.array(normal) / np.linalg.norm(normal)
    points = np.stack(np.mgrid[-10:11, -10:11, -10:11], -1) * 0.75
    along = points @ n
    radial = (points**2).sum(-1) - along**2
    off = {"sheet": along**2, "tube": radial, "blob": along**2 + radial}[squared]
    bright = (1000 * np.exp(-off / 2)).astype(np.float32)
    everywhere = np.ones(bright.shape, bool)
    middle = (10, 10, 10)
    assert least <= sheetness(bright, 0.75, everywhere)[middle] <= most
    assert -most <= sheetness(-bright, 0.75, everywhere)[middle] <= -least


@pytest.mark.parametrize("seed", range(8))
def test_the_cut_is_the_cheapest_of_all(seed: int) -> None:
    random = np.random.default_rng(seed)
    shape = (2, 3, 3)
    stand = np.zeros(shape, np.uint8)
    stand[0, 0, 0], stand[1, 2, 2], stand[0, 2, 0], stand[1, 0, 2] = BONE, OUTSIDE, APART, OUTSIDE
    pull = random.integers(-30, 31, shape).astype(np.int32)
    links = []
    for axis in range(3):
        faces = [n - (k == axis) for k, n in enumerate(shape)]
        onwards, backwards = (random.integers(0, 40, faces).astype(np.int32) for _ in range(2))
        links.append(Links(onwards, backwards))
    undecided = stand == 0

    def cost(bone: NDArray[np.bool_]) -> int:
        total = int(pull[undecided & ~bone].clip(0).sum() + (-pull[undecided & bone]).clip(0).sum())
        for axis, link in enumerate(links):
            low, high = (np.take(bone, r, axis) for r in (range(shape[axis] - 1), range(1, shape[axis])))
            with_links = [np.take(stand != APART, r, axis) for r in (range(shape[axis] - 1), range(1, shape[axis]))]
            linked = with_links[0] & with_links[1]
            total += int(link.onwards[low & ~high & linked].sum() + link.backwards[high & ~low & linked].sum())
        return total

    best = None
    for choice in product((False, True), repeat=int(undecided.sum())):
        bone = stand == BONE
        bone[undecided] = choice
        best = cost(bone) if best is None else min(best, cost(bone))
    assert cost(minimum_cut(stand, pull, links)) == best


def test_what_a_shell_holds_is_enclosed_also_where_the_volume_cuts_it() -> None:
    z, y, x = np.mgrid[:60, -30:30, -30:30]
    shaft = np.abs(np.hypot(y, x) - 12) < 2
    share = enclosure(shaft, 1.0)
    assert share[30, 30, 30] == pytest.approx(24 / 26)  # all but along the shaft
    assert share[0, 30, 30] == pytest.approx(24 / 26)
    plate = np.abs(z - 30) < 2
    assert share[30, 30, 55] < 0.5
    assert 0.3 < enclosure(plate, 1.0)[36, 30, 30] < 0.5


@pytest.fixture(scope="module")
def scene() -> tuple[Volume, NDArray[np.uint8]]:
    return pelvis_scene()


@pytest.fixture(scope="module")
def found(scene: tuple[Volume, NDArray[np.uint8]]) -> Segmentation:
    return segment_bones_without_network(scene[0])


def test_heads_are_found_left_first(scene: tuple[Volume, NDArray[np.uint8]]) -> None:
    both = femoral_heads(scene[0])
    for head, side in zip(both, ("left", "right"), strict=True):
        np.testing.assert_allclose(head.centre, HEADS[side], atol=3.0)


@pytest.mark.parametrize(
    ("bone", "least"),
    [("femur_left", 0.95), ("femur_right", 0.95), ("hip_left", 0.93), ("hip_right", 0.93), ("sacrum", 0.93)],
)
def test_each_bone_is_found_on_its_side(
    bone: str, least: float, scene: tuple[Volume, NDArray[np.uint8]], found: Segmentation
) -> None:
    assert dice(found.labels.data, scene[1], NUMBERS[bone]) > least


def test_nothing_is_told_that_only_a_network_knows(found: Segmentation) -> None:
    assert set(found.volume_ml) == {"hip_left", "hip_right", "sacrum", "femur_left", "femur_right"}
    assert found.confidence == {}
    assert not any("mirrored" in told or "network" in told for told in found.warnings)
    labels = found.labels.data.numpy()
    assert not contact(labels, NUMBERS["femur_left"], NUMBERS["hip_left"]).any()


def test_half_a_pelvis_is_of_its_side(scene: tuple[Volume, NDArray[np.uint8]]) -> None:
    ct, truth = scene
    half = ct.data.shape[2] // 2 - 5
    right = Volume(ct.data[:, :, :half].contiguous(), ct.lps_from_index)
    one = segment_bones_without_network(right, refine=False)
    assert dice(one.labels.data, truth[:, :, :half], NUMBERS["femur_right"]) > 0.85
    assert not {"femur_left", "hip_left"} & set(one.volume_ml)
    assert any("left hip bone is not in the CT" in told for told in one.warnings)


def test_a_ct_without_a_hip_is_refused_in_one_line(scene: tuple[Volume, NDArray[np.uint8]]) -> None:
    ct = scene[0]
    with pytest.raises(InputError, match="holds no bone"):
        segment_bones_without_network(ct.with_data(ct.data.clamp(max=100)))
    plate = torch.zeros_like(ct.data)
    plate[60:64] = 900.0
    with pytest.raises(InputError, match="no femoral head was found"):
        segment_bones_without_network(ct.with_data(plate))


@pytest.mark.parametrize("scale", [0.75, 1.5])
def test_a_ball_that_is_too_small_or_too_large_is_no_head(
    scene: tuple[Volume, NDArray[np.uint8]], scale: float
) -> None:
    """A pelvis of that size looks the same but for its millimetres: heads of 17 or 34 mm, which no adult has."""
    affine = scene[0].lps_from_index.clone()
    affine[:3] *= scale
    with pytest.raises(InputError, match=r"no femoral head was found|what looks like a femoral head"):
        segment_bones_without_network(Volume(scene[0].data, affine), refine=False)


@pytest.mark.parametrize("place", [(125.0, 0.0, -60.0), (70.0, 20.0, 70.0)], ids=["in the shaft", "in the ilium"])
def test_a_head_in_no_socket_is_refused(
    scene: tuple[Volume, NDArray[np.uint8]], place: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    heads = [Head(np.array(place), 23.0, 1.0)]
    monkeypatch.setattr(without_network, "femoral_heads", lambda ct: heads)
    says = (
        f"at LPS {place[0]:.0f}, {place[1]:.0f}, {place[2]:.0f} mm .* lies in no socket of a hip bone. A CT of the hip"
    )
    with pytest.raises(InputError, match=says):
        segment_bones_without_network(scene[0])


def test_a_mask_is_averaged_where_it_lies_on_a_grid_of_another_extent() -> None:
    """Voxels of 1.25 mm end 2.5 mm before those of 3 mm do; a ball at the far end must not be drawn out to it."""
    ct = Volume(torch.zeros(249, 249, 249), axis_aligned((1.0, 1.0, 1.0), (0, 0, 0)))
    grid, fine = resample_isotropic(ct, 3.0), resample_isotropic(ct, 1.25)
    z, y, x = torch.meshgrid(*(torch.arange(n) * 1.25 + 0.125 for n in fine.data.shape), indexing="ij")
    middle = torch.tensor([220.0, 215.0, 222.0])
    ball = ((x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2 < 20**2).float()
    share = _averaged(fine.with_data(ball), grid)
    assert share.shape == grid.data.shape
    index = torch.stack(torch.meshgrid(*(torch.arange(n) for n in share.shape), indexing="ij"), -1).flip(-1).double()
    points = transform_points(grid.lps_from_index, index.reshape(-1, 3))
    centroid = (share.reshape(-1, 1) * points).sum(0) / share.sum()
    torch.testing.assert_close(centroid, middle.double(), atol=0.05, rtol=0)
