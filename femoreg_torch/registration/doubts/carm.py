"""What the images say against the C-arm's file, and C-arms that stand where no orbit leads, in words."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Poses, rotation_angle, transform_points
from femoreg_torch.registration.evidence.covariance import IntrinsicsEstimate, PoseCovariance
from femoreg_torch.registration.orbit import orbits, rolled
from femoreg_torch.registration.quality import Limits, shift_px
from femoreg_torch.registration.scene import Scene

# A mobile C-arm that turns about its orbit comes back within some mm and degrees (the paper draws 2 mm and 1°), and
# sags by a few mm more. A mirrored image ended 121 mm and 10° off.
_MOST_OFF_ORBIT_MM, _MOST_OFF_ORBIT_DEG = 60.0, 15.0
ORBIT_DEG = 100.0
# Of the file's standard deviation, where intrinsics were refined. Seen: 1.4 and 1.7 where all were told 12 mm off (six
# deviations), at most 0.5 where the source distance alone was wrong.
_MOST_SHIFT = 0.9
_NO_DEVIATION = 1e-9
# Of a shift of all principal points alike, by the images of all views together: mm, of the file's standard deviation,
# and by so many of the images' own. Where all were told 12 mm off, two of two: 5 and 10 mm, by 4.0 and 7.1. Of 38 right
# files, of four simulators, by at most 3.1, and one by 3.9. Tried, the shifts of the wrong ones saved shares of 0.0016
# and 0.0041 of the cost, that of this right one 0.0003, those of the others 0.0011 at most. Of 60 right files at home
# one was told by some more than 0.0012. Who says that a file is uncertain by 10 mm is not told of 5.
_MOST_COMMON_SHIFT_MM, _MOST_COMMON_SHIFT, _SURE_OF_COMMON_SHIFT = 3.0, 1.5, 3.6
_GAIN_OF_COMMON_SHIFT = 0.0014


def doubts_about_the_carm(
    scene: Scene,
    poses: Poses,
    covariance: PoseCovariance,
    limits: Limits,
    displays: Sequence[Display],
    gain: Callable[[Tensor], float],
) -> tuple[str, ...]:
    """What the images say against the C-arm's file, in words, as its views' pictures are stored; nan counts as that.

    A shift of all principal points is nearly a turn of the C-arm: images ask for a quarter of it. So where intrinsics
    were refined, a smaller shift is doubted as well. Where the images say little at the end, the estimate stays near
    the file, however far a refinement went from it; so that way is asked too. `gain` tries a shift of all principal
    points, see `evidence.shifted_points`.
    """
    camera, uncertainty, mean = scene.carm.camera, scene.carm.assumed_uncertainty, covariance.intrinsics.mean
    advice = (
        "check the C-arm's file, the pixel size, whether the images are cropped or distorted, the voxel size of the "
        "CT, and that its label map lies on the bones"
    )
    doubts = []
    if not abs(float(mean[0])) <= limits.most_intrinsics_sigma:
        fitted = camera.sdd_mm * math.exp(float(mean[0]) * uncertainty.sdd_percent / 100)
        doubts.append(
            f"the images fit a source distance of {fitted:.0f} mm, the C-arm's file says {camera.sdd_mm:.0f} mm "
            f"(± {uncertainty.sdd_percent:.1f} %): {advice}"
        )
    elif refined_sdd := [
        change.sdd_factor
        for change in poses.changes
        if abs(math.log(change.sdd_factor)) > limits.most_intrinsics_sigma * uncertainty.sdd_percent / 100
    ]:
        doubts.append(
            f"the images moved the source distance from the {camera.sdd_mm:.0f} mm of the C-arm's file "
            f"(± {uncertainty.sdd_percent:.1f} %) to {refined_sdd[0] * camera.sdd_mm:.0f} mm: {advice}"
        )
    for view, shift in enumerate(mean[1:].view(-1, 2)):
        if not float(shift.abs().max()) <= limits.most_intrinsics_sigma:
            x, y = shift_px(scene.carm, displays[view], shift)
            doubts.append(
                f"the images of view {view + 1} fit a principal point ({x:.0f}, {y:.0f}) pixels from where the C-arm's "
                f"file says (± {uncertainty.principal_point_mm:.1f} mm): {advice}"
            )
    refined = (max(map(abs, change.principal_point_shift_mm)) for change in poses.changes)
    shifted = {view: mm for view, mm in enumerate(refined, 1) if mm > _MOST_SHIFT * uncertainty.principal_point_mm}
    if shifted and not doubts:
        view = max(shifted, key=lambda view: shifted[view])
        doubts.append(
            f"the images moved the principal point of view {view} by {shifted[view]:.1f} mm from where the C-arm's "
            f"file says (± {uncertainty.principal_point_mm:.1f} mm), and they see but a part of such an error: {advice}"
        )
    if not doubts and not poses.changes:
        shift, sureness = _common_shift(covariance.intrinsics)
        far = float(shift.abs().max())
        is_far = far > _MOST_COMMON_SHIFT and far * uncertainty.principal_point_mm > _MOST_COMMON_SHIFT_MM
        if is_far and sureness > _SURE_OF_COMMON_SHIFT and not gain(shift) <= _GAIN_OF_COMMON_SHIFT:
            x, y = shift_px(scene.carm, displays[0], shift)
            doubts.append(
                f"the images of all views fit principal points some ({x:.0f}, {y:.0f}) pixels from where the C-arm's "
                f"file says (± {uncertainty.principal_point_mm:.1f} mm), as view 1 is stored: {advice}"
            )
    return tuple(doubts)


def _common_shift(found: IntrinsicsEstimate) -> tuple[Tensor, float]:
    """The shift (2,) of all principal points alike that the images ask for, and by how many deviations.

    In standard deviations of the file. What a view says by itself is what it says with the file, a prior of mean zero
    and deviation one, without that; views are weighted by how well they tell it. Of x and y the surer counts.
    """
    mean, deviation = (each[1:].view(-1, 2) for each in (found.mean, found.deviation))
    told = (deviation.clamp_min(_NO_DEVIATION) ** -2 - 1).clamp_min(0)  # inverse variances
    asked = (mean / deviation.clamp_min(_NO_DEVIATION) ** 2).sum(0)  # of each view: its own shift by its variance
    total = told.sum(0)
    shift = torch.where(total > 0, asked / total, torch.zeros_like(asked))
    return shift, float((shift.abs() * total.sqrt()).max())


def doubts_about_the_views(scene: Scene, poses: Poses) -> tuple[str, ...]:
    """Views whose C-arm was found where no orbit leads, in words; none where its poses are given."""
    if scene.camera_from_camera1 is not None:
        return ()
    orbit = torch.cat([*orbits(scene, poses, ORBIT_DEG), rolled(scene, poses, ORBIT_DEG)])
    isocentre = torch.tensor(scene.carm.isocentre_mm, dtype=torch.float64)
    told = []
    for view, found in enumerate(poses.camera_from_camera1[1:], 2):
        turned = torch.rad2deg(rotation_angle(orbit[:, :3, :3].mT @ found[:3, :3]))
        apart = (transform_points(orbit, isocentre[None]) - transform_points(found, isocentre[None])).norm(dim=-1)[:, 0]
        nearest = torch.maximum(turned / _MOST_OFF_ORBIT_DEG, apart / _MOST_OFF_ORBIT_MM).argmin()
        deg, mm = float(turned[nearest]), float(apart[nearest])
        if not (deg <= _MOST_OFF_ORBIT_DEG and mm <= _MOST_OFF_ORBIT_MM):
            told.append(
                f"the C-arm of view {view} lies {mm:.0f} mm and {deg:.0f}° off its orbit: check that the image is not "
                "mirrored or turned and shows the same patient; if the C-arm was moved so far, give its poses"
            )
    return tuple(told)
