"""A patient taken apart for imaging after one femur has turned: the bone moves rigidly, the soft tissue bends."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.geometry import Camera, about_point, rigid
from femoreg_torch.volume import Volume
from sim.physics.line_integrals import areal_tissue
from sim.physics.tissue_densities import COARSE_MM, separate
from sim.theatre.femur_motion import rotate_femur


@dataclass(frozen=True)
class PosedTissue:
    """Densities in g/cm³ after one femur has turned."""

    filled: Volume  # water, and κ times bone; coarse, and bent around the femur
    bone: Volume  # all bone but the turned femur, and what is held apart
    femur: Volume  # the bone of the turned femur, where the CT has it
    lps_from_femur: Tensor  # (4, 4): the turn, LPS mm
    apart: tuple[Volume, ...] = ()  # bones at rest that were to be held apart

    def to(self, device: torch.device) -> "PosedTissue":
        """The same with its densities on a device."""
        return replace(
            self,
            filled=self.filled.to(device),
            bone=self.bone.to(device),
            femur=self.femur.to(device),
            apart=tuple(bone.to(device) for bone in self.apart),
        )


def take_apart(
    ct: Volume,
    labels: Volume,
    femur: tuple[int, ...],
    rotation: Tensor,
    head_centre: Tensor,
    apart: Sequence[tuple[int, ...]] = (),
) -> PosedTissue:
    """The patient of a CT in HU whose femur has turned about its head centre by `rotation`.

    `labels` lies on the grid of `ct`, 0 where there is no bone; `femur` holds the ids of the femur that moves.
    `rotation` (3, 3) acts in LPS; `head_centre` (3,) in LPS mm. `apart` names bones at rest, by the ids of each, that
    are to be volumes of their own. Raises `InputError` if the label map holds no such femur.
    """
    filled, bone, (moving, *others), coarse_labels = separate(ct, labels, [femur, *apart])
    turn = about_point(rigid(rotation), head_centre)
    moving = moving.with_data(moving.data * (1 - _occupied(moving, coarse_labels, femur, turn)))
    bent = rotate_femur(filled, coarse_labels, femur, rotation, head_centre)
    return PosedTissue(bent, bone, moving, turn, tuple(others))


def _occupied(moving: Volume, labels: Volume, femur: tuple[int, ...], turn: Tensor) -> Tensor:
    """Share (Z, Y, X) of each voxel of the femur that, once turned, lies in another bone: it is left out."""
    names = labels.data.numpy()
    others = (names > 0) & ~np.isin(names, femur)
    affine = torch.linalg.inv(labels.lps_from_index) @ turn @ moving.lps_from_index
    depth, height, width = moving.data.shape
    last = torch.tensor([width, height, depth], dtype=torch.float64) - 1
    counts = [max(2, round(n * s / COARSE_MM)) for n, s in zip((width, height, depth), moving.spacing_mm, strict=True)]
    scale = torch.diag(last / (torch.tensor(counts, dtype=torch.float64) - 1))
    matrix = (affine[:3, :3] @ scale).flip(0, 1).numpy()
    coarse = ndimage.affine_transform(
        others.astype(np.float32), matrix, affine[:3, 3].flip(0).numpy(), tuple(counts[::-1]), order=1
    )
    size = (depth, height, width)
    return F.interpolate(torch.from_numpy(coarse)[None, None], size=size, mode="trilinear", align_corners=True)[0, 0]


def areal_posed_tissue(
    tissue: PosedTissue, camera_from_lps: Tensor, camera: Camera, step_mm: float
) -> dict[str, Tensor]:
    """Mass per area (H, W) in g/cm² of `water` and `bone` of a patient whose femur has turned."""
    resting = [tissue.bone, *tissue.apart]
    poses = torch.stack([camera_from_lps] * len(resting) + [camera_from_lps @ tissue.lps_from_femur])
    return areal_tissue(tissue.filled, camera_from_lps, [*resting, tissue.femur], poses, camera, step_mm)
