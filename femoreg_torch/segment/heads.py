"""The femoral heads of labelled bones, as spheres."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.geometry import transform_points
from femoreg_torch.segment.rules import SIDES, femoral_head
from femoreg_torch.segment.surface import bone_surface
from femoreg_torch.volume import BoneLabels, Volume, crop

HEAD_RADIUS_MM = (15.0, 35.0)  # of what may be a femoral head at all; other spheres are none
DOUBTED_RESIDUAL_MM = 1.5
_NEAR_MM = 40.0  # of a landmark in the head, to each side: a head has 32 mm, and the landmark may be some mm off
# Of adults. Diameters of 170 femora: men 49 ± 3 mm, women 44 ± 3 mm (Mall et al., Forensic Science International 113
# (2000) 315); Thai women 40 mm in the mean (Saengnipanthkul and Techasatien, J Med Assoc Thai 95 (2012) 790). 34 and
# 64 mm lie 3 deviations below the women of the first, and 5 above its men.
ADULT_RADIUS_MM = (17.0, 32.0)


@dataclass(frozen=True, eq=False)
class Head:
    """A femoral head."""

    centre: Tensor  # (3,) LPS mm, float64
    radius_mm: float
    residual_mm: float  # root mean square distance from the sphere, of the surface in the socket

    @property
    def may_be_one(self) -> bool:
        """Whether a head may be so large; other spheres are fitted to something else."""
        return HEAD_RADIUS_MM[0] <= self.radius_mm <= HEAD_RADIUS_MM[1]


def fitted_heads(labels: Volume, ids: Mapping[str, int]) -> dict[str, Head]:
    """By side, the sphere that fits the head of a femur, where the femur and its hip bone are among the `ids`."""
    heads = {}
    for side in SIDES:
        femur, hip = f"femur_{side}", f"hip_{side}"
        if femur in ids and hip in ids:
            sphere, residual = femoral_head(bone_surface(labels, ids[femur]), bone_surface(labels, ids[hip]))
            heads[side] = Head(torch.from_numpy(sphere[:3].copy()), float(sphere[3]), residual)
    return heads


def head_centre(bones: BoneLabels, side: str, near: Tensor | None = None) -> Tensor | None:
    """Centre (3,), LPS mm, of the sphere that fits a femoral head; None where bones are missing or it is no sphere.

    With a point (3,) `near` it, it is looked for within 40 mm along each axis alone, which is faster.
    """
    labels = bones.labels if near is None else _around(bones.labels, near)
    wanted = {name: n for name, n in bones.ids.items() if name.endswith(side) and (labels.data == n).any()}
    head = fitted_heads(labels, wanted).get(side)
    return head.centre if head and head.may_be_one and head.residual_mm <= DOUBTED_RESIDUAL_MM else None


def _around(labels: Volume, point: Tensor) -> Volume:
    """The voxels near a point (3,), LPS mm; at least one."""
    index = transform_points(torch.linalg.inv(labels.lps_from_index), point[None])[0]
    reach = torch.tensor([_NEAR_MM / spacing for spacing in labels.spacing_mm])
    last = torch.tensor(labels.data.shape[::-1]) - 1
    low, high = ((index + sign * reach).round().long().clamp_min(0).minimum(last).tolist() for sign in (-1, 1))
    return crop(labels, (low[0], low[1], low[2]), (high[0] + 1, high[1] + 1, high[2] + 1))


def doubted_radius(side: str, radius_mm: float) -> list[str]:
    """A warning where no adult has a femoral head of such a radius."""
    low, high = ADULT_RADIUS_MM
    if low <= radius_mm <= high:
        return []
    return [
        f"the {side} femoral head has a radius of {radius_mm:.1f} mm, but those of adults have {low:g} to {high:g} mm: "
        "look at its outline, and whether the CT's voxels are as large as its header says"
    ]
