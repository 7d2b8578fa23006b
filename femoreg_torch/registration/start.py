"""The start pose: landmarks in view 1, PnP (paper, section II-A), and then the outlines of the bones."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, Anatomy
from femoreg_torch.case import Case, LandmarkRecord, StartRecord
from femoreg_torch.detect import Detection, as_stored, filled, within_field
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display, nearest_source
from femoreg_torch.geometry import Camera, transform_points
from femoreg_torch.pnp import FRONT_TO_BACK, MINIMUM, MIRRORED_ADVICE, PnpResult, likely_pose, solve_pnp
from femoreg_torch.registration.picked import check_before_detector, check_in_picture, meant_otherwise
from femoreg_torch.registration.prepare import view_distortion
from femoreg_torch.registration.scene import Outline, Scene, Segmentation
from femoreg_torch.registration.silhouette import refine_by_silhouette

Detector = Callable[[Tensor, Camera], Detection]  # finds the landmarks in an attenuation image (H, W) of a camera


# Dice of the outlined bones where few landmarks, or none that agree, tell the pose, chosen on procedural patients 101
# and 102, also where shutters leave less than half of the image; and where four or more agree: of 221 such starts in
# images of two simulators all 4 from 0.83 to 0.90 were within 5°, and none was less. With few, one of 0.84 was 54° off.
LEAST_OVERLAP, _LEAST_WITH_LANDMARKS = 0.90, 0.80
# Share of the bones that lies beyond a CT that cuts them, from which as much is asked as with few landmarks: what is
# left of another patient's, narrower by 0.7, agreed by 83 %; of two right ones by 96 and 97 %.
_MUCH_BEYOND = 0.1
# Of a start by few landmarks, where other views are there to disagree with a wrong one. In images of two simulators 16
# of 18 such starts that would be refused by the above, or are far off and would not be, led to within 2 mm and 0.5° of
# the pelvis. Two did not, nor did six with the CT of another patient: none was trusted, as other views fitted nowhere,
# or femur and device lay elsewhere in them.
_LEAST_AMONG_VIEWS, _MOST_DEG_AMONG_VIEWS = 0.75, 16.0
# Greatest standard deviation of the rotation, over all axes, of a start by landmarks alone, or by few of them and
# outlines. Outlines mend what is more open (9° open: 2 to 3° off afterwards).
MOST_ROTATION_DEG = 5.0
_MIRRORED = Display(mirrored=True)
_NETWORK, _OUTLINES = "landmarks of the network", ", outlines"  # words of where a start comes from
_FEW_GREYS = 16  # pictures of 16 bits of a stout patient held 300, one of 8 bits two
_OF_8_BITS = 256
_ASKED_PX = 200_000
_SURE_OF_SIDES = 3.0  # log likelihood by which landmarks are to fit better than those of the other side
_OF_A_SIDE = (
    "This view is taken from a side, of which the shipped network reads some two of three: pick the landmarks in the "
    "image (--landmarks), or put another view first."
)
_LOOK_AGAIN = (
    "Look again which is nearer to the source (and is shown larger), or put a view from the front or from behind first."
)
_BY_HAND = "Pick the landmarks in the image (--landmarks), or put a view from the front or from behind first."
_MOST_ASKEW_DEG = 60.0  # of the beam against the side that the case says; beyond 45° another side is nearer
GIVEN_DEVIATION_MM = 1.5  # on the detector, along each axis: of landmarks that a person picked in the image


@dataclass(frozen=True)
class Start:
    """A start pose and what speaks for it."""

    camera_from_ct: Tensor  # (4, 4) float64
    pnp: PnpResult
    used: list[str]  # names of the landmarks that PnP was given
    overlap: float | None  # of the outlined bones drawn and seen; None where they were not compared
    few: bool = False  # landmarks: too few for a pose, which is that of the outlines


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


def why_there_is_no_start(case: Case, scene: Scene, error: InputError, find: Detector | None) -> InputError:
    """The refusal of view 1 by `error` with the image's name, and what would help.

    That is how the image would have to be turned, or which view to put first, if `find` then sees landmarks that agree.
    """
    image, field = scene.image(scene.first_kind, 0), scene.field(scene.first_kind, 0)
    anatomy, path = case.anatomy or HIP, case.views[0].images[scene.first_kind]
    seen = f"{path}: {error}"
    if (greys := _greys_where_dense(image, field)) is not None:
        return InputError(
            f"{path}: half of the picture, where the patient is dense, holds no more than {greys} grey "
            f"value{'s' * (greys != 1)}, so hardly a bone is to be seen. Is it of 8 bits, in proportion to the light? "
            "Export it with 16 bits, or its logarithm."
        )
    other = () if find is None else _told_other_view(case, scene, anatomy, find)
    if case.display_of(0).source in ("left", "right"):
        return InputError(" ".join([seen.removesuffix(_BY_HAND).rstrip(), _OF_A_SIDE, *other]))
    turned = () if find is None else _told_turned(case, scene, anatomy, find)
    return InputError(" ".join([seen, *(turned or other)]))


def _greys_where_dense(attenuation: Tensor, field: Tensor | None) -> int | None:
    """How many grey values the denser half of what is exposed holds, if they are few and the picture is of 8 bits."""
    exposed = attenuation.flatten() if field is None else attenuation[field]
    some = exposed[:: max(1, len(exposed) // _ASKED_PX)]
    greys = len(torch.unique(some[some >= some.median()]))
    return greys if greys <= _FEW_GREYS and len(torch.unique(some)) <= _OF_8_BITS else None


def _told_turned(case: Case, scene: Scene, anatomy: Anatomy, find: Detector) -> tuple[str, ...]:
    """In words, by which quarter turn the first image shows landmarks that agree; nothing where neither gives that.

    On its head the network reads it anyway.
    """
    kind, display = scene.first_kind, case.display_of(0)
    image, field = scene.image(kind, 0), scene.field(kind, 0)
    for deg in (90, 270):
        turn = Display(turned_deg=deg)
        camera = turn.camera(case.carm.camera)
        upright, exposed = turn.to_camera(image), None if field is None else turn.to_camera(field)
        there = replace(
            scene,
            carm=replace(scene.carm, camera=camera),
            images={kind: (upright, *scene.images[kind][1:])},
            fields={kind: (exposed, *(None,) * (scene.views - 1))},
        )
        found = look_at(there, 0, find)
        if found.turned:  # the other quarter turn sets it upright
            continue
        try:
            start = find_start(case.landmarks, found, upright, camera, scene.outline, anatomy, exposed, display.beam)
        except InputError:
            continue
        if not start.few:
            turned = (display.turned_deg + (-deg if display.flipped else deg)) % 360
            return (
                f"Turned by a quarter it shows {int(start.pnp.inliers.sum())} landmarks that agree: is the picture not "
                f"head up? Then write `display: {{turned: {turned}}}`.",
            )
    return ()


def _told_other_view(case: Case, scene: Scene, anatomy: Anatomy, find: Detector) -> tuple[str, ...]:
    """In words, which of the other views shows most landmarks that agree; nothing where none shows enough of them."""
    best = best_other_view(case, scene, anatomy, find)
    if best is None:
        return ()
    view, start = best
    agree = int(start.pnp.inliers.sum())
    return (f"View {view + 1} shows {agree} landmarks that agree: list it first, and tell poses in its camera.",)


def best_other_view(case: Case, scene: Scene, anatomy: Anatomy, find: Detector) -> tuple[int, Start] | None:
    """The view (from 0), not the first, that shows most landmarks that agree, and its start; None if there is none."""
    found: dict[int, Start] = {}
    for _, view in scene.there([scene.first_kind], range(1, scene.views)):
        image, field, beam = (
            scene.image(scene.first_kind, view),
            scene.field(scene.first_kind, view),
            case.display_of(view).beam,
        )
        try:
            start = find_start(
                case.landmarks, look_at(scene, view, find), image, case.carm.camera, scene.outline, anatomy, field, beam
            )
        except InputError:
            continue
        if not start.few:
            found[view] = start
    if not found:
        return None
    best = max(found, key=lambda view: int(found[view].pnp.inliers.sum()))
    return best, found[best]


def start_by_landmarks(case: Case, anchor: str, pixels: Mapping[str, Tensor]) -> StartRecord:
    """The pose (4, 4) of the object `anchor` from `pixels` (2,), column and row, of landmarks picked in view 1.

    Pixels are those of the image as it is stored.

    Raises `InputError` if fewer than four have a name that the case knows, most lie beside the picture, fewer than four
    agree, they leave the rotation open by more than 5°, they put the patient on or behind the detector, they tell
    another side of the source than the case, or, in a view from a side, they may be those of the other side. Where they
    would fit if they were meant otherwise (in mm, rows counted from below, …), the message says so.
    """
    names = [name for name in pixels if name in case.landmarks]
    if len(names) < MINIMUM:
        raise InputError(
            f"landmarks in the image: {len(names)} have the name of a landmark of the case "
            f"({', '.join(case.landmarks)}), at least {MINIMUM} are needed."
        )
    camera, display = case.carm.camera, case.display_of(0)
    picked, distortion = torch.stack([pixels[name] for name in names]).double(), view_distortion(case, 0)
    stored = display.stored_camera(camera)
    check_in_picture(names, picked, stored)
    spread = {mark.name: mark.spread_mm for mark in case.anatomy.landmarks} if case.anatomy is not None else {}

    def pose_of(called: Sequence[str], places: Tensor) -> PnpResult:
        """The pose by places (N, 2) in the stored picture, if they are the landmarks of these names."""
        seen = display.pixels_to_camera(places if distortion is None else distortion.straight(places), camera)
        return solve_pnp(
            torch.stack([case.landmarks[name] for name in called]).double(),
            seen,
            camera,
            deviations_px=torch.full((len(called),), GIVEN_DEVIATION_MM / camera.mean_pixel_mm, dtype=torch.float64),
            point_deviations_mm=torch.tensor([spread.get(name, 0.0) for name in called], dtype=torch.float64),
            beam=display.beam,
        )

    def fits(called: Sequence[str], places: Tensor) -> PnpResult | None:
        try:
            return pose_of(called, places) if set(called) <= set(case.landmarks) else None
        except InputError:
            return None

    try:
        pnp = pose_of(names, picked)
    except InputError as error:
        mirror = {} if case.anatomy is None else {mark.name: mark.mirror for mark in case.anatomy.landmarks}
        otherwise = meant_otherwise(names, picked, stored, fits, mirror)
        if otherwise is None:
            raise
        told = str(error).removesuffix(MIRRORED_ADVICE).rstrip()
        raise InputError(f"landmarks in the image: {told} They fit {otherwise}.") from error
    _check_rotation(pnp)
    check_before_detector(pnp, case.landmarks, names, picked, stored, fits)
    _check_beam(pnp.camera_from_object, display)
    if case.anatomy is not None:
        _check_sides(
            pnp,
            case.anatomy,
            case.landmarks,
            names,
            lambda called, rows: pose_of(called, picked[list(rows)]),
            _LOOK_AGAIN,
        )
    marks = {
        name: LandmarkRecord(_pair(pixels[name]), 1.0, True, inlier)
        for name, inlier in zip(names, pnp.inliers.tolist(), strict=True)
    }
    return StartRecord(anchor, pnp.camera_from_object, "landmarks given by hand", marks, pnp.rms_px)


def find_start(
    landmarks: Mapping[str, Tensor],
    detection: Detection,
    attenuation: Tensor,
    camera: Camera,
    outline: Outline | None,
    anatomy: Anatomy,
    field: Tensor | None = None,
    beam: tuple[float, float, float] = FRONT_TO_BACK,
    among_views: bool = False,
) -> Start:
    """The pose of a CT with `landmarks` (3,) in an image (H, W), by PnP and then by the outlines of its bones.

    `field` (H, W), bool, is the exposed part of the image; None: all of it. `beam` is the axis of LPS that the beam
    runs along. `among_views`: other views are there to disagree with a wrong start, so less is asked of few landmarks.

    Fewer than four landmarks, or such as do not agree, tell with the outlines where to look for a pose. From those that
    were seen in 17 views of another simulator, most of one hip alone, that gave 15 poses within 5° and 3 mm across
    (depth within 35 mm), one 5 mm across (its CT was scaled), and one was refused.

    Raises `InputError` if the grey values are inverted, which would mislead the similarity even where the landmarks are
    found, or if the bones drawn at the pose cover those that the network sees by less than 80 % (Dice), or 90 % where
    more than a tenth of these lies beyond a CT that cuts them. Where fewer than four landmarks are of use or agree: if
    that cover is less than 90 %, or the rotation is left open by more than 5°; `among_views` 75 % and 16°, but for a CT
    that cuts the bones; and without an outline.
    """
    if detection.inverted:
        raise InputError(
            "bone seems to be darker than soft tissue where it should be brighter. Set `intensity` of the view (raw: "
            "bone dark, log: bone bright), or invert the picture. If it is right already, as it can be where few "
            "landmarks are in view, give the landmarks by hand (--landmarks)."
        )
    names = anatomy.landmark_names
    usable = [i for i, name in enumerate(names) if name in landmarks and bool(detection.visible[i])]
    used = [names[i] for i in usable]
    points = torch.stack([landmarks[name] for name in used]).double() if used else torch.zeros(0, 3).double()
    deviation_of = dict(zip(names, torch.tensor(anatomy.landmark_spread_mm, dtype=torch.float64), strict=True))
    spread = torch.stack([deviation_of[name] for name in used]) if used else torch.zeros(0).double()
    pixels, deviations = detection.pixels[usable], detection.deviation_px[usable]

    def fitted(called: Sequence[str], rows: Sequence[int]) -> PnpResult:
        """The pose by these rows (N,) of what was found, if they are the landmarks of these names."""
        there = list(rows)
        return solve_pnp(
            torch.stack([landmarks[name] for name in called]).double(),
            pixels[there],
            camera,
            detection.confidence[usable][there],
            deviations[there],
            torch.stack([deviation_of[name] for name in called]),
            beam,
        )

    too_few: InputError | None = None
    try:
        if len(usable) < MINIMUM:
            raise InputError(
                f"{len(usable)} usable landmarks found, at least {MINIMUM} are needed. Is this a {anatomy.name}, and "
                "is `intensity` of the view right (raw: bone dark, log: bone bright)? Otherwise give the landmarks by "
                "hand (--landmarks)."
            )
        pnp = fitted(used, range(len(used)))
    except InputError as error:
        if outline is None or not usable or beam[1] == 0:  # from a side, left lies over right
            raise
        too_few = error
        pnp = likely_pose(points, pixels, camera, deviations, spread, beam, detection.turned)
    else:
        _check_sides(pnp, anatomy, landmarks, used, fitted, _BY_HAND)
    if outline is None:
        _check_rotation(pnp)
        return Start(pnp.camera_from_object, pnp, used, None)
    centre = transform_points(pnp.camera_from_object, points).mean(0)
    bones = Segmentation(detection.segmentation.to(attenuation.device), detection.network_camera)
    fit = refine_by_silhouette(
        outline, anatomy, pnp.camera_from_object, centre, pnp.covariance, bones, attenuation, camera, field
    )
    if too_few is not None:
        alone = not among_views or fit.beyond > _MUCH_BEYOND
        least, most = (LEAST_OVERLAP, MOST_ROTATION_DEG) if alone else (_LEAST_AMONG_VIEWS, _MOST_DEG_AMONG_VIEWS)
        if fit.overlap < least or fit.rotation_deviation_deg > most:
            raise too_few
        return Start(fit.camera_from_ct, pnp, used, fit.overlap, few=True)
    least = LEAST_OVERLAP if fit.beyond > _MUCH_BEYOND else _LEAST_WITH_LANDMARKS
    if fit.overlap < least:
        raise InputError(
            f"{', '.join(outline.bones)} of the CT, drawn where the landmarks put them, and as the network sees them "
            f"agree by {fit.overlap:.0%} only (Dice; {least:.0%} are asked for). Is it the same "
            "patient? Otherwise take a view that shows more of them, or give the landmarks by hand (--landmarks)."
        )
    return Start(fit.camera_from_ct, pnp, used, fit.overlap)


def _check_rotation(pnp: PnpResult) -> None:
    if pnp.rotation_deviation_deg > MOST_ROTATION_DEG:
        raise InputError(
            f"too few usable landmarks: {int(pnp.inliers.sum())} of {len(pnp.inliers)} agree, but they fix the "
            f"rotation only to {pnp.rotation_deviation_deg:.0f}°, and no outlines help. Take a view that shows more "
            "landmarks, give more of them by hand (--landmarks), or name the bones of the label map under `ct.bones`."
        )


def _check_beam(camera_from_ct: Tensor, display: Display) -> None:
    """Raises `InputError` where landmarks tell another side of the source than the case does."""
    beam = camera_from_ct[2, :3]
    off = math.degrees(math.acos(float((beam @ beam.new_tensor(display.beam)).clamp(-1, 1))))
    nearest = nearest_source(beam)
    if off > _MOST_ASKEW_DEG and nearest != display.source:  # steep views of the same side are right
        raise InputError(
            f"landmarks in the image: by them the source stands {off:.0f}° from the patient's {display.source} side, "
            f"which the case says, and nearest to the {nearest} one. Write `display: {{source: {nearest}}}`, and see "
            "whether `mirrored` is right, or look at the landmarks again."
        )


def _check_sides(
    pnp: PnpResult,
    anatomy: Anatomy,
    landmarks: Mapping[str, Tensor],
    names: Sequence[str],
    fitted: Callable[[Sequence[str], Sequence[int]], PnpResult],
    advice: str,
) -> None:
    """Raises `InputError` with this `advice` where landmarks of a view from a side may be those of the other side.

    `fitted` gives the pose if rows of what was seen are the landmarks of given names.

    From a side, a body and its mirror image cast nearly the same shadow, and only perspective tells them apart: picked
    with left and right exchanged, the landmarks of a pelvis gave poses 20° and 80 mm off, within 10 mm on the detector.
    """
    left, back, _ = pnp.camera_from_object[2, :3].abs().tolist()
    if left <= back:
        return
    mirror = {mark.name: mark.mirror for mark in anatomy.landmarks}
    both = [n for n, name in enumerate(names) if mirror.get(name) in landmarks]
    own, other = [names[n] for n in both], [mirror[names[n]] for n in both]
    try:
        gain = fitted(own, both).misfit - fitted(other, both).misfit
    except InputError:  # too few of them, or none of the other side fits
        return
    if gain > -_SURE_OF_SIDES:
        how = "better" if gain > _SURE_OF_SIDES else "about as well"
        raise InputError(
            f"landmarks in the image: with left and right exchanged they fit {how}. Seen from a side, the two lie one "
            f"over the other. {advice}"
        )


def look_at(scene: Scene, view: int, find: Detector) -> Detection:
    """What `find` sees in the first image of a view (from 0); landmarks outside its exposed field are not visible.

    `find` is shown the patient's left on the right.
    """
    image, field, camera = scene.image(scene.first_kind, view), scene.field(scene.first_kind, view), scene.carm.camera
    shown = image if field is None else filled(image, field)
    if view in scene.left_on_left:
        found = as_stored(find(shown.flip(-1), camera.mirrored()), _MIRRORED, camera.mirrored())
    else:
        found = find(shown, camera)
    return found if field is None else within_field(found, field)


def with_segmentations(scene: Scene, first: Detection, find: Detector) -> Scene:
    """The scene with what the network sees of the bones in every view; `first` is what it saw in view 1."""
    others = [look_at(scene, view, find) for view in range(1, scene.views)]
    seen = tuple(Segmentation(found.segmentation.to(scene.device), found.network_camera) for found in (first, *others))
    return replace(scene, segmentations=seen)


def record_from_view_1(case: Case, scene: Scene, detection: Detection, start: Start) -> StartRecord:
    """A start in view 1 with the landmarks of `detection`, in pixels of the image as it is stored."""
    stored = case.display_of(0).pixels_to_stored(detection.pixels, case.carm.camera)
    if (distortion := view_distortion(case, 0)) is not None:
        stored = torch.from_numpy(distortion.bent(stored.numpy()))
    inliers = {name for name, inlier in zip(start.used, start.pnp.inliers.tolist(), strict=True) if inlier}
    marks = {
        name: LandmarkRecord(
            _pair(stored[i]), float(detection.confidence[i]), bool(detection.visible[i]), name in inliers
        )
        for i, name in enumerate((case.anatomy or HIP).landmark_names)
    }
    source = ("few " if start.few else "") + _NETWORK + (_OUTLINES if start.overlap is not None else "")
    return StartRecord(scene.anchor, start.camera_from_ct, source, marks, start.pnp.rms_px, start.overlap)


def record_from_view(view: int, anchor: str, camera1_from: Tensor, start: Start) -> StartRecord:
    """A start in camera 1 that was found from another view (from 0); its landmarks, in that image, are left out."""
    source = f"{_NETWORK} in view {view + 1}{_OUTLINES if start.overlap is not None else ''}, and from there view 1"
    return StartRecord(anchor, camera1_from, source, {}, start.pnp.rms_px, start.overlap)


def _pair(pixel: Tensor) -> tuple[float, float]:
    column, row = pixel.tolist()
    return column, row
