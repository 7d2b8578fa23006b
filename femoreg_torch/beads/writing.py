"""What `femoreg beads` writes: a case without beads whose truth they tell, how sure that is, and what was measured."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from femoreg_torch.beads.clean import ct_without, image_without, shadows_of
from femoreg_torch.beads.given import COLUMNS
from femoreg_torch.beads.measure import Measured
from femoreg_torch.beads.uncertainty import metric_deviations, object_rows, pose_uncertainty, view_rows
from femoreg_torch.case import Case, View, write_case
from femoreg_torch.case.model import Intensity
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import ReferencePoints, reference_points
from femoreg_torch.evaluation.overlay import monitor_picture
from femoreg_torch.files import new_folder, temporary_file, write_json
from femoreg_torch.fluoro import StoredImage, read_stored, settled_intensity, write_image
from femoreg_torch.pictures import write_picture
from femoreg_torch.volume import read_ct, write_volume

UNCERTAINTY_NAME, BEADS_NAME, PICTURE_NAME = "truth_uncertainty.json", "beads.csv", "beads.png"
CT_NAME = "ct.nii.gz"
_VERSION = 1
_PANEL_PX = 768  # of one image in the picture
_YELLOW, _RED = (0, 220, 255), (60, 60, 255)  # blue, green, red
_MOST_GREY = 65535  # of 16 bits


def bead_points(case: Case, names: tuple[str, ...]) -> ReferencePoints:
    """Reference points of the objects with beads; those of others, which need the label map, are not asked for."""
    kept = {name: thing for name, thing in case.objects.items() if name in names}
    plan = case.plan if case.plan is not None and case.plan.object in kept else None
    if plan is not None and plan.tool not in kept:
        plan = replace(plan, tool=None)
    return reference_points(replace(case, objects=kept, plan=plan))


def write_measured(out: Path, case: Case, found: Measured) -> None:
    """Write the case without beads, its truth, and what tells how sure it is, into a folder; whole or not at all.

    Of one view alone the truth holds that view. Raises `InputError` for a case whose images cannot be written anew.
    """
    with new_folder(out) as folder:
        views = tuple(_clean_view(folder, out, case, found, number) for number in range(len(case.views)))
        ct_path = _clean_ct(folder, out, case, found)
        cleaned = replace(
            case, folder=out, views=views, ct_path=ct_path, truth=found.bundle.poses, truth_source="beads"
        )
        write_case(folder, cleaned, standing=out)
        write_json(folder / UNCERTAINTY_NAME, uncertainty_content(case, found))
        _write_table(folder / BEADS_NAME, found)
        picture = beads_picture(case, found)
        with temporary_file(folder / PICTURE_NAME) as part:
            write_picture(part, picture)


def uncertainty_content(case: Case, found: Measured) -> dict[str, object]:
    """What `truth_uncertainty.json` holds, see `docs/beads.md`."""
    bundle = found.bundle
    points = bead_points(case, bundle.objects)
    sure = pose_uncertainty(bundle, points)
    return {
        "version": _VERSION,
        "image_noise_px": bundle.deviation_px,
        "image_noise_estimated": bundle.estimated,
        "bead_noise_mm": {
            thing.object: dict(zip(thing.names, thing.deviations_mm.tolist(), strict=True)) for thing in found.beads
        },
        "reprojection_rms_px": bundle.rms_px,
        "redundancy": bundle.redundancy,
        "shadows": {"used": int(bundle.used.sum()), "given": len(bundle.sights)},
        "views": len(bundle.poses.camera_from_camera1),
        "deviations": object_rows(sure) | view_rows(bundle),
        "metrics": metric_deviations(sure, bundle.poses, points),
        "objects": list(bundle.objects),
        "reference_points": {name: points.objects[name] for name in bundle.objects},
        "covariance": sure.covariance,
        "notes": list(found.notes),
    }


def _write_table(path: Path, found: Measured) -> None:
    bundle = found.bundle
    names = {thing.object: thing.names for thing in found.beads}
    with temporary_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*COLUMNS, "object", "view", "residual_px", "used"])
        for sight, residual, used in zip(bundle.sights, bundle.residuals_px, bundle.used, strict=True):
            column, row = sight.pixel
            writer.writerow(
                [
                    sight.image,
                    names[sight.object][sight.bead],
                    f"{column:.3f}",
                    f"{row:.3f}",
                    sight.object,
                    sight.view + 1,
                    f"{float(np.linalg.norm(residual)):.3f}",
                    int(used),
                ]
            )


def _clean_view(folder: Path, out: Path, case: Case, found: Measured, number: int) -> View:
    """The images of a view without the beads that they show; those of a view that nothing places stay as they are."""
    view, images = case.views[number], {}
    for kind, path in view.images.items():
        centres, radii = _shadows(case, found, number, kind)
        stored = read_stored(path, view.frames)
        _check_raw_16_bits(stored, settled_intensity(view.intensity, stored, str(path)), path)
        image = image_without(stored.values, centres, radii, case.carm.camera)
        if (stored.values != stored.values.round()).any():  # any scale will do, and rounding is not to be seen
            image = image * (_MOST_GREY / image.max())
        image = image.clamp(0, _MOST_GREY)  # what is filled in may lie beyond what is around it
        name = f"view{number + 1}_{kind}.tif"
        write_image(folder / name, image.round().to(torch.uint16))
        images[kind] = out / name
    return replace(view, images=images, frames=None)


def _check_raw_16_bits(image: StoredImage, intensity: Intensity, path: Path) -> None:
    """Raises `InputError` for an image that would be another one as raw intensities of 16 bits."""
    if intensity == "log":
        raise InputError(
            f"{path}: holds logarithms, but raw images of 16 bits are written without beads. Give the raw images."
        )
    low, high = (value.item() for value in image.values.aminmax())
    if low < 0 or high > _MOST_GREY:
        raise InputError(
            f"{path}: holds values from {low:g} to {high:g}, but raw images of 16 bits are written without beads. "
            f"Bring them to 0 to {_MOST_GREY} by a factor, which changes nothing else of raw images."
        )


def _shadows(case: Case, found: Measured, number: int, kind: str) -> tuple[Tensor, Tensor]:
    """Where the beads are in an image (N, 2), and their radii (N,), px."""
    parts = [(torch.empty(0, 2, dtype=torch.float64), torch.empty(0, dtype=torch.float64))]
    for thing in found.beads:
        if number in found.cameras and kind in (case.objects[thing.object].images or case.kinds):
            pose = found.cameras[number] @ found.placed[thing.object]
            parts.append(shadows_of(thing.points, thing.diameter_mm, pose, case.carm.camera))
    centres, radii = (torch.cat(values) for values in zip(*parts, strict=True))
    return centres, radii


def _clean_ct(folder: Path, out: Path, case: Case, found: Measured) -> Path | None:
    """The CT without the beads of its bones; the same file where it has none."""
    inside = [thing for thing in found.beads if case.objects[thing.object].model is None]
    if case.ct_path is None or not inside:
        return case.ct_path
    ct = read_ct(case.ct_path)
    for thing in inside:
        ct = ct_without(ct, thing.points, thing.diameter_mm)
    write_volume(folder / CT_NAME, ct)
    return out / CT_NAME


def beads_picture(case: Case, found: Measured) -> np.ndarray:
    """A column per view, a row per kind of images: yellow circles where beads are drawn, red crosses at outliers."""
    rows = []
    for kind, of_views in found.images.items():
        panels = []
        for number, image in enumerate(of_views):
            shape = case.carm.camera.shape
            factor = max(1, shape[1] // _PANEL_PX)
            grey = np.zeros((*shape, 3), np.uint8) if image is None else monitor_picture(image)
            panel = np.ascontiguousarray(grey[::factor, ::factor])
            if image is not None:
                _draw(panel, case, found, number, kind, factor)
            panels.append(panel)
        rows.append(np.hstack(panels))
    return np.vstack(rows)


def _draw(panel: np.ndarray, case: Case, found: Measured, number: int, kind: str, factor: int) -> None:
    centres, radii = _shadows(case, found, number, kind)
    for (column, row), radius in zip(centres.tolist(), radii.tolist(), strict=True):
        middle = (round(column / factor), round(row / factor))
        cv2.circle(panel, middle, round(radius / factor) + 4, _YELLOW, 1, cv2.LINE_AA)
    for sight, used in zip(found.bundle.sights, found.bundle.used, strict=True):
        if (sight.view, sight.kind) == (number, kind) and not used:
            middle = (round(sight.pixel[0] / factor), round(sight.pixel[1] / factor))
            cv2.drawMarker(panel, middle, _RED, cv2.MARKER_TILTED_CROSS, 12, 1, cv2.LINE_AA)
