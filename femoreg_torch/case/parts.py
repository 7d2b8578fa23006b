"""The parts of `case.yaml` that every form of a case has: anatomy, label table, C-arm, views, truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy, LabelTable, bone_of_name, label_table, load_anatomy
from femoreg_torch.anatomy.tables import label_ids
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import TRUTH_SOURCES, Intensity, TruthSource, View
from femoreg_torch.case.poses import poses_from
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.fluoro import SOURCES, TURNS, Circle, Display, Frames, GridImage, Polygon, Source, carm_settings
from femoreg_torch.geometry import CArm, Poses, carm_from_dict, load_carm
from femoreg_torch.volume import has_names, segment_names

ONE_KIND = "image"  # the kind of images where a view has one alone
VIEW_KEYS = ("intensity", "camera_from_camera1", "field", "frames", "display", "grid")  # what every view may say
_TAGS = "dicom"  # in place of a C-arm: what the header of the first image says


def read_anatomy_and_bones(top: Fields, folder: Path) -> tuple[Anatomy | None, LabelTable]:
    """The body part, if one is named, and which ids of the label map are which bones."""
    anatomy = None
    if "anatomy" in top:
        name = top.text("anatomy", "the name of an anatomy, as hip, or a YAML file")
        try:
            anatomy = load_anatomy(folder / name if name.endswith((".yaml", ".yml")) else name)
        except InputError as error:
            raise InputError(f"{top.where('anatomy')}: {error}") from error
    if "ct" not in top:
        return anatomy, {}
    ct = top.mapping("ct")
    if "labels" not in ct:
        return anatomy, {}
    return anatomy, read_bones(ct, folder, anatomy)


def read_bones(ct: Fields, folder: Path, anatomy: Anatomy | None) -> LabelTable:
    """Ids by bone under `bones`: a table's name, a table's YAML file, or a mapping of bones to ids.

    For a segmentation whose parts have names (`.seg.nrrd`, a folder of masks, DICOM SEG) these say it. Raises
    `InputError`.
    """
    where = ct.where("bones")
    if "bones" not in ct:
        path = ct.file_path("labels", folder, may_be_folder=True)
        if not has_names(path):
            raise InputError(
                f"{where}: missing. Name the table of the label map (femoreg, totalsegmentator_v2, …), or its ids by "
                "bone: {hip_left: 1, …}."
            )
        return _bones_of_segments(path, anatomy, where)
    value = ct.value("bones", "a table of label ids")
    if isinstance(value, dict):
        table = {str(bone): label_ids(ids, f"{where}.{bone}") for bone, ids in value.items()}
    elif isinstance(value, str):
        try:
            table = label_table(folder / value if value.endswith((".yaml", ".yml")) else value)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    else:
        raise InputError(f"{where}: the name of a table or {{bone: id, …}} was expected, found {type(value).__name__}.")
    return _checked_table(table, anatomy, where)


def _bones_of_segments(path: Path, anatomy: Anatomy | None, where: str) -> LabelTable:
    """Ids by bone of a segmentation whose segments have names; segments that are no bones are left out."""
    segments = segment_names(path)
    if anatomy is None:
        return segments
    table: LabelTable = {}
    for text, ids in segments.items():
        bone = bone_of_name(anatomy, text)
        if bone is not None:
            table[bone] = (*table.get(bone, ()), *ids)
    if not table:
        known = ", ".join(anatomy.bone_names)
        raise InputError(
            f"{where}: no segment of {path.name} is named after a bone; there are: {', '.join(segments)[:200]}. Rename "
            f"them ({known}), or give their label values here."
        )
    return table


def _checked_table(table: LabelTable, anatomy: Anatomy | None, where: str) -> LabelTable:
    """The table, if every name is known and no id belongs to two bones other than to both sides of one."""
    if anatomy is not None:
        try:
            anatomy.members(*table)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
    taken: dict[int, str] = {}
    for bone, ids in table.items():
        for n in ids:
            other = taken.setdefault(n, bone)
            both_sides = anatomy and bone in anatomy.bone_names and anatomy.bone(bone).mirror == other
            if other != bone and not both_sides:
                raise InputError(f"{where}.{bone}: label {n} belongs to {other} already.")
    return table


def read_carm(top: Fields, display: Display, views: Sequence[View]) -> CArm:
    """The C-arm under `carm`: a preset's name, a YAML file beside `case.yaml`, its settings, or `dicom`.

    What it says of pixels is of the images of view 1 as they are stored, by its own display or the case's; the C-arm
    that is returned is of those that the source sees. `dicom` stands for what the header of the first image says.
    """
    stored = _stored_carm(top, views)
    first = (views[0].display if views else None) or display
    return replace(stored, camera=first.camera(stored.camera))


def _stored_carm(top: Fields, views: Sequence[View]) -> CArm:
    expected = "the name of a C-arm preset, a YAML file, {sdd_mm, pixel_mm, shape}, or dicom"
    value: Any = top.value("carm", expected)
    if isinstance(value, dict):
        return carm_from_dict(value, top.where("carm"))
    name = top.text("carm", expected)
    if name == _TAGS:
        if not views:
            raise InputError(f"{top.where('carm')}: there is no image to tell it. Name a preset, or give its settings.")
        return carm_from_dict(carm_settings(next(iter(views[0].images.values()))), top.where("carm"))
    try:
        return load_carm(str(Path(top.file).parent / name) if name.endswith((".yaml", ".yml")) else name)
    except InputError as error:
        raise InputError(f"{top.where('carm')}: {error}") from error


def read_view(view: Fields, folder: Path) -> View:
    """A view with `image`, or with `images` by kind."""
    view.only("image", "images", *VIEW_KEYS)
    if "images" in view and "image" in view:
        raise InputError(f"{view.where('image')}: `images` is given too. Keep one of the two.")
    if "images" in view:
        by_kind = view.mapping("images")
        images = {str(kind): by_kind.file_path(kind, folder) for kind in by_kind.content}
    else:
        images = {ONE_KIND: view.file_path("image", folder)}
    if not images:
        raise InputError(f"{view.where('images')}: is empty. Name at least one image.")
    return view_of(images, view, folder)


def view_of(images: dict[str, Path], view: Fields, folder: Path) -> View:
    """A view with these images, and what `VIEW_KEYS` say of it."""
    return View(
        images,
        read_intensity(view),
        read_known_pose(view),
        read_field(view, folder),
        read_frames(view),
        read_display(view) if "display" in view else None,
        read_grid(view, folder),
    )


def read_grid(view: Fields, folder: Path) -> GridImage | None:
    """The image of a grid on an image intensifier, under `grid`: `{image, pitch_mm}`."""
    if "grid" not in view:
        return None
    grid = view.mapping("grid").only("image", "pitch_mm")
    pitch = grid.number("pitch_mm")
    if pitch <= 0:
        raise InputError(f"{grid.where('pitch_mm')}: a positive number of mm was expected, found {pitch:g}.")
    return GridImage(grid.file_path("image", folder), pitch)


def read_display(fields: Fields) -> Display:
    """How images are stored, under `display`: `{source, mirrored, turned, ignore_header}`; else as usual."""
    if "display" not in fields:
        return Display()
    display = fields.mapping("display").only("source", "mirrored", "turned", "ignore_header")
    source = cast(Source, display.choice("source", SOURCES)) if "source" in display else "anterior"
    turned = display.content.get("turned", 0)
    flags = {key: display.content.get(key, False) for key in ("mirrored", "ignore_header")}
    for key, flag in flags.items():
        if not isinstance(flag, bool):
            raise InputError(f"{display.where(key)}: true or false was expected, found {flag!r}.")
    if not isinstance(turned, int | float) or isinstance(turned, bool) or turned not in TURNS:
        known = ", ".join(map(str, TURNS))
        raise InputError(f"{display.where('turned')}: degrees clockwise, {known}, were expected, found {turned!r}.")
    return Display(source, flags["mirrored"], int(turned), flags["ignore_header"])


def read_frames(view: Fields) -> Frames | None:
    """Which frames of cine runs are meant, under `frames`: a number from 1, several to be averaged, or `mean`."""
    if "frames" not in view:
        return None
    value = view.value("frames", "a frame's number")
    if value == "mean":
        return "mean"
    numbers = value if isinstance(value, list) else [value]
    whole = all(isinstance(n, int) and not isinstance(n, bool) and n >= 1 for n in numbers)
    if not numbers or not whole or len(set(numbers)) < len(numbers):
        raise InputError(
            f"{view.where('frames')}: a frame's number from 1, a list of such numbers, or `mean` was expected, found "
            f"{value!r}."
        )
    return tuple(numbers)


def read_field(view: Fields, folder: Path) -> Circle | Polygon | Path | None:
    """What shutters leave of a view's images: `{circle: …}`, `{polygon: …}` or the file of a mask; None: not said."""
    if "field" not in view:
        return None
    if isinstance(view.content["field"], str):
        return view.file_path("field", folder)
    field = view.mapping("field").only("circle", "polygon")
    if ("circle" in field) == ("polygon" in field):
        raise InputError(f"{view.where('field')}: `circle`, `polygon` or the file of a mask was expected.")
    if "circle" in field:
        circle = field.mapping("circle").only("centre", "radius")
        column, row = circle.numbers("centre", 2)
        radius = circle.number("radius")
        if radius <= 0:
            raise InputError(f"{circle.where('radius')}: a positive number of pixels was expected, found {radius:g}.")
        return Circle((column, row), radius)
    corners = field.value("polygon", "a list of corners [column, row]")
    if not isinstance(corners, list) or len(corners) < 3:
        raise InputError(f"{field.where('polygon')}: at least three corners [column, row] were expected.")
    items = field.inside({f"polygon[{n}]": corner for n, corner in enumerate(corners)})
    pairs = (items.numbers(name, 2) for name in items.content)
    return Polygon(tuple((column, row) for column, row in pairs))


