"""A `Case` into its folder: `case.yaml`, `landmarks.json` and `truth.json`."""

import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from femoreg_torch.anatomy import LabelTable, label_table, label_table_names
from femoreg_torch.case.femoroplasty import DEVICE, FEMUR, Device, device_of, femoral_head
from femoreg_torch.case.model import Case, CaseObject, Model, Part, PlannedPath, Start, View
from femoreg_torch.case.parts import ONE_KIND
from femoreg_torch.case.poses import poses_content
from femoreg_torch.case.reading import VERSIONS
from femoreg_torch.configs import preset_names
from femoreg_torch.files import plain, write_json, write_text
from femoreg_torch.fluoro import Circle, Display, Polygon
from femoreg_torch.geometry import CArm, load_carm
from femoreg_torch.volume import write_landmarks


def write_case(folder: Path, case: Case, standing: Path | None = None) -> None:
    """Write `case.yaml` and what it refers to as text; volumes, images and models must stand in place.

    Paths are written relative to `folder`, which must exist, or to where it will be `standing` once it is whole; the
    case then names its files as they will stand there. `case.folder` is not looked at.
    """
    folder, base = Path(folder).resolve(), Path(standing or folder).resolve()
    content: dict[str, Any] = {"version": VERSIONS[-1]}
    if case.template is not None:
        content |= {"template": case.template, "side": case.side}
    elif case.anatomy is not None:
        content["anatomy"] = case.anatomy.name
    if case.ct_path is not None:
        content["ct"] = _ct(case, base)
    if case.landmarks:
        write_landmarks(folder / "landmarks.json", case.landmarks)
        content["landmarks"] = "landmarks.json"
    if case.template is not None:
        content |= _femoroplasty(case, base)
    else:
        content["objects"] = {name: _object(thing, base) for name, thing in case.objects.items()}
        if case.plan is not None:
            content["plan"] = _plan(case.plan, base)
    first = case.display_of(0) if case.views else case.display
    content["carm"] = _carm(replace(case.carm, camera=first.stored_camera(case.carm.camera)))
    content |= display_content(case.display)
    if case.views:
        content["views"] = [_view(view, base, case.template is not None) for view in case.views]
    if case.truth is not None:
        told_by = case.anchor if case.anchor in case.truth.camera1_from else next(iter(case.truth.camera1_from))
        source = {} if case.truth_source is None else {"source": case.truth_source}
        write_json(folder / "truth.json", source | poses_content(case.truth, told_by))
        content["truth"] = "truth.json"
    text = yaml.safe_dump(plain(content), sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    write_text(folder / "case.yaml", text)


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(Path(path).resolve(), folder)).as_posix()


def _ct(case: Case, folder: Path) -> dict[str, Any]:
    assert case.ct_path is not None  # seen by the caller
    ct: dict[str, Any] = {"image": _relative(case.ct_path, folder)}
    if case.labels_path is not None:
        ct["labels"] = _relative(case.labels_path, folder)
        ct["bones"] = _bones(case.bones)
    return ct


def _bones(bones: LabelTable) -> str | dict[str, int | list[int]]:
    """The name of the table that equals `bones`, or all its ids."""
    for name in label_table_names():
        if label_table(name) == bones:
            return name
    return {bone: ids[0] if len(ids) == 1 else list(ids) for bone, ids in bones.items()}


def _femoroplasty(case: Case, folder: Path) -> dict[str, Any]:
    assert case.plan is not None  # the template has both
    if case.plan.file is not None:
        content: dict[str, Any] = {"plan": {"file": _relative(case.plan.file, folder)}}
    else:
        content = {"plan": _points_of(case, case.plan)}
    if (device := device_of(case)) is not None:
        content[DEVICE] = _device(device, folder)
    return content


def _points_of(case: Case, plan: PlannedPath) -> dict[str, Any]:
    """Entry point and target, which is told as the landmark where it is the head's centre."""
    assert case.side is not None
    at_head = torch.equal(plan.target, case.landmarks[femoral_head(case.side)])
    target: str | Tensor = femoral_head(case.side).rpartition("-")[0] if at_head else plan.target
    return {"entry_point": plan.entry_point, "target": target}


