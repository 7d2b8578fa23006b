"""Names of segments, from files written with the header fields that 3D Slicer's documentation lists."""

from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.parts import read_bones
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, read_label_map, read_labels_told, segment_names
from femoreg_torch.volume.segments import read_segments


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
    "two layers by name": (segment(0, "a", 1) | segment(1, "b", 1, 1), "names 2 layers and holds 1"),
    "no value": ({"Segment0_Name": "a"}, "Segment0_LabelValue: a whole number from 1 was expected, found ''"),
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


def test_overlapping_segments_in_layers_become_one_label_map(tmp_path: Path) -> None:
    """As 3D Slicer stores them: one component for each layer, values that repeat."""
    layers = np.zeros((6, 7, 8, 2), np.uint8)
    layers[1:4, 1:4, 1:4, 0], layers[4:, 4:, 4:, 0] = 1, 2
    layers[3:5, 3:5, 3:5, 1] = 1
    image = sitk.GetImageFromArray(layers, isVector=True)
    image.SetSpacing((0.5, 0.6, 2.0))
    for key, text in (segment(0, "femur_left", 1) | segment(1, "sacrum", 2) | segment(2, "hip_left", 1, 1)).items():
        image.SetMetaData(key, text)
    path = tmp_path / "hip.seg.nrrd"
    sitk.WriteImage(image, str(path), useCompression=True)
    assert segment_names(path) == {"femur_left": (1,), "sacrum": (2,), "hip_left": (3,)}
    expected = layers[..., 0].astype(np.int64)
    expected[(layers[..., 1] == 1) & (expected == 0)] = 3
    found = read_label_map(path)
    assert found.data.tolist() == expected.tolist()
    assert found.spacing_mm == pytest.approx((0.5, 0.6, 2.0))
    _, told = read_segments(path)
    assert told == (
        "1 voxels lie in both femur_left and hip_left and count as the former",
        "1 voxels lie in both sacrum and hip_left and count as the former",
    )


def write_masks(folder: Path, masks: dict[str, np.ndarray], affine: np.ndarray) -> Path:
    """A mask for each bone, as TotalSegmentator writes its folder: uint8, by nibabel."""
    folder.mkdir()
    for name, mask in masks.items():
        nibabel.save(nibabel.Nifti1Image(mask.astype(np.uint8), affine), folder / f"{name}.nii.gz")
    return folder


LAS = np.array([[0.8, 0, 0, -40], [0, 0.9, 0, 13], [0, 0, 2.5, 200], [0, 0, 0, 1]])
RAS = np.diag([-1.0, 1.0, 1.0, 1.0]) @ LAS


@pytest.mark.parametrize("affine", [LAS, RAS], ids=["RAS", "left-handed"])
def test_a_folder_with_a_mask_for_each_bone(tmp_path: Path, affine: np.ndarray) -> None:
    masks = {name: np.zeros((8, 7, 6), bool) for name in ("femur_left", "hip_left", "hip_right", "liver")}
    masks["femur_left"][5:, 1:3, :3], masks["hip_left"][4:6, 2:5, 2:5], masks["liver"][:2] = True, True, True
    folder = write_masks(tmp_path / "segmentations", masks, affine)
    (folder / "._femur_left.nii.gz").write_bytes(b"\0\5\x16\7")  # as macOS leaves them on foreign disks
    (folder / "statistics.json").write_text("{}", encoding="utf-8")
    assert segment_names(folder) == {"femur_left": (1,), "hip_left": (2,), "hip_right": (3,), "liver": (4,)}
    table = read_bones(Fields({"labels": "segmentations"}, str(tmp_path / "case.yaml")), tmp_path, HIP)
    assert table == {"femur_left": (1,), "hip_left": (2,), "hip_right": (3,)}
    ct = Volume(torch.zeros(6, 7, 8), read_label_map(folder).lps_from_index)
    labels, told, _ = read_labels_told(folder, ct, {1, 2, 3})
    counts = torch.bincount(labels.data.flatten()).tolist()
    assert counts[1:] == [18, 17]  # the voxel they share is the femur's; the liver was not read
    assert told == ("1 voxels lie in both femur_left and hip_left and count as the former",)
    x, y, z = (affine @ [7, 1, 0, 1])[:3]  # a corner of the femur, in nibabel's RAS
    index = torch.linalg.solve(ct.lps_from_index, torch.tensor([-x, -y, z, 1], dtype=torch.float64)).round().long()
    assert labels.data[index[2], index[1], index[0]] == 1


def test_the_label_table_in_a_nifti_header_of_totalsegmentator(tmp_path: Path) -> None:
    """Its layout: totalsegmentator/nifti_ext_header.py."""
    values = np.zeros((8, 7, 6), np.uint8)
    values[1:3], values[5:] = 75, 77
    image = nibabel.Nifti1Image(values, RAS)
    named = {75: "femur_left", 77: "hip_left", 5: "liver"}
    labels = "".join(f'<Label Key="{n}" Red="1.0"><![CDATA[{name}]]></Label>\n' for n, name in named.items())
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?> <CaretExtension>  <VolumeInformation Index="0">   <LabelTable>\n'
        f"{labels}\n  </LabelTable>  </VolumeInformation></CaretExtension>\n   "
    )
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, xml.encode()))
    path = tmp_path / "segmentation.nii.gz"
    nibabel.save(image, path)
    assert segment_names(path) == {"femur_left": (75,), "hip_left": (77,), "liver": (5,)}
    table = read_bones(Fields({"labels": path.name}, "case.yaml"), tmp_path, HIP)
    assert table == {"femur_left": (75,), "hip_left": (77,)}
    assert read_label_map(path).data.unique().tolist() == [0, 75, 77]
    image.header.extensions[0] = nibabel.nifti1.Nifti1Extension(0, xml.replace("</Label>", "", 1).encode())
    nibabel.save(image, path)
    with pytest.raises(InputError, match="the label table in its header is damaged"):
        segment_names(path)


def test_folders_that_are_no_masks_are_told(tmp_path: Path) -> None:
    masks = {"hip_left": np.ones((4, 4, 4)), "hip_right": np.arange(64).reshape(4, 4, 4)}
    folder = write_masks(tmp_path / "values", masks, RAS)
    with pytest.raises(InputError, match=r"hip_right\.nii\.gz: a mask of zeros and ones was expected, found 64 values"):
        read_label_map(folder)
    folder = write_masks(tmp_path / "grids", {"a": np.ones((4, 4, 4)), "b": np.ones((4, 4, 5))}, RAS)
    with pytest.raises(InputError, match="lies on another grid than the other masks"):
        read_label_map(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds neither masks nor a DICOM segmentation"):
        read_label_map(tmp_path / "empty")


def test_files_that_are_missing_or_something_else(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        segment_names(tmp_path / "none.seg.nrrd")
    (tmp_path / "text.seg.nrrd").write_text("not an image", encoding="utf-8")
    with pytest.raises(InputError, match="no NRRD file"):
        segment_names(tmp_path / "text.seg.nrrd")
