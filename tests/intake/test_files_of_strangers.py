"""Files as other programs write them, unusual and legal: right, or refused in one line that says what mends it."""

import json
from pathlib import Path

import cv2
import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
import torch
from intake_files import SIZE, bones, hu, label_values, landmarks, markups, ras_affine
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import CTImageStorage, EnhancedCTImageStorage, ExplicitVRLittleEndian, RLELossless, generate_uid

from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.intake import inspect_path
from femoreg_torch.volume import Volume, read_ct, read_ct_told, read_label_map, read_labels, read_landmarks

ROWS_FIRST = np.ascontiguousarray(hu().transpose(2, 1, 0))  # (slices, rows, columns): 60 × 52 × 80
SPACING = 4.0


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Volume:
    path = tmp_path_factory.mktemp("plain") / "ct.nii.gz"
    nibabel.save(nibabel.Nifti1Image(hu(), ras_affine()), path)
    return read_ct(path)


def same(found: Volume, plain: Volume) -> None:
    assert torch.equal(found.data, plain.data)
    torch.testing.assert_close(found.lps_from_index, plain.lps_from_index, atol=1e-4, rtol=0)


def header(kind: str) -> Dataset:
    meta = FileMetaDataset()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = Dataset()
    data.file_meta = meta
    data.SOPClassUID = meta.MediaStorageSOPClassUID = kind
    data.SOPInstanceUID = meta.MediaStorageSOPInstanceUID = generate_uid()
    data.StudyInstanceUID, data.PatientID, data.Modality = "1.2", "p", "CT"
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.Rows, data.Columns = ROWS_FIRST.shape[1:]
    return data


def place(k: int) -> list[float]:
    return [-158.0, -102.0, -118.0 + SPACING * k]


@pytest.mark.parametrize("kind", ["signed, 12 bits", "floats in the rescale", "padded", "RLE"])
def test_a_ct_written_from_scratch(tmp_path: Path, plain: Volume, kind: str) -> None:
    """Signed pixels of 12 bits; a rescale that is no whole number; a padding value; as `inspect` and the reader see."""
    series = generate_uid()
    (tmp_path / "ct").mkdir()
    for k, plane in enumerate(ROWS_FIRST):
        data = header(CTImageStorage)
        data.SeriesInstanceUID, data.InstanceNumber = series, k + 1
        data.PixelSpacing, data.ImageOrientationPatient = [SPACING, SPACING], [1, 0, 0, 0, 1, 0]
        data.ImagePositionPatient = place(k)
        data.BitsAllocated, data.BitsStored, data.HighBit = 16, 12, 11
        data.PixelRepresentation = int(kind.startswith("signed"))
        stored, data.RescaleSlope, data.RescaleIntercept = plane + 1024, 1, -1024
        if kind.startswith("signed"):
            stored, data.RescaleIntercept = plane, 0
        elif kind.startswith("floats"):
            stored, data.RescaleSlope, data.RescaleIntercept = (plane + 1000) // 5 * 4, "1.25", "-1000.0"
        elif kind == "padded":
            data.add_new("PixelPaddingValue", "US", 24)
        data.PixelData = stored.astype("<i2").tobytes()
        if kind == "RLE":
            data.compress(RLELossless)
        data.save_as(tmp_path / "ct" / f"{k:03d}.dcm", enforce_file_format=True)
    same(read_ct(tmp_path / "ct"), plain)
    found = inspect_path(tmp_path / "ct")
    assert any("80 × 52 × 60 voxels of 4 × 4 × 4 mm" in fact for fact in found.facts), found.facts


