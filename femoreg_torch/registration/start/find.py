"""The start pose of one image: landmarks, PnP (paper, section II-A), and then the outlines of the bones."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.detect import Detection, as_stored, filled, within_field
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Camera, transform_points
from femoreg_torch.pnp import FRONT_TO_BACK, MINIMUM, PnpResult, likely_pose, solve_pnp
from femoreg_torch.registration.scene import Outline, Scene, Segmentation
from femoreg_torch.registration.start.checks import BY_HAND, MOST_ROTATION_DEG, check_rotation, check_sides
from femoreg_torch.registration.start.silhouette import refine_by_silhouette

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
_MIRRORED = Display(mirrored=True)


@dataclass(frozen=True)
class Start:
    """A start pose and what speaks for it."""

    camera_from_ct: Tensor  # (4, 4) float64
    pnp: PnpResult
    used: list[str]  # names of the landmarks that PnP was given
    overlap: float | None  # of the outlined bones drawn and seen; None where they were not compared
    few: bool = False  # landmarks: too few for a pose, which is that of the outlines


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
    that cuts the bones; and where there is no outline, or nothing of it that could be compared.
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
                "hand (--landmarks) or, if the image shows no four of them, poses to start from (--start)."
            )
        pnp = fitted(used, range(len(used)))
    except InputError as error:
        if outline is None or not usable or beam[1] == 0:  # from a side, left lies over right
            raise
        too_few = error
        pnp = likely_pose(points, pixels, camera, deviations, spread, beam, detection.turned)
    else:
        check_sides(pnp, anatomy, landmarks, used, fitted, BY_HAND)
    if outline is None:
        check_rotation(pnp)
        return Start(pnp.camera_from_object, pnp, used, None)
    centre = transform_points(pnp.camera_from_object, points).mean(0)
    bones = Segmentation(detection.segmentation.to(attenuation.device), detection.network_camera)
    fit = refine_by_silhouette(
        outline, anatomy, pnp.camera_from_object, centre, pnp.covariance, bones, attenuation, camera, field
    )
    if fit.overlap is None:
        if too_few is not None:
            raise too_few
        check_rotation(pnp)
        return Start(pnp.camera_from_object, pnp, used, None)
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
            f"agree by {100 * fit.overlap:.0f} % only (Dice; {100 * least:.0f} % are asked for). Is it the same "
            "patient? Otherwise take a view that shows more of them, or give the landmarks by hand (--landmarks)."
        )
    return Start(fit.camera_from_ct, pnp, used, fit.overlap)


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
