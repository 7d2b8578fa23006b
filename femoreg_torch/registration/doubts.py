"""What speaks against a result besides the quality of its objects and what `device_doubts` asks of a device's model.

The C-arm's file, its poses, the plan, images that show something else, and what may be mirrored, bent or broken.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import chain

import torch
from scipy.spatial import cKDTree

from femoreg_torch.case import Case
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.cores import on_all_cores
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Poses, rotation_angle, transform_points
from femoreg_torch.registration.covariance import PoseCovariance
from femoreg_torch.registration.device_doubts import (
    doubts_about_size,
    doubts_about_the_models,
    doubts_about_told_tips,
    doubts_about_units,
    doubts_beside_devices,
)
from femoreg_torch.registration.handedness import Handedness, handedness
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.misfits import misfits
from femoreg_torch.registration.motion import GuideDrift, JointTurn, MotionBetween
from femoreg_torch.registration.objective import ImageCosts
from femoreg_torch.registration.orbit import orbits
from femoreg_torch.registration.quality import Limits, shift_px
from femoreg_torch.registration.rigidity import CUTS, Bend, Turns, bend, images_of
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.smears import smears

# A mobile C-arm that turns about its orbit comes back within some mm and degrees (the paper draws 2 mm and 1°), and
# sags by a few mm more. A mirrored image ended 121 mm and 10° off.
_MOST_OFF_ORBIT_MM, _MOST_OFF_ORBIT_DEG = 60.0, 15.0
_ORBIT_DEG = 100.0
# Of the anatomy between images without and with the device. Seen in all views together where nothing had moved,
# whatever else was wrong: at most 0.1 mm, 0.2° and 1.6 deviations; in one view by itself 0.4 mm, 0.1° and 2.8. Where a
# patient had moved by 1 mm and 1°: 0.9 to 1.1°, and 10 to 12 deviations; where a leg had turned by 2°, on images of
# another simulator with more noise: 1.8° and 2.4 deviations (five right ones of it: at most 1.1). Of similarity moving
# gained 0.006 to 0.15 in five more; of six right ones at most 0.0007, where one seemed 1.6 mm off by 3.2 deviations.
_GAIN_OF_MOTION = 0.001
_MOST_MOTION_MM, _MOST_MOTION_DEG, _SURE_OF_MOTION, _SURE_IN_ALL = 0.3, 0.3, 3.0, 2.2
# Of a device in one view, beside the others: what its moving gains of similarity. Where it was held still: at most
# 0.0004, on images of other simulators 0.0015 and 2.2 deviations, 0.0018 and 2.9, 0.0009 and 3.2 (one whose device was
# another: 0.0011 and 3.3). Where it moved by 1.2 mm and 0.8° between the views: 0.0014 to 0.0057, in all of eight at
# least 3.4 deviations; on images of another simulator 0.0031 and 2.4.
_GAIN_OF_DRIFT, _GAIN_OF_SURE_DRIFT = 0.002, 0.001
# Of a tool along and about its guide in one view alone. Of 39 right ones of three simulators slides were at most 0.3 mm
# and gained 0.00015; turns at most 0.8°, and 2.5° where they gained less than 0.00005. Slides of 1 and 1.5 mm were
# measured as 0.7 to 1.4 mm, by 5 deviations and more, and gained 0.0016; turns of 4 to 8° as 2.5 to 5°, by 1.5 to 2.9
# deviations, and gained 0.0005.
_MOST_SLIDE_MM, _SURE_OF_SLIDE, _GAIN_OF_SLIDE = 0.6, 3.0, 0.0003
_MOST_TURN_DEG, _SURE_OF_TURN, _GAIN_OF_TURN = 2.0, 1.2, 0.0003
# Of a bone in one view, beside the others. Where a leg had turned by 1.8° from view to view: 0.018, and where a neck
# had broken 0.0029 and more. Of 16 right ones of two simulators, with bad CTs, shutters and metal too: at most 0.0007,
# of nine of a third at most 0.0029.
_GAIN_OF_BONE_DRIFT = 0.004
# Of a bone that turns in its joint in one view. Where a leg had turned by 1.5, 2 and 2.5° in one view of another
# simulator: 1.3, 2.0 and 2.3°, by 4.7, 3.7 and 4.8 deviations, with gains of 0.0013, 0.0018 and 0.0036. Of 15 right
# ones of two simulators: up to 1.4°, but by 3 deviations at most (0.6°), with gains of 0.0009 at most.
_MOST_JOINT_TURN_DEG, _SURE_OF_JOINT_TURN, _GAIN_OF_JOINT_TURN = 0.8, 3.0, 0.0009
# Of the file's standard deviation, where intrinsics were refined. Seen: 1.4 and 1.7 where all were told 12 mm off (six
# deviations), at most 0.5 where the source distance alone was wrong.
_MOST_SHIFT = 0.9
# Entry point and target lie on or in the bone. Marrow is as light as soft tissue, so that voxels of bone may be some mm
# away.
_MOST_FROM_BONE_MM = 12.0
_ALONG = 40  # points of the path that are looked at
# Of the mean patch Grad-NCC. Seen on simulated procedures: mirror images fit worse by 0.01 to 0.06; where the CT was
# mirrored, better by 0.04.
_BETTER_MIRRORED = 0.005
# Of the ends of an object, were it cut, on average over the end that moves less: of a model, and of a bone, whose CT
# and label map err. Seen of 47 right procedures, with shutters, dark images and parts of the table too: at most 0.8 and
# 1.05 mm. Of devices bent by 2 mm or 5°, eleven of twelve 1.0 to 2.8 mm; of four broken femora 1.1 to 11 mm.
_MOST_APART_MM, _MOST_APART_OF_BONE_MM, _SURE_OF_BEND = 1.0, 1.5, 4.0
# By their standard deviation: 8.6 and more of three of those femora; a right one, behind shutters, on images of another
# simulator was 1.9 mm and 2.7 deviations apart.
_SURE_OF_BREAK = 4.0
# And of similarity, lest an end that went astray be told: 0.0003 and more where something was bent, less than nothing
# where a table's edge had drawn the end of a femur away. Two necks broken by 6 to 7° on images of another
# simulator gained 0.0011 to 0.0018 and were 1.0 to 2.0 mm apart; 22 unbroken ones of both simulators, on bad CTs and
# label maps too, at most 0.00014; where a leg had moved as a whole 0.0032, with its ends 0.1 mm apart.
_LEAST_GAIN_OF_BEND = 0.0002
_GAIN_OF_BREAK, _APART_OF_BREAK_MM = 0.0008, 0.8
# Where only a turn of an end about its long axis says so: three right hips of another simulator, whose femora had
# turned by 10° and more since the CT, were 0.9 to 1.5 mm and 3 to 5° apart by that, and gained 0.0008 to 0.0013
# (without it 0.6 mm at most). Four shafts broken by 10° about that axis gained 0.0010, 0.0013, 0.0021 and 0.0030.
_GAIN_OF_A_TURNED_END = 0.0018
# Of a model whose materials are known. Of 14 right ones of two other simulators the ends seemed at most 0.4 mm
# apart where that gained anything. A wire that was bowed by 4 mm was 0.6 and 1.1 mm apart, by 8.9 and 5.5 deviations,
# and gained 0.0003.
_MOST_APART_OF_KNOWN_MM, _SURE_OF_A_KNOWN_BEND = 0.5, 5.0
# Of a model whose materials are estimated: less gain is believed of an end that is surely elsewhere alone. On images
# of two other simulators five right devices seemed 1.1 to 5.4 mm apart, by 4.5 to 5.7 deviations and gains of 0.0003 to
# 0.0005; four bent ones gained 0.0014 to 0.005, by 8.5 to 18.
_GAIN_OF_A_BENT_MODEL, _SURE_OF_A_BENT_MODEL = 0.0008, 7.0
# Of the strength of edges. Smeared by 5 to 8 mm on the detector: 0.80 to 0.94. In 60 that were not, of two
# simulators: at least 0.98; where a fifth of the image before was left in it 0.95.
_LEAST_KEPT = 0.955


def doubts(
    case: Case, told: Scene, scene: Scene, poses: Poses, covariance: PoseCovariance, imaging: Imaging, limits: Limits
) -> tuple[str, ...]:
    """All that speaks against a result besides the quality of its objects, in words.

    `told` is the scene as the case tells it, `scene` the one with what was estimated of the images. Where an image does
    not fit at all, nothing else that the images would say is asked.
    """
    displays = [case.display_of(view) for view in range(len(case.views))]
    if strange := doubts_about_the_images(scene, poses, imaging):
        plan = *doubts_about_the_plan(case, scene), *doubts_about_the_guide(case, poses)
        return (*told.contradictions, *doubts_about_units(case, told, True), *strange, *plan)
    clear = scene.where_unsaturated()
    questions: list[Callable[[], tuple[str, ...]]] = [
        lambda: doubts_about_the_carm(scene, poses, covariance, limits, displays),
        lambda: doubts_about_the_views(scene, poses),
        lambda: doubts_about_motion(covariance, given=scene.camera_from_camera1 is not None),
        lambda: doubts_about_the_plan(case, scene),
        lambda: doubts_about_the_guide(case, poses),
        lambda: doubts_about_the_models(told, scene, poses),
        lambda: doubts_about_told_tips(case, told),
        lambda: doubts_about_smears(clear, poses),  # what moved or was smeared seems to be of another size as well
        lambda: doubts_about_size(case, told, clear, poses, imaging),
        lambda: doubts_about_handedness(told, scene, poses, imaging),
        lambda: doubts_about_rigidity(clear, poses, imaging),
    ]
    # The longest are asked first, so that no core waits long for another at the end.
    answers = on_all_cores(lambda ask: ask(), questions[::-1], scene.device)[::-1]
    found = tuple(chain(*answers))
    found = (*doubts_about_units(case, told, bool(found)), *found)
    return (*told.contradictions, *found, *doubts_beside_devices(clear, poses, imaging, bool(found)))


def doubts_about_the_images(scene: Scene, poses: Poses, imaging: Imaging) -> tuple[str, ...]:
    """Images that do not show what is drawn for them, and the likely reason, in words."""
    told = []
    for found in misfits(scene, poses, imaging):
        what = f"the {found.kind} image of view {found.view + 1}"
        beside = f"(similarity {found.similarity:.2f}, of view 1 {found.in_view_1:.2f})"
        if found.as_view is not None:
            told.append(
                f"{what} shows what the other images of view {found.as_view + 1} show {beside}: are images exchanged? "
                "Check `views` of the case"
            )
        elif found.as_stored is not None:
            told.append(
                f"{what} fits nowhere as the case tells it, and {found.as_stored} it does {beside}: check `display` "
                "and `intensity` of the view"
            )
        elif found.kind != scene.first_kind:
            told.append(
                f"{what} does not show what the other image of that view shows {beside}: check that both were taken "
                "without moving C-arm or patient, and that no images are exchanged"
            )
        elif scene.camera_from_camera1 is not None:
            told.append(
                f"{what} does not fit at the pose that the case gives {beside}: check `camera_from_camera1` of the "
                "views (from camera 1 to that view's, in mm, not the inverse), and that the image shows the same hip"
            )
        else:
            told.append(
                f"{what} fits nowhere within {_ORBIT_DEG:.0f}° of view 1 {beside}: check that it shows the same hip of "
                "the same patient, and that little covers it; a C-arm that stood elsewhere needs its poses "
                "(`camera_from_camera1` of the views)"
            )
    return tuple(told)


def doubts_about_the_carm(
    scene: Scene, poses: Poses, covariance: PoseCovariance, limits: Limits, displays: Sequence[Display]
) -> tuple[str, ...]:
    """What the images say against the C-arm's file, in words, as its views' pictures are stored; nan counts as that.

    A shift of all principal points is nearly a turn of the C-arm: images ask for a quarter of it. So where intrinsics
    were refined, a smaller shift is doubted as well. Where the images say little at the end, the estimate stays near
    the file, however far a refinement went from it; so that way is asked too.
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
    return tuple(doubts)


