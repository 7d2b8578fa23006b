"""What speaks against a device's model, in words: its unit, its size, its tip, parts without a shadow, and rivals."""

from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import avg_pool2d

from femoreg_torch.case import Case
from femoreg_torch.drr import project
from femoreg_torch.errors import in_mm
from femoreg_torch.geometry import Poses, transform_points
from femoreg_torch.registration.evidence.besides import besides, change_about, rival
from femoreg_torch.registration.evidence.sizes import FURTHEST, Size, device_size
from femoreg_torch.registration.evidence.tips import TipLength, tip_length
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.materials.calibration import devices
from femoreg_torch.registration.prepare.models import BEYOND_MM, GUIDE_MM, model_end, told_of_end, told_of_leaning
from femoreg_torch.registration.scene import Kind, RigidObject, Scene, in_view
from femoreg_torch.volume import guide_end

_CASTS_NO_SHADOW = 0.004  # 1/mm: a fifth of water
_MOST_WITHOUT_SHADOW = 0.08  # share of a model's volume
# Shadow, the logarithm of how much less light there is with a device, below which an image shows none: what so little
# would cast, but at most this, as blocks of steel that leave scattered light alone cast one shadow whatever is in them.
# And over how much of the detector it is averaged: in dark images noise is as strong as the shadow of a thin handle.
_NO_SHADOW, _AVERAGED_MM = 0.15, 3.0
_STEP_MM = 1.0
_ENCLOSED_MM = 2.5  # half of the width of a gap that counts as within: a drill in its sleeve
# Another place of a device, of the similarity that it adds where it was found, without its best view: of wires beside
# another one 0.44 and 0.48; of six right ones, on saturated images too, at most 0.31, mostly less than nothing.
_AS_GOOD_ELSEWHERE = 0.37
# Of a guide's line beside the end of its model, and off the middle of that end: the slanted end of a thick needle lies
# 1.6 mm to one side. Of 30 right devices none passed beside it, and none more than 0.1 mm off the middle.
_MOST_ASIDE_MM, _MOST_OFF_MIDDLE_MM = 0.5, 2.0
_FAR_MM = 2.5  # lengths that a tip is looked for end at 4 mm: tips 8 and 12 mm off were found 2.8 to 3.5 mm off
# Of a tip beside that of its model, mm, and what a model of that length gains of the similarity near the tip.
# Seen of 38 right devices of two foreign simulators: at most 0.54 mm and 0.002. Of nine tips 2 to 4 mm off, eight were
# told: five by 1.1 to 3.3 mm and 0.016 to 0.22, and three, whose end the estimate had emptied, by the model as told
# alone, which was 0.8 to 1.5 mm too long. As told, right ones were at most 0.4 mm too long, but 1.9 mm too short. Of
# three right ones of another simulator, in dark and noisy images, 0.8 to 1.3 mm and 0.016, and in a view of one of them
# that length fitted worse by as much. Of six tips that were off there and in one more, 1.1 mm and 0.08 at least, in no
# view worse.
_OFF_TIP = ((0.8, 0.03), (1.0, 0.01))  # either suffices
_CONTRADICTED = 0.5  # of what all views gain together, what one of them loses
# Seen of the same 38: at most 0.9 %, with no gain. Of five models 2 and 3 % off: 1.9 to 3.2 %, and 0.0007 to 0.002. Of
# right devices before saturated air, of two more simulators: 1.6 and 1.9 %, and 0.0003 and 0.0007; of a thin needle,
# whose size nothing tells, 4 % and 0.0005. A step of Newton has the first 0.9 % off, by 1.4 deviations, and the needle
# 0.4 %, by 2.5; 15 models that were told 2 % too small or too large, of three simulators, 1.1 to 2.3 % off, by 2.2 to
# 5.0 deviations, but for one needle's (0.5 %).
_MOST_OFF_SIZE, _LEAST_GAIN_OF_SIZE, _SURE_OF_SIZE = 0.01, 0.0004, 2.0


