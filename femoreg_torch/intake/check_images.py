"""What is wrong with the views of a case and their images."""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.case import Case, femoroplasty_form
from femoreg_torch.case.femoroplasty import ANATOMY_IMAGES, DEVICE, DEVICE_IMAGES
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import View
from femoreg_torch.case.parts import (
    VIEW_KEYS,
    read_display,
    read_field,
    read_frames,
    read_grid,
    read_intensity,
    read_known_pose,
)
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import (
    Circle,
    Display,
    Exposure,
    GridImage,
    Polygon,
    below_zero,
    check_header,
    check_intensity,
    check_matches,
    find_distortion,
    kinds_exchanged,
    other_patient,
    raised,
    read_image,
    read_stored,
    rough_attenuation,
    settled_intensity,
    told_together,
    views_exchanged,
)
from femoreg_torch.fluoro.reading import LOOKS_LOG
from femoreg_torch.geometry import Camera, CArm
from femoreg_torch.intake.found import Found
from femoreg_torch.volume import Patient

# A detector of 200 to 430 mm, 900 to 1,300 mm from the source, is seen under 9 to 27°; one told in wrong units is not.
_OPENING_DEG = 3.0, 45.0
_MOST_OFF_MIDDLE = 0.25  # of the picture: a principal point that a picture of the whole detector has not
_ISOCENTRE = 0.3, 1.0  # of the source distance; of the presets 0.53 and 0.62


@dataclass(frozen=True, eq=False)
class _Seen:
    """An image that could be read, and its attenuation (up to a scale) if it is known which way its values run."""

    values: Tensor  # (H, W)
    attenuation: Tensor | None  # (H, W)
    exposure: Exposure | None  # what the header of a DICOM file says


def readable_views(top: Fields, folder: Path) -> list[View]:
    """The views in which nothing is wrong; what is wrong with the others is told by `check_views`."""
    read: list[View] = []
    try:
        views = top.mappings("views")
    except InputError:
        return read
    for view in views:
        try:
            read.append(femoroplasty_form.read_view(view, folder))
        except InputError:
            continue
    return read


def check_views(
    top: Fields, folder: Path, carm: CArm | None, display: Display | None, patient: Patient, found: Found
) -> dict[str, Tensor]:
    """Every view of the short form by itself. Without a C-arm or display its images are looked at by themselves.

    `patient` is that of the CT. Returns the images (H, W) that could be read, by key.
    """
    views = found.attempt(lambda: top.mappings("views"))
    if views is None:
        return {}
    if not views:
        found.problem(f"{top.where('views')}: empty. At least one fluoroscopic image is needed.")
    if carm is not None:
        found.warnings += _told_of_carm(carm)
    read: dict[str, _Seen] = {}
    poses: dict[str, Tensor] = {}
    for number, view in enumerate(views):
        found.unknown_keys(view, (ANATOMY_IMAGES, DEVICE_IMAGES, *VIEW_KEYS))
        pose = found.attempt(lambda view=view: read_known_pose(view))  # type: ignore[misc]
        if pose is not None:
            poses[view.path] = pose
        field = found.attempt(lambda view=view: read_field(view, folder))  # type: ignore[misc]
        grid = found.attempt(lambda view=view: read_grid(view, folder))  # type: ignore[misc]
        shown = found.attempt(lambda view=view: read_display(view)) if "display" in view else display  # type: ignore[misc]
        looked_at = found.attempt(
            lambda view=view, shown=shown: View({}, read_intensity(view), frames=read_frames(view), display=shown)  # type: ignore[misc]
        )
        if carm is not None and shown is not None:
            camera = shown.stored_camera(carm.camera)
            found.attempt(partial(_check_field, field, camera, view.where("field")))
            found.attempt(partial(_check_grid, grid, camera, view.where("grid")))
        for kind in (ANATOMY_IMAGES, DEVICE_IMAGES):
            if kind == DEVICE_IMAGES and kind not in view:
                continue
            path = found.attempt(lambda view=view, kind=kind: view.file_path(kind, folder))  # type: ignore[misc]
            if path is not None and looked_at is not None:
                _check_image(path, (number, kind), looked_at, carm, view.where(kind), read, found)
    _check_different(read, found)
    _check_together(read, patient, found)
    for (one, first), (other, second) in itertools.combinations(poses.items(), 2):
        if torch.allclose(first, second, atol=1e-6):
            found.warnings.append(f"{one} and {other} are given one and the same pose of the C-arm")
    _check_exchanged(read, ANATOMY_IMAGES, found)
    if DEVICE in top and views and not any(DEVICE_IMAGES in view for view in views):
        found.warnings.append("no view has an image with the device, so it will not be found")
    return _by_key(read)


def check_images(case: Case, patient: Patient, found: Found) -> dict[str, Tensor]:
    """All images of a case whose CT is of that patient. Returns those (H, W) that could be read themselves, by key."""
    found.warnings += _told_of_carm(case.carm)
    read: dict[str, _Seen] = {}
    for number, view in enumerate(case.views):
        shown = View({}, view.intensity, frames=view.frames, display=case.display_of(number))
        for kind, path in view.images.items():
            where = f"{case.folder}/case.yaml, views[{number}].{kind}"
            _check_image(path, (number, kind), shown, case.carm, where, read, found)
    _check_different(read, found)
    _check_together(read, patient, found)
    if case.views:
        _check_exchanged(read, next(iter(case.views[0].images)), found)
    return _by_key(read)


