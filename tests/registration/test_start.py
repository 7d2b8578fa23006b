"""What a detection must offer to start a registration."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera
from femoreg_torch.registration.start import start_from_landmarks
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
