"""A patient on disk: a case folder, or a folder with ct.nii.gz, labels.nii.gz and landmarks.json alone.

What a case.yaml says counts: its CT, its label map or segmentation, and which ids are which bones. Without one the ids
must be those of the table `femoreg`.
"""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, LabelTable, label_table
from femoreg_torch.case import case_folder, read_case
from femoreg_torch.case.reading import read_fields
from femoreg_torch.errors import InputError
from femoreg_torch.paths import check_readable
from femoreg_torch.volume import (
    BoneLabels,
    Volume,
    bone_labels,
    looked_up,
    merged_bones,
    read_ct_told,
    read_labels_told,
    read_landmarks,
    swapped_sides,
)

_CASE = "case.yaml"
_TABLE = "femoreg"
_OTHER = 255  # in `hip_labels`: what is bone, and none of the anatomy's
_NEEDED = tuple(bone for bone in HIP.bone_names if HIP.landmarks_of(bone))  # landmarks lie on them
_MOST_TOLD = 12  # ids in a message


@dataclass(frozen=True, eq=False)
class PatientFiles:
    """Where a patient's files are, and which ids of the label map are which bones. No volume is opened yet."""

    folder: Path
    ct: Path  # a file, or a folder of DICOM
    labels: Path  # a label map, or a segmentation whose parts have names, which may be a folder
    landmarks_file: Path
    landmarks: dict[str, Tensor]  # (3,) LPS mm, all of the hip's
    table: LabelTable  # ids by bone
    in_case: bool  # whether a case.yaml says all this

    def fingerprint(self) -> str:
        """What changes when CT, labels, landmarks or table do: of name, size and time of change of every file."""
        files = [file for path in (self.ct, self.labels, self.landmarks_file) for file in _files(path)]
        found = [(file.name, file.stat()) for file in files]
        stamps = [(name, status.st_size, status.st_mtime_ns) for name, status in found]
        return hashlib.blake2b(json.dumps([stamps, self.table]).encode(), digest_size=16).hexdigest()


@dataclass(frozen=True, eq=False)
class ScannedPatient:
    """A patient's CT with its bones and landmarks."""

    ct: Volume  # HU
    bones: BoneLabels  # on the same grid
    landmarks: dict[str, Tensor]  # (3,) LPS mm, all of the hip's


def find_patient(folder: Path) -> PatientFiles:
    """The files of the patient in a folder, or of its `case.yaml`. Raises `InputError` if something is missing."""
    folder = case_folder(folder)
    in_case = (folder / _CASE).exists()
    files = _files_of_case(folder) if in_case else _files_by_name(folder)
    if missing := [name for name in HIP.landmark_names if name not in files.landmarks]:
        raise InputError(
            f"{files.landmarks_file}: all {len(HIP.landmarks)} landmarks are needed to label images; it lacks "
            f"{', '.join(missing)}. Place them too, in 3D Slicer for instance."
        )
    return files


def _files_by_name(folder: Path) -> PatientFiles:
    ct, labels, landmarks = (folder / name for name in ("ct.nii.gz", "labels.nii.gz", "landmarks.json"))
    for path in (ct, labels, landmarks):
        check_readable(
            path,
            f"A case folder (with {_CASE}) was expected, or one with ct.nii.gz, labels.nii.gz and landmarks.json.",
        )
    return PatientFiles(folder, ct, labels, landmarks, read_landmarks(landmarks), label_table(_TABLE), in_case=False)


def _files_of_case(folder: Path) -> PatientFiles:
    case, top = read_case(folder), read_fields(folder)
    if case.ct_path is None:
        raise InputError(f"{folder / _CASE}, ct.image: missing. Images are made of a CT.")
    if case.labels_path is None:
        raise InputError(
            f"{folder / _CASE}, ct.labels: missing. Give a label map of the bones; `femoreg segment` makes one."
        )
    landmarks = top.file_path("landmarks", folder)
    return PatientFiles(folder, case.ct_path, case.labels_path, landmarks, case.landmarks, case.bones, in_case=True)


def read_patient(files: PatientFiles) -> ScannedPatient:
    """The CT of a patient and its bones.

    Raises `InputError` for files that cannot be read, for ids that are not those of the table, for a label map without
    a bone that landmarks lie on, and where label map and landmarks contradict one another.
    """
    ct, told_of_ct = read_ct_told(files.ct)
    asked = {n for ids in files.table.values() for n in ids} if files.in_case else None
    labels, done, against = read_labels_told(files.labels, ct, asked)
    found = [n for n in torch.bincount(labels.data.flatten()).nonzero()[:, 0].tolist() if n]
    if not files.in_case:
        _check_ids(files, found)
    try:
        bones = bone_labels(labels, ct, files.table, HIP, files.landmarks)
    except InputError as error:
        raise InputError(f"{files.labels}: {error}") from error
    if lacking := [bone for bone in _NEEDED if bone not in bones.ids]:
        raise InputError(
            f"{files.labels}: no voxel is told to be {', '.join(lacking)}. It holds the ids {_told(found)}; "
            f"{_expected(files)}."
        )
    if wrong := swapped_sides(bones, files.landmarks, HIP) or merged_bones(bones, files.landmarks, HIP):
        raise InputError(f"{files.folder}: {'; '.join(wrong)}.")
    notes = (*told_of_ct, *done, *against, *_without_name(bones))
    return ScannedPatient(ct, replace(bones, notes=notes), files.landmarks)


def hip_labels(bones: BoneLabels) -> Volume:
    """A label map with the ids of the table `femoreg`, whatever ids the user's map has.

    Other bones get an id that this table does not have, so that no bone's rim grows into them.
    """
    ids = label_table(_TABLE)
    lookup = torch.full((256,), _OTHER, dtype=torch.uint8)
    lookup[0] = 0
    for bone, number in bones.ids.items():
        if bone in ids:
            lookup[number] = ids[bone][0]
    return bones.labels.with_data(torch.from_numpy(looked_up(lookup.numpy(), bones.labels.data.numpy())))


def _check_ids(files: PatientFiles, found: list[int]) -> None:
    """Raises `InputError` for ids in a label map without case.yaml that the table `femoreg` does not have."""
    known = {n for ids in files.table.values() for n in ids}
    if unknown := [n for n in found if n not in known]:
        raise InputError(
            f"{files.labels}: holds the ids {_told(found)}, and no bones are known for {_told(unknown)}; "
            f"{_expected(files)}."
        )


def _expected(files: PatientFiles) -> str:
    table = ", ".join(f"{bone} {_told(ids)}" for bone, ids in files.table.items())
    if files.in_case:
        return f"by {files.folder / _CASE} they are {table}. Correct `ct.bones` there, or the names of segments"
    return (
        f"without a {_CASE} they must be {table}. Make a case of the folder with `femoreg new-case`, which takes other "
        "tables, or renumber the map"
    )


def _without_name(bones: BoneLabels) -> tuple[str, ...]:
    """In words, that a label map holds what is as dense as bone and none of the hip's bones."""
    if not (hip_labels(bones).data == _OTHER).any():
        return ()
    return (
        f"the label map holds bone that is none of {', '.join(HIP.bone_names)} by its table: in labelled images it is "
        "background",
    )


def _told(ids: Iterable[int]) -> str:
    every = list(map(str, ids))
    return ", ".join(every if len(every) <= _MOST_TOLD else [*every[:_MOST_TOLD], "…"]) or "none"


def _files(path: Path) -> list[Path]:
    """A file, or all files in a folder, in order."""
    return sorted(file for file in path.rglob("*") if file.is_file()) if path.is_dir() else [path]