def doubts_about_units(case: Case, told: Scene, in_doubt: bool) -> tuple[str, ...]:
    """Models that are likely told in another unit than mm, or points of them that are, in words.

    A drill may stand far out of a sleeve whose model lacks it, so points outside a model are told if there is another
    doubt.
    """
    found = []
    for name, thing in case.objects.items():
        if thing.model is None or name not in told.objects:
            continue
        points, volume = thing.points, told.objects[name].volume
        far = [point for point, place in points.items() if in_doubt and volume.beyond_mm(place) > BEYOND_MM]
        length = float((points["tip"] - points["base"]).norm()) if {"base", "tip"} <= set(points) else GUIDE_MM[0]
        if far or not GUIDE_MM[0] <= length <= GUIDE_MM[1]:
            what = f"its point {far[0]} lies far outside its model" if far else f"its guide is {in_mm(length)} long"
            found.append(f"the {name}: {what}: are model and points in mm? (Inches are 25.4 of them.)")
    return tuple(found)


def doubts_about_told_tips(case: Case, told: Scene) -> tuple[str, ...]:
    """Tips that lie before or beyond the end of their model, as they were told, and guides beside it, in words."""
    found: list[str] = []
    for name, thing in case.objects.items():
        if thing.model is None or name not in told.objects or not {"base", "tip"} <= set(thing.points):
            continue
        found += told_of_end(name, told.objects[name].volume, thing.points)
        found += told_of_leaning(name, told.objects[name].volume, thing.points)
        end = guide_end(told.objects[name].volume, thing.points["base"], model_end(thing.points))
        if end is not None and (end.aside_mm > _MOST_ASIDE_MM or end.off_middle_mm > _MOST_OFF_MIDDLE_MM):
            found.append(
                f"the {name}: the line from its base to its tip passes {end.off_middle_mm:.1f} mm beside the middle of "
                "its model's end: check these points and the origin of the model"
            )
    return tuple(found)


def doubts_about_the_models(told: Scene, scene: Scene, poses: Poses) -> tuple[str, ...]:
    """Models of which a part was found to attenuate next to nothing, in words.

    What lies within other parts, as a drill in its sleeve, does not count: the images tell the two together, and how
    the shadow is shared out among them is open. Nor does what no image shows, as the end of a handle, or
    shows before what is saturated: whatever is estimated of it is chance.
    """
    found = []
    for name, thing in scene.objects.items():
        inside = _casting(told.objects[name])
        if not inside.any():
            continue
        empty = inside & (thing.volume.data < _CASTS_NO_SHADOW)
        share = float(empty.sum() / inside.sum())
        if share > _MOST_WITHOUT_SHADOW:
            width = 2 * round(_ENCLOSED_MM / min(thing.volume.spacing_mm)) + 1
            empty &= ~_within_others(thing.volume.data >= _CASTS_NO_SHADOW, width)
            where = empty.nonzero()
            points = transform_points(thing.volume.lps_from_index, where.flip(1).double().cpu())
            bright = _where_no_shadow_is(scene.where_unsaturated(), poses, name, inside)
            empty[where.unbind(1)] = in_view(bright, poses, name, points).to(empty.device)
            share = float(empty.sum() / inside.sum())
        if share > _MOST_WITHOUT_SHADOW:
            found.append(
                f"{100 * share:.0f} % of the {name}'s volume casts no shadow: check that its model is the one in the "
                "images, and not mirrored, and that its nominal pose is not far off (see the preset fast_wide_device)"
            )
    return tuple(found)


def _casting(told: RigidObject) -> Tensor:
    """Voxels (Z, Y, X), bool, of an object that casts a shadow by what the case tells of it, part by part."""
    parts = told.parts or (told.volume,)
    return torch.stack([part.data > max(0.5 * float(part.data.max()), _CASTS_NO_SHADOW) for part in parts]).any(0)


