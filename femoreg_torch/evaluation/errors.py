"""How far a registration is from the truth: equations 5 to 13 of the paper.

Gao et al., Fiducial-free 2D/3D registration for robot-assisted femoroplasty, IEEE Trans Med Robot Bionics 2 (2020) 437.

Differences are taken in the camera frame of view 1 and told along the paper's axes: x = IS towards the head, y = LR
towards the patient's left, z = AP towards the back: a right-handed set. They are the axes of that camera, named by the
side that its source stands on (`paper_from_camera`), so they lie as obliquely to the patient as view 1 does.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from femoreg_torch.case import Case, PlannedPath
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro.display import Display, Source
from femoreg_torch.geometry import Poses, euler_xyz_deg, invert_rigid, log_so3, rotation_angle, transform_points
from femoreg_torch.registration.prepare.bones import read_bones
from femoreg_torch.registration.prepare.reference import reference_point
from femoreg_torch.registration.scene import Scene

_PAPER_FROM_LPS = [2, 0, 1]  # IS, LR and AP among left, back and head


def paper_from_camera(source: Source) -> Tensor:
    """The rotation (3, 3), float64, from camera 1 to IS, LR and AP, its source on this side of the patient.

    Camera 1 sees the patient head up: its −y is IS. Its z is the beam: AP from the front, −AP from behind, LR from the
    right, −LR from the left. Its x is square to both.
    """
    beam = torch.tensor(Display(source).beam, dtype=torch.float64)
    head = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    camera_from_lps = torch.stack([torch.linalg.cross(beam, head), -head, beam])
    return camera_from_lps.T[_PAPER_FROM_LPS] + 0.0  # no −0.0


@dataclass(frozen=True, eq=False)
class ReferencePoints:
    """Where errors are told, mm in the space of each object, and along which axes."""

    objects: dict[str, Tensor]  # (3,) of every object
    plan: PlannedPath | None = None
    guide: tuple[Tensor, Tensor] | None = None  # base and tip (3,) of the plan's tool
    source: Source = "anterior"  # the side of the patient that the source of view 1 stands on

    @property
    def paper_from_camera(self) -> Tensor:
        """From the frame of camera 1 to IS, LR and AP, (3, 3)."""
        return paper_from_camera(self.source)


def reference_points(case: Case, scene: Scene | None = None) -> ReferencePoints:
    """Reference points of a case; that of bones without one of their own is the middle of their labels' bounding box.

    They are taken from the `scene` of the case, if it is there; else the label map is read where one is needed. Raises
    `InputError` if there is none, or none of the bones in it.
    """
    if scene is not None:
        objects = {name: thing.reference_point for name, thing in scene.objects.items()}
    else:
        boxed = any(thing.model is None and thing.reference is None for thing in case.objects.values())
        bones = read_bones(case)[1] if boxed else None
        objects = {name: reference_point(case, name, bones) for name in case.objects}
    guide = None
    if case.plan is not None and case.plan.tool is not None:
        points = case.objects[case.plan.tool].points
        guide = points["base"], points["tip"]
    display = case.display_of(0) if case.views else case.display
    return ReferencePoints(objects, case.plan, guide, display.source)


def errors(truth: Poses, estimate: Poses, points: ReferencePoints) -> dict[str, Any]:
    """Errors of an estimate, the rows of the paper's Tables I and II.

    A row for every object that both place (equations 5 and 6), and `view2`, `view3`, … (7 and 8): `{mm, deg, mm_xyz,
    deg_xyz}` with the displacement of the reference point (of a view: of its source) and the axis angle, and signed
    along IS, LR, AP, the rotation as xyz Euler angles. Of a planned path: `entry_point_mm` (9), `tip_mm` (10),
    `relative_mm` (11), `path_deg` (12), `guide_deg` (13), all where the tool was imaged, and `miss_mm`, `miss_deg` of
    `path_miss`; what needs a tool is left out where truth or estimate has none. A truth of one view is compared with
    the first. Raises `InputError` if the numbers of views differ otherwise.
    """
    if len(truth.camera_from_camera1) == 1:
        estimate = estimate.first_views(1)
    counts = len(truth.camera_from_camera1), len(estimate.camera_from_camera1)
    if counts[0] != counts[1]:
        raise InputError(
            f"errors: the truth has {counts[0]} views, the estimate {counts[1]}. Are they of the same case?"
        )
    there, here, axes = truth.camera1_from, estimate.camera1_from, points.paper_from_camera
    rows: dict[str, Any] = {
        name: _row(there[name], here[name], points.objects[name], axes) for name in there if name in here
    }
    source = torch.zeros(3, dtype=torch.float64)
    cameras = zip(truth.camera_from_camera1[1:], estimate.camera_from_camera1[1:], strict=True)
    for number, (true_camera, camera) in enumerate(cameras, 2):
        rows[f"view{number}"] = _row(invert_rigid(true_camera), invert_rigid(camera), source, axes)
    miss = path_miss(truth, estimate, points)
    left = {} if miss is None else {"miss_mm": miss["mm"], "miss_deg": miss["deg"]}
    return rows | _path_errors(there, here, points) | left


def path_displacements(truth: Poses, estimate: Poses, points: ReferencePoints) -> dict[str, Tensor]:
    """Estimated minus true place (3,) of `entry_point` and `tip`, mm along IS, LR and AP, where both have a pose."""
    found = {}
    if points.plan is not None:
        found["entry_point"] = points.plan.object, points.plan.entry_point
        if points.plan.tool is not None and points.guide is not None:
            found["tip"] = points.plan.tool, points.guide[1]
    there, here = truth.camera1_from, estimate.camera1_from
    return {
        key: points.paper_from_camera @ _displacement(there[name], here[name], point)
        for key, (name, point) in found.items()
        if name in there and name in here
    }


def path_miss(truth: Poses, estimate: Poses, points: ReferencePoints) -> dict[str, Any] | None:
    """By what motion the tool misses its planned place once it was moved as the estimate tells, with no other error.

    A correction C in the tool's frame (`navigation.Guidance.correction`) brings the tool, at D in truth and at D̂ as
    estimated, to DC and D̂C. Seen from the object with the planned path, at P and P̂, it then stands at P⁻¹DC in place
    of P̂⁻¹D̂C: off by the motion P⁻¹DD̂⁻¹P̂, exactly, whatever C is. It holds what the tool's turn error makes of the way
    from where it was imaged to the bone, which `relative_mm` does not, and is what `Result.path_covariance` is of.

    `{mm, deg, mm_xyz, deg_xyz}`: a turn about the entry point, then a shift. The parts are along, and about, the axes
    of the object, which for a bone are the patient's and not those of view 1: IS, LR, AP, that is z, x, y of LPS; the
    turn as a rotation vector. A turn about the guide itself counts. None without plan or tool, or where a pose of these
    is missing.
    """
    plan = points.plan
    if plan is None or plan.tool is None:
        return None
    if any(not {plan.object, plan.tool} <= set(poses.camera1_from) for poses in (truth, estimate)):
        return None
    off, believed = (_object_from_tool(poses, plan.object, plan.tool) for poses in (truth, estimate))
    motion = off @ invert_rigid(believed)
    shift = transform_points(motion, plan.entry_point[None])[0] - plan.entry_point
    turn = torch.rad2deg(log_so3(motion[:3, :3]))
    return {
        "mm": shift.norm().item(),
        "deg": turn.norm().item(),
        "mm_xyz": shift[_PAPER_FROM_LPS].tolist(),
        "deg_xyz": turn[_PAPER_FROM_LPS].tolist(),
    }


def _object_from_tool(poses: Poses, name: str, tool: str) -> Tensor:
    return invert_rigid(poses.camera1_from[name]) @ poses.camera1_from[tool]


def _path_errors(truth: dict[str, Tensor], estimate: dict[str, Tensor], points: ReferencePoints) -> dict[str, float]:
    plan = points.plan
    if plan is None or plan.object not in truth or plan.object not in estimate:
        return {}
    true_pose, pose = truth[plan.object], estimate[plan.object]
    entry = _displacement(true_pose, pose, plan.entry_point)
    metrics = {
        "entry_point_mm": entry.norm().item(),
        "path_deg": _angle_deg(true_pose, pose, plan.target - plan.entry_point),
    }
    if plan.tool is None or points.guide is None or plan.tool not in truth or plan.tool not in estimate:
        return metrics
    base, end = points.guide
    tip = _displacement(truth[plan.tool], estimate[plan.tool], end)
    return metrics | {
        "tip_mm": tip.norm().item(),
        "relative_mm": (entry - tip).norm().item(),
        "guide_deg": _angle_deg(truth[plan.tool], estimate[plan.tool], end - base),
    }


def _displacement(true_pose: Tensor, pose: Tensor, point: Tensor) -> Tensor:
    """Estimated minus true place (3,) of a point, in the frame that the poses map into."""
    return (transform_points(pose, point[None]) - transform_points(true_pose, point[None]))[0]


def _row(true_pose: Tensor, pose: Tensor, point: Tensor, axes: Tensor) -> dict[str, Any]:
    shift = _displacement(true_pose, pose, point)
    turn = pose[:3, :3] @ true_pose[:3, :3].T
    return {
        "mm": shift.norm().item(),
        "deg": math.degrees(rotation_angle(turn).item()),
        "mm_xyz": (axes @ shift).tolist(),
        "deg_xyz": euler_xyz_deg(axes @ turn @ axes.T).tolist(),
    }


def _angle_deg(true_pose: Tensor, pose: Tensor, direction: Tensor) -> float:
    """Angle between the true and the estimated direction; atan2 stays exact for small angles."""
    a, b = true_pose[:3, :3] @ direction, pose[:3, :3] @ direction
    return math.degrees(torch.atan2(torch.linalg.cross(a, b).norm(), a @ b).item())