@pytest.mark.parametrize("mapped", [False, True])
def test_an_enhanced_ct_written_from_scratch(tmp_path: Path, plain: Volume, mapped: bool) -> None:
    """Frames in no order, their places in the groups of each frame; mapped: to iodine too, which is no HU."""
    data = header(EnhancedCTImageStorage)
    data.SeriesInstanceUID, data.InstanceNumber, data.ContentDate, data.ContentTime = (
        generate_uid(),
        1,
        "20200101",
        "120000",
    )
    data.FrameOfReferenceUID = generate_uid()
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    data.ImageType = ["ORIGINAL", "PRIMARY", "VOLUME", "NONE"]
    data.NumberOfFrames = len(ROWS_FIRST)
    order = np.random.default_rng(0).permutation(len(ROWS_FIRST))
    shared, measures, axes, rescale = Dataset(), Dataset(), Dataset(), Dataset()
    measures.PixelSpacing, measures.SliceThickness = [SPACING, SPACING], SPACING
    axes.ImageOrientationPatient = [1, 0, 0, 0, 1, 0]
    rescale.RescaleSlope, rescale.RescaleIntercept, rescale.RescaleType = 1, -1024, "HU"
    shared.PixelMeasuresSequence, shared.PlaneOrientationSequence = [measures], [axes]
    shared.PixelValueTransformationSequence = [rescale]
    if mapped:
        mapping, unit = Dataset(), Dataset()
        unit.CodeValue, unit.CodingSchemeDesignator, unit.CodeMeaning = "mg/cm3", "UCUM", "mg/cm3"
        mapping.MeasurementUnitsCodeSequence, mapping.LUTLabel, mapping.LUTExplanation = [unit], "I", "iodine"
        mapping.RealWorldValueFirstValueMapped, mapping.RealWorldValueLastValueMapped = 0, 4095
        mapping.RealWorldValueIntercept, mapping.RealWorldValueSlope = -500.0, 0.5
        shared.RealWorldValueMappingSequence = [mapping]
    data.SharedFunctionalGroupsSequence = [shared]
    frames = []
    for n, k in enumerate(order.tolist()):
        frame, content, position = Dataset(), Dataset(), Dataset()
        position.ImagePositionPatient = place(k)
        content.DimensionIndexValues, content.InStackPositionNumber, content.StackID = [n + 1], n + 1, "1"
        frame.PlanePositionSequence, frame.FrameContentSequence = [position], [content]
        frames.append(frame)
    data.PerFrameFunctionalGroupsSequence = frames
    data.PixelData = (ROWS_FIRST[order] + 1024).astype("<u2").tobytes()
    path = tmp_path / "enhanced"
    data.save_as(path, enforce_file_format=True)
    same(read_ct(path), plain)


@pytest.mark.parametrize("kind", ["other axes", "4-D", "sform and qform", "int64 metres"])
def test_volumes_of_other_programs(tmp_path: Path, plain: Volume, kind: str) -> None:
    path = tmp_path / ("ct.nrrd" if kind == "other axes" else "ct.nii.gz")
    if kind == "other axes":
        stored = sitk.GetImageFromArray(ROWS_FIRST)
        stored.SetSpacing([SPACING] * 3)
        stored.SetOrigin(place(0))
        sitk.WriteImage(sitk.DICOMOrient(stored, "ASR"), str(path), useCompression=True)
    elif kind == "4-D":
        nibabel.save(nibabel.Nifti1Image(hu()[..., None], ras_affine()), path)
    elif kind == "int64 metres":
        scaled = np.diag([1e-3, 1e-3, 1e-3, 1]) @ ras_affine()
        image = nibabel.Nifti1Image(hu().astype(np.int64), scaled, dtype=np.int64)
        image.header.set_xyzt_units("meter")
        nibabel.save(image, path)
    else:
        image = nibabel.Nifti1Image(hu(), ras_affine())
        moved = ras_affine()
        moved[2, 3] += 30
        image.set_qform(moved, 1)
        image.set_sform(ras_affine(), 2)
        nibabel.save(image, path)
    if kind == "sform and qform":
        with pytest.raises(InputError, match=r"sform and qform of its header disagree by up to 30\.0 mm"):
            read_ct_told(path)
        return
    same(read_ct_told(path)[0], plain)


