"""MetaImage and NRRD files that ITK crashes on, or reads wrongly, never reach it."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, read_label_map, read_volume
from femoreg_torch.volume.itk import read_itk

VOXELS = np.random.default_rng(0).integers(-900, 900, (9, 8, 7)).astype(np.int16)
HOSTILE = ("LOCA4\xfcD\xbf", "x" * 5000, "nowhere.raw", "/dev/zero", ".", "", "LIST", "x%02d.raw 1 9 1")


def written(path: Path, compressed: bool = False) -> Path:
    sitk.WriteImage(sitk.GetImageFromArray(VOXELS), str(path), compressed)
    return path


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("name", ["a.mha", "a.mhd", "a.nrrd", "a.nhdr"])
def test_what_itk_writes_is_read(name: str, compressed: bool, tmp_path: Path) -> None:
    assert (sitk.GetArrayFromImage(read_itk(written(tmp_path / name, compressed))) == VOXELS).all()


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("kind", [np.uint8, np.int8, np.uint16, np.uint32, np.int64, np.uint64, np.float32, np.float64])
def test_types_of_numbers(kind: type[np.generic], channels: int, tmp_path: Path) -> None:
    values = np.arange(60 * channels, dtype=kind).reshape(3, 4, 5, channels)
    for suffix in ("mha", "nrrd"):
        image = sitk.GetImageFromArray(values if channels > 1 else values[..., 0], isVector=channels > 1)
        sitk.WriteImage(image, str(tmp_path / f"a.{suffix}"))
        assert (sitk.GetArrayFromImage(read_itk(tmp_path / f"a.{suffix}")).ravel() == values.ravel()).all()


def test_names_of_files_that_are_not_there(tmp_path: Path) -> None:
    """In a process of its own: MetaIO and NrrdIO crash on some of these."""
    header = written(tmp_path / "a.mhd").read_bytes(), written(tmp_path / "a.nhdr").read_bytes()
    paths = []
    for n, source in enumerate(HOSTILE):
        for suffix, content in zip(("mhd", "nhdr"), header, strict=True):
            paths.append(tmp_path / f"{n}.{suffix}")
            assert b"a.raw" in content
            paths[-1].write_bytes(content.replace(b"a.raw", source.encode("latin-1")))
    code = """
import sys
from collections.abc import Callable
from pathlib import Path
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, read_label_map, read_volume
from femoreg_torch.volume.itk import read_itk
for path in sys.argv[1:]:
    try:
        read_itk(Path(path))
    except InputError as error:
        assert "values stand in" in str(error), error
    else:
        raise AssertionError(path)
