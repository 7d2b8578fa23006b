"""What is compared with what a stage draws: an image at a level, what is exposed of it, and a veil over it.

A veil is light of the image of the same view without the device. Scattered light fills the shadows of metal. Where a
grid, software or a simulator leaves little of it, the logarithm of a shadow is deep and mostly noise, and drowns what
the edges of the shadow say. Then a share of the image without the device is added to the image with it. Both show one
patient from one place, so that no shadow is deeper than that share of the light beside it. To what is drawn the same
share of what is drawn without the device is added.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.scene import Kind, Scene
from femoreg_torch.similarity import FixedSimilarity, Similarity, against_field


@dataclass(frozen=True, eq=False)
class Veil:
    """An image with light added, and the light to add to what is drawn for it."""

    image: Tensor  # (H, W) attenuation
    light: Tensor  # (H, W), per primary light but for what is drawn
    exposed: Tensor | None  # (H, W), bool: what no shutter shades in either image; None for all


def veil_over(
    scene: Scene,
    render: Sequence[str],
    image: tuple[Kind, int],
    level: Level,
    share: float,
    scatter: float,
    alone: Callable[[str], Tensor],
) -> Veil | None:
    """The veil of a `share` over an image (kind, view) at a level.

    It is drawn once, with the objects of `render`, of which `alone` tells the line integrals (H, W) one by one, and
    `scatter` per primary light. None where the share is nothing, or the image is of the first kind, which shows the
    patient alone, or there is none of that kind.
    """
    kind, view = image
    patient = scene.first_kind, view
    if share <= 0 or kind == scene.first_kind or not scene.there([scene.first_kind], [view]):
        return None
    bones = torch.zeros(level.camera(scene.carm.camera).shape, device=scene.device)
    for name in scene.shown(render, scene.first_kind):
        bones = bones + alone(name)
    shadow, beside = (level.image(scene.image(*one), scene.carm.camera) for one in (image, patient))
    fields = [exposed_field(scene, one, level) for one in (image, patient)]
    exposed = [field for field in fields if field is not None]
    return Veil(
        -((-shadow).exp() + share * (-beside).exp()).log(),
        share * ((-bones).exp() + scatter),
        torch.stack(exposed).all(0) if exposed else None,
    )


def exposed_field(scene: Scene, image: tuple[Kind, int], level: Level) -> Tensor | None:
    """The pixels (H, W), bool, of a level that the shutters of an image (kind, view) leave whole; None without any."""
    exposed = scene.field(*image)
    return None if exposed is None else level.field(exposed, scene.carm.camera)


def exposed_in_both(scene: Scene, kinds: tuple[Kind, Kind], view: int, level: Level) -> Tensor:
    """The pixels (H, W), bool, of a level that the shutters of neither of two images of a view (from 0) touch."""
    exposed = torch.ones(level.camera(scene.carm.camera).shape, dtype=torch.bool, device=scene.device)
    for kind in kinds:
        if (field := exposed_field(scene, (kind, view), level)) is not None:
            exposed &= field
    return exposed


def prepared(
    scene: Scene,
    image: tuple[Kind, int],
    level: Level,
    similarity: Similarity,
    weights: Tensor | None = None,
    veil: Veil | None = None,
) -> FixedSimilarity:
    """A similarity against an image (kind, view) at a level, by what is exposed; `weights` (H, W) are of its pixels.

    With a `veil` it is against the veiled image. Raises `InputError` where nothing is left to compare.
    """
    kind, view = image
    fixed = level.image(scene.image(kind, view), scene.carm.camera) if veil is None else veil.image
    exposed = exposed_field(scene, image, level) if veil is None else veil.exposed
    try:
        return against_field(similarity, fixed, weights, exposed)
    except InputError as error:
        raise InputError(f"view {view + 1}, {kind} image: {error}") from error
