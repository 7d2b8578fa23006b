"""Why the network gives no start, and what would help."""

from dataclasses import replace

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, Anatomy
from femoreg_torch.case import Case
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.start.checks import BY_HAND
from femoreg_torch.registration.start.find import Detector, Start, find_start, look_at

_FEW_GREYS = 16  # pictures of 16 bits of a stout patient held 300, one of 8 bits two
_OF_8_BITS = 256
_ASKED_PX = 200_000
_OF_A_SIDE = (
    "This view is taken from a side, of which the shipped network reads some two of three: pick the landmarks in the "
    "image (--landmarks), or put another view first."
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
        return InputError(" ".join([seen.removesuffix(BY_HAND).rstrip(), _OF_A_SIDE, *other]))
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
