"""Anatomy and devices that moved between the images, in words."""

from collections.abc import Callable, Mapping, Sequence

from femoreg_torch.case.quality import largest
from femoreg_torch.registration.evidence.covariance import PoseCovariance
from femoreg_torch.registration.evidence.motion import GuideDrift, JointTurn, MotionBetween
from femoreg_torch.registration.quality import Limits

# Of the anatomy between images without and with the device. Seen in all views together where nothing had moved,
# whatever else was wrong: at most 0.1 mm, 0.2° and 1.6 deviations; in one view by itself 0.4 mm, 0.1° and 2.8. Where a
# patient had moved by 1 mm and 1°: 0.9 to 1.1°, and 10 to 12 deviations; where a leg had turned by 2°, on images of
# another simulator with more noise: 1.8° and 2.4 deviations (five right ones of it: at most 1.1). Of similarity moving
# gained 0.006 to 0.15 in five more; of six right ones at most 0.0007, where one seemed 1.6 mm off by 3.2 deviations.
_GAIN_OF_MOTION = 0.001
_MOST_MOTION_MM, _MOST_MOTION_DEG, _SURE_OF_MOTION, _SURE_IN_ALL = 0.3, 0.3, 3.0, 2.2
# Of a device in one view, beside the others, that would gain so much by a step of Newton: what fitting it there by
# itself saves of the image's cost. Where it moved by 1.2 mm and 0.8° between the views, in six of six at least 0.012;
# where its handle sagged by 3° in one view of another simulator, 0.007. Of 16 right ones of three simulators at most
# 0.002, though the step of one had promised as much as of a moved device; of a right one before saturated air 0.003.
# Fitted without moving along the beam, as now: of five that had slid, turned or moved 0.0117 to 0.026, of the handle
# that sagged 0.0053; of two right ones of one more simulator 0.0042 and 0.0047, where 3 and 9 mm along the beam had
# saved 0.016 each.
_WORTH_FITTING = 0.0009
_SHARE_OF_DRIFT = 0.005
# Of a device that moved across its guide, what fitting saves may be little: its depth gives way. One that moved by 1.5
# mm in one of three views within 42° was 2.4 mm off beside the femur, for 0.2 % of that image's cost. But the views
# still pull it to different places in their images. Of four that had moved by 1 to 1.8 mm: by 0.16 to 0.29 mm, root
# mean square, with gains of 0.0024 to 0.006. Of 95 right ones of five simulators by 0.10 mm at most, but for one, by
# 0.16 mm with a gain of 0.0002.
_APART_MM, _GAIN_OF_APART = 0.13, 0.002
# Of a tool along and about its guide in one view alone. Of 39 right ones of three simulators slides were at most 0.3 mm
# and gained 0.00015; turns at most 0.8°, and 2.5° where they gained less than 0.00005. Slides of 1 and 1.5 mm were
# measured as 0.7 to 1.4 mm, by 5 deviations and more, and gained 0.0016; turns of 4 to 8° as 2.5 to 5°, by 1.5 to 2.9
# deviations, and gained 0.0005.
_MOST_SLIDE_MM, _SURE_OF_SLIDE, _GAIN_OF_SLIDE = 0.6, 3.0, 0.0003
_MOST_TURN_DEG, _SURE_OF_TURN, _GAIN_OF_TURN = 2.0, 1.2, 0.0003
# Of a slide that explains more, less sureness is asked: one of 2 mm in a view that looks nearly along the guide was
# measured as 1.9 mm by 1.3 deviations, and gained 0.0008.
_FAR_SLIDE_MM, _SURE_OF_FAR_SLIDE, _GAIN_OF_FAR_SLIDE = 1.0, 1.0, 0.0006
# Of a bone in one view, beside the others. Where a leg had turned by 1.8° from view to view: 0.018, and where a neck
# had broken 0.0029 and more. Of 16 right ones of two simulators, with bad CTs, shutters and metal too: at most 0.0007,
# of nine of a third at most 0.0029.
_GAIN_OF_BONE_DRIFT = 0.004
# Of a bone that turns in its joint in one view. Where a leg had turned by 1.5, 2 and 2.5° in one view of another
# simulator: 1.3, 2.0 and 2.3°, by 4.7, 3.7 and 4.8 deviations, with gains of 0.0013, 0.0018 and 0.0036. Of 15 right
# ones of two simulators: up to 1.4°, but by 3 deviations at most (0.6°), with gains of 0.0009 at most.
_MOST_JOINT_TURN_DEG, _SURE_OF_JOINT_TURN, _GAIN_OF_JOINT_TURN = 0.8, 3.0, 0.0009
# What is less is asked of finer pixels. Legs of a third simulator that had turned by 0.9 to 1.3° after view 1 seemed
# turned by 0.7 to 1.2°, by 2.8 to 4.0 deviations; then by 0.7 to 1.1°, by 4.1 to 5.5 deviations with gains of 0.0004
# and more, or by 3.5 with a gain of 0.0010. Of 41 right ones of four simulators at most 0.9°, then 0.63° by 2.7
# deviations with a gain of 0.0003; by 3.5 deviations one that seemed turned by 0.48°, and no gain was above 0.0004.
_WORTH_FINER_DEG, _WORTH_FINER_SURE = 0.6, 2.2
_MOST_FINER_DEG = 0.68
_FINER = ((3.6, 0.0003), (3.0, 0.0007))  # deviations and gain: the surer, or what explains more
# Of whatever moved: so much no fault of the C-arm's file gains. Where a leg had turned, a neck had broken or a patient
# had moved 0.012 to 0.26, and the images asked for other principal points too; with sources, pixels, principal points
# or distortion told wrongly at most 0.0025.
_GAIN_OF_NO_CARM = 0.006