def _device(device: Device, folder: Path) -> dict[str, Any]:
    start = device.start
    pose = (
        {f"{FEMUR}_from_{DEVICE}": start.beside_from_object}
        if start.camera1_from is None
        else {f"camera1_from_{DEVICE}": start.camera1_from}
    )
    return _model(device.model, folder) | {"points": device.points} | pose


def _model(model: Model, folder: Path) -> dict[str, Any]:
    if not model.solids:  # a volume in HU
        return {"volume": _relative(model.path, folder)}
    if not model.parts:
        return _solid(model.solids[0], folder)
    if all(part.body is not None for part in model.parts):
        bodies = {part.body: _material(part) for part in model.parts}
        return {"model": _relative(model.path, folder), "parts": bodies}
    return {"parts": [_solid(part, folder) for part in model.parts]}


def _solid(part: Part, folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = {"model" if part.labels is None else "volume": _relative(part.path, folder)}
    if part.labels is not None:
        content["labels"] = list(part.labels)
    return content | _material(part) | ({} if part.name is None else {"name": part.name})


def _material(part: Part) -> dict[str, Any]:
    return {"hu": part.hu} if part.material is None else {"material": part.material}


def _object(thing: CaseObject, folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = {"bones": list(thing.bones)} if thing.model is None else _model(thing.model, folder)
    if thing.points:
        content["points"] = thing.points
    if thing.reference is not None:
        content["reference"] = thing.reference
    if thing.images is not None:
        content["images"] = list(thing.images)
    return content | {"start": _start(thing.start)}


def _start(start: Start) -> Any:
    if start.by_landmarks:
        return "landmarks"
    if start.camera1_from is not None:
        return {"camera1_from": start.camera1_from}
    return {"beside": start.beside} | ({"beside_from_object": start.beside_from_object} if start.nominal else {})


def _plan(plan: PlannedPath, folder: Path) -> dict[str, Any]:
    tool = {} if plan.tool is None else {"tool": plan.tool}
    if plan.file is not None:
        return {"object": plan.object, "file": _relative(plan.file, folder)} | tool
    return {"object": plan.object, "entry_point": plan.entry_point, "target": plan.target} | tool


def _view(view: View, folder: Path, short: bool) -> dict[str, Any]:
    images = {kind: _relative(path, folder) for kind, path in view.images.items()}
    content: dict[str, Any] = images if short or list(images) == [ONE_KIND] else {"images": images}
    pose = {} if view.camera_from_camera1 is None else {"camera_from_camera1": view.camera_from_camera1}
    said = {} if view.intensity is None else {"intensity": view.intensity}
    frames: Any = {} if view.frames is None else {"frames": view.frames}
    if isinstance(view.frames, tuple) and len(view.frames) == 1:
        frames = {"frames": view.frames[0]}
    display = {} if view.display is None else display_content(view.display, whole=True)
    grid = {} if view.grid is None else {"image": _relative(view.grid.path, folder), "pitch_mm": view.grid.pitch_mm}
    return content | said | pose | _field(view, folder) | frames | display | ({"grid": grid} if grid else {})


def display_content(display: Display, whole: bool = False) -> dict[str, Any]:
    """The key `display` of `case.yaml`; nothing for the usual display, unless the `whole` is asked for."""
    if display == Display() and not display.ignore_header and not whole:
        return {}
    told = {"source": display.source, "mirrored": display.mirrored, "turned": display.turned_deg}
    return {"display": told | ({"ignore_header": True} if display.ignore_header else {})}


def _field(view: View, folder: Path) -> dict[str, Any]:
    match view.field:
        case None:
            return {}
        case Circle(centre, radius):
            return {"field": {"circle": {"centre": list(centre), "radius": radius}}}
        case Polygon(corners):
            return {"field": {"polygon": [list(corner) for corner in corners]}}
        case path:
            return {"field": _relative(path, folder)}


def _carm(carm: CArm) -> str | dict[str, Any]:
    """The name of the preset that equals `carm`, or all its settings."""
    for name in preset_names("carm"):
        if load_carm(name) == carm:
            return name
    untold = {"camera"} if carm.uncertainty else {"camera", "uncertainty"}
    settings = {key: value for key, value in asdict(carm).items() if key not in untold}
    return asdict(carm.camera) | settings