def _by_key(read: Mapping[str, _Seen]) -> dict[str, Tensor]:
    return {where.rpartition(", ")[2]: image.values for where, image in read.items()}


def _check_exchanged(read: Mapping[str, _Seen], first_kind: str, found: Found) -> None:
    found.warnings += views_exchanged(_by_key(read), first_kind)
    if first_kind == ANATOMY_IMAGES:
        shown = {where.rpartition(", ")[2]: image.attenuation for where, image in read.items()}
        found.warnings += kinds_exchanged(shown, ANATOMY_IMAGES, DEVICE_IMAGES)


def _check_image(
    path: Path,
    place: tuple[int, str],
    view: View,
    carm: CArm | None,
    where: str,
    read: dict[str, _Seen],
    found: Found,
) -> None:
    """What is wrong with an image, as the registration would say; its values are put into `read`.

    `place` is its view, from 0, and its kind.
    """
    stored = found.attempt(lambda: read_stored(path, view.frames))
    if stored is None:
        return
    found.warnings += [f"{path.name} {remark}" for remark in stored.remarks]
    settled = found.attempt(lambda: settled_intensity(view.intensity, stored, f"{where}: {path.name}"))
    exposure = None if stored.tags is None else Exposure(*place, path.name, stored.tags, view.frames)
    attenuation = None if settled is None else rough_attenuation(stored.values_as(settled), settled)
    read[where] = _Seen(stored.values, attenuation, exposure)
    if settled == "raw":
        found.attempt(lambda: check_intensity(stored.values, f"{where}: {path.name}"))
        if (dark := below_zero(stored.values, stored.padding)) is not None:
            found.warnings.append(f"{path.name} {dark}")
        if (lifted := raised(stored.values)) is not None:
            found.warnings.append(f"{path.name} {lifted}")
    if view.intensity == "raw" and stored.asks == LOOKS_LOG:
        found.warnings.append(f"{path.name} {LOOKS_LOG}, but the case says `intensity: raw`: bone is to be dark in it")
    if carm is not None and view.display is not None:
        shown, camera = view.display, view.display.stored_camera(carm.camera)
        found.attempt(lambda: check_matches(stored.values, camera, f"{where}: it"))
        found.attempt(lambda: check_header(stored.tags, camera, shown, carm.uncertainty, f"{where}: {path.name}"))


def _told_of_carm(carm: CArm) -> list[str]:
    """What is told of a C-arm as none has it, in words."""
    camera, told = carm.camera, []
    wide_mm = max(extent * mm for extent, mm in zip(camera.shape, camera.pixel_mm, strict=True))
    opens = math.degrees(2 * math.atan2(wide_mm / 2, camera.sdd_mm))
    if not _OPENING_DEG[0] <= opens <= _OPENING_DEG[1]:
        told.append(
            f"the C-arm's file tells {camera.sdd_mm:.4g} mm from the source to a detector {wide_mm:.3g} mm wide: a "
            f"beam of {opens:.2g}°, where C-arms have some 10 to 25°. Are source distance and pixel size in mm?"
        )
    column, row = camera.principal_point_px
    off = max(
        abs(column - (camera.shape[1] - 1) / 2) / camera.shape[1],
        abs(row - (camera.shape[0] - 1) / 2) / camera.shape[0],
    )
    if off > _MOST_OFF_MIDDLE:
        told.append(
            f"the C-arm's file tells a principal point at column {column:.5g} and row {row:.5g} of {camera.shape[1]} × "
            f"{camera.shape[0]}, {100 * off:.0f} % of the picture off its middle: is `principal_point_px` in pixels, "
            "column first? It is right of a picture that is cropped to one side"
        )
    depth = carm.isocentre_mm[2]
    if not _ISOCENTRE[0] * camera.sdd_mm <= depth <= _ISOCENTRE[1] * camera.sdd_mm:
        told.append(
            f"the C-arm's file tells an isocentre {depth:.4g} mm from the source, and a detector {camera.sdd_mm:.4g} "
            "mm from it: it lies between the two, mostly at some 0.6 of the way. Is `isocentre_mm` in mm, and its last "
            "number along the beam?"
        )
    return told


def _check_field(field: Circle | Polygon | Path | None, camera: Camera, where: str) -> None:
    """Raises `InputError` for shutters that leave nothing of the stored picture, and a mask of another size."""
    if field is None:
        return
    if isinstance(field, Path):
        exposed = read_image(field)
        check_matches(exposed, camera, f"{where}: it")
    else:
        exposed = field.exposed(camera.shape)
    if not (exposed > 0).any():
        raise InputError(f"{where}: exposes no pixel of the image.")


def _check_grid(grid: GridImage | None, camera: Camera, where: str) -> None:
    """Raises `InputError` for an image in which no grid is found, or of another size."""
    if grid is not None:
        image = read_image(grid.path)
        check_matches(image, camera, f"{where}: it")
        find_distortion(image, camera, grid.pitch_mm, where)


def _check_together(images: Mapping[str, _Seen], patient: Patient, found: Found) -> None:
    exposures = [image.exposure for image in images.values() if image.exposure is not None]
    found.warnings += [*other_patient(exposures, patient), *told_together(exposures)]


def _check_different(images: Mapping[str, _Seen], found: Found) -> None:
    for (one, first), (other, second) in itertools.combinations(images.items(), 2):
        if torch.equal(first.values, second.values):
            found.problem(f"{other}: the same image as {one.rpartition(', ')[2]}. Give every exposure its own image.")
