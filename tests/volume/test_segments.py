"""Names of segments, from files written with the header fields that 3D Slicer's documentation lists."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from femoreg_torch.errors import InputError
from femoreg_torch.volume import read_label_map, segment_names


def write_segmentation(path: Path, fields: dict[str, str], layers: int = 1) -> Path:
    """Two boxes, of values 1 and 300, with these custom fields."""
    data = np.zeros((6, 7, 8), np.uint16)
    data[1:3, 1:3, 1:3], data[4:, 4:, 4:] = 1, 300
    image = sitk.GetImageFromArray(data)
    if layers > 1:
        image = sitk.Compose([image] * layers)
    for key, value in fields.items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(path), useCompression=True)
    return path


def segment(number: int, name: str, value: int, layer: int = 0) -> dict[str, str]:
    fields = {"ID": f"Segment_{number + 1}", "Name": name, "LabelValue": str(value), "Layer": str(layer)}
    return {f"Segment{number}_{key}": text for key, text in fields.items()}


def test_names_and_values_of_a_segmentation(tmp_path: Path) -> None:
    fields = segment(0, "Left femur", 1) | segment(1, "hip_right", 300) | segment(10, "Left femur", 7)
    fields["Segmentation_MasterRepresentation"] = "Binary labelmap"
    path = write_segmentation(tmp_path / "hip.seg.nrrd", fields)
    assert segment_names(path) == {"Left femur": (1, 7), "hip_right": (300,)}
    assert read_label_map(path).data.unique().tolist() == [0, 1, 300]


BAD = {
    "a label map": ({}, "names no segments"),
    "two layers by name": (segment(0, "a", 1) | segment(1, "b", 1, 1), r"lie in 2 layers.* `Collapse labelmap layers`"),
    "no value": ({"Segment0_Name": "a"}, "Segment0_LabelValue: a whole number above 0 was expected, found ''"),
    "background": (segment(0, "a", 0), "found '0'"),
    "one value twice": (segment(0, "a", 4) | segment(1, "b", 4), "label value 4 belongs to two segments"),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_is_no_segmentation_in_one_layer_is_told(tmp_path: Path, kind: str) -> None:
    fields, message = BAD[kind]
    path = write_segmentation(tmp_path / "hip.seg.nrrd", fields)
    with pytest.raises(InputError, match=message) as raised:
        segment_names(path)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_layers_in_the_data_are_told(tmp_path: Path) -> None:
    path = write_segmentation(tmp_path / "hip.seg.nrrd", segment(0, "a", 1), layers=3)
    with pytest.raises(InputError, match="lie in 3 layers, one was expected"):
        segment_names(path)


def test_files_that_are_missing_or_something_else(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        segment_names(tmp_path / "none.seg.nrrd")
    (tmp_path / "text.seg.nrrd").write_text("not an image")
    with pytest.raises(InputError, match="cannot be read; a segmentation of 3D Slicer"):
        segment_names(tmp_path / "text.seg.nrrd")
