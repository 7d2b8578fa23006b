"""From a case on disk to the scene that is registered."""

from concurrent.futures import ThreadPoolExecutor
from itertools import chain

import torch

from femoreg_torch.case import Case, CaseObject, Model
from femoreg_torch.errors import InputError
from femoreg_torch.registration.prepare.bones import SOFT_HU, ct_objects, read_bones
from femoreg_torch.registration.prepare.images import read_with_saturated
from femoreg_torch.registration.prepare.models import ModelVolumes, model_attenuation, told_of_middle
from femoreg_torch.registration.prepare.nominal import check_points, check_starts
from femoreg_torch.registration.prepare.outline import outline_of
from femoreg_torch.registration.prepare.plan_and_landmarks import (
    doubts_about_the_labels,
    doubts_about_the_points,
    doubts_about_the_slices,
    heads_near_landmarks,
    notes_on_the_slices,
)
from femoreg_torch.registration.roundness import Axis, round_axis
from femoreg_torch.registration.scene import RigidObject, Scene
from femoreg_torch.volume import (
    BoneLabels,
    Volume,
    check_inside,
    densities,
    hu_to_attenuation,
    landmarks_without_bones,
    merged_bones,
    mostly_stray,
    resample_isotropic,
    soft_bones,
    swapped_sides,
)

TISSUE_SPACING_MM = 3.0  # soft tissue is smooth


def prepare_scene(case: Case) -> Scene:
    """Volumes, reference points and images of a case. Raises `InputError` for every input that does not fit."""
    if not case.views:
        raise InputError(f"{case.folder}/case.yaml, views: empty. At least one fluoroscopic image is needed.")
    from_ct = [thing for thing in case.objects.values() if thing.model is None]
    objects: dict[str, RigidObject] = {}
    tissue = outline = None
    contradictions: tuple[str, ...] = ()
    with ThreadPoolExecutor(max_workers=2) as beside:  # images and models are read while the CT is
        reading = beside.submit(read_with_saturated, case)
        making = {
            thing.name: beside.submit(_read_model, case, thing, thing.model)
            for thing in case.objects.values()
            if thing.model
        }
        if from_ct:
            ct, bones = read_bones(case)
            outlining = beside.submit(outline_of, bones, case.anatomy)
            heeding = beside.submit(_told_of_points, case, ct, bones)
            looking = [beside.submit(ask, ct, bones) for ask in (doubts_about_the_labels, doubts_about_the_slices)]
            check_inside(case.landmarks, ct)
            told_of_ct = (*bones.notes, *_check_anatomy(case, ct, bones))
            _check_path(case, ct)
            soft = resample_isotropic(ct.with_data(ct.data.clamp_max(SOFT_HU)), TISSUE_SPACING_MM)
            tissue = soft.with_data(hu_to_attenuation(soft.data, -1000.0))
        images, fields, bright, told = reading.result()
        if from_ct:
            objects = ct_objects(ct, bones, from_ct, case.anatomy, tuple(images))
            of_points, told_of_slices = heeding.result()
            contradictions = *bones.against, *chain(*(each.result() for each in looking)), *of_points
            told = (*told_of_ct, *told_of_slices, *told)
            outline = outlining.result()
        made = {name: model.result() for name, model in making.items()}
    for name, (volumes, axis) in made.items():
        thing = case.objects[name]
        assert thing.model is not None
        told = (*told, *told_of_middle(name, volumes.volume, thing.points))
        objects[name] = RigidObject(
            volumes.volume,
            volumes.volume.centre() if thing.reference is None else thing.reference,
            thing.images or tuple(images),
            thing.start,
            parts=volumes.parts,
            axis=axis,
            guide=(thing.points["base"], thing.points["tip"]) if {"base", "tip"} <= set(thing.points) else None,
            materials_known=thing.model.materials_known,
            sharp=bool(thing.model.solids),
        )
    known = case.views[-1].camera_from_camera1 is not None
    identity = torch.eye(4, dtype=torch.float64)
    cameras = [identity if v.camera_from_camera1 is None else v.camera_from_camera1 for v in case.views]
    check_starts(objects, case.carm.camera.sdd_mm, f"{case.folder}/case.yaml")
    return Scene(
        case.carm,
        {name: objects[name] for name in case.objects},
        images,
        fields=fields,
        saturated=bright,
        tissue=tissue,
        outline=outline,
        camera_from_camera1=torch.stack(cameras) if known else None,
        left_on_left=tuple(view for view in range(len(case.views)) if case.display_of(view).left_on_left),
        missing=told,
        contradictions=contradictions,
    )


def _check_anatomy(case: Case, ct: Volume, bones: BoneLabels) -> tuple[str, ...]:
    """What is strange of CT and label map, in words.

    Raises `InputError` if they and the landmarks contradict one another.
    """
    asked = bones, case.landmarks, case.anatomy
    told = swapped_sides(*asked) or merged_bones(*asked) or mostly_stray(*asked)
    seen = densities(ct, bones.labels)
    if wrong := [*told, *filter(None, [seen.unscaled])]:
        raise InputError(f"{case.folder}: {'; '.join(wrong)}.")
    elsewhere = seen.light or seen.elsewhere or soft_bones(ct, bones.labels, bones.ids)
    return (*filter(None, [elsewhere, seen.windowed]), *landmarks_without_bones(bones, case.landmarks, case.anatomy))


def _told_of_points(case: Case, ct: Volume, bones: BoneLabels) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What speaks against landmarks and plan, and what the femoral heads say of the slices, in words."""
    heads = heads_near_landmarks(case, bones)
    return doubts_about_the_points(case, ct, bones, heads), notes_on_the_slices(bones, heads)


def _check_path(case: Case, ct: Volume) -> None:
    """Raises `InputError` if a path through bones of the CT leaves the CT."""
    if case.plan is not None and case.objects[case.plan.object].model is None:
        check_inside({"entry_point of the plan": case.plan.entry_point, "target of the plan": case.plan.target}, ct)


def _read_model(case: Case, thing: CaseObject, model: Model) -> tuple[ModelVolumes, Axis | None]:
    """An object's model as volumes, and its axis if it is round. Raises `InputError` for what does not fit.

    Where its reference lies does not matter for that: of a round object deviations are told on the axis.
    """
    volumes = model_attenuation(model)
    check_points(case, thing, volumes.volume)
    elsewhere = [p for p in thing.points.values() if thing.reference is None or not torch.equal(p, thing.reference)]
    return volumes, round_axis(volumes.volume, volumes.parts, elsewhere)