def doubts_about_the_views(scene: Scene, poses: Poses) -> tuple[str, ...]:
    """Views whose C-arm was found where no orbit leads, in words; none where its poses are given."""
    if scene.camera_from_camera1 is not None:
        return ()
    orbit = torch.cat(orbits(scene, poses, _ORBIT_DEG))
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


def doubts_about_motion(covariance: PoseCovariance, *, given: bool = False) -> tuple[str, ...]:
    """Anatomy that lies elsewhere in images of another kind, or a device that moved between the views, in words.

    Where the poses of the C-arm were `given`, these may be off as well.

    Where both explain the images, what explains them better. A single bone or device counts if it is sure by itself:
    the depth of a bone in one view is so open that it may gain more where a device has moved.
    """
    moved = [each for each in covariance.drifts if _has_drifted(each)]
    if any(_has_moved(each) for each in covariance.motions):
        moved.append(max(covariance.motions, key=lambda each: each.gain))
    if not moved:
        return doubts_about_joints(covariance) or doubts_about_guides(covariance)
    or_given = ", or the poses that the case gives (`camera_from_camera1`) are off" if given else ""
    found = max(moved, key=lambda each: each.gain)
    deg, mm = found.size
    view = f" of view {found.views[0] + 1}"
    if found in covariance.drifts and found.kind is None:
        return (
            f"in view {found.views[0] + 1}, the {found.objects[0]} lies {mm:.1f} mm and {deg:.1f}° from where the "
            f"other views show it: it has moved between the views (a leg that turned?){or_given}; take them again, or, "
            "if nothing has moved, check the size of pixels and voxels, and that the bone is whole",
        )
    if found in covariance.drifts:
        return (
            f"in the {found.kind} image{view}, the {found.objects[0]} lies elsewhere than in those of the other views: "
            f"it has moved between the views, or the C-arm's distance or pixels differ in that view{or_given}; hold it "
            "still and take them again",
        )
    where = "" if len(found.views) > 1 else view
    who = "the patient or the C-arm" if where or len(found.objects) > 1 else f"the {found.objects[0]}"
    lies = " and ".join(found.objects)
    return (
        f"in the {found.kind} images{where}, {lies} lie{'s' if len(found.objects) == 1 else ''} {mm:.1f} mm and "
        f"{deg:.1f}° from where the other images show them: {who} has moved between the images{or_given}; take them "
        "again",
    )


