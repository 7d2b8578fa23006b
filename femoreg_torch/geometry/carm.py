"""The C-arm: a camera that orbits about an isocentre, and its presets."""

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.arrays import MOST_PIXELS
from femoreg_torch.configs import load_preset
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.geometry.camera import Camera, centred_camera
from femoreg_torch.geometry.rigid import about_point, exp_so3, rigid

_SDD_MM = (50.0, 10_000.0)  # from a micro-CT to a chest stand
_PIXEL_MM = (0.001, 50.0)
_FARTHEST_POINT = 10.0  # of the principal point, in widths of the detector


@dataclass(frozen=True)
class Uncertainty:
    """How well a C-arm's intrinsics are known: standard deviations.

    The source distance is one for all views, as the arm holds it. The principal point is that of each view by itself,
    as the arm sags differently in every pose. The defaults are those of a C-arm that nobody has calibrated: a nominal
    distance is told to the housing or to the detector's plane, which differ by about 2 % of it, and arms sag by about
    2 mm. Zero holds a value.
    """

    sdd_percent: float = 2.0
    principal_point_mm: float = 2.0  # along each axis of the detector

    def __post_init__(self) -> None:
        if not (0 <= self.sdd_percent <= 50 and 0 <= self.principal_point_mm <= 500):
            raise InputError(
                "uncertainty of a C-arm: standard deviations must not be negative, nor above 50 % and 500 mm, got "
                f"{self}."
            )


@dataclass(frozen=True)
class CArm:
    """A C-arm: its camera and, in the camera frame, the axis that its orbit turns about."""

    camera: Camera
    isocentre_mm: tuple[float, float, float]  # in the camera frame; the orbit axis passes through it
    orbit_axis: tuple[float, float, float]  # unit vector in the camera frame
    uncertainty: Uncertainty | None = None  # of the camera; None: nobody says

    @property
    def assumed_uncertainty(self) -> Uncertainty:
        """What is told, or that of a C-arm that nobody has calibrated."""
        return self.uncertainty or Uncertainty()

    def orbit(self, angle_rad: Tensor) -> Tensor:
        """`moved_camera_from_camera` (..., 4, 4) after the C-arm has turned by `angle_rad` (...) along its orbit.

        A positive angle turns the camera by the right-hand rule about the orbit axis, so that a point that stands
        still in the room turns by the negative angle in the camera frame.
        """
        axis = angle_rad.new_tensor(self.orbit_axis)
        turn = rigid(exp_so3(-angle_rad[..., None] * axis))
        return about_point(turn, angle_rad.new_tensor(self.isocentre_mm))


def carm_from_dict(settings: dict[str, Any], where: str) -> CArm:
    """A C-arm from `{sdd_mm, pixel_mm, shape, principal_point_px, isocentre_mm, orbit_axis, uncertainty}`.

    The last four may be left out: centre of the detector, (0, 0, 0.62 · sdd_mm) (the ratio of the Cios Fusion), +y, and
    what `Uncertainty` has for a C-arm that nobody has calibrated; a mapping with its keys.
    Raises `InputError` that names `where` and the key.
    """
    known = {"sdd_mm", "pixel_mm", "shape", "principal_point_px", "isocentre_mm", "orbit_axis", "uncertainty"}
    if unknown := sorted(set(settings) - known):
        raise InputError(f"{where}: unknown key {shortened(unknown[0])}. Known keys: {', '.join(sorted(known))}.")
    for key in ("sdd_mm", "pixel_mm", "shape"):
        if key not in settings:
            raise InputError(f"{where}: `{key}` is missing. Give at least sdd_mm, pixel_mm and shape.")
    (sdd,) = _numbers(settings["sdd_mm"], 1, f"{where}.sdd_mm")
    row_mm, column_mm = _numbers(settings["pixel_mm"], 2, f"{where}.pixel_mm")
    rows, columns = _numbers(settings["shape"], 2, f"{where}.shape")
    _check_ranges(sdd, (row_mm, column_mm), (rows, columns), where)
    camera = centred_camera(sdd, (row_mm, column_mm), (int(rows), int(columns)))
    if "principal_point_px" in settings:
        column, row = _numbers(settings["principal_point_px"], 2, f"{where}.principal_point_px")
        if max(abs(column) / columns, abs(row) / rows) > _FARTHEST_POINT:
            raise InputError(f"{where}.principal_point_px: a point on or near the detector was expected, in pixels.")
        camera = replace(camera, principal_point_px=(column, row))
    x, y, z = _numbers(settings.get("isocentre_mm", (0.0, 0.0, 0.62 * sdd)), 3, f"{where}.isocentre_mm")
    axis = _numbers(settings.get("orbit_axis", (0.0, 1.0, 0.0)), 3, f"{where}.orbit_axis")
    if max(abs(x), abs(y), abs(z)) > _SDD_MM[1]:
        raise InputError(f"{where}.isocentre_mm: a point near the beam was expected, in mm from the source.")
    length = math.sqrt(sum(v * v for v in axis))
    if not length > 0:
        raise InputError(f"{where}.orbit_axis: must not be zero.")
    unit = (axis[0] / length, axis[1] / length, axis[2] / length)
    return CArm(camera, (x, y, z), unit, _uncertainty(settings.get("uncertainty"), f"{where}.uncertainty"))


