"""Smooth random pictures."""

import cv2
import numpy as np
import torch
from torch import Tensor


def picture(seed: int, height: int = 40, width: int = 33) -> Tensor:
    """A picture (H, W), float32, of which no two parts are alike."""
    generator = np.random.default_rng(seed)
    return torch.from_numpy(cv2.GaussianBlur(generator.random((height, width), np.float32), (0, 0), 2.0))
