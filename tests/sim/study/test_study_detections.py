"""Simulated detections have the errors, the gaps and the outliers that were asked for."""

import pytest
import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera, project_points, transform_points
from femoreg_torch.pnp import solve_pnp
from sim.study.detections import DetectionNoise, draw_landmarks

CAMERA = centred_camera(1020.0, (0.25, 0.2), (1200, 1500))  # oblong pixels: rows and columns must not be mixed up
POSE = torch.tensor([[1, 0, 0, 5], [0, 0, -1, -8], [0, 1, 0, 760], [0, 0, 0, 1]], dtype=torch.float64)
PAPER = DetectionNoise(mean_error_mm=3, missing=0.2, gross=0.02)


def landmarks(seed: int = 0) -> dict[str, torch.Tensor]:
    """14 points that all fall on the detector."""
    points = torch.rand(14, 3, generator=torch.Generator().manual_seed(seed)).double() * 120 - 60
    return dict(zip(HIP.landmark_names, points, strict=True))


def many(noise: DetectionNoise, draws: int = 600) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances in mm on the detector (draws, 14) and visibility (draws, 14)."""
    points = torch.stack(list(landmarks().values()))
    exact = project_points(CAMERA, transform_points(POSE, points))
    assert ((exact > 60) & (exact < 1140)).all()
    distances, seen = [], []
    for seed in range(draws):
        pixels, visible = draw_landmarks(landmarks(), POSE, CAMERA, noise, torch.Generator().manual_seed(seed))
        distances.append(((pixels - exact) * torch.tensor([0.2, 0.25])).norm(dim=1))
        seen.append(visible)
    return torch.stack(distances), torch.stack(seen)


def test_mean_error_is_the_one_asked_for_on_the_detector() -> None:
    distances, _ = many(DetectionNoise(3, 0, 0))
    assert distances.mean().item() == pytest.approx(3.0, abs=0.1)


def test_shares_of_missing_landmarks_and_outliers() -> None:
    distances, seen = many(PAPER)
    assert seen.double().mean().item() == pytest.approx(0.8, abs=0.02)
    # 3 mm of mean is 2.39 mm of deviation along each axis: only outliers are more than 15 mm off, and few of those,
    # being anywhere on 300 × 300 mm, are not
    assert (distances[seen] > 15).double().mean().item() == pytest.approx(0.02, abs=0.006)


def test_draws_are_independent_of_one_another() -> None:
    distances, seen = many(PAPER, 2000)
    gross = distances > 15
    assert (gross & seen).sum().item() == pytest.approx(0.8 * gross.sum().item(), rel=0.08)


def test_same_seed_same_detections() -> None:
    def draw(seed: int) -> torch.Tensor:
        return draw_landmarks(landmarks(), POSE, CAMERA, PAPER, torch.Generator().manual_seed(seed))[0]

    assert torch.equal(draw(4), draw(4))
    assert not torch.equal(draw(4), draw(5))


def test_what_is_not_in_the_image_is_not_seen() -> None:
    points = landmarks() | {"FH-l": torch.tensor([400.0, 0, 0], dtype=torch.float64)}
    del points["GSN-r"]
    _, seen = draw_landmarks(points, POSE, CAMERA, DetectionNoise(0, 0, 0), torch.Generator().manual_seed(0))
    unseen = {name for name, visible in zip(HIP.landmark_names, seen.tolist(), strict=True) if not visible}
    assert unseen == {"FH-l", "GSN-r"}


def test_without_noise_pnp_returns_the_pose() -> None:
    pixels, seen = draw_landmarks(
        landmarks(), POSE, CAMERA, DetectionNoise(0, 0.2, 0), torch.Generator().manual_seed(1)
    )
    found = solve_pnp(torch.stack(list(landmarks().values()))[seen], pixels[seen], CAMERA)
    torch.testing.assert_close(found.camera_from_object, POSE, atol=1e-4, rtol=0)


def test_nothing_found_is_refused_by_pnp() -> None:
    pixels, seen = draw_landmarks(landmarks(), POSE, CAMERA, DetectionNoise(3, 1, 0), torch.Generator().manual_seed(1))
    assert not seen.any()
    with pytest.raises(InputError, match="too few"):
        solve_pnp(torch.stack(list(landmarks().values()))[seen], pixels[seen], CAMERA)
