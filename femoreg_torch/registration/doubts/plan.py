"""A planned path that does not lie in its bone, or a guide that points away from it, in words."""

import torch
from scipy.spatial import cKDTree

from femoreg_torch.case import Case
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.geometry import Poses, transform_points
from femoreg_torch.registration.scene import Scene

# Entry point and target lie on or in the bone. Marrow is as light as soft tissue, so that voxels of bone may be some mm
# away.
_MOST_FROM_BONE_MM = 12.0
_ALONG = 40  # points of the path that are looked at


def doubts_about_the_plan(case: Case, scene: Scene) -> tuple[str, ...]:
    """A planned path that does not lie in its bone, in words."""
    plan = case.plan
    if plan is None or plan.object not in scene.objects or case.objects[plan.object].model is not None:
        return ()
    volume = scene.objects[plan.object].volume
    voxels = transform_points(volume.lps_from_index, volume.data.nonzero().cpu().flip(1).double())
    share = torch.linspace(0, 1, _ALONG, dtype=torch.float64)[:, None]
    path = plan.entry_point + share * (plan.target - plan.entry_point)
    away = cKDTree(voxels.numpy()).query(path.numpy())[0]
    for where, mm in (("entry point", away[0]), ("target", away[-1])):
        if mm > _MOST_FROM_BONE_MM:
            return (
                f"the planned {where} lies {mm:.0f} mm from the {plan.object}: check `plan`; its points are LPS mm of "
                "the CT",
            )
    if away.max() > _MOST_FROM_BONE_MM:
        return (f"the planned path leaves the {plan.object} by {away.max():.0f} mm: check `plan`",)
    return ()


def doubts_about_the_guide(case: Case, poses: Poses) -> tuple[str, ...]:
    """A guide that points out of the bone, away from the planned path, in words."""
    directions = path_in_camera1(case, poses)[1]
    if "guide" not in directions or float(directions["guide"] @ directions["path"]) > 0:
        return ()
    assert case.plan is not None  # it has the path
    return (
        f"the guide of the {case.plan.tool} points against the planned path: are its points `tip` and `base` "
        "exchanged, or entry point and target of the plan? Is `side` the one that is treated?",
    )
