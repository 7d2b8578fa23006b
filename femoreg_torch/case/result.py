"""The result of a registration: poses, how they came about, and how far they can be trusted."""

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from femoreg_torch.case.model import Case
from femoreg_torch.case.quality import CameraQuality, ObjectQuality
from femoreg_torch.case.trace import StageRecord
from femoreg_torch.case.verdict import Verdict, verdict_on
from femoreg_torch.geometry import Poses, invert_rigid, transform_points


@dataclass(frozen=True)
class LandmarkRecord:
    """A landmark in the first image, as the start saw it."""

    pixel: tuple[float, float]  # column, row of the image as stored
    confidence: float
    visible: bool
    used: bool  # whether PnP took it for right


@dataclass(frozen=True, eq=False)
class StartRecord:
    """The pose that the registration started from."""

    object: str  # the one that the others were placed by
    camera1_from_object: Tensor  # (4, 4)
    source: str  # where it came from, in words
    landmarks: dict[str, LandmarkRecord] = field(default_factory=dict)
    reprojection_rms_px: float | None = None  # reprojection residual of the landmarks that were used
    silhouette_overlap: float | None = None  # Dice of the outlines drawn and seen; None if they were not compared


@dataclass(frozen=True, eq=False)
class Result:
    """A registration of one case. Poses are mm; the frame of all is camera 1, that of the first view."""

    poses: Poses  # its first object is the one that the C-arm's poses are told by
    quality: dict[str, ObjectQuality]
    start: StartRecord | None = None
    cameras: tuple[CameraQuality, ...] = ()  # of every view, where they were refined
    stages: tuple[StageRecord, ...] = ()
    skipped: tuple[str, ...] = ()  # what was left out, and why, in words
    path: tuple[str, str | None] | None = None  # the object with the planned path, and the tool that is to follow it
    points_camera1: dict[str, Tensor] = field(default_factory=dict)  # (3,): entry_point, tip
    directions_camera1: dict[str, Tensor] = field(default_factory=dict)  # (3,) unit vectors: path, guide
    # (6, 6) of the motion by which the tool, brought onto the planned path, would miss it: mm at the entry point, then
    # degrees about it, along the axes of the object with the path (LPS for a bone). None without a registered tool.
    path_covariance: Tensor | None = None
    timings_s: dict[str, float] = field(default_factory=dict)
    preset: str = ""
    seed: int = 0
    versions: dict[str, str] = field(default_factory=dict)
    errors: dict[str, Any] | None = None  # against the case's truth, where it has one: see `femoreg_torch.evaluation`
    inputs: str = ""  # digest of all that it was made of, see `case/inputs.py`
    case_files: str = ""  # of its case alone, without a truth
    case: str | None = None  # the case's folder, seen from that of the result
    doubts: tuple[str, ...] = ()  # what speaks against it besides the quality of its objects

    @property
    def anchor(self) -> str:
        """The object that the C-arm's poses are told by."""
        return next(iter(self.poses.camera1_from))

    @property
    def verdict(self) -> Verdict:
        """Whether it can be trusted, and why not."""
        return verdict_on(tuple(self.poses.camera1_from), self.quality, self.doubts)

    @property
    def object_from_tool(self) -> Tensor | None:
        """Where the tool is in the object with the planned path, (4, 4); None without a registered tool."""
        if self.path is None or self.path[1] not in self.poses.camera1_from:
            return None
        return invert_rigid(self.poses.camera1_from[self.path[0]]) @ self.poses.camera1_from[self.path[1]]


def path_in_camera1(case: Case, poses: Poses) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Points (3,) and unit directions (3,) of the planned path and of the guide, where they were registered."""
    plan = case.plan
    if plan is None or plan.object not in poses.camera1_from:
        return {}, {}
    points = {"entry_point": _moved(poses.camera1_from[plan.object], plan.entry_point)}
    directions = {"path": _direction(poses.camera1_from[plan.object], plan.target - plan.entry_point)}
    if plan.tool is not None and plan.tool in poses.camera1_from:
        guide = case.objects[plan.tool].points
        points["tip"] = _moved(poses.camera1_from[plan.tool], guide["tip"])
        directions["guide"] = _direction(poses.camera1_from[plan.tool], guide["tip"] - guide["base"])
    return points, directions


def _moved(pose: Tensor, point: Tensor) -> Tensor:
    return transform_points(pose, point[None])[0]


def _direction(pose: Tensor, vector: Tensor) -> Tensor:
    turned = pose[:3, :3] @ vector
    return turned / turned.norm()
