"""What is wrong with the views of a case and their images."""

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

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
from femoreg_torch.fluoro import Display, check_header, check_matches, read_stored, settled_intensity
from femoreg_torch.geometry import CArm
from femoreg_torch.intake.found import Found


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
    top: Fields, folder: Path, carm: CArm | None, display: Display | None, found: Found
) -> dict[str, Tensor]:
    """Every view of the short form by itself. Without a C-arm or display its images are looked at by themselves.

    Returns the images (H, W) that could be read, by key.
    """
    views = found.attempt(lambda: top.mappings("views"))
    if views is None:
        return {}
    if not views:
        found.problem(f"{top.where('views')}: empty. At least one fluoroscopic image is needed.")
    read: dict[str, Tensor] = {}
    for view in views:
        found.unknown_keys(view, (ANATOMY_IMAGES, DEVICE_IMAGES, *VIEW_KEYS))
        by_folder = (lambda one: read_field(one, folder), lambda one: read_grid(one, folder))
        for get in (read_known_pose, *by_folder):
            found.attempt(lambda get=get, view=view: cast(Callable[[Fields], Any], get)(view))  # type: ignore[misc]
        shown = found.attempt(lambda view=view: read_display(view)) if "display" in view else display  # type: ignore[misc]
        looked_at = found.attempt(
            lambda view=view, shown=shown: View({}, read_intensity(view), frames=read_frames(view), display=shown)  # type: ignore[misc]
        )
        for kind in (ANATOMY_IMAGES, DEVICE_IMAGES):
            if kind == DEVICE_IMAGES and kind not in view:
                continue
            path = found.attempt(lambda view=view, kind=kind: view.file_path(kind, folder))  # type: ignore[misc]
            if path is not None and looked_at is not None:
                _check_image(path, looked_at, carm, view.where(kind), read, found)
    _check_different(read, found)
    if DEVICE in top and views and not any(DEVICE_IMAGES in view for view in views):
        found.warnings.append("no view has an image with the device, so it will not be found")
    return _by_key(read)


def check_images(case: Case, found: Found) -> dict[str, Tensor]:
    """All images of a case that could be read. Returns those (H, W) that could be read themselves, by key."""
    read: dict[str, Tensor] = {}
    for number, view in enumerate(case.views):
        shown = View({}, view.intensity, frames=view.frames, display=case.display_of(number))
        for kind, path in view.images.items():
            _check_image(path, shown, case.carm, f"{case.folder}/case.yaml, views[{number}].{kind}", read, found)
    _check_different(read, found)
    return _by_key(read)


def _by_key(read: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {where.rpartition(", ")[2]: image for where, image in read.items()}


def _check_image(path: Path, view: View, carm: CArm | None, where: str, read: dict[str, Tensor], found: Found) -> None:
    """What is wrong with an image, as the registration would say; its values are put into `read`."""
    stored = found.attempt(lambda: read_stored(path, view.frames))
    if stored is None:
        return
    read[where] = stored.values
    found.warnings += [f"{path.name} {remark}" for remark in stored.remarks]
    found.attempt(lambda: settled_intensity(view.intensity, stored, f"{where}: {path.name}"))
    if carm is not None and view.display is not None:
        shown, camera = view.display, view.display.stored_camera(carm.camera)
        found.attempt(lambda: check_matches(stored.values, camera, f"{where}: it"))
        found.attempt(lambda: check_header(stored.tags, camera, shown, carm.uncertainty, f"{where}: {path.name}"))


def _check_different(images: Mapping[str, Tensor], found: Found) -> None:
    for (one, first), (other, second) in itertools.combinations(images.items(), 2):
        if torch.equal(first, second):
            found.problem(f"{other}: the same image as {one.rpartition(', ')[2]}. Give every exposure its own image.")
