"""Implants in femora of training images: nails with a neck screw, plates with screws, and artificial hips.

They follow the bone: a femur's long axis is that of its label far from its head. Lengths are in mm in the patient, for
a magnification of 1.4 on the network's grid. Shapes and amounts are coarse, made for variety.
"""

import math
from collections.abc import Callable

import torch
from torch import Generator, Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect.grid import NETWORK_PIXEL_MM

_PX = 1.4 / NETWORK_PIXEL_MM  # pixels of the grid per mm in the patient
_SHAFT_MM = 55.0  # from the head's centre: what is further off is shaft
_LEAST_SHAFT = 40  # pixels of the label that are needed to find the axis
_FEMORA = tuple(
    (HIP.classes((f"femur_{side}",))[0], HIP.landmark_names.index(f"FH-{side[0]}")) for side in ("left", "right")
)

Uniform = Callable[[float, float], float]


def add_implants(attenuation: Tensor, labels: Tensor, landmarks: Tensor, share: float, generator: Generator) -> Tensor:
    """Implants added to a share of the femora that are seen in images (B, H, W).

    `labels` (B, H / 2, W / 2) are classes, `landmarks` (B, L, 2) columns and rows of the images.
    """
    attenuation = attenuation.clone()

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    for image, classes, points in zip(attenuation, labels, landmarks, strict=True):
        for number, head in _FEMORA:
            if uniform(0, 1) < share:
                kind = _KINDS[int(uniform(0, len(_KINDS)))]
                shaft = _shaft(classes == number, points[head])
                if shaft is not None:
                    image += kind(image.shape, points[head], *shaft, uniform)
    return attenuation


def _shaft(mask: Tensor, head: Tensor) -> tuple[Tensor, Tensor] | None:
    """The middle (2,) of a femur's shaft, column and row, and the unit vector down it; None if too little is seen."""
    places = 2 * mask.nonzero().flip(1).float() + 0.5
    places = places[(places - head).norm(dim=1) > _SHAFT_MM * _PX]
    if len(places) < _LEAST_SHAFT:
        return None
    middle = places.mean(0)
    away = places - middle
    axis = torch.linalg.eigh(away.T @ away).eigenvectors[:, -1]
    return middle, axis * torch.where(axis @ (middle - head) < 0, -1.0, 1.0)


def _rod(shape: torch.Size, start: Tensor, end: Tensor, radius: float) -> Tensor:
    """Chords (H, W) through a round rod from start to end (2,), 1 in its middle, with half a pixel of blur."""
    row, column = torch.meshgrid(torch.arange(shape[0]).float(), torch.arange(shape[1]).float(), indexing="ij")
    places, along = torch.stack([column, row], -1) - start, end - start
    share = ((places @ along) / (along @ along).clamp_min(1e-6)).clamp(0, 1)
    distance = (places - share[..., None] * along).norm(dim=-1)
    return (1 - (distance / (radius + 0.5)).square()).clamp_min(0).sqrt()


def _nail(shape: torch.Size, head: Tensor, middle: Tensor, axis: Tensor, uniform: Uniform) -> Tensor:
    level = middle + ((head - middle) @ axis) * axis  # of the head on the shaft's axis
    top, end = level - uniform(-5, 15) * _PX * axis, level + uniform(110, 400) * _PX * axis
    entry = level + uniform(15, 45) * _PX * axis
    tip = entry + uniform(0.8, 1.1) * (head - entry)
    metal = uniform(0.5, 3.0)
    nail = metal * _rod(shape, top, end, uniform(4, 7) * _PX)
    return torch.maximum(nail, metal * uniform(0.6, 1.0) * _rod(shape, entry, tip, uniform(2.5, 5.5) * _PX))


def _plate(shape: torch.Size, head: Tensor, middle: Tensor, axis: Tensor, uniform: Uniform) -> Tensor:
    side = torch.stack([-axis[1], axis[0]])
    side = side * torch.where(side @ (middle - head) < 0, -1.0, 1.0)
    level = middle + ((head - middle) @ axis) * axis + uniform(11, 17) * _PX * side
    top, length = level + uniform(15, 50) * _PX * axis, uniform(50, 150) * _PX
    metal = uniform(0.5, 2.5)
    implant = metal * _rod(shape, top, top + length * axis, uniform(2, 4) * _PX)
    for _ in range(int(uniform(2, 6))):
        place = top + uniform(0.05, 0.95) * length * axis
        screw = _rod(shape, place, place - uniform(25, 38) * _PX * side, uniform(1.2, 2.5) * _PX)
        implant = torch.maximum(implant, 0.7 * metal * screw)
    if uniform(0, 1) < 0.7:  # a sliding hip screw
        implant = torch.maximum(implant, metal * _rod(shape, top, head, uniform(3, 6) * _PX))
    return implant


def _artificial_hip(shape: torch.Size, head: Tensor, middle: Tensor, axis: Tensor, uniform: Uniform) -> Tensor:
    level = middle + ((head - middle) @ axis) * axis
    shoulder = level + uniform(5, 25) * _PX * axis
    metal, radius = uniform(1.5, 4.0), uniform(13, 18) * _PX
    implant = metal * _rod(shape, head, head + 0.01, radius)
    implant = torch.maximum(implant, metal * _rod(shape, head, shoulder, uniform(5, 8) * _PX))
    stem = _rod(shape, shoulder, shoulder + uniform(70, 140) * _PX * axis, uniform(4.5, 7) * _PX)
    implant = torch.maximum(implant, metal * uniform(0.7, 1.0) * stem)
    if uniform(0, 1) < 0.8:  # the cup: half a shell about the head, open downwards and outwards
        outer = radius + uniform(4, 10) * _PX
        shell = _rod(shape, head, head + 0.01, outer) - _rod(shape, head, head + 0.01, outer - uniform(1.5, 4) * _PX)
        turn = uniform(-0.6, 0.6)
        normal = torch.tensor([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ axis
        row, column = torch.meshgrid(torch.arange(shape[0]).float(), torch.arange(shape[1]).float(), indexing="ij")
        behind = (torch.stack([column, row], -1) - head) @ normal < 0
        implant = torch.maximum(implant, uniform(0.8, 2.0) * shell * behind)
    return implant


_KINDS = (_nail, _plate, _artificial_hip)
