"""A femur made of simple solids, in a CT with air, fat and muscle, that the planner's tests share."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from femoreg_torch.planning.calibration import Calibration
from femoreg_torch.planning.femur import Femur, cut_out
from femoreg_torch.planning.settings import Planning, load_planning
from femoreg_torch.volume import Volume

HEAD = np.array([20.0, 0.0, 130.0])  # LPS mm; the shaft stands on (65, 0), lateral is +x
SLOPE = Calibration("uncalibrated", 0.000887, 0.0633, {})

MakeFemur = Callable[..., tuple[Volume, Volume, np.ndarray]]


def _capsule(points: np.ndarray, start: np.ndarray, end: np.ndarray, radius: float) -> np.ndarray:
    """Distance (…) to a rod with round ends, below 0 inside."""
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(points - start - share[..., None] * along, axis=-1) - radius


def _solids(spacing: float) -> tuple[Volume, Volume, np.ndarray]:
    axes = [np.arange(low, high, spacing) for low, high in ((-20, 106), (-40, 40), (0, 170))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    head = np.linalg.norm(points - HEAD, axis=-1) - 22
    neck = _capsule(points, HEAD, np.array([62.0, 3.0, 93.0]), 15)
    shaft = _capsule(points, np.array([65.0, 0.0, -30.0]), np.array([65.0, 0.0, 95.0]), 14)
    trochanter = np.linalg.norm(points - [68.0, 6.0, 108.0], axis=-1) - 18
    depth = -np.minimum.reduce([head, neck, shaft, trochanter])
    bone = 100 + 900 / (1 + np.exp((depth - 3.0) / 0.6))  # a cortex of 3 mm around spongy bone
    soft = np.where(points[..., 1] < -20, -95.0, 50.0)
    soft[points[..., 0] < -10] = -1000
    hu = np.where(depth > 0, bone, soft)
    affine = torch.eye(4, dtype=torch.float64)
    affine[:3, :3] *= spacing
    affine[:3, 3] = torch.tensor([axis[0] for axis in axes])
    ct = Volume(torch.from_numpy(hu.transpose(2, 1, 0).astype(np.float32).copy()), affine)
    labels = Volume(torch.from_numpy((depth > 0).transpose(2, 1, 0).astype(np.uint8).copy()), affine)
    return ct, labels, HEAD


@pytest.fixture(scope="session")
def solids() -> tuple[Volume, Volume, np.ndarray]:
    """CT, labels (the femur is 1) and the head's centre, at 2 mm; a left femur."""
    return _solids(2.0)


@pytest.fixture(scope="session")
def planning() -> Planning:
    return load_planning()


@pytest.fixture(scope="session")
def femur(solids: tuple[Volume, Volume, np.ndarray]) -> Femur:
    ct, labels, head = solids
    return cut_out(ct, labels, 1, head, "left", 95.0)
