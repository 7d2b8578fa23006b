"""Voxels of models: attenuation of a whole object that is no bone, and of each of its parts."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.case import Model, Part
from femoreg_torch.volume import (
    Solid,
    Volume,
    bounds_of,
    guide_end,
    label_share,
    labelled_device,
    read_bodies,
    read_mesh,
    scanned_device,
    solid_volumes,
    voxelise_mesh,
)

MODEL_SPACING_MM = 0.5  # a sleeve's wall is thinner than a CT voxel
BEYOND_MM = 25.0  # of a point outside the box of its model: a drill stands out of a sleeve, or the unit is another
# Of the tip that is told: past the model's end, before it, and from that end's middle. Of 63 right devices of four
# simulators at most 0.7, 0.6 and 0.2 mm. A point of 1 mm by 10 mm fills so little of its last voxels that its model
# seems to end 1 mm earlier.
_MOST_BEYOND_END_MM, _MOST_BEFORE_END_MM, _MOST_OFF_MIDDLE_MM = 1.5, 1.0, 1.0
# Of the guide's line against the axis of its model's end. Of 46 right models of other simulators it leant by 0.6° at
# most; of one that was turned by 4° about its tip by 4.0°.
_MOST_LEANING_DEG = 1.5
GUIDE_MM = (20.0, 600.0)  # from base to tip; a model in metres, inches or µm is likely beyond


@dataclass(frozen=True, eq=False)
class ModelVolumes:
    """Attenuation (1/mm) of a model in its own space."""

    volume: Volume  # the sum of the parts
    parts: tuple[Volume, ...]  # each by itself, in the order of the model, all on one grid


def model_attenuation(model: Model) -> ModelVolumes:
    """A model as volumes. Raises `InputError` for a mesh or volume that does not fit."""
    if model.parts:
        parts = _parts(model)
        total = torch.stack([part.data for part in parts]).sum(0)
        return ModelVolumes(parts[0].with_data(total), parts)
    whole = _single(model.solids[0]) if model.solids else scanned_device(model.path)
    return ModelVolumes(whole, (whole,))


def model_end(points: Mapping[str, Tensor]) -> Tensor:
    """The point (3,) where a model is said to end along its guide: the tip, if no point `end` is told."""
    return points.get("end", points["tip"])


def told_of_end(name: str, volume: Volume, points: Mapping[str, Tensor]) -> tuple[str, ...]:
    """In words, a tip before or beyond the end of the model of an object along its guide, if no point `end` says so.

    `volume` is its attenuation (1/mm), `points` (3,) mm are in its space. It may be meant so: a drill stands out of a
    sleeve, or cement leaves a needle at its side. A model that was exported from another origin looks the same.
    """
    if not {"base", "tip"} <= set(points):
        return ()
    end = guide_end(volume, points["base"], model_end(points))
    if end is None:
        lies = "far from where its model ends"
    elif not -_MOST_BEFORE_END_MM <= end.beyond_mm <= _MOST_BEYOND_END_MM:
        lies = f"{abs(end.beyond_mm):.1f} mm {'beyond' if end.beyond_mm > 0 else 'before'} the end of its model"
    else:
        return ()
    point, meant = "point end", ""
    if "end" not in points:
        point, meant = "tip", "; if the tip is meant to lie there, tell the point `end` too, where the model ends"
    return (
        f"the {point} of the {name}, as it was told, lies {lies}: check its points and the origin of its model{meant}",
    )


def told_of_middle(name: str, volume: Volume, points: Mapping[str, Tensor]) -> tuple[str, ...]:
    """In words, a guide that passes beside the middle of the end of its model. It may: a needle's end is slanted."""
    end = guide_end(volume, points["base"], model_end(points)) if {"base", "tip"} <= set(points) else None
    if end is None or end.off_middle_mm <= _MOST_OFF_MIDDLE_MM:
        return ()
    return (
        f"the guide of the {name}, as it was told, passes {end.off_middle_mm:.1f} mm beside the middle of its model's "
        "end: if it is not meant to, check its points and the origin of its model",
    )


def told_of_leaning(name: str, volume: Volume, points: Mapping[str, Tensor]) -> tuple[str, ...]:
    """In words, a guide that leans against the axis of its model's end: the model was turned against its points."""
    end = guide_end(volume, points["base"], model_end(points)) if {"base", "tip"} <= set(points) else None
    if end is None or not end.leaning_deg > _MOST_LEANING_DEG:
        return ()
    return (
        f"the {name}: the line from its base to its tip leans by {end.leaning_deg:.0f}° against the axis of its "
        "model's end: check these points and the axes of the model",
    )


def _single(part: Part) -> Volume:
    if part.labels is not None:
        return labelled_device(part.path, part.labels, part.solid_hu, MODEL_SPACING_MM)
    mesh = read_mesh(part.path)
    bounds_of([mesh], str(part.path))
    return voxelise_mesh(mesh, MODEL_SPACING_MM, part.solid_hu)


def _parts(model: Model) -> tuple[Volume, ...]:
    names = [part.body for part in model.parts if part.body is not None]
    bodies = read_bodies(model.path, names) if names else {}
    solids = []
    for part in model.parts:
        if part.body is not None:
            solids.append(Solid(bodies[part.body], part.solid_hu, f"{part.path}, body {part.body}"))
            continue
        where = str(part.path) if part.name is None else f"{part.path} ({part.name})"
        shape = read_mesh(part.path) if part.labels is None else label_share(part.path, part.labels, MODEL_SPACING_MM)
        solids.append(Solid(shape, part.solid_hu, where))
    return solid_volumes(solids, MODEL_SPACING_MM)