def _check_ranges(sdd_mm: float, pixel_mm: tuple[float, float], shape: tuple[float, float], where: str) -> None:
    """Raises `InputError` for what no C-arm has."""
    if not _SDD_MM[0] <= sdd_mm <= _SDD_MM[1]:
        raise InputError(
            f"{where}.sdd_mm: positive mm, {_SDD_MM[0]:g} to {_SDD_MM[1]:g}, were expected, found {sdd_mm:g}."
        )
    if not all(_PIXEL_MM[0] <= pixel <= _PIXEL_MM[1] for pixel in pixel_mm):
        raise InputError(
            f"{where}.pixel_mm: positive numbers of mm, {_PIXEL_MM[0]:g} to {_PIXEL_MM[1]:g}, were expected, found "
            f"{pixel_mm[0]:g} and {pixel_mm[1]:g}."
        )
    if not all(n == int(n) and n >= 1 for n in shape) or shape[0] * shape[1] > MOST_PIXELS:
        raise InputError(
            f"{where}.shape: positive whole numbers of rows and columns, together at most {MOST_PIXELS} pixels, were "
            f"expected, found {shape[0]:g} and {shape[1]:g}."
        )


def _uncertainty(settings: Any, where: str) -> Uncertainty | None:
    """What a C-arm's file says of its intrinsics; None: nothing. Raises `InputError` that names `where` and the key."""
    if settings is None:
        return None
    known = [f.name for f in fields(Uncertainty)]
    if not isinstance(settings, dict) or (unknown := sorted(set(settings) - set(known))):
        found = repr(settings) if not isinstance(settings, dict) else f"the key {shortened(unknown[0])}"
        raise InputError(f"{where}: {{{', '.join(known)}}} was expected, found {found}.")
    values = {key: _numbers(value, 1, f"{where}.{key}")[0] for key, value in settings.items()}
    try:
        return Uncertainty(**values)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _numbers(value: Any, count: int, where: str) -> list[float]:
    """`value` as `count` numbers; a single number may stand alone. Raises `InputError` that names `where`."""
    values = value if isinstance(value, list | tuple) else [value]
    if len(values) != count or not all(_is_number(v) for v in values):
        expected = "one number was" if count == 1 else f"{count} numbers were"
        raise InputError(f"{where}: {expected} expected, got {shortened(value)}.")
    return [float(v) for v in values]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def load_carm(name: str | Path) -> CArm:
    """The C-arm preset `configs/carm/<name>.yaml`, or the C-arm in a YAML file with the keys of `carm_from_dict`.

    Raises `InputError` with the list of presets if there is none of this name, and for a file that is not of that kind.
    """
    return carm_from_dict(load_preset("carm", name), f"C-arm {name}")


def orbit_angles(half_range_deg: float, step_deg: float) -> Tensor:
    """Angles (N,) in radians of an exhaustive orbit search, −half_range to +half_range inclusive."""
    n = round(half_range_deg / step_deg)
    return torch.arange(-n, n + 1, dtype=torch.float64) * math.radians(step_deg)