def _where_no_shadow_is(scene: Scene, poses: Poses, name: str, inside: Tensor) -> Scene:
    """The same with only those pixels exposed that have as much light as in the image without the device.

    `inside` (Z, Y, X), bool, is what its model fills. The two images may differ in exposure, and those that were
    equalised for display are brighter all about a dark device. Both are taken off.
    """
    radius = int(_AVERAGED_MM / scene.carm.camera.mean_pixel_mm / 2)
    filled = replace(scene.objects[name].volume, data=inside.to(scene.objects[name].volume.data))

    def averaged(image: Tensor) -> Tensor:
        return avg_pool2d(image[None], 2 * radius + 1, 1, radius, count_include_pad=False)[0]

    def left(kind: Kind, view: int) -> Tensor | None:
        exposed, first = scene.field(kind, view), scene.first_kind
        if kind == first or not (scene.there([first], [view]) and scene.there([kind], [view])):
            return exposed
        placed = poses.camera_from(name)[view][None, None]
        path_mm = project([filled], placed, poses.camera(view, scene.carm.camera), _STEP_MM)[0]
        shadow = scene.image(kind, view) - scene.image(first, view)
        shadow = shadow - change_about(scene, poses, name, kind, view)
        own = (path_mm > 0).to(shadow)
        shadow = averaged(shadow * own) / averaged(own).clamp_min(1e-6)  # not of what lies beside it
        bright = shadow < (_CASTS_NO_SHADOW * path_mm).clamp_max(_NO_SHADOW)
        return bright if exposed is None else exposed & bright

    return replace(scene, fields={kind: tuple(left(kind, v) for v in range(scene.views)) for kind in scene.images})


def _within_others(solid: Tensor, width: int) -> Tensor:
    """Voxels (Z, Y, X), bool, of a solid and of gaps in it that are no wider than so many voxels."""
    closed = ndimage.grey_closing(solid.cpu().numpy().astype(np.uint8), size=width)
    return torch.from_numpy(closed > 0).to(solid.device)


def doubts_about_size(case: Case, told: Scene, scene: Scene, poses: Poses, imaging: Imaging) -> tuple[str, ...]:
    """Devices that the images show larger or smaller than their models, or with another tip, in words.

    `told` is the scene as the case tells it, `scene` the one with what was estimated of the images. Where a model is
    longer than the device, its end may have been estimated to be empty; so the model as told is asked for its tip, too.
    """
    found = []
    for name, kind in _models(scene, poses):
        words = []
        shown = device_size(scene, poses, name, kind, imaging)
        if shown is not None and _is_off(shown):
            off = abs(shown.factor - 1)
            words.append(
                f"the {name} about {100 * off:.1f} %{' or more' if off >= FURTHEST else ''} "
                f"{'larger' if shown.factor > 1 else 'smaller'} than its model, beside the {scene.anchor}"
            )
        end = _tip_elsewhere(case, told, scene, poses, name, kind, imaging)
        if end is not None:
            more = " or more" if abs(end.longer_mm) > _FAR_MM else ""
            words.append(
                f"the guide of the {name} end {abs(end.longer_mm):.1f} mm{more} "
                f"{'beyond' if end.longer_mm > 0 else 'before'} the tip of its model"
            )
        if words:
            found.append(
                f"the images show {', or '.join(words)}: check that the model is the one in the images, its length, "
                "size and unit, and the voxel size of the CT"
            )
    return tuple(found)


def _is_off(shown: Size) -> bool:
    if (shown.factor - 1) * shown.step.value <= 0:  # one says larger, the other smaller
        return False
    off = min(abs(shown.factor - 1), abs(shown.step.value))
    return off > _MOST_OFF_SIZE and shown.gain > _LEAST_GAIN_OF_SIZE and shown.step.sureness > _SURE_OF_SIZE


def _models(scene: Scene, poses: Poses) -> list[tuple[str, Kind]]:
    """Devices, and whatever else has a model, each with the first kind of images that shows it.

    That need not be a kind of their own: where all images show a drill, its length is to be asked too. The anchor is
    not asked, as the C-arm's poses follow it.
    """
    found = devices(scene, poses)
    for name in poses.camera1_from:
        thing = scene.objects[name]
        if thing.parts and name != scene.anchor and all(name != other for other, _ in found):
            found.append((name, scene.there(thing.shown_in, range(scene.views))[0][0]))
    return found


