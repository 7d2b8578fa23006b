"""Objects of a case that are written out: where each comes from, and how it starts."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy, LabelTable
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import CaseObject, PlannedPath, Side, Start
from femoreg_torch.case.models import MODEL_KEYS, is_model, read_model
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.files import read_json

_LONGEST_NAME = 100
_BY_LANDMARKS = "landmarks"
_RESERVED = ("all", "each", "view", "views", "intrinsics", "camera1")  # words of presets, and of names of poses


def read_object(
    entries: Fields,
    name: str,
    folder: Path,
    bones: LabelTable,
    anatomy: Anatomy | None,
    landmarks: Mapping[str, Tensor],
) -> CaseObject:
    """One entry of `objects`: bones of the CT's label map, or a model, with points, images and start.

    Raises `InputError` that names file and key for whatever does not fit.
    """
    if len(name) > _LONGEST_NAME:
        raise InputError(
            f"{entries.where(shortened(name))}: a name of at most {_LONGEST_NAME} characters was expected."
        )
    entry = entries.mapping(name).only("bones", *MODEL_KEYS, "reference", "points", "images", "start")
    if not name.isidentifier() or name in _RESERVED:
        raise InputError(
            f"{entries.where(name)}: a name of letters, digits and _ was expected, other than {', '.join(_RESERVED)}; "
            "poses are named after it."
        )
    points = {}
    if "points" in entry:
        named = entry.mapping("points")
        points = {key: named.point(key) for key in named.content}
    from_ct = "bones" in entry
    if from_ct == is_model(entry):
        raise InputError(
            f"{entries.where(name)}: either `bones` of the CT or a `model`, `volume` or `parts` was expected."
        )
    return CaseObject(
        name=name,
        bones=_bones(entry, bones, anatomy) if from_ct else (),
        model=None if from_ct else read_model(entry, folder),
        reference=_reference(entry, points, landmarks if from_ct else {}),
        points=points,
        images=tuple(entry.texts("images", "a kind of images, or a list")) if "images" in entry else None,
        start=_start(entry),
    )


def _bones(entry: Fields, bones: LabelTable, anatomy: Anatomy | None) -> tuple[str, ...]:
    names = entry.texts("bones", "the name of a bone, or a list")
    for name in names:
        inside = anatomy.groups.get(name, (name,)) if anatomy else (name,)
        if name not in bones and not any(bone in bones for bone in inside):
            raise InputError(
                f"{entry.where('bones')}: `ct.bones` has no {shortened(name)}. It has: {', '.join(bones) or 'nothing'}."
            )
    return tuple(names)


def _reference(entry: Fields, points: Mapping[str, Tensor], landmarks: Mapping[str, Tensor]) -> Tensor | None:
    if "reference" not in entry:
        return None
    value = entry.value("reference", "a point's name or [x, y, z]")
    if not isinstance(value, str):
        return entry.point("reference")
    known = {**landmarks, **points}
    if value not in known:
        raise InputError(
            f"{entry.where('reference')}: there is no point {shortened(value)}. There are: {', '.join(known)}."
        )
    return known[value]


def _start(entry: Fields) -> Start:
    if entry.value("start", "landmarks, {beside: …} or {camera1_from: …}") == _BY_LANDMARKS:
        return Start()
    start = entry.mapping("start").only("beside", "beside_from_object", "camera1_from")
    if ("beside" in start) == ("camera1_from" in start):
        raise InputError(f"{entry.where('start')}: either `beside` or `camera1_from` was expected.")
    if "camera1_from" in start:
        if "beside_from_object" in start:
            raise InputError(
                f"{start.where('beside_from_object')}: only an object that starts `beside` another has it."
            )
        return Start(camera1_from=start.transform("camera1_from"))
    beside = start.text("beside", "the name of another object")
    if "beside_from_object" not in start:
        return Start(beside=beside)
    return Start(beside=beside, beside_from_object=start.transform("beside_from_object"))


def plan_points(plan: Fields, folder: Path, side: Side | None = None) -> tuple[Fields, Path | None]:
    """Where `entry_point` and `target` stand: in the case, or in the `plan.json` that it names under `file`, and that.

    Raises `InputError` for a file that is no plan, or one for the other side, or points that are given twice.
    """
    if "file" not in plan:
        return plan, None
    for key in ("entry_point", "target"):
        if key in plan:
            raise InputError(f"{plan.where(key)}: stands in the `file` of the plan already. Keep one of them.")
    path = plan.file_path("file", folder)
    content = Fields(read_json(path), str(path))
    check_frame(content)
    planned = content.content.get("side")
    if side is not None and planned not in (None, side):
        raise InputError(
            f"{plan.where('file')}: {path} is a plan for the {planned} femur, the case is of the {side} side."
        )
    return content.mapping("plan"), path


def check_frame(plan: Fields) -> None:
    """Raises `InputError` for the content of a `plan.json` that says of itself that it is not in LPS mm."""
    for key, known in (("space", "LPS"), ("unit", "mm")):
        if str(value := plan.content.get(key, known)).strip().lower() != known.lower():
            raise InputError(f"{plan.where(key)}: {known} was expected, found {shortened(value)}.")


def read_plan(
    plan: Fields, folder: Path, objects: Mapping[str, CaseObject], landmarks: Mapping[str, Tensor]
) -> PlannedPath:
    """The planned path of a case whose objects are written out. Raises `InputError`."""
    plan.only("object", "file", "entry_point", "target", "tool")
    name = plan.choice("object", tuple(objects))
    tool = plan.choice("tool", tuple(objects)) if "tool" in plan else None
    if tool is not None and not {"tip", "base"} <= set(objects[tool].points):
        raise InputError(
            f"{plan.where('tool')}: {tool} needs the points `tip` and `base`; its guide runs from base to tip."
        )
    if tool is not None:
        check_guide(objects[tool].points, f"{plan.where('tool')}: {tool}")
    points, file = plan_points(plan, folder)
    target = points.value("target", "a landmark or a point [x, y, z]")
    if isinstance(target, str):
        known = {**landmarks, **objects[name].points}
        if target not in known:
            raise InputError(
                f"{points.where('target')}: there is no point {shortened(target)}. There are: {', '.join(known)}."
            )
        end = known[target]
    else:
        end = points.point("target")
    path = PlannedPath(name, points.point("entry_point"), end, tool, file)
    return checked_path(path, f"{points.file}, {points.path}")


def checked_path(path: PlannedPath, where: str) -> PlannedPath:
    """The path, if it has a direction. Raises `InputError` that starts with `where` the plan stands."""
    if not (path.target - path.entry_point).norm() > 1e-6:
        raise InputError(f"{where}.entry_point: is the target itself, so the path has no direction.")
    return path


def check_guide(points: Mapping[str, Tensor], where: str) -> None:
    """Raises `InputError` that starts with `where` if tip and base are one point."""
    if torch.equal(points["tip"], points["base"]):
        raise InputError(f"{where}: tip and base are the same point, so the guide has no direction.")
