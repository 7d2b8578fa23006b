"""From a case on disk to the scene that is registered."""

from collections.abc import Sequence

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.case import Case, CaseObject, Model, View
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import attenuation_image, check_matches, read_image
from femoreg_torch.registration.scene import Kind, RigidObject, Scene
from femoreg_torch.registration.silhouette import outline_of
from femoreg_torch.volume import (
    BoneLabels,
    Volume,
    bone_labels,
    check_inside,
    hu_to_attenuation,
    label_box_centre,
    labelled_device,
    read_ct,
    read_labels,
    read_mesh,
    resample_isotropic,
    scanned_device,
    structure_attenuation,
    voxelise_mesh,
)

REGISTRATION_SPACING_MM = 1.0  # the paper resamples the CT to 1 mm (section III-A)
TISSUE_SPACING_MM = 3.0  # soft tissue is smooth
SOFT_HU = 50.0  # what is above is drawn as bone
MODEL_SPACING_MM = 0.5  # a sleeve's wall is thinner than a CT voxel


def prepare_scene(case: Case) -> Scene:
    """Volumes, reference points and images of a case. Raises `InputError` for every input that does not fit."""
    if not case.views:
        raise InputError(f"{case.folder}/case.yaml, views: empty. At least one fluoroscopic image is needed.")
    images, missing = read_images(case)
    from_ct = [thing for thing in case.objects.values() if thing.model is None]
    objects: dict[str, RigidObject] = {}
    tissue = outline = None
    if from_ct:
        ct, bones = read_bones(case)
        check_inside(case.landmarks, ct)
        objects = ct_objects(ct, bones, from_ct, case.anatomy, tuple(images))
        soft = hu_to_attenuation(ct.data.float().clamp_max(SOFT_HU), -1000.0)
        tissue = resample_isotropic(ct.with_data(soft), TISSUE_SPACING_MM)
        outline = outline_of(bones, case.anatomy)
    for thing in case.objects.values():
        if thing.model is not None:
            volume = model_attenuation(thing.model)
            centre = volume.centre() if thing.reference is None else thing.reference
            objects[thing.name] = RigidObject(volume, centre, thing.images or tuple(images), thing.start)
    known = case.views[-1].camera_from_camera1 is not None
    identity = torch.eye(4, dtype=torch.float64)
    cameras = [identity if v.camera_from_camera1 is None else v.camera_from_camera1 for v in case.views]
    return Scene(
        case.carm,
        {name: objects[name] for name in case.objects},
        images,
        tissue=tissue,
        outline=outline,
        camera_from_camera1=torch.stack(cameras) if known else None,
        missing=missing,
    )


def read_bones(case: Case) -> tuple[Volume, BoneLabels]:
    """The CT of a case, HU, and its bones on the same grid. Raises `InputError`."""
    if case.ct_path is None:
        raise InputError(f"{case.folder}/case.yaml, ct.image: missing. Bones are taken from a CT.")
    if case.labels_path is None:
        raise InputError(f"{case.folder}/case.yaml, ct.labels: missing. Give a label map of the bones.")
    ct = read_ct(case.ct_path)
    labels = read_labels(case.labels_path, ct)
    return ct, bone_labels(labels, ct, case.bones, case.anatomy, case.landmarks)


def ct_objects(
    ct: Volume, bones: BoneLabels, things: Sequence[CaseObject], anatomy: Anatomy | None, kinds: tuple[Kind, ...]
) -> dict[str, RigidObject]:
    """Objects that are bones of a CT in HU, with attenuation on voxels of 1 mm; `kinds` are all kinds of images."""
    ids = {thing.name: bones.of(thing.bones, anatomy) for thing in things}
    centres = {
        thing.name: label_box_centre(bones.labels, ids[thing.name]) if thing.reference is None else thing.reference
        for thing in things
    }
    labels = bones.labels
    if max(abs(s - REGISTRATION_SPACING_MM) for s in ct.spacing_mm) > 1e-3:
        labels = resample_isotropic(labels, REGISTRATION_SPACING_MM, nearest=True)
        ct = resample_isotropic(ct, REGISTRATION_SPACING_MM)
    return {
        thing.name: RigidObject(
            structure_attenuation(ct, labels, ids[thing.name], offset_hu=SOFT_HU),
            centres[thing.name],
            thing.images or kinds,
            thing.start,
            anatomy.classes(thing.bones) if anatomy else (),
        )
        for thing in things
    }


def reference_point(case: Case, name: str, bones: BoneLabels | None) -> Tensor:
    """Where the errors of an object are told, (3,) mm in its space."""
    thing = case.objects[name]
    if thing.reference is not None:
        return thing.reference
    if thing.model is not None:
        return model_attenuation(thing.model).centre()
    if bones is None:
        raise InputError(f"{case.folder}: has no label map to find the middle of {name}. Add `ct.labels`.")
    return label_box_centre(bones.labels, bones.of(thing.bones, case.anatomy))


def model_attenuation(model: Model) -> Volume:
    """Attenuation (1/mm) of a model in its own space. Raises `InputError` for a mesh or volume that does not fit."""
    if model.hu is None:
        return scanned_device(model.path)
    if model.labels is not None:
        return labelled_device(model.path, model.labels, model.hu, MODEL_SPACING_MM)
    return voxelise_mesh(read_mesh(model.path), MODEL_SPACING_MM, model.hu)


def read_images(case: Case) -> tuple[dict[Kind, tuple[Tensor, ...]], tuple[str, ...]]:
    """Attenuation images (H, W) of all views by kind, and in words which kinds are left out.

    A kind is taken only if every view has an image of it. Raises `InputError` if a view lacks one of the first kind.
    """
    images: dict[Kind, tuple[Tensor, ...]] = {}
    missing = []
    wanted = dict.fromkeys((*case.kinds, *(kind for thing in case.objects.values() for kind in thing.images or ())))
    for kind in wanted:
        without = [number for number, view in enumerate(case.views, 1) if kind not in view.images]
        if not without:
            images[kind] = tuple(_attenuation(case, i, view, kind) for i, view in enumerate(case.views))
        elif kind == case.kinds[0]:
            raise InputError(f"{case.folder}/case.yaml, views[{without[0] - 1}].{kind}: missing.")
        elif len(without) == len(case.views):
            missing.append(f"there are no {kind} images")
        else:
            views = ", ".join(map(str, without))
            missing.append(
                f"view {views} has no {kind} image, so the {kind} images of the other views were left out too"
            )
    return images, tuple(missing)


def _attenuation(case: Case, index: int, view: View, kind: Kind) -> Tensor:
    path = view.images[kind]
    image = read_image(path)
    check_matches(image, case.carm.camera, f"{case.folder}/case.yaml, views[{index}].{kind}")
    return attenuation_image(image) if view.intensity == "raw" else image
