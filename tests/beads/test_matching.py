"""Which shadow is which bead: with beads missing, other spots, and any order; and what must be refused."""

import cv2
import numpy as np
import pytest
import torch
from bead_scenes import CAMERA, DEVICE, FEMUR, pose, seen
from hypothesis import given, settings
from hypothesis import strategies as st

from femoreg_torch.beads import check_beads, match_beads
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import pose_difference

TWIST = (0.2, -0.3, 0.15, 4.0, -6.0, 10.0)


def shuffled(pixels: torch.Tensor, others: torch.Tensor, seed: int) -> tuple[torch.Tensor, list[int]]:
    """Spots in random order, and where each of the `pixels` went."""
    spots = torch.cat([pixels, others])
    order = torch.randperm(len(spots), generator=torch.Generator().manual_seed(seed))
    return spots[order], order.argsort()[: len(pixels)].tolist()


def test_exact_shadows_give_the_pose_of_opencv() -> None:
    true = pose(TWIST, 755, FEMUR)
    rotation, _ = cv2.Rodrigues(true[:3, :3].numpy())
    pixels, _ = cv2.projectPoints(FEMUR.numpy(), rotation, true[:3, 3].numpy(), CAMERA.matrix().numpy(), None)
    match = match_beads(FEMUR, torch.from_numpy(pixels[:, 0]), CAMERA)
    assert match.spots.tolist() == list(range(7))
    turned, shifted = pose_difference(true, match.camera_from_object, FEMUR.mean(0))
    assert turned < 1e-3
    assert shifted < 1e-2
    assert match.rms_px < 1e-3


@settings(max_examples=6, deadline=None, derandomize=True)
@given(
    turn=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    missing=st.integers(0, 1),
    false=st.integers(0, 4),
    seed=st.integers(0, 1000),
)
def test_any_order_missing_beads_and_false_ones(
    turn: tuple[float, float, float], missing: int, false: int, seed: int
) -> None:
    rng = torch.Generator().manual_seed(seed)
    true = pose((*turn, 3.0, -5.0, 12.0), 755, FEMUR)
    there = torch.randperm(7, generator=rng)[: 7 - missing].sort().values
    noisy = seen(FEMUR, true)[there] + 0.1 * torch.randn(len(there), 2, generator=rng).double()
    others = 400 + 700 * torch.rand(false, 2, generator=rng).double()
    spots, places = shuffled(noisy, others, seed)
    match = match_beads(FEMUR, spots, CAMERA)
    expected = torch.full((7,), -1)
    expected[there] = torch.tensor(places)
    assert match.spots.tolist() == expected.tolist()


def test_a_rough_pose_tells_apart_what_alone_would_be_chance() -> None:
    true = pose(TWIST, 560, DEVICE)
    rough = pose((0.17, -0.32, 0.14, 6.0, -9.0, 4.0), 560, DEVICE)
    rng = torch.Generator().manual_seed(3)
    four = seen(DEVICE, true)[[0, 1, 3, 4]] + 0.2 * torch.randn(4, 2, generator=rng).double()
    others = 100 + 1300 * torch.rand(9, 2, generator=rng).double()
    spots, places = shuffled(four, others, 3)
    with pytest.raises(InputError, match=r"which chance alone does too|two ways"):
        match_beads(DEVICE, spots, CAMERA)
    labels = torch.full((len(spots),), -1)
    labels[places] = torch.tensor([0, 1, 3, 4])
    assert match_beads(DEVICE, spots, CAMERA, rough, 12.0).count == 4
    told = match_beads(DEVICE, spots[places], CAMERA, labels=labels[places])
    assert told.spots.tolist() == [0, 1, -1, 2, 3]


def test_a_mislabelled_shadow_is_left_out() -> None:
    pixels = seen(FEMUR, pose(TWIST, 755, FEMUR))
    labels = torch.tensor([1, 0, 2, 3, 4, 5, 6])
    assert match_beads(FEMUR, pixels, CAMERA, labels=labels).spots.tolist() == [-1, -1, 2, 3, 4, 5, 6]


def test_symmetric_beads_cannot_be_told_apart() -> None:
    corners = torch.tensor([[x, y, z] for x in (-15, 15) for y in (-15, 15) for z in (-15, 15)], dtype=torch.float64)
    with pytest.raises(InputError, match="two ways to match"):
        match_beads(corners, seen(corners, pose(TWIST, 755, corners)), CAMERA)


def test_spots_that_are_no_beads_are_refused_in_one_line() -> None:
    spots = 200 + 1100 * torch.rand(9, 2, generator=torch.Generator().manual_seed(0)).double()
    with pytest.raises(InputError) as caught:
        match_beads(FEMUR, spots, CAMERA, where="beads of femur in view1.tif")
    assert str(caught.value).startswith("beads of femur in view1.tif: ")
    assert "\n" not in str(caught.value)


def test_three_shadows_are_too_few() -> None:
    with pytest.raises(InputError, match="3 shadows of beads found, at least 4"):
        match_beads(FEMUR, seen(FEMUR, pose(TWIST, 755, FEMUR))[:3], CAMERA)


def test_beads_behind_the_source_match_nothing() -> None:
    behind = pose(TWIST, -755, FEMUR)
    drawn = torch.from_numpy(
        cv2.projectPoints(
            FEMUR.numpy(),
            cv2.Rodrigues(behind[:3, :3].numpy())[0],
            behind[:3, 3].numpy(),
            CAMERA.matrix().numpy(),
            None,
        )[0][:, 0]
    )
    with pytest.raises(InputError, match=r"no pose brings|chance|two ways"):
        match_beads(FEMUR, drawn, CAMERA, behind, 5.0)


@pytest.mark.parametrize(
    ("points", "told"),
    [
        (FEMUR[:3], "3 beads, at least 4 are needed"),
        (torch.arange(6)[:, None] * torch.tensor([[3.0, 4.0, 5.0]]).double(), "in one line"),
        (FEMUR[:1].expand(5, 3), "all 5 beads lie in one point"),
        (FEMUR / 1000, "in metres"),
        (FEMUR * 1000, "Give mm"),
        (FEMUR.clone().index_fill_(0, torch.tensor(0), float("nan")), "not finite"),
    ],
)
def test_beads_that_no_pose_follows_from(points: torch.Tensor, told: str) -> None:
    with pytest.raises(InputError, match=told) as caught:
        check_beads(points, "beads.yaml, objects.femur.points")
    assert str(caught.value).startswith("beads.yaml, objects.femur.points: ")
    assert "\n" not in str(caught.value)


def test_the_result_does_not_depend_on_chance() -> None:
    spots, _ = shuffled(seen(FEMUR, pose(TWIST, 755, FEMUR)), torch.rand(6, 2).double() * 900 + 300, 5)
    first, second = (match_beads(FEMUR, spots, CAMERA) for _ in range(2))
    assert np.array_equal(first.camera_from_object.numpy(), second.camera_from_object.numpy())
