"""What one procedure consists of: rigid objects, fluoroscopic images, and how each object starts."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy, LabelTable
from femoreg_torch.geometry import CArm, Poses

Side = Literal["left", "right"]
Intensity = Literal["raw", "log"]  # raw: bone dark, as a detector counts; log: attenuation, bone bright


@dataclass(frozen=True, eq=False)
class Start:
    """How an object starts: at a nominal pose, beside another object, or, with neither, where landmarks put it.

    Two structures of one CT have one space, so that beside one another they start where the CT has them.
    """

    camera1_from: Tensor | None = None  # (4, 4) nominal pose in camera 1
    beside: str | None = None  # the name of another object
    beside_from_object: Tensor = field(default_factory=lambda: torch.eye(4, dtype=torch.float64))

    @property
    def by_landmarks(self) -> bool:
        """Whether landmarks place it."""
        return self.camera1_from is None and self.beside is None


@dataclass(frozen=True)
class Model:
    """What an object looks like if it is no bone: a closed mesh, a labelled volume, or (`hu` None) a volume in HU."""

    path: Path
    hu: float | None  # of its material
    labels: tuple[int, ...] | None = None  # of its voxels in a labelled volume


@dataclass(frozen=True, eq=False)
class CaseObject:
    """A rigid object. Points (3,) are mm in its own space: LPS of the CT or of its volume, coordinates of its mesh."""

    name: str
    bones: tuple[str, ...] = ()  # of the CT's label map: names in the case's `bones`, or groups of the anatomy
    model: Model | None = None  # or a model of its own
    reference: Tensor | None = None  # (3,) where errors are told and rotations turn about; None: middle of its box
    points: dict[str, Tensor] = field(default_factory=dict)  # named points
    images: tuple[str, ...] | None = None  # kinds of images that show it; None: all
    start: Start = field(default_factory=Start)


@dataclass(frozen=True, eq=False)
class PlannedPath:
    """A path through an object, from the entry point to the target, that the guide of a tool is to follow."""

    object: str
    entry_point: Tensor  # (3,) in the object's space
    target: Tensor  # (3,)
    tool: str | None = None  # the object whose points `base` and `tip` are the guide's


@dataclass(frozen=True, eq=False)
class View:
    """The images of one C-arm pose, by kind."""

    images: dict[str, Path]
    intensity: Intensity = "raw"
    camera_from_camera1: Tensor | None = None  # (4, 4) where the C-arm's pose is known


@dataclass(frozen=True, eq=False)
class Case:
    """One procedure. Points are mm, all tensors float64."""

    folder: Path
    carm: CArm
    objects: dict[str, CaseObject]  # in order; the C-arm's poses are told by where the first one is
    views: tuple[View, ...] = ()
    anatomy: Anatomy | None = None  # the body part, where it is a known one
    ct_path: Path | None = None
    labels_path: Path | None = None
    bones: LabelTable = field(default_factory=dict)  # ids in the label map of bones, or of groups of bones
    landmarks: dict[str, Tensor] = field(default_factory=dict)  # (3,) each, LPS
    plan: PlannedPath | None = None
    truth: Poses | None = None
    template: str | None = None  # what `case.yaml` is a short form of
    side: Side | None = None  # operated side, where the template has one

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of images that any view has, in order of appearance; landmarks are seen in the first."""
        return tuple(dict.fromkeys(kind for view in self.views for kind in view.images))

    @property
    def anchor(self) -> str:
        """The first object: the C-arm's poses are told by where it is."""
        return next(iter(self.objects))