def doubts_about_joints(covariance: PoseCovariance) -> tuple[str, ...]:
    """A leg that turned in its joint in one view, in words: what explains the images best."""
    moved = [each for each in covariance.joint_turns if _has_turned(each)]
    if not moved:
        return ()
    found = max(moved, key=lambda each: each.gain)
    return (
        f"in view {found.view + 1}, the {found.name} is turned by {found.degrees:.1f}° in its joint from where the "
        "other views show it: the leg has turned between the views; hold it still and take them again",
    )


def doubts_about_guides(covariance: PoseCovariance) -> tuple[str, ...]:
    """A tool that slid along its guide or turned about it in one view, in words: what explains the images best."""
    moved = [each for each in covariance.guide_drifts if _has_drifted_along(each)]
    if not moved:
        return ()
    found = max(moved, key=lambda each: each.gain)
    how = "is turned by {:.0f}° about its guide" if found.turns else "lies {:.1f} mm along its guide"
    return (
        f"in the {found.kind} image of view {found.view + 1}, the {found.name} {how.format(abs(found.amount))} from "
        "where the other views show it: it has moved between the views; hold it still and take them again",
    )


def doubts_about_smears(scene: Scene, poses: Poses) -> tuple[str, ...]:
    """Images that something smeared while they were taken, in words."""
    return tuple(
        f"of view {found.view + 1}, the {scene.first_kind} and the {found.kind} image differ in sharpness along one "
        f"direction (edges {1 - found.kept:.0%} weaker): one of the two is smeared; hold everything still and take it "
        "again"
        for found in smears(scene, poses)
        if found.kept < _LEAST_KEPT
    )


