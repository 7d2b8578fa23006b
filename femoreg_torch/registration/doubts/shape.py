"""Objects that are mirrored, bent or broken against their models, in words."""

from dataclasses import replace

from femoreg_torch.cores import on_all_cores
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.evidence.handedness import Handedness, handedness
from femoreg_torch.registration.evidence.rigidity import CUTS, Bend, Turns, bend, images_of
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.objective import ImageCosts
from femoreg_torch.registration.scene import Scene

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
# Of a model whose materials are estimated: less is believed. On images of three other simulators six right devices
# seemed 1.1 to 5.4 mm apart, by 4.5 to 6.2 deviations and gains of 0.0003 to 0.0025; five bent ones gained 0.0014 to
# 0.005, by 8.5 to 18.
_GAIN_OF_A_BENT_MODEL, _SURE_OF_A_BENT_MODEL = 0.0005, 7.0


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
    told = sure_of_materials or (found.gain > _GAIN_OF_A_BENT_MODEL and found.sureness > _SURE_OF_A_BENT_MODEL)
    surely = found.sureness > (_SURE_OF_A_KNOWN_BEND if materials_known else _SURE_OF_BEND)
    return broken or (apart and told and surely and found.gain > _LEAST_GAIN_OF_BEND)