def test_runs_in_time_and_headers_without_a_space(tmp_path: Path) -> None:
    run = nibabel.Nifti1Image(np.stack([hu(), hu()], -1), ras_affine())
    nibabel.save(run, tmp_path / "run.nii.gz")
    with pytest.raises(InputError, match=r"run\.nii\.gz: a 3-D volume .*80 × 52 × 60 × 2 .*Save one volume of it"):
        read_ct(tmp_path / "run.nii.gz")
    bare = f"NRRD0004\ntype: short\ndimension: 3\nsizes: {' '.join(map(str, SIZE))}\nendian: little\nencoding: raw\n"
    axes = "space dimension: 3\nspace directions: (4,0,0) (0,4,0) (0,0,4)\n"
    content = ROWS_FIRST.astype("<i2").tobytes()
    (tmp_path / "bare.nrrd").write_bytes((bare + axes + "\n").encode() + content)
    assert any("names no `space`" in one for one in inspect_path(tmp_path / "bare.nrrd").warnings)
    assert any(one.startswith("bare.nrrd: CT, ") and " warning" in one for one in inspect_path(tmp_path).facts)
    said = axes.replace("space dimension: 3", "space: left-posterior-superior")
    (tmp_path / "said.nrrd").write_bytes((bare + said + "\n").encode() + content)
    assert not any("space" in one for one in inspect_path(tmp_path / "said.nrrd").warnings)
    loud = axes.replace("space dimension: 3", "Space: Scanner-XYZ")
    (tmp_path / "loud.nrrd").write_bytes((bare + loud + "\n").encode() + content)
    assert any("`space` Scanner-XYZ, which says" in one for one in inspect_path(tmp_path / "loud.nrrd").warnings)


@pytest.mark.parametrize("name", ["ct.nii", "ct.hdr"])
def test_nifti_files_and_pairs_without_a_place_are_told(tmp_path: Path, name: str) -> None:
    kind = nibabel.Nifti1Image if name.endswith(".nii") else nibabel.Nifti1Pair
    image = kind(hu(), ras_affine())
    image.set_sform(ras_affine(), 0)
    image.set_qform(ras_affine(), 0)
    nibabel.save(image, tmp_path / name)
    assert any("neither sform nor qform" in one for one in inspect_path(tmp_path / name).warnings)


@pytest.mark.parametrize(
    ("lines", "told"),
    [
        ("", "has no `TransformMatrix`: its axes are assumed to run to the left, back and head"),
        ("AnatomicalOrientation = LPI\n", "and its AnatomicalOrientation, LPI, is passed over"),
        ("AnatomicalOrientation = RAI\n", None),
        ("TransformMatrix = 1 0 0 0 1 0 0 0 1\n", None),
    ],
)
def test_a_meta_image_without_a_matrix_is_told(tmp_path: Path, lines: str, told: str | None) -> None:
    size = " ".join(map(str, SIZE))
    header = f"ObjectType = Image\nNDims = 3\nBinaryData = True\n{lines}ElementSpacing = 4 4 4\nDimSize = {size}\n"
    content = ROWS_FIRST.astype("<i2").tobytes()
    (tmp_path / "ct.mha").write_bytes(
        (header + "ElementType = MET_SHORT\nElementDataFile = LOCAL\n").encode() + content
    )
    warnings = [one for one in inspect_path(tmp_path / "ct.mha").warnings if "MetaImage" in one]
    assert len(warnings) == (told is not None)
    assert told is None or told in warnings[0]


@pytest.mark.parametrize("name", ["view.mha", "view.nrrd", "view.nii.gz"])
def test_images_of_one_slice_are_inspected_as_images(tmp_path: Path, name: str) -> None:
    values = np.random.default_rng(0).integers(100, 9000, (1, 30, 40)).astype(np.uint16)
    sitk.WriteImage(sitk.GetImageFromArray(values), str(tmp_path / name))
    found = inspect_path(tmp_path / name)
    assert found.kind == "image"
    assert found.facts[0].startswith("40 × 30 pixels")


