"""The start by landmarks that a person picked in view 1."""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from femoreg_torch.case import Case, LandmarkRecord, StartRecord
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display, nearest_source
from femoreg_torch.pnp import MINIMUM, MIRRORED_ADVICE, PnpResult, solve_pnp
from femoreg_torch.registration.prepare.images import view_distortion
from femoreg_torch.registration.start.checks import check_rotation, check_sides
from femoreg_torch.registration.start.picked import check_before_detector, check_in_picture, meant_otherwise
from femoreg_torch.registration.start.records import pair

_LOOK_AGAIN = (
    "Look again which is nearer to the source (and is shown larger), or put a view from the front or from behind first."
)
_MOST_ASKEW_DEG = 60.0  # of the beam against the side that the case says; beyond 45° another side is nearer
GIVEN_DEVIATION_MM = 1.5  # on the detector, along each axis: of landmarks that a person picked in the image


def start_by_landmarks(case: Case, anchor: str, pixels: Mapping[str, Tensor]) -> StartRecord:
    """The pose (4, 4) of the object `anchor` from `pixels` (2,), column and row, of landmarks picked in view 1.

    Pixels are those of the image as it is stored.

    Raises `InputError` if fewer than four have a name that the case knows, most lie beside the picture, fewer than four
    agree, they leave the rotation open by more than 5°, they put the patient on or behind the detector, they tell
    another side of the source than the case, or, in a view from a side, they may be those of the other side. Where they
    would fit if they were meant otherwise (in mm, rows counted from below, …), the message says so.
    """
    names = [name for name in pixels if name in case.landmarks]
    if len(names) < MINIMUM:
        raise InputError(
            f"landmarks in the image: {len(names)} have the name of a landmark of the case "
            f"({', '.join(case.landmarks)}), at least {MINIMUM} are needed."
        )
    camera, display = case.carm.camera, case.display_of(0)
    picked, distortion = torch.stack([pixels[name] for name in names]).double(), view_distortion(case, 0)
    stored = display.stored_camera(camera)
    check_in_picture(names, picked, stored)
    spread = {mark.name: mark.spread_mm for mark in case.anatomy.landmarks} if case.anatomy is not None else {}

    def pose_of(called: Sequence[str], places: Tensor) -> PnpResult:
        """The pose by places (N, 2) in the stored picture, if they are the landmarks of these names."""
        seen = display.pixels_to_camera(places if distortion is None else distortion.straight(places), camera)
        return solve_pnp(
            torch.stack([case.landmarks[name] for name in called]).double(),
            seen,
            camera,
            deviations_px=torch.full((len(called),), GIVEN_DEVIATION_MM / camera.mean_pixel_mm, dtype=torch.float64),
            point_deviations_mm=torch.tensor([spread.get(name, 0.0) for name in called], dtype=torch.float64),
            beam=display.beam,
        )

    def fits(called: Sequence[str], places: Tensor) -> PnpResult | None:
        try:
            return pose_of(called, places) if set(called) <= set(case.landmarks) else None
        except InputError:
            return None

    try:
        pnp = pose_of(names, picked)
    except InputError as error:
        mirror = {} if case.anatomy is None else {mark.name: mark.mirror for mark in case.anatomy.landmarks}
        otherwise = meant_otherwise(names, picked, stored, fits, mirror)
        if otherwise is None:
            raise
        told = str(error).removesuffix(MIRRORED_ADVICE).rstrip()
        raise InputError(f"landmarks in the image: {told} They fit {otherwise}.") from error
    check_rotation(pnp)
    check_before_detector(pnp, case.landmarks, names, picked, stored, fits)
    _check_beam(pnp.camera_from_object, display)
    if case.anatomy is not None:
        check_sides(
            pnp,
            case.anatomy,
            case.landmarks,
            names,
            lambda called, rows: pose_of(called, picked[list(rows)]),
            _LOOK_AGAIN,
        )
    marks = {
        name: LandmarkRecord(pair(pixels[name]), 1.0, True, inlier)
        for name, inlier in zip(names, pnp.inliers.tolist(), strict=True)
    }
    return StartRecord(anchor, pnp.camera_from_object, "landmarks given by hand", marks, pnp.rms_px)


def _check_beam(camera_from_ct: Tensor, display: Display) -> None:
    """Raises `InputError` where landmarks tell another side of the source than the case does."""
    beam = camera_from_ct[2, :3]
    off = math.degrees(math.acos(float((beam @ beam.new_tensor(display.beam)).clamp(-1, 1))))
    nearest = nearest_source(beam)
    if off > _MOST_ASKEW_DEG and nearest != display.source:  # steep views of the same side are right
        raise InputError(
            f"landmarks in the image: by them the source stands {off:.0f}° from the patient's {display.source} side, "
            f"which the case says, and nearest to the {nearest} one. Write `display: {{source: {nearest}}}`, and see "
            "whether `mirrored` is right, or look at the landmarks again."
        )
