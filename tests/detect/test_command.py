"""`femoreg detect`: what it writes, and that bad input leaves nothing behind."""

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import pytest
import SimpleITK as sitk
import torch
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.uid import DigitalXRayImageStorageForPresentation, ExplicitVRLittleEndian, generate_uid
from torch import Tensor, nn
from torch.nn import functional as F

from femoreg_torch.anatomy import HIP
from femoreg_torch.commands.detect import detect
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import read_image, write_image
from femoreg_torch.volume import read_landmarks
from models.kinds import NETWORKS
from models.protocols import Prediction
from models.weights import Weights, save_weights

SPOT = (1000.0, 400.0)  # column and row of the brightest place of `image`


class BrightestPlace(nn.Module):
    """Every landmark is where the image is brightest."""

    def __init__(self, classes: int, landmarks: int, absence: float) -> None:
        super().__init__()
        self.counts = (classes, landmarks)
        self.register_buffer("absence", torch.tensor(absence))

    def forward(self, images: Tensor) -> Prediction:
        small = F.avg_pool2d(images, 2)
        classes, landmarks = self.counts
        logits = small - small.amax((2, 3), keepdim=True)  # the spot is 14 deviations bright
        absence = self.absence.expand(len(images), landmarks)
        return Prediction(small.new_zeros(len(images), classes, 96, 96), logits.expand(-1, landmarks, -1, -1), absence)


@dataclass(frozen=True)
class BrightestPlaceSettings:
    classes: int
    landmarks: int

    def build(self) -> nn.Module:
        return BrightestPlace(self.classes, self.landmarks, 0.0)


@pytest.fixture
def weights_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[float], Path]:
    """Writes weights of a network that finds the brightest place, or, with an `absence` far above 0, nothing."""
    monkeypatch.setitem(NETWORKS, "brightest_place", BrightestPlaceSettings)
    counts = {"classes": 1 + len(HIP.bones), "landmarks": len(HIP.landmarks)}

    def write(absence: float) -> Path:
        state = BrightestPlace(*counts.values(), absence).state_dict()
        path = tmp_path / "weights.safetensors"
        save_weights(path, Weights("brightest_place", counts, HIP.name, 1.25, state), {})
        return path

    return write


@pytest.fixture
def weights(weights_of: Callable[[float], Path]) -> Path:
    return weights_of(-50.0)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A raw picture with one dark spot, which is the brightest place of its attenuation."""
    axis = torch.arange(1536.0)
    squares = (axis - SPOT[0]) ** 2 + (axis[:, None] - SPOT[1]) ** 2
    raw = 30000 * torch.exp(-2.0 * torch.exp(-squares / (2 * 60.0**2)))
    path = tmp_path_factory.mktemp("images") / "view1.tif"
    write_image(path, raw.to(torch.uint16))
    return path


def test_writes_table_markups_and_picture(image: Path, weights: Path, tmp_path: Path) -> None:
    detect([image], out=tmp_path / "out", weights=weights)
    with (tmp_path / "out" / "landmarks.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["image", "landmark", "column_px", "row_px", "confidence", "visible"]
    assert [row["landmark"] for row in rows] == list(HIP.landmark_names)
    assert {row["image"] for row in rows} == {str(image)}
    seen = {row["landmark"]: row for row in rows if row["visible"] == "1"}
    assert list(seen) == list(HIP.landmark_names)
    for row in seen.values():
        assert (float(row["column_px"]), float(row["row_px"])) == pytest.approx(SPOT, abs=2.0)
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
    (tmp_path / "text.png").write_text("not an image", encoding="utf-8")
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
    with (tmp_path / "out" / "landmarks.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    count = len(HIP.landmarks)
    assert [row["image"] for row in rows[::count]] == [str(folder / n) for n in ("a.png", "b.tif", "c.nii.gz", "d")]
    assert len(rows) == 4 * count
    for n in range(count):
        assert len({(row["column_px"], row["row_px"], row["confidence"]) for row in rows[n::count]}) == 1
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="a folder without files"):
        detect([tmp_path / "empty"], out=tmp_path / "out2", weights=weights)


def test_too_few_landmarks_are_said(
    image: Path, weights_of: Callable[[float], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    detect([image], out=tmp_path / "out", weights=weights_of(50.0))
    said = " ".join(capsys.readouterr().out.split())
    assert "0 of 14 landmarks, fewer than 4: a start pose then hangs on the outlines of the bones" in said


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
