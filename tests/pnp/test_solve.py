"""Robust PnP against poses that OpenCV itself projected."""

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import (
    Camera,
    centred_camera,
    exp_so3,
    load_carm,
    log_so3,
    project_points,
    rotation_angle,
    transform_points,
)
from femoreg_torch.pnp import PnpResult, solve_pnp

AP_FROM_LPS = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
LEFT_HALF = [  # an adult pelvis, LPS mm: FH, GSN, IOF, MOF, SPS, IPS, ASIS
    [90.0, -10, -80],
    [75, 15, -25],
    [48, 10, -120],
    [30, -10, -112],
    [4, -45, -108],
    [4, -20, -120],
    [125, -75, -25],
]
PELVIS = torch.tensor([[side * x, y, z] for x, y, z in LEFT_HALF for side in (1, -1)], dtype=torch.float64)
CAMERA = load_carm("cios_fusion").camera


def pose(rotation_deg: tuple[float, float, float] = (0, 0, 0), depth_mm: float = 740.0) -> Tensor:
    camera_from_lps = torch.eye(4, dtype=torch.float64)
    camera_from_lps[:3, :3] = exp_so3(torch.deg2rad(torch.tensor(rotation_deg, dtype=torch.float64))) @ AP_FROM_LPS
    camera_from_lps[:3, 3] = torch.tensor([12.0, -8, depth_mm]) - camera_from_lps[:3, :3] @ PELVIS.mean(0)
    return camera_from_lps


def seen(camera_from_lps: Tensor, camera: Camera = CAMERA, points: Tensor = PELVIS) -> Tensor:
    """Pixels (N, 2) by OpenCV's own projection."""
    rotation, translation = cv2.Rodrigues(camera_from_lps[:3, :3].numpy())[0], camera_from_lps[:3, 3].numpy()
    pixels, _ = cv2.projectPoints(points.numpy(), rotation, translation, camera.matrix().numpy(), None)
    return torch.from_numpy(pixels[:, 0])


def assert_pose(result: PnpResult, truth: Tensor, deg: float, lateral_mm: float, depth_mm: float) -> None:
    turned = result.camera_from_object[:3, :3] @ truth[:3, :3].mT
    assert torch.rad2deg(rotation_angle(turned)) < deg
    middle = torch.cat([PELVIS.mean(0), torch.ones(1, dtype=torch.float64)])
    shift = ((result.camera_from_object - truth) @ middle)[:3].abs()
    assert shift[:2].max() < lateral_mm
    assert shift[2] < depth_mm


@pytest.mark.parametrize("rotation_deg", [(0, 0, 0), (15, -30, 10), (-20, 45, -15), (5, 10, 180)])
def test_exact_landmarks_give_the_exact_pose(rotation_deg: tuple[float, float, float]) -> None:
    truth = pose(rotation_deg)
    result = solve_pnp(PELVIS, seen(truth), CAMERA)
    assert_pose(result, truth, 1e-9, 1e-9, 1e-9)
    assert result.inliers.all()
    assert result.rms_px < 1e-9