"""
    assert subprocess.run([sys.executable, "-c", code, *map(str, paths)], check=False).returncode == 0


@pytest.mark.parametrize(
    ("name", "was", "becomes", "says"),
    [
        ("a.mha", b"NDims = 3", b"NDims = -1", "NDims"),
        ("a.mha", b"NDims = 3", b"NDims = 2147483648", "NDims"),
        ("a.mha", b"NDims = 3", b"NDims = 4", "DimSize"),
        ("a.mha", b"DimSize = 7 8 9", b"DimSize = 7 8", "DimSize"),
        ("a.mha", b"DimSize = 7 8 9", b"DimSize = 7 8 nine", "whole numbers"),
        ("a.mha", b"DimSize = 7 8 9", b"DimSize = 7 8 10", "claims 1120 bytes of values, found 1008"),
        ("a.mha", b"DimSize = 7 8 9", b"DimSize = 7 8 8", "claims 896 bytes"),
        ("a.mha", b"MET_SHORT", b"MET_STRING", "ElementType"),
        ("a.mha", b"MET_SHORT", b"MET_FLOAT", "claims 2016 bytes"),
        ("a.mha", b"CompressedData = False", b"CompressedData = True", "damaged"),
        ("a.mha", b"BinaryData = True", b"BinaryData = False", "BinaryData"),
        ("a.mha", b"NDims = 3", b"NDims = 3\nHeaderSize = 9999", "HeaderSize"),
        ("a.mha", b"NDims = 3", b"NDims = 3\nNDims = 3", "stands twice"),
        ("a.mha", b"ElementDataFile", b"ElementDatafile", "ElementDataFile"),
        ("a.mha", b"Offset = 0 0 0", b"Offset = nan 0 0", "`Offset` in its header is not a finite number"),
        ("a.nrrd", b"sizes: 7 8 9", b"sizes: 7 8 10", "claims 1120 bytes"),
        ("a.nrrd", b"type: short", b"type: block", "`type`"),
        ("a.nrrd", b"NRRD", b"DRRN", "no NRRD"),
        ("a.nrrd", b"space origin: (0,0,0)", b"space origin: (0,inf,0)", "space origin"),
        ("a.nrrd", b"endian", b"Type: short\nendian", "stands twice"),
    ],
)
def test_headers_that_cannot_be(name: str, was: bytes, becomes: bytes, says: str, tmp_path: Path) -> None:
    path = written(tmp_path / name)
    content = path.read_bytes()
    assert was in content
    path.write_bytes(content.replace(was, becomes))
    with pytest.raises(InputError, match=f"{name}: .*{says}"):
        read_itk(path)


@pytest.mark.parametrize("name", ["a.mha", "a.nrrd"])
def test_one_bit_of_compressed_values(name: str, tmp_path: Path) -> None:
    """ITK passes over most of these."""
    path = written(tmp_path / name, compressed=True)
    content = bytearray(path.read_bytes())
    for place in (-1, -3, -100, -300, -500):
        damaged = content.copy()
        damaged[place] ^= 16
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="damaged"):
            read_itk(path)
    path.write_bytes(content[:-200])
    with pytest.raises(InputError, match="damaged"):
        read_itk(path)


@pytest.mark.parametrize("becomes", [b"", b"CompressedDataSize = 10"])
def test_compressed_values_whose_size_is_not_told(tmp_path: Path, becomes: bytes) -> None:
    """ITK returns memory that nothing was written to."""
    path = written(tmp_path / "a.mha", compressed=True)
    content = path.read_bytes()
    path.write_bytes(re.sub(rb"CompressedDataSize = [0-9]+" + (b"" if becomes else b"\n"), becomes, content, count=1))
    with pytest.raises(InputError, match="bytes of compressed values follow its header"):
        read_itk(path)


def test_other_formats_that_itk_knows_are_not_meant(tmp_path: Path) -> None:
    for name in ("a.vtk", "a.gipl", "a.hdf5"):
        with pytest.raises(InputError, match=f"{name}: a name that ends in"):
            read_itk(written(tmp_path / name))


def test_what_users_add_to_an_nrrd_header(tmp_path: Path) -> None:
    path = written(tmp_path / "a.nrrd")
    more = b"encoding: raw\n# a: b\nSegment0_Name:=a: b\nSegment0_Name:=c\n"
    path.write_bytes(path.read_bytes().replace(b"encoding: raw\n", more))
    assert read_itk(path).GetSize() == (7, 8, 9)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("a.nrrd", 'space units: "cm" "cm" "cm"'),
        ("a.nrrd", 'space units: "m" "m" "m"'),
        ("a.nrrd", 'space units: "um" "um" "um"'),
        ("a.mha", "DistanceUnits = cm"),
    ],
)
def test_lengths_that_are_not_in_mm_are_refused(name: str, line: str, tmp_path: Path) -> None:
    """ITK reads 0.2 cm as 0.2 mm, a femur of the size of a bean that no other check tells."""
    path = written(tmp_path / name)
    mark = b"space directions" if name.endswith("nrrd") else b"ElementDataFile"
    path.write_bytes(path.read_bytes().replace(mark, line.encode() + b"\n" + mark, 1))
    with pytest.raises(InputError, match=r"lengths in (cm|m|um), but mm were expected"):
        read_itk(path)


@pytest.mark.parametrize("units", ['"mm" "mm" "mm"', '"" "" ""', '"???" "???" "???"'])
def test_units_that_are_mm_or_say_nothing_are_read(units: str, tmp_path: Path) -> None:
    path = written(tmp_path / "a.nrrd")
    path.write_bytes(path.read_bytes().replace(b"space dir", f"space units: {units}\nspace dir".encode(), 1))
    assert (sitk.GetArrayFromImage(read_itk(path)) == VOXELS).all()


@pytest.mark.parametrize("read", [read_volume, read_label_map])
@pytest.mark.parametrize("name", ["a.mha", "a.mhd", "a.nrrd", "a.nhdr"])
def test_voxels_of_no_size_are_refused(read: Callable[[Path], Volume], name: str, tmp_path: Path) -> None:
    """ITK reads them as of 1 mm, in which a CT of other voxels is another femur."""
    path = tmp_path / name
    sitk.WriteImage(sitk.GetImageFromArray(VOXELS.clip(0)), str(path))
    assert read(path).spacing_mm == (1.0, 1.0, 1.0)
    kept = [line for line in path.read_bytes().split(b"\n") if not line.startswith((b"ElementSpacing", b"space dir"))]
    path.write_bytes(b"\n".join(kept))
    with pytest.raises(InputError, match=r"no size of voxels .* add the line `(ElementSpacing = |spacings: )x y z`"):
        read(path)


def test_the_line_that_is_asked_for_mends_it(tmp_path: Path) -> None:
    path = tmp_path / "a.nrrd"
    header = "NRRD0004\ntype: int16\ndimension: 3\nsizes: 7 8 9\nencoding: raw\nendian: little\n"
    path.write_bytes(header.encode() + b"spacings: 0.5 0.5 2\n\n" + VOXELS.tobytes())
    assert read_volume(path).spacing_mm == (0.5, 0.5, 2.0)
