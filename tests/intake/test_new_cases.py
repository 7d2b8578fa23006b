"""A case made of the files that users have: what it then holds, and that it appears whole or not at all."""

import re
import shutil
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
import torch
import yaml
from fuzz_faults import full_after
from intake_files import ENTRY, HEAD, SPACING, bones, landmarks, markups, ras_affine, write_files
from pydicom.dataset import FileMetaDataset
from pydicom.uid import CTImageStorage, ExplicitVRLittleEndian, XRayAngiographicImageStorage, generate_uid

from femoreg_torch.anatomy import fitting_tables, label_table
from femoreg_torch.case import read_case
from femoreg_torch.commands.main import main
from femoreg_torch.fluoro import Display, read_image
from femoreg_torch.intake import check_case, inspect_path
from femoreg_torch.registration import prepare_scene
from femoreg_torch.volume import read_ct, read_labels, read_landmarks


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `write_files` writes, and the same CT, bones and images in other forms."""
    folder = write_files(tmp_path_factory.mktemp("user") / "files")
    write_dicom_ct(folder / "dicom", folder / "ct.nii.gz")
    (folder / "segmentations").mkdir()
    for name, mask in bones().items():
        nibabel.save(nibabel.Nifti1Image(mask.astype(np.uint8), ras_affine()), folder / f"segmentations/{name}.nii.gz")
    (folder / "ras.stl").write_bytes(
        b"3D Slicer output. SPACE=RAS".ljust(80) + (folder / "device.stl").read_bytes()[80:]
    )
    write_slicer_segmentation(folder / "bones.seg.nrrd", folder / "labels.nii.gz")
    for kind in ("plain", "device"):
        (folder / kind).mkdir()
        for number in (1, 2, 3):
            write_dicom_image(folder / kind / f"run{number}", number + (10 if kind == "device" else 0))
    aside = "{sdd_mm: 1000, pixel_mm: [4, 4], shape: [48, 40], principal_point_px: [20.5, 23.5]}\n"
    (folder / "aside.yaml").write_text(aside, encoding="utf-8")
    return folder


def dataset(kind: str, modality: str, series: str) -> pydicom.Dataset:
    meta = FileMetaDataset()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data = pydicom.Dataset()
    data.file_meta = meta
    data.SOPClassUID = meta.MediaStorageSOPClassUID = kind
    data.SOPInstanceUID = meta.MediaStorageSOPInstanceUID = generate_uid()
    data.SeriesInstanceUID, data.StudyInstanceUID, data.Modality, data.PatientID = series, "1.2", modality, "p"
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated, data.BitsStored, data.HighBit, data.PixelRepresentation = 16, 16, 15, 0
    return data


def write_dicom_ct(folder: Path, source: Path) -> None:
    folder.mkdir()
    image, series = sitk.DICOMOrient(sitk.ReadImage(str(source)), "LPS"), generate_uid()
    values = sitk.GetArrayFromImage(image)
    for k, plane in enumerate(values):
        data = dataset(CTImageStorage, "CT", series)
        data.Rows, data.Columns = plane.shape
        data.RescaleSlope, data.RescaleIntercept = 1, -1024
        data.PixelSpacing, data.ImageOrientationPatient = list(image.GetSpacing()[:2]), [1, 0, 0, 0, 1, 0]
        data.ImagePositionPatient = list(image.TransformIndexToPhysicalPoint((0, 0, k)))
        data.PixelData = (plane + 1024).astype("<u2").tobytes()
        data.save_as(folder / f"{len(values) - k:03d}", enforce_file_format=True)


def write_dicom_image(path: Path, seed: int, frames: int = 0, **tags: Any) -> None:
    data = dataset(XRayAngiographicImageStorage, "XA", generate_uid())
    data.Rows, data.Columns = 48, 40
    data.DistanceSourceToDetector, data.ImagerPixelSpacing = 1000, [4, 4]
    shape = (frames, 48, 40) if frames else (48, 40)
    data.PixelData = np.random.default_rng(seed).integers(1000, 50000, shape).astype("<u2").tobytes()
    if frames:
        data.NumberOfFrames = frames
    for name, value in tags.items():
        setattr(data, name, value)
    data.save_as(path, enforce_file_format=True)


def write_slicer_segmentation(path: Path, source: Path) -> None:
    image = sitk.ReadImage(str(source))
    names = {1: "Left hip", 2: "Right hip", 4: "Sacrum", 5: "left femur", 6: "Femur_Right"}
    for n, (value, name) in enumerate(names.items()):
        for key, text in {"Name": name, "LabelValue": str(value), "Layer": "0"}.items():
            image.SetMetaData(f"Segment{n}_{key}", text)
    sitk.WriteImage(image, str(path), useCompression=True)


def arguments(files: Path, out: Path, **changes: Any) -> list[str]:
    """The command with DICOM, masks of TotalSegmentator and markups, but for `changes`; None leaves an option out."""
    options: dict[str, Any] = {
        "ct": files / "dicom",
        "labels": files / "segmentations",
        "landmarks": files / "landmarks.mrk.json",
        "plan": files / "plan.mrk.json",
        "device": files / "device.stl",
        "device-points": files / "points.mrk.json",
        "before-entry-mm": 25,
        "images": [files / "plain"],
        "device-images": [files / "device" / f"run{n}" for n in (1, 2, 3)],
    }
    words = ["new-case", str(out)]
    for name, value in (options | {key.replace("_", "-"): value for key, value in changes.items()}).items():
        if value is not None:
            values = [] if value is True else value if isinstance(value, list) else [value]
            words += [f"--{name}", *map(str, values)]
    return words


def test_a_case_from_two_dicom_folders(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments(files, tmp_path / "case")) == 0
    told = capsys.readouterr().out
    assert "the operated side is the left one" in told
    assert "source to detector 1000 mm, pixels of 4 mm" in told
    assert "view 2 is plain/run2, with the device device/run2" in told
    case = read_case(tmp_path / "case")
    assert case.side == "left"
    assert case.plan is not None
    torch.testing.assert_close(case.plan.entry_point, torch.tensor(ENTRY).double())
    torch.testing.assert_close(case.plan.target, torch.tensor(HEAD).double())
    assert {name: point.tolist() for name, point in case.landmarks.items()} == {
        k: list(v) for k, v in landmarks().items()
    }
    assert case.carm.camera.sdd_mm == 1000
    assert len(case.views) == 3
    assert all(path.parent == tmp_path / "case" for view in case.views for path in view.images.values())
    assert case.ct_path is not None
    assert case.labels_path is not None
    ct, plain = read_ct(case.ct_path), read_ct(files / "ct.nii.gz")
    assert torch.equal(ct.data, plain.data)
    torch.testing.assert_close(ct.lps_from_index, plain.lps_from_index, atol=1e-4, rtol=0)
    labels = read_labels(case.labels_path, ct).data
    for name, (number,) in case.bones.items():
        assert np.array_equal((labels == number).numpy(), sitk_mask(files, name))
    assert case.objects["device"].start.beside == "femur"


def sitk_mask(files: Path, name: str) -> np.ndarray:
    image = sitk.DICOMOrient(sitk.ReadImage(str(files / f"segmentations/{name}.nii.gz")), "LPS")
    return sitk.GetArrayFromImage(image) > 0


@pytest.mark.parametrize(
    "changes",
    [
        {"ct": "ct.nii.gz", "labels": "labels.nii.gz", "bones": "femoreg"},
        {"labels": "bones.seg.nrrd"},
        {"device": None, "device_points": None, "device_images": None, "before_entry_mm": None},
        {"material": "steel", "guide": "from the side", "turned_deg": 30, "side": "left"},
        {
            "carm": "carm.yaml",
            "images": ["view1.png", "view2.png"],
            "device_images": ["view1_device.png", "view2_device.png"],
        },
    ],
    ids=["files", "3D Slicer", "no device", "words", "pictures"],
)
def test_other_forms_give_the_same_bones(files: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    def standing(value: Any) -> Any:
        if isinstance(value, list):
            return [standing(one) for one in value]
        return files / value if isinstance(value, str) and (files / value).exists() else value

    assert main(arguments(files, tmp_path / "case", **{key: standing(value) for key, value in changes.items()})) == 0
    case = read_case(tmp_path / "case")
    assert case.ct_path is not None
    assert case.labels_path is not None
    labels = read_labels(case.labels_path, read_ct(case.ct_path)).data
    for name, (number, *_) in case.bones.items():
        if name != "vertebrae":
            assert np.array_equal((labels == number).numpy(), sitk_mask(files, name))
    content = yaml.safe_load((tmp_path / "case" / "case.yaml").read_text(encoding="utf-8"))
    assert ("device" in content) == (changes.get("device", "") is not None)


def test_images_whose_values_stand_beside_their_headers_are_copied_whole(files: Path, tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(100, 60000, (48, 40)).astype(np.uint16)
    images = []
    for n in (1, 2):
        images.append(tmp_path / f"shot{n}.mhd")
        sitk.WriteImage(sitk.GetImageFromArray(pixels + n), str(images[-1]))
    given = {
        "carm": files / "carm.yaml",
        "images": images,
        "device": None,
        "device_images": None,
        "device_points": None,
    }
    assert main(arguments(files, tmp_path / "case", **given)) == 0
    found = read_image(read_case(tmp_path / "case").views[1].images["anatomy"])
    np.testing.assert_array_equal(found.numpy(), pixels + 2)


@pytest.mark.parametrize(
    ("changes", "messages"),
    [
        (
            {"ct": None, "plan": None, "device_points": None},
            ["--ct is missing", "--plan is missing", "--device-points is"],
        ),
        (
            {"labels": "none.nii.gz", "material": "steel", "hu": 3},
            ["none.nii.gz: no such file or folder", "--material and --hu"],
        ),
        ({"carm": "none.yaml", "plan": None}, ["--plan is missing", "none.yaml: no such file"]),
        ({"labels": "labels.nii.gz"}, ["--bones: is missing", "hip bones and femora of femoreg"]),
        ({"images": ["plain/run1"]}, ["3 files, but there are 1 images without the device"]),
        ({"images": ["view1.png", "view2.png", "view3.png"]}, ["--carm: is missing, and view1.png is no DICOM file"]),
        ({"guide": "upwards"}, ["guide: one of along the planned path"]),
        ({"device": "ras.stl"}, ["says that it is in RAS"]),
        ({"series": "7"}, ["none of its series is '7'"]),
        ({"side": "right", "images": ["plain/run1"] * 3}, ["entry point lies on the femur_left", "the same image as"]),
    ],
)
def test_what_is_wrong_is_told_at_once_and_nothing_is_written(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, Any], messages: list[str]
) -> None:
    def standing(value: Any) -> Any:
        if isinstance(value, list):
            return [files / one for one in value]
        return files / value if isinstance(value, str) and "." in value else value

    assert main(arguments(files, tmp_path / "case", **{key: standing(value) for key, value in changes.items()})) == 2
    told = capsys.readouterr().err
    assert all(message in told for message in messages), told
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_what_is_wrong_with_six_images_alike_is_told_once_and_of_the_files_given(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for kind in ("plain", "device"):
        (tmp_path / kind).mkdir()
        for n in (1, 2, 3):
            write_dicom_image(tmp_path / kind / f"IM{n}", n, frames=4 + n)
    given = {"images": [tmp_path / "plain"], "device_images": [tmp_path / "device"]}
    assert main(arguments(files, tmp_path / "case", **given)) == 2
    told = capsys.readouterr().err
    assert told.count("holds several frames") == 1
    assert f"{tmp_path}/plain/IM1: holds several frames" in told
    assert "The same of device/IM1, plain/IM2, device/IM2, plain/IM3, device/IM3." in told
    assert "view1" not in told
    assert "said by --frames" in told
    write_dicom_image(tmp_path / "device/IM2", 2, frames=2)
    assert main(arguments(files, tmp_path / "case", frames=3, **given)) == 2
    told = capsys.readouterr().err
    assert f"{tmp_path}/device/IM2: there is no frame 3" in told
    assert "The same of" not in told


def test_headers_say_side_and_values_and_flags_may_say_otherwise(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def made(name: str, **options: Any) -> str:
        images = sorted((tmp_path / "images").iterdir())
        plain: dict[str, Any] = {"device": None, "device_points": None, "device_images": None, "before_entry_mm": None}
        status = main(arguments(files, tmp_path / name, images=images, **plain, **options))
        told = capsys.readouterr()
        assert (status == 0) == (tmp_path / name).exists()
        return told.out + told.err

    (tmp_path / "images").mkdir()
    field = {"FieldOfViewOrigin": [0, 0], "DetectorElementSpacing": [2, 2], "DetectorActiveDimensions": [192, 168]}
    for n in (1, 2):
        detector_in_front = {"PositionerPrimaryAngle": 10 * n, **field}
        write_dicom_image(tmp_path / f"images/run{n}", n, 2, PixelIntensityRelationship="LIN", **detector_in_front)
    found = inspect_path(tmp_path / "images" / "run1")
    assert any("the patient's posterior side" in fact for fact in found.facts)
    assert any("shown: the first frame" in fact for fact in found.facts)
    told = made("cine")
    assert "holds several frames, one was expected" in told
    assert "To new-case, this is said by --frames." in told
    assert "the patient's posterior side, by the header of run1" in made("behind", frames="mean")
    case = read_case(tmp_path / "behind")
    assert (case.display, case.views[0].frames, case.views[0].intensity) == (Display("posterior"), "mean", None)
    assert case.display.stored_camera(case.carm.camera).principal_point_px == (20.5, 23.5)  # the field is off by 4 mm
    told = made("front", frames=1, source="anterior")
    assert "put the source on the patient's posterior side" in told
    assert "ignore_header: true" in told
    told = made("mine", frames=1, source="anterior", ignore_header=True, turned=90, carm=files / "aside.yaml")
    assert "Case written" in told, told
    content = yaml.safe_load((tmp_path / "mine" / "case.yaml").read_text(encoding="utf-8"))
    assert content["display"] == {"source": "anterior", "mirrored": False, "turned": 90, "ignore_header": True}
    assert [view["frames"] for view in content["views"]] == [1, 1]
    assert "holds intensities (raw) by its PixelInt" in made("logs", frames=1, intensity="log")
    for n in (1, 2):
        write_dicom_image(tmp_path / f"images/run{n}", n, PatientOrientation=["H", "R"])  # L, F, mirrored, turned
    assert "the pictures are mirrored and turned by 90°, by PatientOrientation" in made("turned")
    assert read_case(tmp_path / "turned").display == Display("anterior", mirrored=True, turned_deg=90)
    told = made("otherwise", turned=180)
    assert "does not fit the display" in told
    assert "said by --source, --mirrored, --turned or --ignore-header." in told
    for n in (1, 2):
        write_dicom_image(tmp_path / f"images/run{n}", n, Modality="DX")
    assert any("does not say what its values are" in one for one in inspect_path(tmp_path / "images/run1").warnings)
    assert "does not say what its values are" in made("radiographs")
    assert "Case written" in made("said", intensity="raw")


def test_a_folder_that_is_there_is_not_touched(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "mine").write_text("x", encoding="utf-8")
    assert main(arguments(files, tmp_path / "case")) == 2
    assert "is there already" in capsys.readouterr().err
    assert (tmp_path / "case" / "mine").read_text(encoding="utf-8") == "x"


@pytest.mark.parametrize(
    ("name", "kind", "fact"),
    [
        ("dicom", "DICOM folder", "series ? (CT, 60 files)"),
        ("ct.nii.gz", "CT", "80 × 52 × 60 voxels of 4 × 4 × 4 mm, along the patient's axes"),
        ("labels.nii.gz", "label map", "labels: 1 ("),
        ("bones.seg.nrrd", "label map", "bones by name: hip_left, hip_right, sacrum, femur_left, femur_right"),
        ("segmentations", "label map", "bones by name: femur_left, femur_right, hip_left, hip_right, sacrum"),
        ("landmarks.mrk.json", "landmarks of the hip", "FH-l: (110.00, 0.00, -40.00) mm LPS"),
        ("plan.mrk.json", "points", "L-1: (148.00, 0.00, -70.00) mm LPS"),
        ("device.stl", "mesh", "triangles, closed"),
        ("view1.png", "image", "40 × 48 pixels"),
        ("plain/run1", "DICOM image", "source to detector, mm: 1000"),
    ],
)
def test_inspect_says_what_is_there(files: Path, name: str, kind: str, fact: str) -> None:
    found = inspect_path(files / name)
    assert found.kind == kind
    assert any(fact in one for one in found.facts), found.facts
    assert (found.picture is not None) == (kind in ("DICOM folder", "CT", "label map", "image", "DICOM image"))


@pytest.mark.parametrize("ct", ["ct.nii.gz", "dicom"])  # copied, and written anew
def test_a_full_disk_is_told_with_the_file_that_finds_no_room(
    ct: str, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with full_after(5000):  # holds the images, not the CT
        assert main(arguments(files, tmp_path / "case", ct=files / ct)) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"femoreg: {tmp_path}/case/ct.nii.gz: ")
    assert str(files) not in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_inspect_lists_what_stands_together(files: Path, tmp_path: Path) -> None:
    (files / "torn.stl").write_text("solid of nothing", encoding="utf-8")
    found = inspect_path(files)
    (files / "torn.stl").unlink()
    assert found.kind == "folder of several things"
    for told in (
        "ct.nii.gz: CT, 80 × 52 × 60 voxels",
        "bones.seg.nrrd: label map, 80 × 52 × 60 voxels",
        "segmentations: folder of masks of bones",
        "landmarks.mrk.json: landmarks of the hip, FH-l: (110.00,",
        "plan.mrk.json: points, L-1: (148.00,",
        "device.stl: mesh, ",
        "view1.png: image, 40 × 48 pixels",
    ):
        assert any(fact.startswith(told) for fact in found.facts), told
    assert any(fact.startswith("dicom: ") and "CT" in fact for fact in found.facts)
    assert any(fact.startswith("torn.stl: ") and "mesh" not in fact[:15] for fact in found.facts)
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "view1.png").write_bytes((files / "view1.png").read_bytes())
    assert inspect_path(tmp_path / "pictures").kind == "folder of images"


def test_a_ct_beside_its_label_map_is_no_folder_of_masks(files: Path, tmp_path: Path) -> None:
    folder = tmp_path / "patient" / "volumes"
    folder.mkdir(parents=True)
    for name, other in (("ct.nii.gz", "ct.nii.gz"), ("labels.nii.gz", "seg.nii.gz")):
        (folder / other).write_bytes((files / name).read_bytes())
    found = inspect_path(folder)
    assert found.kind == "folder of several things"
    assert [fact.partition(", ")[0] for fact in found.facts] == ["ct.nii.gz: CT", "seg.nii.gz: label map"]
    outer = inspect_path(tmp_path / "patient")
    assert outer.facts == ("volumes: folder of several things",)


def test_inspect_tells_other_points_and_boxes_of_segments_without_alarm(files: Path, tmp_path: Path) -> None:
    points = inspect_path(files / "plan.mrk.json")
    assert "none of these names is one of the landmarks FH-l" in points.facts[-1]
    assert not points.warnings
    image = sitk.ReadImage(str(files / "bones.seg.nrrd"))
    inside = sitk.LabelShapeStatisticsImageFilter()
    inside.Execute(sitk.Cast(image > 0, sitk.sitkUInt8))
    x, y, z, *size = inside.GetBoundingBox(1)
    box = image[x : x + size[0], y : y + size[1], z : z + size[2]]
    for key in image.GetMetaDataKeys():
        if key.startswith("Segment"):
            box.SetMetaData(key, image.GetMetaData(key))
    sitk.WriteImage(box, str(tmp_path / "box.seg.nrrd"))
    found = inspect_path(tmp_path / "box.seg.nrrd")
    assert not found.warnings  # though every bone touches a face of this file
    assert "the box of the segments alone" in found.facts[-1]


def test_inspect_warns_of_swapped_landmarks_and_unclear_headers(files: Path, tmp_path: Path) -> None:
    other = {"l": "r", "r": "l"}
    swapped = {name[:-1] + other[name[-1]]: point for name, point in landmarks().items()}
    (tmp_path / "marks.mrk.json").write_text(markups(swapped), encoding="utf-8")
    assert "lie to the right of their partners" in inspect_path(tmp_path / "marks.mrk.json").warnings[0]
    image = nibabel.load(files / "ct.nii.gz")
    image.header.set_sform(None, 0)
    image.header.set_qform(None, 0)
    nibabel.Nifti1Image(np.asarray(image.dataobj), None, image.header).to_filename(tmp_path / "bare.nii.gz")
    assert any("neither sform nor qform" in one for one in inspect_path(tmp_path / "bare.nii.gz").warnings)
    affine = read_ct(tmp_path / "bare.nii.gz").lps_from_index  # as the warning says: to the left, back and head
    torch.testing.assert_close(affine[:3, :3], SPACING * torch.eye(3, dtype=torch.float64))


def test_the_pictures_left_is_the_patients_right(files: Path) -> None:
    """Axial plane: a bright block on the patient's left, in front, is drawn on the right, above the middle."""
    values = np.full((20, 20, 20), -1000, np.int16)
    values[14:18, 12:16, :] = 1000
    path = files / "block.nii.gz"
    nibabel.save(nibabel.Nifti1Image(values, np.diag([-10.0, 10.0, 10.0, 1.0])), path)  # in RAS: −x is left
    picture = inspect_path(path).picture
    assert picture is not None
    axial = picture[:, : picture.shape[1] // 3].max(2)
    rows, columns = np.nonzero(axial[40:-40] > 200)
    assert columns.mean() > axial.shape[1] / 2
    assert rows.mean() + 40 < axial.shape[0] / 2
    path.unlink()


def test_in_a_terminal_what_is_missing_is_asked_for(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = iter(
        [
            str(files / "ct.nii.gz"),
            str(files / "labels.nii.gz"),
            "",  # landmarks cannot be left out: asked again
            str(files / "landmarks.mrk.json"),
            str(files / "plan.mrk.json"),
            "",  # no device
            f"{files / 'view1.png'} {files / 'view2.png'}",
            "femoreg",
            str(files / "carm.yaml"),
        ]
    )
    monkeypatch.setattr("builtins.input", lambda *_: next(answers))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    assert main(["new-case", str(tmp_path / "case")]) == 0, capsys.readouterr().err
    assert next(answers, None) is None
    case = read_case(tmp_path / "case")
    assert len(case.views) == 2
    assert "device" not in case.objects


def test_a_table_fits_where_the_hips_do_though_other_bones_lie_outside() -> None:
    assert fitting_tables([25, 75, 76, 77, 78]) == ["totalsegmentator_v2"]  # no vertebrae, half a sacrum
    assert fitting_tables([75, 76, 77]) == []


def test_a_table_that_is_not_that_of_the_map_is_told_with_the_one_that_is(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = label_table("totalsegmentator_v2")
    values = np.zeros(next(iter(bones().values())).shape, np.uint8)
    for name, mask in bones().items():
        values[mask] = table[name][0]
    values[:2, :2, :2] = 88  # a muscle by this table, the left femur by that of version 1
    path = tmp_path / "map.nii.gz"
    nibabel.save(nibabel.Nifti1Image(values, ras_affine()), path)
    ct, out = str(files / "ct.nii.gz"), str(tmp_path / "points.mrk.json")
    for words in (
        arguments(files, tmp_path / "case", labels=path, bones="totalsegmentator_v1"),
        ["landmarks", ct, str(path), "--out", out, "--bones", "totalsegmentator_v1"],
    ):
        assert main(words) == 2
        told = capsys.readouterr().err
        assert "no voxel carries the hip_left or hip_right of its table (90, 91)" in told
        assert "Name that one: `--bones totalsegmentator_v2`" in told
    assert main(["landmarks", ct, str(path), "--out", out]) == 2
    assert "hip bones and femora of totalsegmentator_v2 are there" in capsys.readouterr().err
    assert main(["landmarks", ct, str(path), "--out", out, "--bones", "totalsegmentator_v2"]) == 0


def test_ids_that_are_taken_for_those_of_segment_are_doubted_where_left_and_right_are_swapped(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of another table may be among them, and then mean other bones."""
    table, values = label_table("femoreg"), np.zeros(next(iter(bones().values())).shape, np.uint8)
    others = {"hip_left": "hip_right", "hip_right": "hip_left"}
    for name, mask in bones().items():
        values[mask] = table[others.get(name, name)][0]
    path, out = tmp_path / "map.nii.gz", tmp_path / "points.mrk.json"
    nibabel.save(nibabel.Nifti1Image(values, ras_affine()), path)
    assert main(["landmarks", str(files / "ct.nii.gz"), str(path), "--out", str(out)]) == 2
    assert "left and right are swapped, or its ids are of another table. Say which: --bones" in capsys.readouterr().err
    assert not out.exists()


def test_a_path_beside_a_ct_without_a_place_is_told_with_that(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("ct", "labels"):
        image = nibabel.load(files / f"{name}.nii.gz")
        image.set_sform(ras_affine(), 0)
        image.set_qform(ras_affine(), 0)
        nibabel.save(image, tmp_path / f"{name}.nii.gz")
    bare = {"labels": tmp_path / "labels.nii.gz", "ct": tmp_path / "ct.nii.gz", "bones": "femoreg"}
    assert main(arguments(files, tmp_path / "case", **bare)) == 2
    told = capsys.readouterr().err
    assert "lies on no femur of the label map" in told
    assert "Of the CT, the NIfTI header has neither sform nor qform" in told


def test_of_several_tables_that_fit_none_is_named_as_the_right_one(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Small ids are those of several tables; the first of them has other bones there."""
    words = arguments(files, tmp_path / "case", labels=files / "labels.nii.gz", bones="totalsegmentator_v2")
    assert main(words) == 2
    told = capsys.readouterr().err
    assert re.search(r"of the table \w+ and of \w+.* are there\. Name the one of them by whose program", told)
    assert "--bones NAME" in told


def test_landmarks_go_by_the_names_of_the_parts_whatever_their_values(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = sitk.ReadImage(str(files / "labels.nii.gz"))
    exchanged = sitk.ChangeLabel(image, {1: 2, 2: 1, 5: 6, 6: 5})  # values of `femoreg` with their sides exchanged
    names = {2: "Hüftbein links", 1: "Hüftbein rechts", 4: "Kreuzbein", 6: "Femur li.", 5: "Femur re."}
    for n, (value, name) in enumerate(names.items()):
        for key, text in {"Name": name, "LabelValue": str(value), "Layer": "0"}.items():
            exchanged.SetMetaData(f"Segment{n}_{key}", text)
    sitk.WriteImage(exchanged, str(tmp_path / "mine.seg.nrrd"))
    out = tmp_path / "points.mrk.json"
    assert main(["landmarks", str(files / "ct.nii.gz"), str(tmp_path / "mine.seg.nrrd"), "--out", str(out)]) == 0
    assert read_landmarks(out)["FH-l"][0] > 100
    assert read_landmarks(out)["FH-r"][0] < -100
    exchanged.SetMetaData("Segment0_Name", "Knochen 1")
    exchanged.SetMetaData("Segment1_Name", "Knochen 2")
    sitk.WriteImage(exchanged, str(tmp_path / "mine.seg.nrrd"))
    assert (
        main(
            ["landmarks", str(files / "ct.nii.gz"), str(tmp_path / "mine.seg.nrrd"), "--out", str(tmp_path / "p.json")]
        )
        == 2
    )
    told = capsys.readouterr().err
    assert "none of its parts is named after a hip bone; those taken for no bone are: Knochen 1, Knochen 2" in told


def test_a_folder_as_it_was_exported(files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Images by their numbers; what holds none is passed over, and told."""
    for kind, seed in (("plain", 1), ("device", 20)):
        (tmp_path / kind / "DICOM").mkdir(parents=True)
        for n in (2, 10, 1):
            write_dicom_image(tmp_path / kind / f"DICOM/IM{n}", seed + n)
        (tmp_path / kind / "README").write_text("A viewer for this disc.", encoding="utf-8")
        report = dataset("1.2.840.10008.5.1.4.1.1.88.67", "SR", generate_uid())
        report.save_as(tmp_path / kind / "dose", enforce_file_format=True)
    given = {"images": [tmp_path / "plain"], "device_images": [tmp_path / "device"]}
    assert main(arguments(files, tmp_path / "case", **given)) == 0
    told = capsys.readouterr().out
    assert "passed over README, dose, which hold no image" in told
    assert "view 2 is DICOM/IM2, with the device DICOM/IM2" in told
    assert "view 3 is DICOM/IM10, with the device DICOM/IM10" in told
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "README").write_text("nothing", encoding="utf-8")
    assert main(arguments(files, tmp_path / "none", images=[tmp_path / "empty"])) == 2
    assert "empty: a folder without images" in capsys.readouterr().err


def test_parts_that_no_bone_is_called_by_are_named(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    image = sitk.ReadImage(str(files / "bones.seg.nrrd"))
    image.SetMetaData("Segment1_Name", "Knochen 2")
    sitk.WriteImage(image, str(tmp_path / "mine.seg.nrrd"))
    assert main(arguments(files, tmp_path / "case", labels=tmp_path / "mine.seg.nrrd")) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "parts of mine.seg.nrrd that are taken for no bone: Knochen 2" in told
    assert "does not tell the hip_right, which landmarks lie on" in told


def test_where_the_source_stands_is_told_where_nobody_says_it(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = "the source is taken to stand in front of the patient"
    assert main(arguments(files, tmp_path / "case", ignore_header=True)) == 0
    assert told in " ".join(capsys.readouterr().out.split())
    assert main(arguments(files, tmp_path / "other", ignore_header=True, source="anterior")) == 0
    assert told not in " ".join(capsys.readouterr().out.split())


def test_images_of_another_patient_and_another_pose_are_told_by_all_that_read_them(
    files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By `new-case`, which still has the header of the CT, by `check`, and in the result."""
    images = []
    for n, angle in enumerate((0, 20)):
        images.append(tmp_path / f"run{n}")
        tags = {"PatientID": "q", "PositionerPrimaryAngle": angle, "PositionerSecondaryAngle": 0}
        write_dicom_image(images[-1], n, **tags)
    given = {"images": images[:1], "device_images": images[1:], "source": "anterior", "ignore_header": True}
    assert main(arguments(files, tmp_path / "case", **given)) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "run1: of another patient than the CT, by PatientID" in told
    assert "view 1: view1_device.dcm was taken 20° from view1.dcm" in told
    folder = tmp_path / "case"
    content = yaml.safe_load((folder / "case.yaml").read_text(encoding="utf-8"))
    shutil.copytree(files / "dicom", folder / "dicom")
    content["ct"]["image"] = "dicom"
    (folder / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    for notes in (check_case(folder, find_start=False).warnings, prepare_scene(read_case(folder)).missing):
        assert any("view1.dcm, view1_device.dcm: of another patient than the CT" in note for note in notes)
        assert any("view1_device.dcm was taken 20° from view1.dcm" in note for note in notes)
