"""All that speaks against a result besides the quality of its objects, asked in one go."""

from collections.abc import Callable, Mapping
from itertools import chain

from femoreg_torch.case import Case, ObjectQuality
from femoreg_torch.cores import on_all_cores
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.doubts.bends import doubts_about_bends
from femoreg_torch.registration.doubts.carm import doubts_about_the_carm, doubts_about_the_views
from femoreg_torch.registration.doubts.ct import doubts_about_the_ct
from femoreg_torch.registration.doubts.device import (
    doubts_about_size,
    doubts_about_the_models,
    doubts_about_told_tips,
    doubts_about_units,
    doubts_beside_devices,
)
from femoreg_torch.registration.doubts.images import (
    doubts_about_exchanged_kinds,
    doubts_about_smears,
    doubts_about_the_images,
)
from femoreg_torch.registration.doubts.movement import anatomy_moved, doubts_about_motion, explains_the_carm
from femoreg_torch.registration.doubts.plan import doubts_about_the_guide, doubts_about_the_plan
from femoreg_torch.registration.doubts.shape import doubts_about_handedness, doubts_about_rigidity
from femoreg_torch.registration.evidence.covariance import PoseCovariance
from femoreg_torch.registration.evidence.fitted_alone import gain_alone
from femoreg_torch.registration.evidence.misfits import misfits
from femoreg_torch.registration.evidence.shifted_points import gain_of_shifted_points
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.quality import Limits, finer_joint_turns
from femoreg_torch.registration.scene import Scene


def doubts(
    case: Case,
    told: Scene,
    scene: Scene,
    poses: Poses,
    quality: Mapping[str, ObjectQuality],
    covariance: PoseCovariance,
    imaging: Imaging,
    limits: Limits,
) -> tuple[str, ...]:
    """All that speaks against a result besides the quality of its objects, in words.

    `told` is the scene as the case tells it, `scene` the one with what was estimated of the images. Where an image does
    not fit at all, nothing else that the images would say is asked.
    """
    displays = [case.display_of(view) for view in range(len(case.views))]
    contradictions = *told.contradictions, *doubts_about_exchanged_kinds(told)
    if strange := doubts_about_the_images(scene, misfits(scene, poses, imaging)):
        plan = *doubts_about_the_plan(case, scene), *doubts_about_the_guide(case, poses)
        return (*contradictions, *doubts_about_units(case, told, True), *strange, *plan)
    clear = scene.where_unsaturated()
    given = scene.camera_from_camera1 is not None
    # The longest are asked first, so that no core waits long for another at the end.
    asked: dict[str, Callable[[], tuple[str, ...]]] = {
        "rigidity": lambda: doubts_about_rigidity(clear, poses, imaging),
        "handedness": lambda: doubts_about_handedness(told, scene, poses, imaging),
        "size": lambda: doubts_about_size(case, told, clear, poses, imaging),
        "smears": lambda: doubts_about_smears(clear, poses),
        "told tips": lambda: doubts_about_told_tips(case, told),
        "models": lambda: doubts_about_the_models(told, scene, poses),
        "guide": lambda: doubts_about_the_guide(case, poses),
        "plan": lambda: doubts_about_the_plan(case, scene),
        "motion": lambda: doubts_about_motion(
            covariance,
            limits,
            {name: each.in_plane_uncertainty_mm for name, each in quality.items()},
            lambda drift: gain_alone(scene, poses, drift, imaging),
            lambda: finer_joint_turns(scene, poses, imaging),
            given=given,
        ),
        "views": lambda: doubts_about_the_views(scene, poses),
        "C-arm": lambda: doubts_about_the_carm(
            scene,
            poses,
            covariance,
            limits,
            displays,
            lambda shift: gain_of_shifted_points(scene, poses, shift, imaging),
        ),
        "CT": lambda: (
            doubts_about_the_ct(case, clear, poses, imaging) or doubts_about_bends(case, clear, poses, imaging)
        ),
    }
    answers = dict(zip(asked, on_all_cores(lambda ask: ask(), list(asked.values()), scene.device), strict=True))
    found = tuple(chain.from_iterable(answers[name] for name in _likeliest_first(covariance)))
    found = (*doubts_about_units(case, told, bool(found)), *found)
    return (*contradictions, *found, *doubts_beside_devices(clear, poses, imaging, bool(found)))


def _likeliest_first(covariance: PoseCovariance) -> tuple[str, ...]:
    """The questions of `doubts`, those first whose answers are likely the cause of what others find.

    Bones of a CT of another shape, or in bent pictures, seem to have moved or bent as well. Anatomy that moved between
    the images seems bent, too. But where only one view seems to show something elsewhere, it is the model in nine of
    ten cases of three other simulators that was bent, broken, or of another size; in the tenth the device had moved.
    What was smeared seems to be of another size.
    """
    models = "smears", "size", "rigidity"
    moved = ("motion", *models) if anatomy_moved(covariance) else (*models, "motion")
    carm = "C-arm", "views"
    geometry = (*moved, *carm[::-1]) if explains_the_carm(covariance) else (*carm, *moved)
    return ("CT", *geometry, "plan", "guide", "models", "told tips", "handedness")
