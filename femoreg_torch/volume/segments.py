"""Names of the segments in a `.seg.nrrd` file of 3D Slicer.

Slicer keeps them in custom fields of the header, `Segment0_Name`, `Segment0_LabelValue`, `Segment0_Layer`, …: 3D Slicer
documentation, developer guide, Segmentations, "Segmentation labelmap file format".
"""

import re
from pathlib import Path

import SimpleITK as sitk

from femoreg_torch.arrays import quiet
from femoreg_torch.errors import InputError, shortened

_NAME = re.compile(r"Segment(\d+)_Name")


def segment_names(path: Path) -> dict[str, tuple[int, ...]]:
    """Label values of each segment by its name; several if several segments have that name.

    Raises `InputError` if the file is no segmentation of 3D Slicer, or if its segments lie in several layers, that is
    overlap: a label map has one value per voxel.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    reader = sitk.ImageFileReader()
    reader.SetFileName(str(path))
    try:
        with quiet():
            reader.ReadImageInformation()
            fields = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys()}
    except (RuntimeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read; a segmentation of 3D Slicer (.seg.nrrd) was expected.") from error
    numbers = sorted(int(match[1]) for match in map(_NAME.fullmatch, fields) if match)
    if not numbers:
        raise InputError(
            f"{path}: names no segments. In 3D Slicer, save the segmentation itself (.seg.nrrd), not a label map of it."
        )
    layers = {fields.get(f"Segment{n}_Layer", "0") for n in numbers}
    if len(layers) > 1 or reader.GetNumberOfComponents() > 1:
        raise InputError(
            f"{path}: its segments lie in {max(len(layers), reader.GetNumberOfComponents())} layers, one was expected. "
            "In 3D Slicer, module Segmentations, Binary labelmap layers: tick `Force collapse to single layer`, press "
            "`Collapse labelmap layers`, and save again."
        )
    found: dict[str, tuple[int, ...]] = {}
    for n in numbers:
        name = fields[f"Segment{n}_Name"]
        found[name] = (*found.get(name, ()), _label_value(fields, n, path))
    values = [value for ids in found.values() for value in ids]
    if twice := [value for value in values if values.count(value) > 1]:
        raise InputError(f"{path}: label value {twice[0]} belongs to two segments. Save it anew with 3D Slicer.")
    return found


def _label_value(fields: dict[str, str], number: int, path: Path) -> int:
    text = fields.get(f"Segment{number}_LabelValue", "")
    if not (text.strip().isdecimal() and len(text.strip()) < 10 and int(text) > 0):
        raise InputError(
            f"{path}, Segment{number}_LabelValue: a whole number above 0 was expected, found {shortened(text, 20)}. "
            "Save it anew with 3D Slicer 4.11 or later."
        )
    return int(text)
