"""A body whose bones are boxes, with landmarks."""

import torch

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.volume import Volume, axis_aligned


def landmarks():
    left = [[90.3, -10, -80], [75, 15.5, -25], [48, 10, -120.2], [30, -10, -112], [8, -45, -90], [9, -20, -120.7]]
    points = [[s * x, y, z] for x, y, z in [*left, [119.0, -70.4, -25]] for s in (1, -1)]
    return dict(zip(HIP.landmark_names, torch.tensor(points, dtype=torch.float64), strict=True))


def box_scan():
    """Bones as boxes in a body; CT in HU and labels at 2 mm."""
    affine = axis_aligned((2.0, 2.0, 2.0), (-150.0, -90.0, -180.0))
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (120, 85, 150)), indexing="ij")
    points = torch.stack([x, y, z], -1) * 2 + affine[:3, 3]
    hu = torch.full(points.shape[:3], -1000.0)
    hu[:, 4:-4, 4:-4] = 40.0
    labels = torch.zeros_like(hu, dtype=torch.uint8)
    boxes = {
        "hip_left": (80, 140, 60, 110),
        "hip_right": (10, 70, 60, 110),
        "sacrum": (66, 84, 80, 115),
        "femur_left": (105, 140, 5, 55),
        "femur_right": (10, 45, 5, 55),
    }
    for bone, (x0, x1, z0, z1) in boxes.items():
        labels[z0:z1, 30:50, x0:x1] = label_table("femoreg")[bone][0]
    hu[labels > 0] = 250.0
    return Volume(hu, affine), Volume(labels, affine)