def read_intensity(view: Fields) -> Intensity | None:
    """What the values of a view's images are; None where the case does not say."""
    return cast(Intensity, view.choice("intensity", ("raw", "log"))) if "intensity" in view else None


def read_known_pose(view: Fields) -> Tensor | None:
    """`camera_from_camera1` (4, 4) of a view, or None where it is to be found."""
    return view.transform("camera_from_camera1") if "camera_from_camera1" in view else None


def with_known_poses(views: tuple[View, ...], top: Fields) -> tuple[View, ...]:
    """The views, if the C-arm's pose is known in all of them (that of the first may be left out) or in none."""
    known = [number for number, view in enumerate(views) if view.camera_from_camera1 is not None]
    if not known:
        return views
    first = views[0].camera_from_camera1
    if first is not None and not torch.allclose(first, torch.eye(4, dtype=torch.float64), atol=1e-6):
        raise InputError(f"{top.where('views[0].camera_from_camera1')}: the first view is camera 1: leave it out.")
    for number, view in enumerate(views[1:], 1):
        if view.camera_from_camera1 is None:
            raise InputError(
                f"{top.where(f'views[{number}].camera_from_camera1')}: missing, while views[{known[0]}] has it. Give "
                "the C-arm's pose of every view, or of none."
            )
    return views


def read_truth(top: Fields, folder: Path, objects: list[str], views: int) -> tuple[Poses | None, TruthSource | None]:
    """Known poses, or None, and where they come from, if their file says so.

    They are of all objects, or, where the first one's are not known, of some. In the second case another object tells
    the C-arm's poses, in all views or in the first alone.
    """
    if "truth" not in top:
        return None, None
    path = top.file_path("truth", folder)
    fields = Fields(read_json(path), str(path))
    told = [name for name in objects if f"camera_from_{name}" in fields] or objects[:1]
    leader = told[0]
    others = [name for name in objects if name != leader]
    source = cast(TruthSource, fields.choice("source", TRUTH_SOURCES)) if "source" in fields else None
    fields.only("source", f"camera_from_{leader}", *(f"camera1_from_{name}" for name in others if name != objects[0]))
    if leader != objects[0]:
        others = [name for name in others if f"camera1_from_{name}" in fields]
    truth = poses_from(fields, leader, others)
    count = len(truth.camera_from_camera1)
    if views and count != views and (leader == objects[0] or count != 1):
        raise InputError(f"{fields.where(f'camera_from_{leader}')}: {count} poses, but the case has {views} views.")
    return truth, source