def _tip_elsewhere(
    case: Case, told: Scene, scene: Scene, poses: Poses, name: str, kind: Kind, imaging: Imaging
) -> TipLength | None:
    """Where a guide ends in the images, if that is not where its model does."""
    points = case.objects[name].points
    if not {"base", "tip"} <= set(points):
        return None
    guide = points["base"], model_end(points)
    as_told = replace(scene, objects=scene.objects | {name: told.objects[name]})
    found, if_told = (tip_length(of, poses, name, kind, guide, imaging) for of in (scene, as_told))
    off = []
    if found is not None and _ends_elsewhere(found) and (if_told is None or _is_borne_out(found, if_told)):
        off.append(found)
    if if_told is not None and if_told.longer_mm < 0 and _ends_elsewhere(if_told):
        off.append(if_told)
    return max(off, key=lambda each: each.gain, default=None)


def _ends_elsewhere(found: TipLength) -> bool:
    far = any(abs(found.longer_mm) > mm and found.gain > gain for mm, gain in _OFF_TIP)
    return far and found.least_gain > -_CONTRADICTED * found.gain


def _is_borne_out(found: TipLength, if_told: TipLength) -> bool:
    """Whether the model as it was told ends elsewhere too, or fits the images near the tip worse than the estimate.

    Of 18 tips that were 1.2 to 6 mm off both said so of 17, within 0.6 mm, and neither of one. Of three right devices,
    whose end was estimated wrongly, the one as told fitted better and ended where it should.
    """
    same_way = found.longer_mm * if_told.longer_mm > 0 and _ends_elsewhere(if_told)
    return same_way or found.cost <= if_told.cost


def notes_on_unseen_tips(case: Case, scene: Scene, poses: Poses) -> tuple[str, ...]:
    """Guides whose end no image shows, in words: how long they are is taken from their models alone."""
    clear = scene.where_unsaturated()
    return tuple(
        f"no image shows where the guide of the {name} ends, or it is saturated there: that the guide is as long as "
        "its model was not asked; let the images show the tip"
        for name, _ in _models(scene, poses)
        if {"base", "tip"} <= set(points := case.objects[name].points)
        and not in_view(clear, poses, name, model_end(points)[None]).any()
    )


def doubts_beside_devices(scene: Scene, poses: Poses, imaging: Imaging, in_doubt: bool) -> tuple[str, ...]:
    """Other things that a device may have been taken for, in words.

    If there is another doubt, also what else came or went between the images, as that may be its cause. Where something
    came and something went in one view, the patient has moved, which is asked elsewhere.
    """
    told = []
    for name, kind in devices(scene, poses):
        seen = [found for found in besides(scene, poses, name, kind) if found.more != found.less]
        came, went = ([found.view + 1 for found in seen if getattr(found, way)] for way in ("more", "less"))
        other = None
        if len(came) >= min(2, len(scene.there([kind], range(scene.views)))):
            other = rival(scene, poses, name, kind, imaging)
        if other is not None and other.share > _AS_GOOD_ELSEWHERE:
            fits = "" if other.share >= 1 else f"{100 * other.share:.0f} % "
            told.append(
                f"the {kind} images show something else of the shape of the {name}, {other.apart_mm:.0f} mm beside it, "
                f"which it fits {fits}as well: no image tells which of the two it is; take the other one out of view "
                "and register again"
            )
        elif came and in_doubt:
            told.append(
                f"the {kind} images of view {' and '.join(map(str, came))} show something besides the {name} that the "
                "other images lack (cement, a hand, a clamp?): it may be what the other doubts come from"
            )
        if went and in_doubt:
            equalised = ", or brighter all about it, as images are that were equalised for display" if went[1:] else ""
            told.append(
                f"the images without the {name} of view {' and '.join(map(str, went))} show something that those with "
                f"it lack (the {name} itself{equalised}?): it may be what the other doubts come from"
            )
    return tuple(told)
