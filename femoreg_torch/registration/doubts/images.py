"""Images that do not show what is drawn for them, and smeared ones, in words."""

from collections.abc import Iterable

from femoreg_torch.fluoro import rough_attenuation, shows_less
from femoreg_torch.geometry import Poses
from femoreg_torch.registration.doubts.carm import ORBIT_DEG
from femoreg_torch.registration.evidence.misfits import Misfit
from femoreg_torch.registration.evidence.smears import smears
from femoreg_torch.registration.scene import Scene

# Of the strength of edges. Smeared by 5 to 8 mm on the detector: 0.80 to 0.94. In 60 that were not, of two
# simulators: at least 0.98; where a fifth of the image before was left in it 0.95.
_LEAST_KEPT = 0.955


def doubts_about_the_images(scene: Scene, found: Iterable[Misfit]) -> tuple[str, ...]:
    """Images that do not show what is drawn for them, and the likely reason, in words."""
    return tuple(_told(scene, misfit) for misfit in found)


def _told(scene: Scene, found: Misfit) -> str:
    what = f"the {found.kind} image of view {found.view + 1}"
    beside = f"(similarity {found.similarity:.2f}, of view 1 {found.in_view_1:.2f})"
    if found.as_view is not None:
        return (
            f"{what} shows what the other images of view {found.as_view + 1} show {beside}: are images exchanged? "
            "Check `views` of the case"
        )
    if found.as_stored is not None:
        return (
            f"{what} does not fit as the case tells it, and {found.as_stored} it does {beside}: check `display` "
            "and `intensity` of the view, and that all of its images are stored alike"
        )
    if found.kind != scene.first_kind:
        return (
            f"{what} does not show what the other image of that view shows {beside}: check that both were taken "
            "without moving C-arm or patient, and that no images are exchanged"
        )
    if found.view == 0:
        return (
            f"{what} does not show the bones where they were found (similarity {found.similarity:.2f}): check that it "
            "shows the hip of this patient, and `display` and `intensity` of the view"
        )
    if found.found_deg is not None:
        return (
            f"{what} does not fit where it was found {beside}, but {found.found_deg:.0f}° from view 1 it does: the "
            "search for it ended elsewhere, or does not go so far; take the preset fast, which looks as far as "
            f"{ORBIT_DEG:.0f}°, or give the C-arm's poses (`camera_from_camera1` of the views)"
        )
    if scene.camera_from_camera1 is not None:
        return (
            f"{what} does not fit at the pose that the case gives {beside}: check `camera_from_camera1` of the "
            "views (from camera 1 to that view's, in mm, not the inverse), and that the image shows the same hip"
        )
    others = len(scene.there([found.kind], range(scene.views))) - 1
    without = "; or register without that view" if others > 1 else ""
    return (
        f"{what} fits nowhere within {ORBIT_DEG:.0f}° of view 1 {beside}: check that it shows the same hip of "
        "the same patient, and that little covers it; a C-arm that stood elsewhere needs its poses "
        f"(`camera_from_camera1` of the views){without}"
    )


def doubts_about_exchanged_kinds(scene: Scene) -> tuple[str, ...]:
    """Views whose image without the device shows something dense that the one with it lacks, in words."""
    first, objects = scene.first_kind, list(scene.objects)
    told = []
    for kind in scene.images:
        if kind == first or not set(scene.shown(objects, first)) < set(scene.shown(objects, kind)):
            continue
        exchanged = [
            str(view + 1)
            for _, view in scene.there([kind], range(scene.views))
            if scene.there([first], [view])
            and shows_less(*(rough_attenuation(scene.image(of, view), "log") for of in (first, kind)))
        ]
        if exchanged:
            told.append(
                f"the {first} image of view {' and '.join(exchanged)} shows something dense that the {kind} image "
                "lacks, not the other way round: are the two exchanged? Check `views` of the case"
            )
    return tuple(told)


def doubts_about_smears(scene: Scene, poses: Poses) -> tuple[str, ...]:
    """Images that something smeared while they were taken, in words."""
    return tuple(
        f"of view {found.view + 1}, the {scene.first_kind} and the {found.kind} image differ in sharpness along one "
        f"direction (edges {100 * (1 - found.kept):.0f} % weaker): one of the two is smeared; hold everything "
        "still and take it again"
        for found in smears(scene, poses)
        if found.kept < _LEAST_KEPT
    )