def doubts_about_motion(
    covariance: PoseCovariance,
    limits: Limits,
    apart: Mapping[str, float],
    alone: Callable[[MotionBetween], float],
    finer: Callable[[], Sequence[JointTurn]],
    *,
    given: bool = False,
) -> tuple[str, ...]:
    """Anatomy that lies elsewhere in images of another kind, or a device that moved between the views, in words.

    `apart` tells how far the views disagree where an object lies in their images, mm, by its name: that is
    `in_plane_uncertainty_mm` of its quality. `alone` tells what is gained where a device is fitted in one view by
    itself, see `evidence.fitted_alone`. `finer` tells by finer pixels how far bones are turned in their joints. Where
    the poses of the C-arm were `given`, these may be off as well.

    Where both explain the images, what explains them better. A single bone or device counts if it is sure by itself:
    the depth of a bone in one view is so open that it may gain more where a device has moved.
    """
    moved = [each for each in covariance.drifts if _has_drifted(each, apart, alone)]
    if anatomy_moved(covariance):
        moved.append(max(covariance.motions, key=lambda each: each.gain))
    if not moved:
        return doubts_about_joints(covariance, finer) or doubts_about_guides(covariance, limits)
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


def anatomy_moved(covariance: PoseCovariance) -> bool:
    """Whether bones lie elsewhere in the images with the device than in those without it."""
    return any(_has_moved(each) for each in covariance.motions)


def explains_the_carm(covariance: PoseCovariance) -> bool:
    """Whether something moved by so much that it is the likely cause of what the images say against the C-arm too."""
    bones = [each for each in covariance.drifts if each.kind is None]
    gains = [each.gain for each in (*covariance.motions, *bones)] + [each.gain for each in covariance.joint_turns]
    return max(gains, default=0.0) > _GAIN_OF_NO_CARM


def doubts_about_joints(covariance: PoseCovariance, finer: Callable[[], Sequence[JointTurn]]) -> tuple[str, ...]:
    """A leg that turned in its joint in one view, in words: what explains the images best."""
    moved = [each for each in covariance.joint_turns if _has_turned(each)]
    if not moved and any(_is_worth_finer(each) for each in covariance.joint_turns):
        moved = [each for each in finer() if _has_turned_by_finer(each)]
    if not moved:
        return ()
    found = max(moved, key=lambda each: each.gain)
    return (
        f"in view {found.view + 1}, the {found.name} is turned by {found.degrees:.1f}° in its joint from where the "
        "other views show it: the leg has turned between the views; hold it still and take them again",
    )


def doubts_about_guides(covariance: PoseCovariance, limits: Limits) -> tuple[str, ...]:
    """A tool that slid along its guide or turned about it in one view, in words: what explains the images best.

    A turn is passed over where the images leave the tool's rotation open by more than is trusted: its quality says so.
    """

    def may_mean_something(found: GuideDrift) -> bool:
        return not found.turns or largest(covariance.by_images(found.name)[0]) <= limits.most_deviation_deg

    moved = [each for each in covariance.guide_drifts if _has_drifted_along(each) and may_mean_something(each)]
    if not moved:
        return ()
    found = max(moved, key=lambda each: each.gain)
    how = "is turned by {:.0f}° about its guide" if found.turns else "lies {:.1f} mm along its guide"
    return (
        f"in the {found.kind} image of view {found.view + 1}, the {found.name} {how.format(abs(found.amount))} from "
        "where the other views show it: it has moved between the views; hold it still and take them again",
    )


def _has_moved(found: MotionBetween) -> bool:
    sure = _SURE_IN_ALL if len(found.views) > 1 else _SURE_OF_MOTION
    far = found.size[0] > _MOST_MOTION_DEG or found.size[1] > _MOST_MOTION_MM
    return far and found.sureness > sure and found.gain > _GAIN_OF_MOTION


def _has_drifted(found: MotionBetween, apart: Mapping[str, float], alone: Callable[[MotionBetween], float]) -> bool:
    if found.kind is None:
        return found.gain > _GAIN_OF_BONE_DRIFT
    if found.gain > _GAIN_OF_APART and apart.get(found.objects[0], 0.0) > _APART_MM:
        return True
    if found.gain <= _WORTH_FITTING:
        return False
    return alone(found) > _SHARE_OF_DRIFT


def _has_turned(found: JointTurn) -> bool:
    told = found.degrees > _MOST_JOINT_TURN_DEG and found.sureness > _SURE_OF_JOINT_TURN
    return told and found.gain > _GAIN_OF_JOINT_TURN


def _is_worth_finer(found: JointTurn) -> bool:
    return found.degrees > _WORTH_FINER_DEG and found.sureness > _WORTH_FINER_SURE


def _has_turned_by_finer(found: JointTurn) -> bool:
    told = any(found.sureness > sure and found.gain > gain for sure, gain in _FINER)
    return told and found.degrees > _MOST_FINER_DEG


def _has_drifted_along(found: GuideDrift) -> bool:
    if found.turns:
        limits = [(_MOST_TURN_DEG, _SURE_OF_TURN, _GAIN_OF_TURN)]
    else:
        limits = [
            (_MOST_SLIDE_MM, _SURE_OF_SLIDE, _GAIN_OF_SLIDE),
            (_FAR_SLIDE_MM, _SURE_OF_FAR_SLIDE, _GAIN_OF_FAR_SLIDE),
        ]
    return any(abs(found.amount) > most and found.sureness > sure and found.gain > gain for most, sure, gain in limits)
