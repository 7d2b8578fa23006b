"""Pictures that are bent, in words."""

from femoreg_torch.case import Case
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.doubts.ct import bones_of_the_ct
from femoreg_torch.registration.evidence.bent_pictures import Bend, bent_pictures
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.scene import Scene

# By how much less the bones cost in straightened pictures, and the deviations by which an amount of that way is known.
# Of 70 procedures of three simulators with straight pictures, and 80 with other faults, none gained more than 0.008 by
# a twist or by halves put together otherwise, but for a CT that was mirrored, 0.016. Twists of 2 and 5 mm at the rim
# gained 0.030 and 0.073, halves that lay 1.9 mm apart 0.037. Towards the rim pictures gain as well where they shrink:
# straight ones up to 0.024, but by 2.3 deviations at most, or with a gain of 0.001 by 3.7; with a pincushion of 3.5 mm
# 0.051, by 4.1, and with one of 6 mm in one view 0.008, by 8.6. A barrel gained nothing, and is not told.
_GAIN, _SURE = 0.02, 3.0
_GAIN_AT_RIM, _SURE_AT_RIM = 0.005, 3.5
_MOST_MM = 10.0  # no detector bends pictures by more; in those of a CT that was mirrored rims seemed 12 mm off


def doubts_about_bends(case: Case, scene: Scene, poses: Poses, imaging: Imaging) -> tuple[str, ...]:
    """The way in which the pictures seem to be bent, in words: of those that are sure, the one that explains most."""
    names = bones_of_the_ct(case, scene, poses)
    if not names:
        return ()
    found = [bend for bend in bent_pictures(scene, poses, names, imaging) if _is_sure(bend)]
    if not found:
        return ()
    best = max(found, key=lambda bend: bend.gain)
    return (f"{_told(best)} (straightened so, they fit {100 * best.gain:.0f} % better): {_ADVICE[best.way.name]}",)


_ADVICE = {
    "rim": "is the pincushion distortion of an image intensifier left in them? Give each view a picture of its grid "
    "(`grid` of the views)",
    "twist": "is the S-distortion of an image intensifier left in them? Give each view a picture of its grid (`grid` "
    "of the views)",
    "columns": "are halves of the detector put together wrongly, or did the patient move while the CT was taken?",
    "rows": "are halves of the detector put together wrongly, or did the patient move while the CT was taken?",
}


def _is_sure(bend: Bend) -> bool:
    gain, sure = (_GAIN_AT_RIM, _SURE_AT_RIM) if bend.way.name == "rim" else (_GAIN, _SURE)
    values = [
        each.value if bend.way.name == "rim" else abs(each.value) for each in bend.amounts
    ]  # a barrel is not told
    sure_ones = [value for value, each in zip(values, bend.amounts, strict=True) if each.sureness > sure]
    within = max(map(abs, values)) < _MOST_MM
    return bend.gain > gain and within and max(sure_ones, default=0.0) > bend.way.least_mm


def _told(bend: Bend) -> str:
    if bend.way.name in ("columns", "rows"):
        which = "left and the right" if bend.way.name == "columns" else "upper and the lower"
        across, down = (abs(each.value) for each in bend.amounts)
        return (
            f"the {which} half of the pictures, set upright, seem to lie {across:.1f} mm aside and {down:.1f} mm up or "
            "down against each other"
        )
    how = "stretched towards" if bend.way.name == "rim" else "twisted at"
    views = [view + 1 for fields in bend.way.fields for view in fields]
    amounts = (f"{each.value:.1f} mm in view {view}" for view, each in zip(views, bend.amounts, strict=True))
    return f"the pictures seem to be {how} their rim, by {' and '.join(amounts)}"
