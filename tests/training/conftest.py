"""What the tests of training share."""

from pathlib import Path

import pytest
import torch

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.volume import Volume, axis_aligned, write_landmarks, write_volume


@pytest.fixture(scope="session")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two hip bones, a sacrum and two femora as boxes of bone in a block of muscle."""
    folder = tmp_path_factory.mktemp("case")
    ct, labels = torch.full((50, 40, 70), -1000.0), torch.zeros((50, 40, 70), dtype=torch.uint8)
    ct[2:-2, 2:-2, 2:-2] = 40.0
    boxes = {
        "hip_left": (44, 62, 15, 45),
        "hip_right": (8, 26, 15, 45),
        "sacrum": (29, 41, 30, 48),
        "femur_left": (50, 60, 3, 13),
        "femur_right": (10, 20, 3, 13),
    }
    ids = label_table("femoreg")
    for bone, (x0, x1, z0, z1) in boxes.items():
        ct[z0:z1, 12:28, x0:x1], labels[z0:z1, 12:28, x0:x1] = 700.0, ids[bone][0]
    affine = axis_aligned((4.0, 4.0, 4.0), (-140.0, -80.0, -100.0))
    write_volume(folder / "ct.nii.gz", Volume(ct, affine))
    write_volume(folder / "labels.nii.gz", Volume(labels, affine))
    sides = {"l": 1.0, "r": -1.0}
    points = {
        name: torch.tensor([sides[name[-1]] * (20.0 + 12 * (n // 2)), -5.0 * (n // 2), -40.0 + 15 * (n // 2)])
        for n, name in enumerate(HIP.landmark_names)
    }
    write_landmarks(folder / "landmarks.json", points)
    return folder
