"""Which ids of a user's label map are which bones: by a table's name, or by the names of its parts."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch

from femoreg_torch.anatomy import HIP, LabelTable, bone_of_name, fitting_tables, label_table, label_table_names
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.intake.check_anatomy import some_of
from femoreg_torch.volume import has_names, read_label_map, segment_names

_NEEDED = {"hip bone": ("hip_left", "hip_right", "pelvis"), "femur": ("femur_left", "femur_right")}


def table_of_map(labels: Path, bones: str | None, usual: str | None = None) -> tuple[LabelTable, list[str]]:
    """The ids of each bone in a label map, by the table `bones` or else by the names of its parts; and notes on it.

    A map without names, of which no table is named, is taken for one by the `usual` table if it holds no other ids.
    Raises `InputError` where nothing says it.
    """
    if bones is not None:
        return label_table(bones), []
    if has_names(labels):
        return _by_names(labels)
    if (own := _told_beside(labels)) is not None:
        return label_table(own), []
    there = [n for n in torch.unique(read_label_map(labels).data).tolist() if n]
    if usual is not None and set(there) <= {n for ids in label_table(usual).values() for n in ids}:
        return label_table(usual), []
    fitting = fitting_tables(there)
    hint = (
        f"hip bones and femora of {' and of '.join(fitting)} are there" if fitting else "no shipped table fits its ids"
    )
    raise InputError(
        f"--bones: is missing, and {labels.name} does not name its bones. Say which table its ids are of: "
        f"{', '.join(label_table_names())}, or a YAML file ({hint})."
    )


def _told_beside(labels: Path) -> str | None:
    """The table that `femoreg segment` names in the JSON file beside its map; None where none is of this map."""
    beside = labels.with_name(re.sub(r"\.nii(\.gz)?$|\.nrrd$|\.mha$", "", labels.name, flags=re.IGNORECASE) + ".json")
    if labels.is_dir() or not beside.is_file():
        return None
    content = read_json(beside)
    return str(content["table"]) if content.get("labels") == labels.name and "table" in content else None


def _by_names(labels: Path) -> tuple[LabelTable, list[str]]:
    names = segment_names(labels)
    table: LabelTable = {}
    for text, ids in names.items():
        if bone := bone_of_name(HIP, text):
            table[bone] = (*table.get(bone, ()), *ids)
    others = [text for text in names if bone_of_name(HIP, text) is None]
    if others and (lacking := _lacking(table)):
        raise InputError(
            f"{labels}: none of its parts is named after a {' or a '.join(lacking)}; those taken for no bone are: "
            f"{some_of(others)[:200]}. Name them {', '.join(HIP.bone_names)}."
        )
    return table, [f"parts of {labels.name} that are taken for no bone: {some_of(others)}"] if others else []


def _lacking(table: LabelTable) -> Sequence[str]:
    return [kind for kind, bones in _NEEDED.items() if not set(bones) & set(table)]
