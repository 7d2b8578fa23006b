"""Landmarks as a network of a stated quality would find them, drawn from the truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import Detection, LandmarkNetwork, detect
from femoreg_torch.geometry import Camera, project_points, transform_points
from femoreg_torch.registration.start.find import Detector
from femoreg_torch.settings import check_within


@dataclass(frozen=True)
class DetectionNoise:
    """How well landmarks are found; the three draws are independent of one another."""

    mean_error_mm: float  # on the detector, of the found ones that are not gross outliers
    missing: float  # share of the landmarks in the image
    gross: float  # share of the found ones that lie anywhere in the image

    def __post_init__(self) -> None:
        check_within(self, mean_error_mm=(0, 100), missing=(0, 1), gross=(0, 1))


def draw_landmarks(
    landmarks: Mapping[str, Tensor],
    camera_from_pelvis: Tensor,
    camera: Camera,
    noise: DetectionNoise,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Pixels (L, 2) (column, row) and visibility (L,) of the landmarks, in the order of the anatomy's.

    Errors are normal along rows and columns alike, with the deviation whose mean distance, σ · √(π / 2), is the one
    asked for. Landmarks that lie outside the image (or that are unknown) are not visible.
    """
    count = len(HIP.landmarks)
    shift_mm = noise.mean_error_mm / math.sqrt(math.pi / 2) * torch.randn(count, 2, generator=generator).double()
    missed = torch.rand(count, generator=generator) < noise.missing
    gross = torch.rand(count, generator=generator) < noise.gross
    size = torch.tensor(camera.shape[::-1], dtype=torch.float64)
    anywhere = torch.rand(count, 2, generator=generator).double() * size - 0.5

    unknown = torch.full((3,), torch.nan, dtype=torch.float64)
    points = torch.stack([landmarks.get(name, unknown) for name in HIP.landmark_names])
    exact = project_points(camera, transform_points(camera_from_pelvis, points))
    in_image = ((exact >= -0.5) & (exact <= size - 0.5)).all(1)
    pixel_mm = torch.tensor(camera.pixel_mm[::-1], dtype=torch.float64)
    pixels = torch.where(gross[:, None], anywhere, exact + shift_mm / pixel_mm)
    return pixels, in_image & ~missed


def simulated_detector(
    landmarks: Mapping[str, Tensor],
    camera_from_pelvis: Tensor,
    noise: DetectionNoise,
    seed: int,
    network: LandmarkNetwork,
) -> Detector:
    """A detector whose landmarks are drawn from the truth, all of them equally confident.

    `camera_from_pelvis` (4, 4) is the true pose in the view that is asked for. What else a detection holds (the bones)
    is what the network sees.
    """

    def find(attenuation: Tensor, camera: Camera) -> Detection:
        generator = torch.Generator().manual_seed(seed)
        pixels, visible = draw_landmarks(landmarks, camera_from_pelvis, camera, noise, generator)
        seen = detect(network, attenuation, camera)
        alike = torch.ones_like(seen.confidence)
        deviation_px = alike * max(1.0, noise.mean_error_mm / math.sqrt(math.pi / 2)) / min(camera.pixel_mm)
        return replace(seen, pixels=pixels, visible=visible, confidence=alike, deviation_px=deviation_px)

    return find
