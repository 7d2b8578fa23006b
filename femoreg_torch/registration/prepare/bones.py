"""CT and label map of a case, and the objects that are bones of it."""

from collections.abc import Sequence
from dataclasses import replace

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.case import Case, CaseObject
from femoreg_torch.errors import InputError
from femoreg_torch.registration.scene import Kind, RigidObject
from femoreg_torch.volume import (
    BoneLabels,
    Volume,
    bone_labels,
    label_box_centre,
    read_ct_told,
    read_labels_told,
    resample_isotropic,
    structure_attenuation,
)

REGISTRATION_SPACING_MM = 1.0  # the paper resamples the CT to 1 mm (section III-A)
SOFT_HU = 50.0  # what is above is drawn as bone


def read_bones(case: Case) -> tuple[Volume, BoneLabels]:
    """The CT of a case, HU, and its bones on the same grid. Raises `InputError`."""
    if case.ct_path is None:
        raise InputError(f"{case.folder}/case.yaml, ct.image: missing. Bones are taken from a CT.")
    if case.labels_path is None:
        raise InputError(
            f"{case.folder}/case.yaml, ct.labels: missing. Give a label map of the bones; "
            "`femoreg segment` makes one of the CT, `femoreg new-case --segment` the whole case."
        )
    ct, told = read_ct_told(case.ct_path)
    labels, done, against = read_labels_told(case.labels_path, ct, {n for ids in case.bones.values() for n in ids})
    bones = bone_labels(labels, ct, case.bones, case.anatomy, case.landmarks)
    return ct, replace(bones, notes=(*told, *done), against=against)


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
