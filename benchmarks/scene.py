"""The scene of the projector's benchmark: a pelvis before the paper's detector, four times coarser."""

import os
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.geometry import about_point, exp_se3, load_carm
from femoreg_torch.volume import read_ct, read_labels, structure_attenuation
from femoreg_torch.volume.grid import Volume, axis_aligned

CAMERA = load_carm("cios_fusion").camera.downsampled(4)  # 384 × 384 of 0.776 mm, 1020 mm from the source
_DEPTH_MM = 800.0  # source to the middle of the pelvis


def default_case() -> Path | None:
    """The real pelvis: under FEMOREG_DATA, or in a folder `shared/data` beside the checkout; None if there is none."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    case = Path(os.environ.get("FEMOREG_DATA", beside)) / "cases" / "bmf"
    return case if (case / "ct.nii.gz").exists() else None


def pelvis(case: Path | None) -> tuple[Volume, str]:
    """Attenuation of the pelvis of a case folder (or of a phantom without one), and what to call it."""
    if case is None:
        return phantom(), "phantom"
    ct, ids = read_ct(case / "ct.nii.gz"), label_table("femoreg")
    bones = [number for bone in HIP.members("pelvis") for number in ids[bone]]
    return structure_attenuation(ct, read_labels(case / "labels.nii.gz", ct), bones), f"pelvis of `{case.name}`"


def phantom() -> Volume:
    """Three hollow ellipsoids, as large as two iliac wings and a sacrum, in 1 mm voxels; a fifth of the box is bone."""
    shape = (220, 160, 280)
    z, y, x = torch.meshgrid(*[torch.arange(n) - (n - 1) / 2 for n in shape], indexing="ij")
    data = torch.zeros(shape)
    for middle, axes in (((-85, 0, 20), (50, 70, 85)), ((85, 0, 20), (50, 70, 85)), ((0, 45, 20), (50, 28, 60))):
        parts = zip((x, y, z), middle, axes, strict=True)
        radius = torch.stack([((v - m) / a) ** 2 for v, m, a in parts]).sum(0).sqrt()
        data[radius < 1] = 0.005
        data[(radius < 1) & (radius > 0.94)] = 0.03
    return Volume(data, axis_aligned((1.0, 1.0, 1.0), (-139.5, -79.5, -109.5)))


def poses(volume: Volume, count: int) -> Tensor:
    """`camera_from_volume` (count, 4, 4): patient upright before the source, ± 15° and ± 15 mm about the middle."""
    upright = torch.tensor([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, _DEPTH_MM], [0, 0, 0, 1]], dtype=torch.float64)
    upright[:3, 3] -= upright[:3, :3] @ volume.centre()
    generator = torch.Generator().manual_seed(0)
    reach = torch.tensor([0.26, 0.26, 0.26, 15, 15, 15], dtype=torch.float64)
    twists = (2 * torch.rand(count, 6, generator=generator, dtype=torch.float64) - 1) * reach
    middle = torch.tensor([0, 0, _DEPTH_MM], dtype=torch.float64)
    return about_point(exp_se3(twists), middle) @ upright
