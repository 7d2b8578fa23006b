"""CT, label map, landmarks and side of a new case."""

from pathlib import Path
from typing import cast

from torch import Tensor

from femoreg_torch.anatomy import HIP, LabelTable, label_table, label_table_names
from femoreg_torch.case.femoroplasty import operated_femur
from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.intake.given import copied
from femoreg_torch.segment import load_bone_network, propose_landmarks, segment_bones
from femoreg_torch.volume import Volume, bone_labels, read_labels_told, write_volume
from femoreg_torch.volume.bones import nearest_label

_COPIED = (".nii", ".nii.gz", ".nrrd", ".mha")  # volumes of one file, which are taken as they are


def segmented_labels(folder: Path, ct: Volume, notes: list[str]) -> tuple[str, Volume]:
    """The name of the label map of the bones that the network finds in the CT, and the map."""
    found = segment_bones(ct, load_bone_network())
    write_volume(folder / "labels.nii.gz", found.labels)
    sure = ", ".join(f"{bone} {share:.2f}" for bone, share in found.confidence.items())
    notes.append(f"the bones were found in the CT by the shipped network (mean probability: {sure}): look at them")
    notes += found.warnings
    return "labels.nii.gz", found.labels


def proposed_landmarks(labels: Volume, ct: Volume, bones: LabelTable, notes: list[str]) -> dict[str, Tensor]:
    """Landmarks by the rules of `femoreg landmarks`."""
    found = propose_landmarks(ct, bone_labels(labels, ct, bones, HIP, {}))
    errors = ", ".join(f"{name} {error:.1f}" for name, error in found.expected_error_mm.items())
    notes.append(
        f"the landmarks are proposals by rules, with errors to expect of (mm) {errors}: correct landmarks.json"
    )
    notes += [f"no {name}: {why}" for name, why in found.left_out.items()]
    notes += found.warnings
    return found.points


def placed_ct(folder: Path, path: Path, ct: Volume) -> str:
    """The name of the CT in `folder`: its file as it is, or, of DICOM slices, the volume."""
    if path.is_file() and path.name.lower().endswith(_COPIED):
        return copied(path, folder, "ct")
    write_volume(folder / "ct.nii.gz", ct)
    return "ct.nii.gz"


def told_bones(bones: LabelTable) -> str | dict[str, list[int]]:
    """The name of a shipped label table, or what the table says."""
    for name in label_table_names():
        if label_table(name) == bones:
            return name
    return {bone: list(ids) for bone, ids in bones.items()}


def placed_labels(folder: Path, path: Path, ct: Volume, bones: LabelTable, notes: list[str]) -> tuple[str, Volume]:
    """The name of the label map in `folder`, and the map on the grid of the CT."""
    ids = {n for of_bone in bones.values() for n in of_bone}
    labels, done, against = read_labels_told(path, ct, ids)
    if path.is_file() and path.name.lower().endswith(_COPIED):
        return copied(path, folder, "labels"), labels  # what was done is done again, and told, whenever it is read
    notes += [*done, *against]
    write_volume(folder / "labels.nii.gz", labels)
    return "labels.nii.gz", labels


def operated_side(
    labels: Volume,
    ct: Volume,
    bones: LabelTable,
    landmarks: dict[str, Tensor],
    entry_point: Tensor,
    doubts: list[str],
    notes: list[str],
) -> Side:
    """The side whose femur the entry point lies on. Raises `InputError` if it lies on none, with `doubts` of the CT."""
    found = bone_labels(labels, ct, bones, HIP, landmarks)
    sides = {found.ids[operated_femur(side)]: side for side in ("left", "right") if operated_femur(side) in found.ids}
    label = nearest_label(found.labels, list(sides), entry_point) if sides else None
    if label is None:
        where = ", ".join(f"{v:.1f}" for v in entry_point.tolist())
        raise InputError(
            f"--side: is missing, and the entry point ({where}) mm LPS lies on no femur of the label map. Give the "
            "side, and check the plan's coordinate system (RAS or LPS)."
            + "".join(f" Of the CT, {doubt}." for doubt in doubts)
        )
    notes.append(f"the operated side is the {sides[label]} one, as the entry point lies on its femur")
    return cast(Side, sides[label])
