"""`femoreg detect`: what it writes, and that bad input leaves nothing behind."""

import csv
from pathlib import Path

import cv2
import pytest
import SimpleITK as sitk
import torch
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import DigitalXRayImageStorageForPresentation, ExplicitVRLittleEndian, generate_uid

from femoreg_torch.commands.detect import detect
from femoreg_torch.detect import looks, network
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import read_image, write_image
from femoreg_torch.volume import HIP_LANDMARKS, read_landmarks
from models.unet import UNet, UNetConfig
from models.weights import save_weights


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny untrained network whose heat maps all peak sharply somewhere."""
    torch.manual_seed(2)
    tiny = UNet(UNetConfig(channels=(8, 12, 16), convolutions=(1, 1, 1)))
    torch.nn.init.constant_(tiny.absence.bias, -50.0)
    with torch.no_grad():
        tiny.heatmaps.weight *= 200
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(path, tiny, {})
    return path


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    raw = torch.rand((24, 24), generator=torch.Generator().manual_seed(1)).repeat_interleave(64, 0)
    raw = raw.repeat_interleave(64, 1) * 30000 + 5000
    path = folder / "view1.tif"
    write_image(path, raw.to(torch.uint16))
    return path


@pytest.fixture
def one_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several looks agree on what a trained network sees; this one sees something else each time."""
    plainly = looks.read_image
    monkeypatch.setattr(network, "read_image", lambda net, image, _looks: plainly(net, image, looks.PLAIN))


@pytest.mark.usefixtures("one_look")
def test_writes_table_markups_and_picture(image: Path, weights: Path, tmp_path: Path) -> None:
    detect([image], out=tmp_path / "out", weights=weights)
    with (tmp_path / "out" / "landmarks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["image", "landmark", "column_px", "row_px", "confidence", "visible"]
    assert [row["landmark"] for row in rows] == list(HIP_LANDMARKS)
    assert {row["image"] for row in rows} == {str(image)}
    seen = {row["landmark"]: row for row in rows if row["visible"] == "1"}
    assert seen
    assert all(-0.5 <= float(row["column_px"]) <= 1535.5 for row in seen.values())
    points = read_landmarks(tmp_path / "out" / "view1.mrk.json")
    assert set(points) == set(seen)
    for name, point in points.items():
        assert point[0] == pytest.approx(float(seen[name]["column_px"]), abs=0.01)
        assert point[1] == pytest.approx(float(seen[name]["row_px"]), abs=0.01)
    assert cv2.imread(str(tmp_path / "out" / "view1.png")).shape == (768, 768, 3)


def test_bad_input_leaves_nothing_behind(image: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    constant, small, colour = (tmp_path / f"{name}.png" for name in ("constant", "small", "colour"))
    write_image(constant, torch.full((1536, 1536), 900, dtype=torch.uint16))
    write_image(small, (torch.arange(100 * 100) % 999).view(100, 100).to(torch.uint16))
    cv2.imwrite(str(colour), torch.randint(0, 255, (1536, 1536, 3)).to(torch.uint8).numpy())
    (tmp_path / "text.png").write_text("not an image")
    for bad, message in {
        tmp_path / "missing.tif": "no such file",
        constant: "every pixel is 900",
        small: "100 × 100 pixels, but the C-arm has 1536 × 1536",
        colour: "colour image",
        tmp_path / "text.png": "cannot be read",
    }.items():
        with pytest.raises(InputError, match=message):
            detect([image, bad], out=out, weights=weights)
    with pytest.raises(InputError, match="view1 stands there twice"):
        detect([image, image], out=out, weights=weights)
    with pytest.raises(InputError, match="no carm preset 'ct'"):
        detect([image], out=out, carm="ct", weights=weights)
    assert not out.exists()


@pytest.mark.usefixtures("one_look")
def test_a_folder_of_images_in_every_format(image: Path, weights: Path, tmp_path: Path) -> None:
    """The same picture as PNG, TIFF, NIfTI and DICOM gives the same landmarks."""
    raw = read_image(image)
    folder = tmp_path / "images"
    folder.mkdir()
    for name in ("a.png", "b.tif"):
        write_image(folder / name, raw.to(torch.uint16))
    sitk.WriteImage(sitk.GetImageFromArray(raw.numpy()[None]), str(folder / "c.nii.gz"))
    write_dicom(folder / "d", raw)
    detect([folder], out=tmp_path / "out", weights=weights)
    with (tmp_path / "out" / "landmarks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * 14
    assert [row["image"] for row in rows[::14]] == [str(folder / name) for name in ("a.png", "b.tif", "c.nii.gz", "d")]
    for n in range(14):
        assert len({(row["column_px"], row["row_px"], row["confidence"]) for row in rows[n::14]}) == 1
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="a folder without files"):
        detect([tmp_path / "empty"], out=tmp_path / "out2", weights=weights)


def test_too_few_landmarks_are_said(image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny = UNet(UNetConfig(channels=(8, 12, 16), convolutions=(1, 1, 1)))
    torch.nn.init.constant_(tiny.absence.bias, 50.0)
    save_weights(tmp_path / "blind.safetensors", tiny, {})
    detect([image], out=tmp_path / "out", weights=tmp_path / "blind.safetensors")
    said = " ".join(capsys.readouterr().out.split())
    assert "0 of 14 landmarks, not enough landmarks for a start pose, which takes 4" in said


def write_dicom(path: Path, raw: torch.Tensor) -> None:
    """A minimal digital X-ray image of 16 bits."""
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = DigitalXRayImageStorageForPresentation
    meta.MediaStorageSOPInstanceUID = generate_uid()
    meta.TransferSyntaxUID = ExplicitVRLittleEndian
    content = Dataset()
    content.file_meta = meta
    content.SOPClassUID, content.SOPInstanceUID = meta.MediaStorageSOPClassUID, meta.MediaStorageSOPInstanceUID
    content.Rows, content.Columns = raw.shape
    content.SamplesPerPixel, content.PhotometricInterpretation = 1, "MONOCHROME2"
    content.BitsAllocated, content.BitsStored, content.HighBit, content.PixelRepresentation = 16, 16, 15, 0
    content.PixelData = raw.to(torch.uint16).numpy().tobytes()
    content.save_as(path, enforce_file_format=True)
