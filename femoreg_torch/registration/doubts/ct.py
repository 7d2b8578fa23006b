"""A CT that has not the shape of the patient, in words."""

import math

from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.evidence.bones import Amount
from femoreg_torch.registration.evidence.ct_shape import ct_shape
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.scene import Scene

# Right CTs seemed stretched by 0.3 % and sheared by 1.0 % at most, in 19 procedures and 21 faults of other kinds of
# another simulator, but for small fields and dark views, by 1.4 deviations at most. Of the same: slices told 1 and 2 %
# too near or too far, and pixels 1 % too wide or high, by 1.0 to 2.0 %; gantries tilted by 1.5 and 4°, 1.3 and 3.8°, by
# 2.6 deviations. The deviation holds the misfit itself, so that more of it is no surer.
_MOST_STRETCHED, _MOST_SHEARED = 0.008, 0.012
_SURE = 2.0  # deviations


def doubts_about_the_ct(case: Case, scene: Scene, poses: Poses, imaging: Imaging) -> tuple[str, ...]:
    """How the images would stretch and shear the bones of the CT, in words, where that is much and sure."""
    names = bones_of_the_ct(case, scene, poses)
    if not names:
        return ()
    found = ct_shape(scene, poses, names, imaging)
    if found is None:
        return ()
    told = []
    if _is_sure(found.stretch, _MOST_STRETCHED):
        longer = "longer" if found.stretch.value > 0 else "shorter"
        percent, deviation = 100 * abs(found.stretch.value), 100 * found.stretch.deviation
        told.append(
            f"the images show the bones {percent:.1f} % {longer} across the slices than the CT has them (± "
            f"{deviation:.1f} %): check the slices' distance and the pixel size in the CT's header, and whether the "
            "pictures' pixels are as wide and as high as the C-arm's file says"
        )
    rows, columns, _ = scene.objects[scene.anchor].volume.lps_from_index[:3, :3].T
    for way, amount in ((columns, found.tilt), (rows, found.slide)):
        if _is_sure(amount, _MOST_SHEARED):
            told.append(
                f"the images show the bones sheared by {_degrees(amount.value):.1f}° {_along(way)} against the CT (± "
                f"{_degrees(amount.deviation):.1f}°): was the CT's gantry tilted, without its program knowing, or did "
                "the patient slide while it was taken?"
            )
    return tuple(told)


def bones_of_the_ct(case: Case, scene: Scene, poses: Poses) -> list[str]:
    """The objects that were cut from the CT and have a pose; none where the anchor is not among them."""
    names = [name for name, thing in case.objects.items() if thing.model is None and name in poses.camera1_from]
    return names if scene.anchor in names else []


def _is_sure(amount: Amount, most: float) -> bool:
    return abs(amount.value) > most and amount.sureness > _SURE


def _along(way: Tensor) -> str:
    """The patient's axis that a direction (3,) in LPS is nearest to, in words."""
    return ("from side to side", "from front to back", "from head to foot")[int(way.abs().argmax())]


def _degrees(shear: float) -> float:
    return math.degrees(math.atan(abs(shear)))
