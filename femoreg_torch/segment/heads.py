"""The femoral heads of labelled bones, as spheres."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points
from femoreg_torch.segment.rules import DOUBTED_RESIDUAL_MM, HEAD_RADIUS_MM, SIDES, femoral_head
from femoreg_torch.segment.sphere import stretch_along
from femoreg_torch.segment.surface import bone_surface
from femoreg_torch.volume import BoneLabels, Volume, crop

_NEAR_MM = 40.0  # of a landmark in the head, to each side: a head has 32 mm, and the landmark may be some mm off
# Of adults. Diameters of 170 femora: men 49 ± 3 mm, women 44 ± 3 mm (Mall et al., Forensic Science International 113
# (2000) 315); Thai women 40 mm in the mean (Saengnipanthkul and Techasatien, J Med Assoc Thai 95 (2012) 790). 34 and
# 64 mm lie 3 deviations below the women of the first, and 5 above its men.
ADULT_RADIUS_MM = (17.0, 32.0)
# By which a head may be longer or shorter along the voxels' third axis than across. Of 6 surfaces, 20 label maps of a
# network and 3 drawn by hand, and 34 of simulated CTs, both heads together were within 2.6 % and each within 3.1 %, but
# for one of 6 % on slices of 3 mm; 14 of the 20 on slices of 2 to 5 mm, within 4.1 % together. All were stretched and
# compressed by 10 %: both together were told of 125 of 126, one head alone of 238 of 252. Beside that labels may reach
# half a slice too far, or too short, on either end.
_MOST_OF_BOTH, _MOST_OF_ONE = 0.035, 0.06


@dataclass(frozen=True, eq=False)
class Head:
    """A femoral head."""

    centre: Tensor  # (3,) LPS mm, float64
    radius_mm: float
    residual_mm: float  # root mean square distance from the sphere, of the surface in the socket
    stretch: float = 1.0  # along the third axis of the voxels against across; nan where no spheroid fits

    @property
    def may_be_one(self) -> bool:
        """Whether a head may be so large; other spheres are fitted to something else."""
        return HEAD_RADIUS_MM[0] <= self.radius_mm <= HEAD_RADIUS_MM[1]

    @property
    def is_round(self) -> bool:
        """Whether the surface in the socket is that of a sphere."""
        return self.residual_mm <= DOUBTED_RESIDUAL_MM


def fitted_heads(labels: Volume, ids: Mapping[str, int]) -> dict[str, Head]:
    """By side, the sphere that fits the head of a femur, where the femur and its hip bone are among the `ids`."""
    heads = {}
    axis = labels.lps_from_index[:3, 2].numpy() / labels.spacing_mm[2]
    for side in SIDES:
        femur, hip = f"femur_{side}", f"hip_{side}"
        if femur in ids and hip in ids:
            try:
                surface, socket = (bone_surface(labels, ids[bone]) for bone in (femur, hip))
            except InputError:  # a sliver of a bone has no head
                continue
            sphere, residual = femoral_head(surface, socket)
            stretch = stretch_along(surface.vertices, sphere, axis)
            heads[side] = Head(torch.from_numpy(sphere[:3].copy()), float(sphere[3]), residual, stretch)
    return heads


def head_of(bones: BoneLabels, side: str, near: Tensor | None = None) -> Head | None:
    """The sphere that fits the femoral head of a side, whether or not it may be one; None where bones are missing.

    With a point (3,), LPS mm, `near` it, it is looked for within 40 mm along each axis alone, which is faster.
    """
    labels = bones.labels if near is None else _around(bones.labels, near)
    wanted = {name: n for name, n in bones.ids.items() if name.endswith(side) and (labels.data == n).any()}
    return fitted_heads(labels, wanted).get(side)


def doubted_slices(heads: Iterable[Head], spacing_mm: Sequence[float]) -> list[str]:
    """A warning where heads, which are round, are longer or shorter along the slices' normal than anatomy explains.

    `spacing_mm` (3,) is that of the label map, as x, y, z. Of CTs whose slices are told to lie 6 % too far apart or too
    close most are found so.
    """
    found = [head for head in heads if head.may_be_one and math.isfinite(head.stretch)]
    if not found:
        return []
    off = [head.stretch - 1 for head in found]
    radius = sum(head.radius_mm for head in found) / len(found)
    thick = max(0.0, spacing_mm[2] - (spacing_mm[0] + spacing_mm[1]) / 2) / (2 * radius)
    most = thick + (_MOST_OF_ONE if len(found) == 1 else _MOST_OF_BOTH)
    mean = sum(off) / len(off)
    if abs(mean) <= most or any(one * mean < most * abs(mean) / 2 for one in off):
        return []
    which = "the femoral head" if len(found) == 1 else "both femoral heads"
    return [
        f"{which} of the label map measure{'s' * (len(found) == 1)} {abs(100 * mean):.0f} % "
        f"{'more' if mean > 0 else 'less'} across the slices than within them, and heads are round: are the slices of "
        f"the CT {spacing_mm[2]:.3g} mm apart, as its header says? If not, export it anew. A deformed head, or labels "
        "that bulge, look so too"
    ]


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