def _has_moved(found: MotionBetween) -> bool:
    sure = _SURE_IN_ALL if len(found.views) > 1 else _SURE_OF_MOTION
    far = found.size[0] > _MOST_MOTION_DEG or found.size[1] > _MOST_MOTION_MM
    return far and found.sureness > sure and found.gain > _GAIN_OF_MOTION


def _has_drifted(found: MotionBetween) -> bool:
    if found.kind is None:
        return found.gain > _GAIN_OF_BONE_DRIFT
    return found.gain > _GAIN_OF_DRIFT or (found.gain > _GAIN_OF_SURE_DRIFT and found.sureness > _SURE_OF_MOTION)


def _has_turned(found: JointTurn) -> bool:
    told = found.degrees > _MOST_JOINT_TURN_DEG and found.sureness > _SURE_OF_JOINT_TURN
    return told and found.gain > _GAIN_OF_JOINT_TURN


def _has_drifted_along(found: GuideDrift) -> bool:
    if found.turns:
        most, sure, gain = _MOST_TURN_DEG, _SURE_OF_TURN, _GAIN_OF_TURN
    else:
        most, sure, gain = _MOST_SLIDE_MM, _SURE_OF_SLIDE, _GAIN_OF_SLIDE
    return abs(found.amount) > most and found.sureness > sure and found.gain > gain


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


