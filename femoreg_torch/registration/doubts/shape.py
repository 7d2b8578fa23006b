"""Objects that are mirrored, bent or broken against their models, in words."""

from dataclasses import replace

from femoreg_torch.cores import on_all_cores
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.costs import ImageCosts
from femoreg_torch.registration.evidence.handedness import Handedness, handedness
from femoreg_torch.registration.evidence.rigidity import CUTS, Bend, Turns, bend, gain_as_one, images_of
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.scene import Scene

# Of the mean patch Grad-NCC. Seen on simulated procedures: mirror images fit worse by 0.01 to 0.06; where the CT was
# mirrored, better by 0.04.
_BETTER_MIRRORED = 0.005
# Of the ends of a bone, whose CT and label map err, were it cut: on average over the end that moves less. Seen of 47
# right procedures, with shutters, dark images and parts of the table too: at most 1.05 mm; of four broken femora 1.1 to
# 11 mm.
_MOST_APART_OF_BONE_MM, _SURE_OF_BEND = 1.5, 4.0
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
# apart where that gained anything; of one more simulator one 0.7 mm, by 6.2 deviations. A wire that was bowed by 4 mm
# was 0.6 and 1.1 mm apart, by 8.9 and 5.5 deviations, and gained 0.0003. One pair of mm and deviations is asked.
_BEND_OF_KNOWN = (0.75, 5.0), (0.5, 7.5)
# Of a model whose materials are estimated: less is believed, and an end's turn that no image tells is left out at once.
# On images of four other simulators 20 right devices gained at most 0.0005, and the ends of some seemed 1 to 5 mm
# apart, by 6.6 deviations at most; one whose hub hardly any view told gained 0.0025, by 6.2. Bent and kinked ones were
# 0.8 to 2.8 mm apart and gained 0.0007 to 0.005, by 8.5 to 18.
_MOST_APART_OF_UNKNOWN_MM, _GAIN_OF_A_BENT_MODEL, _SURE_OF_A_BENT_MODEL = 0.75, 0.0005, 7.0
# A drill and a needle that leaned in their holders by 3.2 to 4.2°, on images of another one, were 0.4 to 0.7 mm apart,
# gained 0.004 to 0.009, by 12 to 17 deviations; leaning by 2°, 0.002, by 7. Right devices there gained at most 0.0007,
# and those of more than 4 deviations 0.0003; but for one whose source distance was told wrong: 0.0044, by 10, of which
# its ends gained 7 %.
_LEANING = 0.4, 0.003, 9.0  # mm apart, gain, deviations
# Of that gain, what is by the ends, and not by the model moved as one: coarse images that draw a wrong material may ask
# for another pose of the whole. Of two right devices it was 2 % of 0.033 and 0.038, that is 0.0008; of three bent ones
# 27 % and more, 0.0005 to 0.0007. One of these shares or gains is asked.
_LEAST_SHARE_OF_ENDS, _GAIN_OF_ENDS = 0.1, 0.001


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
    is_model = bool(thing.parts)

    def apart(turns: Turns) -> Bend | None:
        return bend(scene, poses, name, share, images, turns)

    if is_model and not thing.materials_known:
        freely = apart("all")
        if freely is None or freely.gain <= _GAIN_OF_A_BENT_MODEL:
            return None
        found = apart("told")
        if found is None or not _is_surely_bent(found):
            return None
        by_ends = found.gain - gain_as_one(scene, poses, name, share, images)
        return found if by_ends > min(_LEAST_SHARE_OF_ENDS * found.gain, _GAIN_OF_ENDS) else None

    def bent(found: Bend | None) -> Bend | None:
        return found if found is not None and _is_bent(found, is_model) else None

    found = bent(apart("all")) and bent(apart("told"))
    if found is None or is_model or found.gain > _GAIN_OF_A_TURNED_END:
        return found
    return found if bent(apart("none")) else None


def _is_surely_bent(found: Bend) -> bool:
    """Of a model whose materials are estimated: its ends lie far apart, or less so where that explains very much."""

    def bent(apart_mm: float, gain: float, surely: float) -> bool:
        apart = found.apart_mm > max(apart_mm, found.apart_deviation_mm)
        return apart and found.gain > gain and found.sureness > surely

    return bent(_MOST_APART_OF_UNKNOWN_MM, _GAIN_OF_A_BENT_MODEL, _SURE_OF_A_BENT_MODEL) or bent(*_LEANING)


def _is_bent(found: Bend, is_model: bool) -> bool:
    """Of a bone, or of a model whose materials are known."""
    limits = _BEND_OF_KNOWN if is_model else ((_MOST_APART_OF_BONE_MM, _SURE_OF_BEND),)
    deviations = 1.0 if is_model else _SURE_OF_BREAK
    surely = any(found.apart_mm > most and found.sureness > sure for most, sure in limits)
    apart = surely and found.apart_mm > deviations * found.apart_deviation_mm
    broken = not is_model and found.gain > _GAIN_OF_BREAK and found.apart_mm > _APART_OF_BREAK_MM
    return broken or (apart and found.gain > _LEAST_GAIN_OF_BEND)