def test_label_maps_of_floats_and_with_names_in_the_header(tmp_path: Path, plain: Volume) -> None:
    values = label_values()
    expected = torch.from_numpy(np.ascontiguousarray(values.transpose(2, 1, 0)))
    image = nibabel.Nifti1Image(values.astype(np.float64), ras_affine())
    nibabel.save(image, tmp_path / "floats.nii.gz")
    assert torch.equal(read_labels(tmp_path / "floats.nii.gz", plain).data, expected)
    names = dict(enumerate(bones(), 1))
    table = "".join(f'<Label Key="{n}" Red="1">{name}</Label>' for n, name in names.items())
    multi = np.zeros(SIZE, np.float32)
    for n, name in names.items():
        multi[bones()[name]] = n
    image = nibabel.Nifti1Image(multi, ras_affine())
    text = f"<CaretExtension><VolumeInformation><LabelTable>{table}</LabelTable></VolumeInformation></CaretExtension>"
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension(0, text.encode()))
    nibabel.save(image, tmp_path / "total.nii.gz")
    assert torch.equal(
        read_label_map(tmp_path / "total.nii.gz").data, torch.from_numpy(multi.transpose(2, 1, 0).copy()).byte()
    )
    assert any("femur_left" in fact for fact in inspect_path(tmp_path / "total.nii.gz").facts)
    nibabel.save(nibabel.Nifti1Image(values * 0.5, ras_affine()), tmp_path / "halves.nii.gz")
    with pytest.raises(InputError, match=r"whole numbers .* Export the segmentation as a label map"):
        read_label_map(tmp_path / "halves.nii.gz")


@pytest.mark.parametrize(("system", "space"), [("0", "RAS"), (0, "RAS"), (1, "LPS"), ("1", "LPS")])
def test_markups_of_3d_slicer_with_numbers_for_the_space(tmp_path: Path, system: object, space: str) -> None:
    content = json.loads(markups(landmarks(), space))
    content["@schema"] = "https://raw.githubusercontent.com/slicer/slicer/master/markups-schema-v1.0.3.json#"
    markup = content["markups"][0] | {"coordinateSystem": system, "coordinateUnits": "mm", "locked": False}
    markup["measurements"] = [{"name": "length", "enabled": False, "units": "mm", "printFormat": "%-#4.4g%s"}]
    for n, point in enumerate(markup["controlPoints"]):
        point |= {"associatedNodeID": "", "orientation": [-1.0, 0, 0, 0, -1, 0, 0, 0, 1], "selected": n > 2}
    unplaced = {"id": "20", "label": "GSN-l", "position": [None] * 3, "positionStatus": "undefined"}
    markup["controlPoints"].append(unplaced)
    (tmp_path / "f.mrk.json").write_text(json.dumps(content | {"markups": [markup]}), encoding="utf-8")
    found = read_landmarks(tmp_path / "f.mrk.json")
    assert {name: tuple(point.tolist()) for name, point in found.items()} == landmarks()
    del markup["coordinateSystem"]
    (tmp_path / "f.mrk.json").write_text(json.dumps(content | {"markups": [markup]}), encoding="utf-8")
    with pytest.raises(InputError, match=r"does not say it\. Write `.coordinateSystem.: .LPS.`"):
        read_landmarks(tmp_path / "f.mrk.json")


def test_a_picture_does_not_take_the_place_of_what_it_is_made_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = np.random.default_rng(0).integers(0, 4000, (20, 20), dtype=np.uint16)
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "case.yaml").write_text("views: [{anatomy: view1.png}]\n", encoding="utf-8")
    for path in (tmp_path / "a.png", tmp_path / "case" / "view1.png"):
        cv2.imwrite(str(path), image)
        before = path.read_bytes()
        command = ["inspect", str(path)] if path.name == "a.png" else ["check", str(path.parent)]
        assert main([*command, "--out", str(path)]) == 2
        told = capsys.readouterr().err
        assert "is what the picture is made of" in told
        assert told.count("\n") == 1
        assert path.read_bytes() == before