def test_off_centre_detectors_with_oblong_pixels() -> None:
    camera = Camera(980.0, (0.3, 0.25), (1000, 1100), (520.0, 470.0))
    truth = pose((4, 12, -3), 700.0)
    assert_pose(solve_pnp(PELVIS, seen(truth, camera), camera), truth, 1e-9, 1e-9, 1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_a_fifth_missing_and_two_gross_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = pose(tuple(rng.uniform(-20, 20, 3)))
    pixels = seen(truth) + torch.from_numpy(rng.normal(scale=1.0 / 0.194, size=(14, 2)))
    pixels[:2] += torch.from_numpy(rng.choice([-1, 1], (2, 2)) * rng.uniform(120, 400, (2, 2)))
    kept = torch.from_numpy(np.concatenate([[0, 1], 2 + rng.permutation(12)[:9]]))
    result = solve_pnp(PELVIS[kept], pixels[kept], CAMERA)
    assert_pose(result, truth, 2.0, 1.5, 8.0)
    assert not result.inliers[:2].any()
    assert result.inliers[2:].sum() >= 8


def test_swapped_sides_are_outvoted() -> None:
    truth = pose((8, -14, 3))
    pixels = seen(truth)
    pixels[[2, 3]] = pixels[[3, 2]]
    result = solve_pnp(PELVIS, pixels, CAMERA)
    assert_pose(result, truth, 1e-9, 1e-9, 1e-9)
    assert result.inliers.tolist() == [n not in (2, 3) for n in range(14)]


@pytest.mark.parametrize("seed", range(4))
def test_nearly_planar_points_do_not_flip_front_to_back(seed: int) -> None:
    """Far points near a plane have a second pose, tilted the other way."""
    rng = np.random.default_rng(seed)
    flat = PELVIS.clone()
    flat[:, 1] *= 0.5
    truth = pose((25, -20, 0))
    pixels = seen(truth, points=flat) + torch.from_numpy(rng.normal(scale=0.3 / 0.194, size=(14, 2)))
    result = solve_pnp(flat, pixels, CAMERA)
    assert torch.rad2deg(rotation_angle(result.camera_from_object[:3, :3] @ truth[:3, :3].mT)) < 4
    assert result.camera_from_object[2, 1] > 0


def test_weights_decide_between_landmarks() -> None:
    truth = pose()
    pixels = seen(truth)
    pixels[0] += 10.0
    weights = torch.ones(14)
    error = []
    for weight in (1.0, 1e-3):
        weights[0] = weight
        found = seen(solve_pnp(PELVIS, pixels, CAMERA, weights).camera_from_object)
        error.append((found - seen(truth)).norm())
    assert error[1] < 0.02 * error[0]


def test_covariance_is_the_spread_of_repeated_solutions() -> None:
    truth = pose((5, 5, 0))
    rng = np.random.default_rng(3)
    results = [
        solve_pnp(PELVIS, seen(truth) + torch.from_numpy(rng.normal(scale=1.5 / 0.194, size=(14, 2))), CAMERA)
        for _ in range(25)
    ]
    middle = torch.cat([PELVIS.mean(0), torch.ones(1, dtype=torch.float64)])
    depths = torch.stack([(result.camera_from_object @ middle)[2] for result in results])
    expected = torch.stack([result.covariance[5, 5].sqrt() for result in results]).median()
    assert 0.6 < depths.std() / expected < 1.6


def test_fewer_than_four() -> None:
    with pytest.raises(InputError, match="too few usable landmarks: 3 given, at least 4"):
        solve_pnp(PELVIS[:3], seen(pose())[:3], CAMERA)


def test_no_consensus() -> None:
    pixels = torch.from_numpy(np.random.default_rng(1).uniform(0, 1535, (14, 2)))
    with pytest.raises(InputError, match=r"too few usable landmarks: .* of 14 agree"):
        solve_pnp(PELVIS, pixels, CAMERA)


def test_a_patient_seen_from_behind_is_refused() -> None:
    behind = pose((0, 180, 0))
    with pytest.raises(InputError, match=r"too few usable landmarks|no usable pose"):
        solve_pnp(PELVIS, seen(behind), CAMERA)


def test_landmarks_that_agree_on_an_impossible_pose_alone_are_not_called_too_few() -> None:
    """Of a picture whose rows are counted from below; one is off, so that a pose of the right side is found first."""
    camera = centred_camera(1020.0, (0.776, 0.776), (384, 384))
    pixels = project_points(camera, transform_points(pose((8, 4, 0)), PELVIS))
    pixels[:, 1] = 383 - pixels[:, 1]
    with pytest.raises(
        InputError, match=r"no usable pose: \d+ of 14 landmarks agree on one, but by it the beam enters"
    ):
        solve_pnp(PELVIS, pixels, camera, deviations_px=torch.full((14,), 1.9).double())


def test_shapes_and_values_are_checked() -> None:
    pixels = seen(pose())
    with pytest.raises(InputError, match="pixels \\(N, 2\\)"):
        solve_pnp(PELVIS, pixels[:5], CAMERA)
    with pytest.raises(InputError, match="finite"):
        solve_pnp(PELVIS, pixels * torch.nan, CAMERA)


def test_a_patient_on_the_tube_is_refused() -> None:
    """Pose and landmarks agree, but nobody lies 350 mm from the source."""
    with pytest.raises(InputError, match="too few usable landmarks"):
        solve_pnp(PELVIS, seen(pose(depth_mm=350.0)), CAMERA)


def trial(rng: np.random.Generator, deviations_px: Tensor) -> tuple[Tensor, Tensor]:
    """A random pose, and its landmarks off by normal deviates of `deviations_px` (14,)."""
    truth = pose(tuple(rng.uniform(-15, 15, 3)), rng.uniform(650, 800))
    noise = torch.from_numpy(rng.normal(size=(14, 2))) * deviations_px[:, None]
    return truth, seen(truth) + noise


def test_known_deviations_are_better_than_none() -> None:
    rng = np.random.default_rng(7)
    deviations = torch.tensor([1.0, 6.0] * 7).double() / 0.194
    errors = []
    for _ in range(10):
        truth, pixels = trial(rng, deviations)
        poses = [solve_pnp(PELVIS, pixels, CAMERA, None, given).camera_from_object for given in (None, deviations)]
        errors.append([rotation_angle(found[:3, :3] @ truth[:3, :3].mT).item() for found in poses])
    without, known = np.median(errors, axis=0)
    assert known < 0.8 * without


def test_the_posterior_covariance_covers_the_truth() -> None:
    """The squared error in units of the covariance has the mean of chi squared with six degrees of freedom."""
    rng = np.random.default_rng(11)
    deviations = torch.full((14,), 2.0 / 0.194, dtype=torch.float64)
    middle = PELVIS.mean(0)
    distances = []
    for _ in range(25):
        truth, pixels = trial(rng, deviations)
        result = solve_pnp(PELVIS, pixels, CAMERA, None, deviations)
        found = result.camera_from_object
        turn = log_so3(truth[:3, :3] @ found[:3, :3].mT)
        shift = (truth[:3, :3] @ middle + truth[:3, 3]) - (found[:3, :3] @ middle + found[:3, 3])
        error = torch.cat([turn, shift])
        distances.append((error @ torch.linalg.solve(result.covariance, error)).item())
    assert 3.8 < np.mean(distances) < 9


def test_a_gross_outlier_counts_little() -> None:
    rng = np.random.default_rng(2)
    deviations = torch.full((14,), 2.0 / 0.194, dtype=torch.float64)
    truth, pixels = trial(rng, deviations)
    pixels[4] += 300.0
    assert_pose(solve_pnp(PELVIS, pixels, CAMERA, None, deviations), truth, 2.0, 1.5, 8.0)


def test_a_rotation_left_open_is_refused() -> None:
    """Four landmarks about one hip, known to 6 mm: they agree on a pose, but on many others too."""
    pixels = seen(pose((5, 5, 0)))
    few = torch.tensor([0, 2, 4, 6])
    deviations = torch.full((4,), 6.0 / 0.194, dtype=torch.float64)
    assert solve_pnp(PELVIS[few], pixels[few], CAMERA).inliers.all()
    with pytest.raises(InputError, match=r"too few usable landmarks: .* fix the rotation only to"):
        solve_pnp(PELVIS[few], pixels[few], CAMERA, None, deviations)


def test_points_that_lie_close_together_are_no_harm() -> None:
    """Among the subsets that are tried are then some that OpenCV refuses to solve."""
    crowd = PELVIS[8] + 0.1 * torch.randn((8, 3), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    points = torch.cat([PELVIS[:6], crowd])
    truth = pose((3, -4, 2))
    found = solve_pnp(points, seen(truth, points=points), CAMERA)
    assert torch.rad2deg(rotation_angle(found.camera_from_object[:3, :3] @ truth[:3, :3].mT)) < 0.01
