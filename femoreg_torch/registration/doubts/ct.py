"""A CT that has not the shape of the patient, in words."""

import math

from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.evidence.ct_shape import ct_shape
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.scene import Scene

# As a second look measured them, on 70 procedures of three simulators. Slices told 1 to 3 % too near or too far, and
# pixels 1 to 2.5 % too wide or high: stretches of 0.9 to 2.7 % by 4.1 deviations and more; of right CTs one seemed
# stretched by 2.5 %, by 2.2 deviations. Gantries tilted by 1.5 and 4°, slides of 2 and 4 mm, and two spacings of slices
# told as one: shears of 1.2 to 6.6 %, by 3 deviations and more, with gains of 0.006 and more; right CTs up to 1.9 % by
# 5.3 deviations, in views that hardly tell, with gains of 0.002 at most; of 60 more one by 1.6 %, 5 deviations and a
# gain of 0.0048.
# A stretch may gain nothing, as it changes how finely a CT is looked at: down to -0.015; of bones far off, -0.034.
_MOST_STRETCHED, _SURE_OF_STRETCH, _GAIN_OF_STRETCH = 0.008, 3.5, -0.02
_MOST_SHEARED, _SURE_OF_SHEAR, _GAIN_OF_SHEAR = 0.012, 2.5, 0.0054


def doubts_about_the_ct(case: Case, scene: Scene, poses: Poses, imaging: Imaging) -> tuple[str, ...]:
    """How the images would stretch and shear the bones of the CT, in words, where that is much and sure."""
    names = bones_of_the_ct(case, scene, poses)
    if not names:
        return ()
    told = []
    rows, columns, _ = scene.objects[scene.anchor].volume.lps_from_index[:3, :3].T
    for found in ct_shape(scene, poses, names, imaging):
        amount = found.amount
        stretched = abs(amount.value) > _MOST_STRETCHED and amount.sureness > _SURE_OF_STRETCH
        if found.way == "stretch" and stretched and found.gain > _GAIN_OF_STRETCH:
            longer = "longer" if amount.value > 0 else "shorter"
            told.append(
                f"the images show the bones {100 * abs(amount.value):.1f} % {longer} across the slices than the CT has "
                f"them (± {100 * amount.deviation:.1f} %): check the slices' distance and the pixel size in the CT's "
                "header, and whether the pictures' pixels are as wide and as high as the C-arm's file says"
            )
        sheared = abs(amount.value) > _MOST_SHEARED and amount.sureness > _SURE_OF_SHEAR
        if found.way != "stretch" and sheared and found.gain > _GAIN_OF_SHEAR:
            way = columns if found.way == "tilt" else rows
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


def _along(way: Tensor) -> str:
    """The patient's axis that a direction (3,) in LPS is nearest to, in words."""
    return ("from side to side", "from front to back", "from head to foot")[int(way.abs().argmax())]


def _degrees(shear: float) -> float:
    return math.degrees(math.atan(abs(shear)))
