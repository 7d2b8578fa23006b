"""A result as a scene of 3D Slicer: CT, surfaces of all objects where they were found, landmarks, path and guide.

The scene stands in the space of the anchor: of what landmarks place, else of the first bone. That is the CT's, whatever
comes first in the case. Every other object hangs below a transform `<anchor>_from_<object>`. All files are in LPS and
say so: surfaces in the header of their STL file, which 3D Slicer reads since 4.11, markups in `coordinateSystem`,
transforms as ITK stores them.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from femoreg_torch.case import Case, CaseObject, Result, anchor_of
from femoreg_torch.errors import InputError
from femoreg_torch.files import write_json, write_text
from femoreg_torch.geometry import invert_rigid
from femoreg_torch.navigation import transform_text
from femoreg_torch.registration.prepare.bones import read_bones
from femoreg_torch.registration.prepare.models import model_attenuation
from femoreg_torch.volume import BoneLabels, Volume, write_landmarks

if TYPE_CHECKING:
    import trimesh

SCENE_NAME, SCENE_FOLDER = "scene.mrml", "slicer"
_BONE, _TOOL = (0.89, 0.85, 0.73), (0.35, 0.6, 0.85)
_SMOOTH_PX = 0.7  # of a mask, before its surface is taken


def write_scene(folder: Path, case: Case, result: Result, standing: Path | None = None) -> list[str]:
    """Write the scene of a result and its files into `folder`; returns the names of the files.

    The CT is named where it lies, seen from `standing`, where the folder will be (itself by default). CT and landmarks
    are left out where no object lies in their space, see `outside_ct`. Raises `InputError` for what the case does not
    hold.
    """
    poses, anchor = result.poses.camera1_from, _anchor(case, result)
    bones = read_bones(case)[1] if any(case.objects[name].model is None for name in poses) else None
    scene = _Scene(folder, standing or folder)
    in_ct = not outside_ct(case, result)
    if in_ct and case.ct_path is not None and case.ct_path.is_file():
        scene.volume("CT", case.ct_path)
    anchor_from = {name: invert_rigid(poses[anchor]) @ pose for name, pose in poses.items()}
    for name, pose in anchor_from.items():
        below = None if name == anchor else scene.transform(f"{anchor}_from_{name}", pose)
        colour = _BONE if case.objects[name].model is None else _TOOL
        scene.model(name, _surface(case, case.objects[name], bones), colour, below)
        for line, ends in _lines(case, name).items():
            scene.line(line, ends, below)
    if in_ct and case.landmarks:
        scene.landmarks(case.landmarks)
    return scene.finish(result)


def outside_ct(case: Case, result: Result) -> bool:
    """Whether nothing that was registered lies in the CT's space: only models with a start of their own."""
    anchor = case.objects[_anchor(case, result)]
    return anchor.model is not None and not anchor.start.by_landmarks


def _anchor(case: Case, result: Result) -> str:
    """The object in whose space the scene stands, of those that were registered."""
    found = list(result.poses.camera1_from)
    return anchor_of(
        found,
        {name: case.objects[name].start for name in found},
        [name for name in found if case.objects[name].model is None],
    )


def _lines(case: Case, name: str) -> dict[str, tuple[Tensor, Tensor]]:
    """The planned path and the guide, where they belong to an object; points (3,) in its space."""
    plan, found = case.plan, {}
    if plan is not None and plan.object == name:
        found["path"] = (plan.entry_point, plan.target)
    if plan is not None and plan.tool == name:
        found["guide"] = (case.objects[name].points["base"], case.objects[name].points["tip"])
    return found


def _surface(case: Case, thing: CaseObject, bones: BoneLabels | None) -> "trimesh.Trimesh":
    """The surface of an object in its own space, mm."""
    if thing.model is not None:
        volume = model_attenuation(thing.model).volume
        return surface_of(volume.with_data((volume.data > 0.25 * volume.data.max()).float()), thing.name)
    assert bones is not None  # read where there is such an object
    ids = torch.tensor(bones.of(thing.bones, case.anatomy), dtype=torch.uint8)
    return surface_of(bones.labels.with_data(torch.isin(bones.labels.data, ids).float()), thing.name)


