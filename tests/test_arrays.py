"""The door for arrays: claims of headers are compared with what is there, and libraries print nothing."""

import gzip
import resource
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import nibabel
import numpy as np
import pytest
import SimpleITK as sitk

from femoreg_torch.arrays import MOST_PIXELS, check_claim, check_voxels, quiet
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import read_image
from femoreg_torch.volume import read_ct, read_label_map, read_landmarks, read_mesh, read_volume

VOXELS = np.random.default_rng(0).integers(-1000, 1500, (6, 7, 8)).astype(np.int16)


def ct(path: Path, **fields: object) -> Path:
    """A CT as ITK writes it, with fields set."""
    image = sitk.GetImageFromArray(VOXELS)
    for name, value in fields.items():
        getattr(image, f"Set{name}")(value)
    sitk.WriteImage(image, str(path))
    return path


def png(path: Path, rows: int, columns: int) -> Path:
    """A PNG that claims so many pixels, all of them there and zero."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    data = zlib.compress(bytes(min(rows * (columns + 1), 10**7)))
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + parts)
    return path


def tiff(path: Path, rows: int, columns: int) -> Path:
    """A TIFF of one strip that claims so many pixels, and holds ten bytes of them."""
    tags = [(256, columns), (257, rows), (258, 8), (259, 1), (262, 1), (273, 8), (277, 1), (278, rows), (279, 10)]
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    path.write_bytes(b"II*\0" + struct.pack("<I", 18) + bytes(10) + struct.pack("<H", 9) + entries + bytes(4))
    return path


def nrrd_nowhere(path: Path) -> Path:
    path.write_bytes(ct(path).read_bytes().replace(b"space origin: (0,0,0)", b"space origin: (nan,nan,nan)"))
    assert b"nan" in path.read_bytes()[:600]
    return path


def claiming_mha(path: Path, side: int) -> Path:
    text = path.read_bytes() if path.exists() else b""
    assert not text
    header = f"ObjectType = Image\nNDims = 3\nDimSize = {side} {side} {side}\nElementType = MET_SHORT\n"
    path.write_bytes((header + "ElementDataFile = LOCAL\n").encode() + bytes(100))
    return path


def claiming_nifti(path: Path, side: int) -> Path:
    image = nibabel.Nifti1Image(VOXELS, np.eye(4))
    content = bytearray(image.to_bytes())
    struct.pack_into("<4h", content, 40, 3, side, side, side)
    path.write_bytes(gzip.compress(bytes(content)) if path.suffix == ".gz" else bytes(content))
    return path


def not_gzip(path: Path) -> Path:
    path.write_bytes(b"\x1f\x8b\x08\x00" + bytes(400))
    return path


@pytest.mark.parametrize(
    "make",
    [
        lambda folder: claiming_mha(folder / "a.mha", 2**31),
        lambda folder: claiming_mha(folder / "a.mha", 2000),
        lambda folder: claiming_mha(folder / "a.mha", 500),
        lambda folder: claiming_nifti(folder / "a.nii", 32767),
        lambda folder: claiming_nifti(folder / "a.nii.gz", 32767),
        lambda folder: claiming_nifti(folder / "a.nii.gz", 700),
        lambda folder: not_gzip(folder / "a.nii.gz"),
        lambda folder: ct(folder / "a.mha", Origin=(float("nan"), 0.0, 0.0)),
        lambda folder: ct(folder / "a.nii.gz", Origin=(float("nan"), 0.0, 0.0)),
        lambda folder: nrrd_nowhere(folder / "a.nrrd"),
        lambda folder: ct(folder / "a.mha", Spacing=(1e-6, 1e-6, 1e-6)),
        lambda folder: ct(folder / "a.mha", Spacing=(1.0, 1.0, 5000.0)),
        lambda folder: ct(folder / "a.mha", Origin=(1e12, 0.0, 0.0)),
    ],
)
def test_volumes_that_claim_what_cannot_be(make, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path, began = make(tmp_path), time.perf_counter()
    with pytest.raises(InputError, match=path.name) as raised:
        read_ct(path)
    assert "\n" not in str(raised.value)
    assert time.perf_counter() - began < 5
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", ["mha", "nrrd", "nii.gz"])
def test_labels_of_nan_and_complex_volumes(suffix: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    labels = sitk.GetImageFromArray(np.where(VOXELS > 0, 1.0, np.nan).astype(np.float32))
    sitk.WriteImage(labels, str(tmp_path / f"labels.{suffix}"))
    with pytest.raises(InputError, match=r"not finite|whole numbers"):
        read_label_map(tmp_path / f"labels.{suffix}")
    if suffix == "nii.gz":
        nibabel.save(nibabel.Nifti1Image(VOXELS.astype(np.complex64), np.eye(4)), tmp_path / "complex.nii.gz")
        with pytest.raises(InputError, match="complex"):
            read_volume(tmp_path / "complex.nii.gz")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    "make",
    [
        lambda folder: tiff(folder / "a.tif", 40_000, 40_000),
        lambda folder: tiff(folder / "a.tif", 20_000, 20_000),
        lambda folder: tiff(folder / "a.tif", 4000, 4000),
        lambda folder: png(folder / "a.png", 30_000, 30_000),
        lambda folder: png(folder / "a.png", 2**31 - 1, 2**31 - 1),
    ],
)
def test_images_that_claim_what_cannot_be(make, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path, began = make(tmp_path), time.perf_counter()
    with pytest.raises(InputError, match=path.name):
        read_image(path)
    assert time.perf_counter() - began < 5
    assert capfd.readouterr() == ("", "")


def test_a_chunk_of_a_png_that_claims_four_gigabytes(tmp_path: Path) -> None:
    path = png(tmp_path / "a.png", 12, 10)
    content = path.read_bytes()
    place = content.index(b"IDAT") - 4
    path.write_bytes(content[:place] + b"\xff\xff\xff\xf0" + content[place + 4 :])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="damaged"):
        read_image(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # kB


def test_a_picture_cut_off_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    pixels = np.random.default_rng(0).integers(0, 4000, (50, 50), dtype=np.uint16)
    for suffix in ("png", "tif", "jpg", "bmp"):
        path = tmp_path / f"a.{suffix}"
        cv2.imwrite(str(path), pixels if suffix in ("png", "tif") else (pixels // 16).astype(np.uint8))
        path.write_bytes(path.read_bytes()[:1000])
        with pytest.raises(InputError):
            read_image(path)
    assert capfd.readouterr() == ("", "")


def test_a_mesh_with_a_corner_far_away(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    (tmp_path / "a.off").write_text(
        "OFF\n4 4 0\n0 0 0\n9 0 0\n0 9 0\n0 0 1e300\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n", encoding="utf-8"
    )
    with pytest.raises(InputError, match=r"a\.off: a corner lies 1e\+300 mm"):
        read_mesh(tmp_path / "a.off")
    assert len(recwarn) == 0


def test_a_mesh_with_a_corner_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.off"):
        read_mesh(tmp_path / "a.off")
    (tmp_path / "a.pickle").write_bytes(b"x")
    with pytest.raises(InputError, match="a mesh"):
        read_mesh(tmp_path / "a.pickle")


def test_claims_are_compared_with_the_bytes_that_are_there() -> None:
    check_claim(Path("a.nii"), (100, 100, 100), 2, 2_000_352)
    check_claim(Path("a.mhd"), (100, 100, 100), 2, None)
    with pytest.raises(InputError, match="which 500 bytes cannot hold"):
        check_claim(Path("a.nii"), (100, 100, 100), 2, 500)
    with pytest.raises(InputError, match="claims 100 × 0 × 100 values"):
        check_claim(Path("a.nii"), (100, 0, 100), 2, 500)
    with pytest.raises(InputError, match="voxels are more than"):
        check_voxels((2000, 2000, 2000), "a", "Crop it.")


def test_opencv_was_told_what_the_largest_image_is() -> None:
    import os

    assert int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"]) == MOST_PIXELS


def test_quiet_threads_leave_stderr_as_it_was(capfd: pytest.CaptureFixture[str]) -> None:
    import os
    from concurrent.futures import ThreadPoolExecutor

    def loud(n: int) -> None:
        with quiet():
            os.write(2, b"a library says something\n")
            time.sleep(0.001 * (n % 3))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(loud, range(40)))
    os.write(2, b"after")
    assert capfd.readouterr().err == "after"


@pytest.mark.parametrize("read", [read_volume, read_label_map, read_mesh, read_image, read_landmarks])
def test_what_a_disk_does_not_give_is_told_with_its_name(read: Callable[[Path], object]) -> None:
    """The memory of a process is a regular file whose first bytes cannot be read."""
    with pytest.raises(InputError, match=r"/proc/self/mem: "):
        read(Path("/proc/self/mem"))
