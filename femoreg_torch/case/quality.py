"""What was measured at a solution about every object in every view, and whether it is trusted."""

import math
from collections.abc import Sequence
from dataclasses import dataclass


def largest(deviations: Sequence[float]) -> float:
    """The largest of them; nan if one is, or there are none. Python's `max` drops a nan that is not the first."""
    return math.nan if not deviations or any(map(math.isnan, deviations)) else max(deviations)


@dataclass(frozen=True)
class ViewQuality:
    """One object in one image."""

    view: int  # from 1
    similarity: float  # of the image with all objects drawn: mean patch Grad-NCC, at most 1
    gain: float  # what drawing this object adds to it
    pull_mm: tuple[float, float]  # where this view alone would move the object, along its columns and rows


@dataclass(frozen=True)
class ObjectQuality:
    """One object in all views."""

    views: tuple[ViewQuality, ...]
    in_plane_uncertainty_mm: float  # root mean square disagreement of the views in their image planes
    common_pull: tuple[float, float]  # degrees, mm: where all images together would move it, were all free
    # Standard deviations about the axes of camera 1, and along them, of the reference point: of the images, and of the
    # C-arm's intrinsics where its file tells how uncertain these are, or the images do not believe it.
    rotation_deviation_deg: tuple[float, ...]
    translation_deviation_mm: tuple[float, ...]
    displacement: tuple[float, float] | None  # degrees, mm from where it was expected, at the reference point
    trusted: bool
    reason: str
    turn_told: bool = True  # False for a round object, whose turn about its own axis no image tells
    # The same deviations with what is not known of the C-arm in any case: where its file is silent, that of a C-arm
    # which nobody has calibrated. It moves all objects together.
    rotation_deviation_with_carm_deg: tuple[float, ...] = (math.nan,) * 3
    translation_deviation_with_carm_mm: tuple[float, ...] = (math.nan,) * 3


@dataclass(frozen=True)
class CameraQuality:
    """The camera that a view was registered with, and how well images and C-arm file together know it."""

    sdd_mm: float
    principal_point_px: tuple[float, float]  # column, row of the images as stored
    sdd_deviation_mm: float  # standard deviations
    principal_point_deviation_px: tuple[float, float]