def surface_of(mask: Volume, name: str) -> "trimesh.Trimesh":
    """The surface of a mask (1 inside), mm in its space. Raises `InputError` if it is empty."""
    import trimesh
    from skimage.measure import marching_cubes

    inside = np.argwhere(mask.data.numpy() > 0.5)
    if not len(inside):
        raise InputError(f"{name}: has no voxel, so there is no surface to be shown.")
    low, high = np.maximum(inside.min(0) - 2, 0), inside.max(0) + 3
    box = np.pad(mask.data.numpy()[tuple(slice(a, b) for a, b in zip(low, high, strict=True))], 1)
    corners, faces, _, _ = marching_cubes(ndimage.gaussian_filter(box, _SMOOTH_PX), 0.5)
    index = torch.from_numpy((corners + low - 1)[:, ::-1].astype(np.float64))  # x, y, z
    points = index @ mask.lps_from_index[:3, :3].T + mask.lps_from_index[:3, 3]
    mesh = trimesh.Trimesh(points.numpy(), faces, process=False)
    if mesh.volume < 0:  # axes that are a mirror image turn faces inside out
        mesh.invert()
    return mesh


def write_stl(path: Path, mesh: "trimesh.Trimesh") -> None:
    """A binary STL file whose header tells 3D Slicer that it is in LPS."""
    content = mesh.export(file_type="stl")
    assert isinstance(content, bytes)  # the binary form
    path.write_bytes(b"femoreg SPACE=LPS".ljust(80) + content[80:])


class _Scene:
    """Nodes of a scene and the files that they name."""

    def __init__(self, folder: Path, standing: Path) -> None:
        self.folder, self.standing = folder, standing
        self.root = ElementTree.Element("MRML", version="Slicer4.4.0")
        self.files: list[str] = []

    def _node(self, kind: str, name: str, **settings: str) -> str:
        number = 1 + sum(node.tag == kind for node in self.root)
        found = f"vtkMRML{kind}Node{number}"
        ElementTree.SubElement(self.root, kind, {"id": found, "name": name} | settings)
        return found

    def _stored(self, kind: str, name: str, storage: str, file: str, display: str | None, below: str | None) -> str:
        stored = self._node(storage, f"{name} file", fileName=file)
        settings, references = {"storageNodeRef": stored}, f"storage:{stored};"
        if display is not None:
            settings["displayNodeRef"] = display
            references += f"display:{display};"
        if below is not None:
            settings["transformNodeRef"] = below
            references += f"transform:{below};"
        return self._node(kind, name, references=references, **settings)

    def volume(self, name: str, path: Path) -> None:
        file = Path(os.path.relpath(path.resolve(), self.standing.resolve())).as_posix()
        display = self._node("ScalarVolumeDisplay", f"{name} display", window="1500", level="300", autoWindowLevel="0")
        self._stored("Volume", name, "VolumeArchetypeStorage", file, display, None)

    def transform(self, name: str, b_from_a: Tensor) -> str:
        write_text(self.folder / f"{name}.tfm", transform_text(b_from_a, [name]))
        self.files.append(f"{name}.tfm")
        return self._stored("LinearTransform", name, "TransformStorage", f"{name}.tfm", None, None)

    def model(self, name: str, mesh: "trimesh.Trimesh", colour: tuple[float, ...], below: str | None) -> None:
        write_stl(self.folder / f"{name}.stl", mesh)
        self.files.append(f"{name}.stl")
        shade = " ".join(f"{value:g}" for value in colour)
        display = self._node("ModelDisplay", f"{name} display", color=shade, opacity="1", visibility="true")
        self._stored("Model", name, "ModelStorage", f"{name}.stl", display, below)

    def line(self, name: str, ends: tuple[Tensor, Tensor], below: str | None) -> None:
        labels = zip(("from", "to"), ends, strict=True)
        points = [
            {"id": str(n), "label": f"{name} {label}", "position": end, "positionStatus": "defined"}
            for n, (label, end) in enumerate(labels, 1)
        ]
        markup = {"type": "Line", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
        write_json(self.folder / f"{name}.mrk.json", {"markups": [markup]})
        self._markups("MarkupsLine", name, below)

    def landmarks(self, landmarks: Mapping[str, Tensor]) -> None:
        write_landmarks(self.folder / "landmarks.mrk.json", landmarks)
        self._markups("MarkupsFiducial", "landmarks", None)

    def _markups(self, kind: str, name: str, below: str | None) -> None:
        self.files.append(f"{name}.mrk.json")
        display = self._node("MarkupsDisplay", f"{name} display", visibility="true")
        self._stored(kind, name, "MarkupsJsonStorage", f"{name}.mrk.json", display, below)

    def finish(self, result: Result) -> list[str]:
        ElementTree.indent(self.root)
        verdict = " ".join(result.verdict.sentence.split()).replace("--", "-")
        text = ElementTree.tostring(self.root, encoding="unicode")
        write_text(self.folder / SCENE_NAME, f'<?xml version="1.0" encoding="UTF-8"?>\n<!-- {verdict} -->\n{text}\n')
        return [SCENE_NAME, *self.files]
