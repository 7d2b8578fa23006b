"""The start by what the landmark network sees in view 1."""

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, StartRecord
from femoreg_torch.detect import Detection
from femoreg_torch.errors import InputError
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.start.find import Detector, Start, find_start
from femoreg_torch.registration.start.no_start import why_there_is_no_start
from femoreg_torch.registration.start.records import record_from_view_1


def start_by_detection(case: Case, scene: Scene, detection: Detection, find: Detector | None = None) -> StartRecord:
    """The pose (4, 4) of the scene's anchor from what the network sees in view 1, and how it came.

    Raises `InputError` as `find_start` does, with the image's name, and how the image would have to be turned, or which
    view to put first, if `find` then sees landmarks that agree.
    """
    try:
        return record_from_view_1(case, scene, detection, start_in_view_1(case, scene, detection))
    except InputError as error:
        raise why_there_is_no_start(case, scene, error, find) from error


def start_in_view_1(case: Case, scene: Scene, detection: Detection) -> Start:
    """The start by what the network sees in view 1. Raises `InputError` as `find_start` does."""
    return find_start(
        case.landmarks,
        detection,
        scene.image(scene.first_kind, 0),
        case.carm.camera,
        scene.outline,
        case.anatomy or HIP,
        scene.field(scene.first_kind, 0),
        case.display_of(0).beam,
        among_views=scene.views > 1,
    )
