"""What is wrong with the views of a case and their images."""

import itertools
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

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
    GridImage,
    Polygon,
    below_zero,
    check_header,
    check_intensity,
    check_matches,
    find_distortion,
    raised,
    read_image,
    read_stored,
    settled_intensity,
)
from femoreg_torch.fluoro.reading import LOOKS_LOG
from femoreg_torch.geometry import Camera, CArm
from femoreg_torch.intake.found import Found

_LOOK_PX = 96  # images are compared at about so many pixels across
_MORE_ALIKE = 0.2  # correlation by which another view's image must be more alike before it is told


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
    poses: dict[str, Tensor] = {}
    for view in views:
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
                _check_image(path, looked_at, carm, view.where(kind), read, found)
    _check_different(read, found)
    for (one, first), (other, second) in itertools.combinations(poses.items(), 2):
        if torch.allclose(first, second, atol=1e-6):
            found.warnings.append(f"{one} and {other} are given one and the same pose of the C-arm")
    _check_exchanged(_by_key(read), ANATOMY_IMAGES, found)
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
    if case.views:
        _check_exchanged(_by_key(read), next(iter(case.views[0].images)), found)
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
    settled = found.attempt(lambda: settled_intensity(view.intensity, stored, f"{where}: {path.name}"))
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


def _check_different(images: Mapping[str, Tensor], found: Found) -> None:
    for (one, first), (other, second) in itertools.combinations(images.items(), 2):
        if torch.equal(first, second):
            found.problem(f"{other}: the same image as {one.rpartition(', ')[2]}. Give every exposure its own image.")


def _check_exchanged(images: Mapping[str, Tensor], first_kind: str, found: Found) -> None:
    """Warns of images that look less like the first one of their own view than like that of another view."""
    looks = {key: _look(image) for key, image in images.items()}
    firsts = {key.rpartition(".")[0]: look for key, look in looks.items() if key.endswith(f".{first_kind}")}
    for key, look in looks.items():
        view = key.rpartition(".")[0]
        alike = {other: float((look * first).mean()) for other, first in firsts.items() if first.shape == look.shape}
        if key == f"{view}.{first_kind}" or view not in alike:
            continue
        nearest = max(alike, key=lambda other: alike[other])
        if alike[nearest] > alike[view] + _MORE_ALIKE:
            found.warnings.append(
                f"{key}: looks like {nearest}.{first_kind} (correlation {alike[nearest]:.2f}) and not like "
                f"{view}.{first_kind} ({alike[view]:.2f}). Are images of two views exchanged? Both of a view are to be "
                "of one C-arm pose."
            )


def _look(image: Tensor) -> Tensor:
    """What is seen in an image (H, W), coarse, without slow changes of brightness: mean 0, mean square 1."""
    factor = max(1, round(min(image.shape) / _LOOK_PX))
    values = image.float() - image.min()
    coarse = avg_pool2d(values[None, None], factor)
    logs = (coarse + 0.01 * coarse.mean() + 1e-30).log()
    detail = logs - avg_pool2d(logs, 11, stride=1, padding=5, count_include_pad=False)
    return ((detail - detail.mean()) / detail.std().clamp_min(1e-30))[0, 0]
