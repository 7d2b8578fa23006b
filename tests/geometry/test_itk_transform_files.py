"""Transforms of ITK and 3D Slicer: every linear kind in every format, and numbers that do not fit their kind."""

import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
import SimpleITK as sitk
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import read_itk_transform

AFFINE = (
    "#Insight Transform File V1.0\n#Transform 0\nTransform: AffineTransform_double_3_3\nParameters: {}\n"
    "FixedParameters: {}\n"
)
KINDS = {
    "euler": sitk.Euler3DTransform((1, 2, 3), 0.1, 0.2, 0.3, (4, 5, 6)),
    "versor": sitk.VersorRigid3DTransform((0, 1, 0), 0.3, (1, 2, 3)),
    "translation": sitk.TranslationTransform(3, (1, 2, 3)),
    "identity": sitk.Transform(3, sitk.sitkIdentity),
}


@pytest.mark.parametrize("suffix", ["tfm", "txt", "mat", "h5"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_in_every_format(tmp_path: Path, kind: str, suffix: str) -> None:
    path = tmp_path / f"pose.{suffix}"
    sitk.WriteTransform(KINDS[kind], str(path))
    matrix = read_itk_transform(path)
    point = (10.0, -20.0, 30.0)
    there = torch.tensor([*KINDS[kind].TransformPoint(point), 1.0], dtype=torch.float64)
    assert torch.allclose(matrix @ there, torch.tensor([*point, 1.0], dtype=torch.float64))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (AFFINE.format("1 0 0 0 1 0 0 0 1", "0 0 0"), "9 parameters"),
        (AFFINE.format("1 0 0 0 1 0 0 0 1 0 0 0", "0"), "1 fixed"),
        (AFFINE.format("1 0 0 0 1 0 0 0 1 nan 0 0", "0 0 0"), "not all finite"),
        (AFFINE.format("1 0 0 0 1 0 0 0 1 0 0 0", "0 0 0").replace("Affine", "BSpline"), "rigid transform"),
        (AFFINE.format("1 0 0 0 1 0 0 0 1 0 0 0", "0 0 0").replace("Parameters", "Parameter", 1), "one transform"),
        ("", r"is empty \(0 bytes\)"),
    ],
)
def test_numbers_that_do_not_fit_never_reach_itk(tmp_path: Path, text: str, says: str) -> None:
    """ITK crashes on some of them."""
    path = tmp_path / "pose.tfm"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=says):
        read_itk_transform(path)


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("TransformParameters", np.zeros(5), "5 parameters"),
        ("TransformParameters", (2**40,), "at most 64 numbers"),
        ("TransformFixedParameters", np.zeros(2), "2 fixed"),
        ("TransformParameters", np.full(6, np.nan), "not all finite"),
        ("TransformParameters", h5py.Empty("f"), "is empty"),
        ("TransformType", h5py.Empty("f"), "is empty"),
    ],
)
def test_hdf5_files_of_other_numbers(tmp_path: Path, name: str, value: object, says: str) -> None:
    """A data set of 8 TiB takes a few bytes in a file."""
    path = tmp_path / "pose.h5"
    sitk.WriteTransform(KINDS["euler"], str(path))
    with h5py.File(path, "a") as file:
        group = file["TransformGroup/0"]
        del group[name]
        if isinstance(value, tuple):
            group.create_dataset(name, value, "f8", chunks=True)
        else:
            group.create_dataset(name, data=value)
    with pytest.raises(InputError, match=says):
        read_itk_transform(path)


@pytest.mark.parametrize("suffix", ["mat", "h5", "tfm"])
def test_a_file_that_is_cut_off(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"pose.{suffix}"
    sitk.WriteTransform(KINDS["euler"], str(path))
    content = path.read_bytes()
    for size in (0, 1, len(content) // 2, len(content) - 12):
        path.write_bytes(content[:size])
        with pytest.raises(InputError, match=rf"pose\.{suffix}"):
            read_itk_transform(path)


def test_a_file_of_another_name_is_no_transform(tmp_path: Path) -> None:
    (tmp_path / "pose.nii").write_bytes(bytes(400))
    with pytest.raises(InputError, match=r"a name that ends in \.tfm"):
        read_itk_transform(tmp_path / "pose.nii")


def test_a_number_format_that_is_not_known_is_refused_without_a_warning(tmp_path: Path) -> None:
    """A MATLAB file of version 4 from a VAX."""
    header = np.array([2000, 1, 1, 0, 2], "<i4").tobytes()
    (tmp_path / "a.mat").write_bytes(header + b"x\0" + bytes(8))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=r"a\.mat"):
            read_itk_transform(tmp_path / "a.mat")
