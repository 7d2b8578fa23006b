"""Pictures that are bent, in words."""

from collections.abc import Mapping

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
# 0.051, by 4.1, and with one of 6 mm in one view 0.008, by 8.6. Of two barrels one gained nothing, and one of 3 to 4
# mm, of another simulator, 0.10.
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
    "rim": "is the pincushion of an image intensifier left in them, or a barrel where they are drawn in? "
    "Give each view a picture of its grid (`grid` of the views)",
    "twist": "is the S-distortion of an image intensifier left in them? Give each view a picture of its grid (`grid` "
    "of the views)",
    "columns": "are halves of the detector put together wrongly, or did the patient move while the CT was taken?",
    "rows": "are halves of the detector put together wrongly, or did the patient move while the CT was taken?",
}


def _is_sure(bend: Bend) -> bool:
    gain, sure = (_GAIN_AT_RIM, _SURE_AT_RIM) if bend.way.name == "rim" else (_GAIN, _SURE)
    sizes = [abs(each.value) for each in bend.amounts]
    sure_ones = [size for size, each in zip(sizes, bend.amounts, strict=True) if each.sureness > sure]
    return bend.gain > gain and max(sizes) < _MOST_MM and max(sure_ones, default=0.0) > bend.way.least_mm


def _told(bend: Bend) -> str:
    if bend.way.name in ("columns", "rows"):
        which = "left and the right" if bend.way.name == "columns" else "upper and the lower"
        across, down = (abs(each.value) for each in bend.amounts)
        return (
            f"the {which} half of the pictures, set upright, seem to lie {across:.1f} mm aside and {down:.1f} mm up or "
            "down against each other"
        )
    views = [view + 1 for fields in bend.way.fields for view in fields]
    amounts = {view: each.value for view, each in zip(views, bend.amounts, strict=True)}
    if bend.way.name == "twist":
        return f"the pictures seem to be twisted at their rim, {_by(amounts)}"
    told, least = [], bend.way.least_mm
    if outward := {view: mm for view, mm in amounts.items() if mm > least}:
        told.append(f"stretched towards their rim, {_by(outward)}")
    if inward := {view: -mm for view, mm in amounts.items() if mm < -least}:
        told.append(f"drawn in at their rim, {_by(inward)}")
    return f"the pictures seem to be {', and '.join(told)}"


def _by(amounts: Mapping[int, float]) -> str:
    return "by " + " and ".join(f"{mm:.1f} mm in view {view}" for view, mm in amounts.items())