def doubts_about_handedness(told: Scene, scene: Scene, poses: Poses, imaging: Imaging) -> tuple[str, ...]:
    """Objects whose mirror images fit better, in words. A round model is its own mirror image, but for a turn.

    Asked of the objects as they were `told`: where a model is mirrored, what is estimated of its materials leaves out
    what the images do not show, and the rest may be its own mirror image.
    """
    names = [name for name in poses.camera1_from if scene.objects[name].axis is None]

    def ask(name: str) -> Handedness:
        return handedness(replace(scene, objects=scene.objects | {name: told.objects[name]}), poses, name, imaging)

    every = on_all_cores(ask, names, scene.device)
    return tuple(
        f"the {name} fits the images better mirrored (similarity {fits.mirrored:.3f} against "
        f"{fits.similarity:.3f}): check the axes of the CT or model, and whether the images are mirrored"
        for name, fits in zip(names, every, strict=True)
        if fits.mirrored > fits.similarity + _BETTER_MIRRORED
    )


def doubts_about_rigidity(scene: Scene, poses: Poses, imaging: Imaging) -> tuple[str, ...]:
    """Objects whose ends do not lie as their models have them, in words; the anchor is asked where it is alone."""
    names = [name for name in poses.camera1_from if name != scene.anchor] or [scene.anchor]
    images = {name: images_of(scene, poses, name, imaging) for name in names}
    asked = [(name, share) for name in names for share in CUTS]
    every = on_all_cores(lambda each: _ends_apart(scene, poses, *each, images[each[0]]), asked, scene.device)
    told = []
    for name in names:
        bent = [found for (of, _), found in zip(asked, every, strict=True) if of == name and found is not None]
        if bent:
            found = max(bent, key=lambda each: each.apart_mm)
            told.append(
                f"the images show the ends of the {name} {found.apart_mm:.1f} mm and {found.angle_deg:.0f}° from where "
                "its model or label map has them: check that it is not bent or broken, that it is the one in the "
                "images, that more than an end of it is in view, and that no images are exchanged"
            )
    return tuple(told)


def _ends_apart(
    scene: Scene, poses: Poses, name: str, share: float, images: tuple[ImageCosts, ...] | None
) -> Bend | None:
    """How the ends of an object lie apart, if they do, and still do without turns that no image tells.

    A bone that hardly fits better so is asked without any turn of an end about its long axis as well.
    """
    thing = scene.objects[name]

    def apart(turns: Turns) -> Bend | None:
        found = bend(scene, poses, name, share, images, turns)
        return found if found is not None and _is_bent(found, bool(thing.parts), thing.materials_known) else None

    found = apart("all") and apart("told")
    if found is None or thing.parts or found.gain > _GAIN_OF_A_TURNED_END:
        return found
    return found if apart("none") else None


def _is_bent(found: Bend, is_model: bool, materials_known: bool) -> bool:
    most, sure = (_MOST_APART_MM, 1.0) if is_model else (_MOST_APART_OF_BONE_MM, _SURE_OF_BREAK)
    most = _MOST_APART_OF_KNOWN_MM if materials_known else most
    apart = found.apart_mm > max(most, sure * found.apart_deviation_mm)
    broken = not is_model and found.gain > _GAIN_OF_BREAK and found.apart_mm > _APART_OF_BREAK_MM
    sure_of_materials = not is_model or materials_known
    told = sure_of_materials or found.gain > _GAIN_OF_A_BENT_MODEL or found.sureness > _SURE_OF_A_BENT_MODEL
    surely = found.sureness > (_SURE_OF_A_KNOWN_BEND if materials_known else _SURE_OF_BEND)
    return broken or (apart and told and surely and found.gain > _LEAST_GAIN_OF_BEND)
