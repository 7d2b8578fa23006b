"""What one procedure consists of: rigid objects, fluoroscopic images, and how each object starts."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy, LabelTable
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Circle, Display, Frames, GridImage, Polygon
from femoreg_torch.geometry import CArm, Poses
from femoreg_torch.volume.materials import material_hu

Side = Literal["left", "right"]
Intensity = Literal["raw", "log"]  # raw: bone dark, as a detector counts; log: attenuation, bone bright


@dataclass(frozen=True, eq=False)
class Start:
    """How an object starts: at a nominal pose, beside another object, or, with neither, where landmarks put it.

    Two structures of one CT have one space, so that beside one another they start where the CT has them. With both, the
    search starts at the pose, and the place beside the other object is what is expected.
    """

    camera1_from: Tensor | None = None  # (4, 4) nominal pose in camera 1
    beside: str | None = None  # the name of another object
    beside_from_object: Tensor = dataclasses.field(default_factory=lambda: torch.eye(4, dtype=torch.float64))

    @property
    def nominal(self) -> bool:
        """Whether it is where something is meant to be, and not where the CT has it."""
        if self.beside is None:
            return self.camera1_from is not None
        return not torch.equal(self.beside_from_object, torch.eye(4, dtype=torch.float64))

    @property
    def by_landmarks(self) -> bool:
        """Whether landmarks place it."""
        return self.camera1_from is None and self.beside is None


def anchor_of(shown: Sequence[str], starts: Mapping[str, Start], bones: Collection[str]) -> str:
    """Of objects by name, the one in whose space a registration and its pictures stand.

    It is the one that landmarks place, else the first bone that images show, else the first object that they show, else
    the first one. Landmarks and CT lie in its space if landmarks place it or it is a bone; what is a model has a space
    of its own, which they have nothing to do with.
    """
    placed = [name for name, start in starts.items() if start.by_landmarks]
    return next(iter([*placed, *(name for name in shown if name in bones), *shown, *starts]))


@dataclass(frozen=True)
class Part:
    """A solid of one material: a closed mesh, a body of a file of several, or labelled voxels.

    Either `hu` or `material` is given.
    """

    path: Path
    hu: float | None = None  # of its material
    labels: tuple[int, ...] | None = None  # of its voxels in a labelled volume
    material: str | None = None  # by name, see `volume/materials.py`
    body: str | None = None  # its name in a file of several bodies
    name: str | None = None  # for the reader of the case

    def __post_init__(self) -> None:
        if (self.hu is None) == (self.material is None):
            raise InputError(f"part {self.path.name}: either `hu` or `material` was expected.")

    @property
    def solid_hu(self) -> float:
        """HU of its material. Raises `InputError` for a material that is not known."""
        if self.material is not None:
            return material_hu(self.material)
        assert self.hu is not None  # seen when it was made
        return self.hu


@dataclass(frozen=True)
class Model:
    """What an object looks like if it is no bone.

    One solid of `hu` or of a named `material`, several solids (`parts`), or, with none of the three, a volume in HU.
    """

    path: Path  # of the mesh or volume; of parts in files of their own, that of the first
    hu: float | None  # of its material
    labels: tuple[int, ...] | None = None  # of its voxels in a labelled volume
    material: str | None = None  # by name
    parts: tuple[Part, ...] = ()  # in order: where two overlap, the later one replaces the earlier

    def __post_init__(self) -> None:
        if (self.hu is not None) + (self.material is not None) + bool(self.parts) > 1:
            raise InputError(f"model {self.path.name}: has two of `hu`, `material` and `parts`. Keep one of them.")

    @property
    def solids(self) -> tuple[Part, ...]:
        """All solids; none for a volume in HU."""
        if self.parts or (self.hu is None and self.material is None):
            return self.parts
        return (Part(self.path, self.hu, self.labels, self.material),)

    @property
    def materials_known(self) -> bool:
        """Whether materials were named, or told for each part. A single HU may be a guess."""
        return self.material is not None or bool(self.parts)


@dataclass(frozen=True, eq=False)
class CaseObject:
    """A rigid object. Points (3,) are mm in its own space: LPS of the CT or of its volume, coordinates of its mesh."""

    name: str
    bones: tuple[str, ...] = ()  # of the CT's label map: names in the case's `bones`, or groups of the anatomy
    model: Model | None = None  # or a model of its own
    reference: Tensor | None = None  # (3,) where errors are told and rotations turn about; None: middle of its box
    points: dict[str, Tensor] = dataclasses.field(default_factory=dict)  # named points
    images: tuple[str, ...] | None = None  # kinds of images that show it; None: all
    start: Start = dataclasses.field(default_factory=Start)


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """A path through an object, from the entry point to the target, that the guide of a tool is to follow."""

    object: str
    entry_point: Tensor  # (3,) in the object's space
    target: Tensor  # (3,)
    tool: str | None = None  # the object whose points `base` and `tip` are the guide's
    file: Path | None = None  # the plan.json of `femoreg plan` that it is from


@dataclass(frozen=True, eq=False)
class View:
    """The images of one C-arm pose, by kind."""

    images: dict[str, Path]
    intensity: Intensity | None = "raw"  # None: what the files say
    camera_from_camera1: Tensor | None = None  # (4, 4) where the C-arm's pose is known
    field: Circle | Polygon | Path | None = None  # what shutters leave of all its images, or a mask; None: looked for
    frames: Frames | None = None  # of all its images, where they are cine runs
    display: Display | None = None  # where it is another one than the case's
    grid: GridImage | None = None  # of an image intensifier, at this pose of the C-arm


TruthSource = Literal["simulation", "beads"]
TRUTH_SOURCES: tuple[TruthSource, ...] = ("simulation", "beads")


@dataclass(frozen=True, eq=False)
class Case:
    """One procedure. Points are mm, all tensors float64."""

    folder: Path
    carm: CArm  # of images as the source sees them, head up
    objects: dict[str, CaseObject]  # in order; the C-arm's poses are told by where the first one is
    views: tuple[View, ...] = ()
    anatomy: Anatomy | None = None  # the body part, where it is a known one
    ct_path: Path | None = None
    labels_path: Path | None = None
    bones: LabelTable = dataclasses.field(default_factory=dict)  # ids in the label map of bones, or of groups of bones
    landmarks: dict[str, Tensor] = dataclasses.field(default_factory=dict)  # (3,) each, LPS
    plan: PlannedPath | None = None
    truth: Poses | None = None
    truth_source: TruthSource | None = None  # where it comes from, if its file says so
    template: str | None = None  # what `case.yaml` is a short form of
    side: Side | None = None  # operated side, where the template has one
    display: Display = dataclasses.field(default_factory=Display)  # of the images as they are stored

    def display_of(self, view: int) -> Display:
        """How the images of a view (from 0) are stored."""
        return self.views[view].display or self.display

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of images that any view has, in order of appearance; landmarks are seen in the first."""
        return tuple(dict.fromkeys(kind for view in self.views for kind in view.images))

    @property
    def anchor(self) -> str:
        """The first object: the C-arm's poses are told by where it is."""
        return next(iter(self.objects))
