"""All that speaks against a result besides the quality of its objects, asked in one go."""

from collections.abc import Callable
from itertools import chain

from femoreg_torch.case import Case
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
from femoreg_torch.registration.doubts.images import doubts_about_smears, doubts_about_the_images
from femoreg_torch.registration.doubts.movement import doubts_about_motion, explains_the_carm
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
    case: Case, told: Scene, scene: Scene, poses: Poses, covariance: PoseCovariance, imaging: Imaging, limits: Limits
) -> tuple[str, ...]:
    """All that speaks against a result besides the quality of its objects, in words.

    `told` is the scene as the case tells it, `scene` the one with what was estimated of the images. Where an image does
    not fit at all, nothing else that the images would say is asked.
    """
    displays = [case.display_of(view) for view in range(len(case.views))]
    if strange := doubts_about_the_images(scene, misfits(scene, poses, imaging)):
        plan = *doubts_about_the_plan(case, scene), *doubts_about_the_guide(case, poses)
        return (*told.contradictions, *doubts_about_units(case, told, True), *strange, *plan)
    clear = scene.where_unsaturated()
    given = scene.camera_from_camera1 is not None
    geometry: list[Callable[[], tuple[str, ...]]] = [
        lambda: doubts_about_the_carm(
            scene,
            poses,
            covariance,
            limits,
            displays,
            lambda shift: gain_of_shifted_points(scene, poses, shift, imaging),
        ),
        lambda: doubts_about_the_views(scene, poses),
        lambda: doubts_about_motion(
            covariance,
            limits,
            lambda drift: gain_alone(scene, poses, drift, imaging),
            lambda: finer_joint_turns(scene, poses, imaging),
            given=given,
        ),
    ]
    questions: list[Callable[[], tuple[str, ...]]] = [
        # What is shown of such a CT, or in such pictures, seems to have moved or bent as well.
        lambda: doubts_about_the_ct(case, clear, poses, imaging) or doubts_about_bends(case, clear, poses, imaging),
        *(geometry[::-1] if explains_the_carm(covariance) else geometry),
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
