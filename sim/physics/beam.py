"""The open beam on the detector: 1 where the central ray meets it, less towards the edges, none past a collimator."""

import math

import torch
from torch import Tensor

from femoreg_torch.geometry import Camera

_PENUMBRA_MM = 2.0  # on the detector: a focal spot of 0.6 mm, a collimator at a quarter of the way


def inverse_square(camera: Camera) -> Tensor:
    """Irradiance (H, W) of a plane by a point source, relative to its foot: cos³ of the angle to the central ray.

    Two powers are the inverse square law, one is the slant of the plane (Lambert's cosine law).
    """
    rays = camera.pixel_positions(torch.float32)
    return (camera.sdd_mm / rays.norm(dim=-1)) ** 3


def heel(camera: Camera, loss: float) -> Tensor:
    """Fall-off (H, W) towards the anode, which lies at the first column's side: photons cross more tungsten there.

    `loss` is the share of the beam that is lost from the far edge to the edge at the anode's side, linear in between
    (Bushberg et al., The Essential Physics of Medical Imaging, 3rd ed. 2012, chapter 6: the heel effect).
    """
    columns = camera.shape[1]
    across = (torch.arange(columns, dtype=torch.float32) - camera.principal_point_px[0]) / columns
    return (1 + loss * across).clamp_min(0).expand(camera.shape)


def circular_collimator(camera: Camera, radius_mm: float) -> Tensor:
    """Share (H, W) of the focal spot that is seen past a round collimator of this radius on the detector, mm.

    The penumbra is a focal spot's uniform disc taken as a straight ramp.
    """
    distance = camera.pixel_positions(torch.float32)[..., :2].norm(dim=-1)
    return ((radius_mm - distance) / _PENUMBRA_MM + 0.5).clamp(0, 1)


def shutter(camera: Camera, width_mm: float, height_mm: float, turn_deg: float) -> Tensor:
    """Share (H, W) of the focal spot that is seen past a rectangular opening about the central ray.

    Width and height are those on the detector before it is turned by `turn_deg`, from columns to rows. The penumbra is
    that of `circular_collimator`; shutters that turn: Bushberg et al., The Essential Physics of Medical Imaging, 3rd
    ed. 2012, chapter 9.
    """
    x, y = camera.pixel_positions(torch.float32)[..., :2].unbind(-1)
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    share = torch.ones(camera.shape)
    for size, along in zip((width_mm, height_mm), (x * cos + y * sin, y * cos - x * sin), strict=True):
        share *= ((size / 2 - along.abs()) / _PENUMBRA_MM + 0.5).clamp(0, 1)
    return share


def open_beam(camera: Camera, falls_off: bool, heel_loss: float, collimator_mm: float) -> Tensor:
    """The beam (H, W) without a shutter: the product of the above; `collimator_mm` of 0 is an open collimator."""
    field = inverse_square(camera) if falls_off else torch.ones(camera.shape)
    if heel_loss:
        field = field * heel(camera, heel_loss)
    if collimator_mm:
        field = field * circular_collimator(camera, collimator_mm)
    return field
