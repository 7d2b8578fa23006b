"""What a detection must offer to start a registration."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera, project_points, rotation_angle, transform_points
from femoreg_torch.registration.start import find_start, start_from_landmarks
from femoreg_torch.volume import HIP_LANDMARKS

CAMERA = centred_camera(1020.0, (0.776, 0.776), (384, 384))
CASE: Any = SimpleNamespace(
    views=[SimpleNamespace(anatomy=Path("view1.tif"))],
    landmarks={name: torch.zeros(3, dtype=torch.float64) for name in HIP_LANDMARKS},
    carm=SimpleNamespace(camera=CAMERA),
)
SCENE: Any = SimpleNamespace(images={"anatomy": (torch.rand(CAMERA.shape),)}, hips=None)


def detection(visible: int, inverted: bool) -> Detection:
    seen = torch.arange(len(HIP_LANDMARKS)) < visible
    ones = torch.ones(len(HIP_LANDMARKS), dtype=torch.float64)
    pixels = torch.zeros(len(HIP_LANDMARKS), 2, dtype=torch.float64)
    return Detection(pixels, ones, ones, seen, torch.zeros(7, 96, 96), CAMERA, False, inverted)


def test_too_few_landmarks_are_refused() -> None:
    with pytest.raises(InputError, match=r"view1.tif: 3 usable landmarks found, at least 4"):
        start_from_landmarks(CASE, SCENE, detection(3, inverted=False))


def test_inverted_grey_values_are_refused_however_many_landmarks_there_are() -> None:
    with pytest.raises(InputError, match=r"view1.tif: bone seems to be darker"):
        start_from_landmarks(CASE, SCENE, detection(14, inverted=True))


def test_a_rotation_left_open_is_refused_where_no_outline_can_mend_it() -> None:
    """Six landmarks of one hip, seen exactly but trusted to some mm only."""
    six = [[75.0, 15, -25], [48, 10, -120], [30, -10, -112], [4, -45, -108], [4, -20, -120], [125, -75, -25]]
    points = torch.tensor(six, dtype=torch.float64)
    landmarks = dict(zip(HIP_LANDMARKS[:6], points, strict=True))
    pose = torch.tensor([[1.0, 0, 0, -30], [0, 0, -1, -80], [0, 1, 0, 740], [0, 0, 0, 1]], dtype=torch.float64)
    found = detection(6, inverted=False)
    found.pixels[:6] = project_points(CAMERA, transform_points(pose, points))
    start = find_start(landmarks, found, torch.rand(CAMERA.shape), CAMERA, None)
    assert rotation_angle(start.camera_from_ct[:3, :3] @ pose[:3, :3].mT) < 0.02
    vague = replace(found, deviation_px=9 * found.deviation_px)
    with pytest.raises(InputError, match=r"fix the rotation only to \d+°, and no outlines help"):
        find_start(landmarks, vague, torch.rand(CAMERA.shape), CAMERA, None)
