"""Small files of the documented layouts of DeepFluoro and xReg are read as they are."""

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from fuzz_faults import full_after

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import centred_camera, project_points, transform_points
from femoreg_torch.neighbours.deepfluoro import (
    is_full_resolution,
    read_pictures,
    read_preprocessed,
    read_specimen,
    specimens,
)
from femoreg_torch.neighbours.xreg import read_projections, read_transform, write_transform
from training.labelled import deepfluoro_images

SIZE = 136
INTRINSIC = [[-1020 / 1.94, 0, 67.5], [0, -1020 / 1.94, 67.5], [0, 0, 1]]
EXTRINSIC = [  # of the public file, made exactly rigid below
    [0.00141739, 5.7733e-6, 0.9999991, -157.58221],
    [-0.99999076, -0.0040758, 0.0014174, -2.6757495],
    [0.0040758, -0.9999918, 0, -631.7765],
    [0, 0, 0, 1],
]
FH = np.array([93.0, 38.0, -940.0])


def extrinsic() -> np.ndarray:
    matrix = np.array(EXTRINSIC)
    u, _, v = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = u @ v
    return matrix


def lps_from_world() -> np.ndarray:
    """A pose with the source behind the patient, whose left femoral head lies on the central ray, 750 mm deep."""
    xreg_from_lps = np.eye(4)
    xreg_from_lps[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # columns to the left, rows to the feet, z to the back
    xreg_from_lps[:3, 3] = np.array([0, 0, -750]) - xreg_from_lps[:3, :3] @ FH
    return np.linalg.inv(xreg_from_lps) @ extrinsic()


@pytest.fixture(scope="module")
def full(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("deepfluoro") / "full.h5"
    rng = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        for name, value in (("extrinsic", extrinsic()), ("intrinsic", INTRINSIC)):
            file[f"proj-params/{name}"] = np.array(value, np.float32)
        for name, value in (("num-cols", SIZE), ("num-rows", SIZE)):
            file[f"proj-params/{name}"] = np.uint64(value)
        for name in ("pixel-col-spacing", "pixel-row-spacing"):
            file[f"proj-params/{name}"] = np.float32(1.94)
        group = file.create_group("17-1882")
        for name, dtype in (("vol", np.float32), ("vol-seg/image", np.uint8)):
            group[f"{name}/dir-mat"], group[f"{name}/origin"] = np.eye(3), np.array([[1.0], [2.0], [3.0]])
            group[f"{name}/spacing"] = np.array([[1.0], [1.0], [2.0]])
            group[f"{name}/pixels"] = np.arange(240).reshape(8, 6, 5).astype(dtype)
        for name in HIP.landmark_names:
            group[f"vol-landmarks/{name}"] = FH.reshape(3, 1).astype(np.float32)
        for number, turned in (("000", 0), ("001", 1)):
            one = group.create_group(f"projections/{number}")
            one["image/pixels"] = rng.integers(100, 60000, (SIZE, SIZE)).astype(np.float32)
            one["gt-landmarks/FH-l"] = np.array([[67.5], [67.5]], np.float32)
            one["gt-landmarks/SPS-l"] = np.array([[30.0], [100.0]], np.float32)
            one["gt-poses/cam-to-pelvis-vol"] = lps_from_world()
            one["gt-poses/cam-to-left-femur-vol"] = lps_from_world()
            one["gt-poses/left-femur-good-fov"] = np.uint8(0)
            one["gt-seg/pixels"] = rng.integers(0, 7, (SIZE, SIZE)).astype(np.uint8)
            one["rot-180-for-up"] = np.uint8(turned)
    return path


def test_the_full_resolution_file(full: Path) -> None:
    assert is_full_resolution(full)
    assert specimens(full) == ["17-1882"]
    specimen = read_specimen(full, "17-1882")
    assert specimen.ct.data.shape == (8, 6, 5)
    assert (specimen.ct.lps_from_index @ torch.tensor([1.0, 1, 1, 1], dtype=torch.float64)).tolist() == [2, 3, 5, 1]
    plain, turned = read_pictures(full, "17-1882")
    assert (plain.display, turned.display) == (Display("posterior"), Display("posterior", turned_deg=180))
    assert set(plain.camera_from) == {"pelvis"}  # the femur is not to be trusted
    camera = plain.display.camera(plain.camera)
    assert (camera.sdd_mm, camera.pixel_mm[0]) == pytest.approx((1020, 1.94), rel=1e-6)
    head = transform_points(plain.camera_from["pelvis"], torch.from_numpy(FH)[None])
    assert head[0].tolist() == pytest.approx([0, 0, 750], abs=1e-3)
    assert project_points(camera, head)[0].tolist() == pytest.approx([67.5, 67.5], abs=1e-3)
    # what lies 10 mm to the patient's left is seen on the right as stored, and on the left from the source
    beside = project_points(
        camera, transform_points(plain.camera_from["pelvis"], torch.from_numpy(FH + np.array([10.0, 0, 0]))[None])
    )
    assert beside[0, 0] < 67.5
    assert plain.display.pixels_to_stored(beside, camera)[0, 0] > 67.5


def test_its_images_are_ready_to_be_measured(full: Path) -> None:
    images = list(deepfluoro_images(full))
    assert [image.camera.shape for image in images] == [(36, 36)] * 2  # less 50 pixels at each border
    for image in images:
        head = transform_points(image.camera_from_lps, image.points[:1])
        torch.testing.assert_close(project_points(image.camera, head)[0], image.landmarks[0], atol=1e-3, rtol=0)
        assert image.visible[0]
        assert image.display.left_on_left
        assert image.posed


def test_the_preprocessed_file(tmp_path: Path) -> None:
    path, detector = tmp_path / "ds.h5", centred_camera(1020.0, (0.194, 0.194), (1536, 1536))
    with h5py.File(path, "w") as file:
        file["land-names/num-lands"] = 14
        for n, name in enumerate(HIP.landmark_names):
            file[f"land-names/land-{n:02d}"] = name
        file["01/projs"] = np.random.default_rng(0).random((2, 90, 90), np.float32) * 5
        file["01/segs"] = np.zeros((2, 90, 90), np.uint8)
        file["01/lands"] = np.stack([np.arange(28).reshape(2, 14)] * 2).astype(np.float32)
    assert not is_full_resolution(path)
    one, _ = read_preprocessed(path, detector)
    assert one.intensity == "log"
    assert one.landmarks["FH-r"].tolist() == [1, 15]  # columns first, then rows
    assert (one.camera.shape, one.camera.sdd_mm) == ((90, 90), 1020)
    assert (*one.camera.pixel_mm, *one.camera.principal_point_px) == pytest.approx((3.104, 3.104, 44.84375, 44.84375))
    assert not next(iter(deepfluoro_images(path))).posed


def test_projection_data_of_xreg(tmp_path: Path) -> None:
    path = tmp_path / "proj.h5"
    pixels = np.arange(12, dtype=np.float32).reshape(3, 4)
    with h5py.File(path, "w") as file:
        file["num-projs"] = np.uint64(1)
        cam = file.create_group("proj-000/cam")
        cam["num-rows"], cam["num-cols"] = np.uint64(3), np.uint64(4)
        cam["row-spacing"], cam["col-spacing"] = 0.5, 0.5
        cam["cam-coord-frame-type"] = "origin-at-focal-pt-det-neg-z"
        cam["intrinsic"], cam["extrinsic"] = np.diag([-2000.0, -2000, 1]), extrinsic()
        file["proj-000/img/pixels"] = pixels
        file["proj-000/landmarks/FH-l"] = np.array([[1.0], [2.0]])
        file["proj-000/rot-to-pat-up"] = 180
    (read,) = read_projections(path)
    assert read.image is not None
    np.testing.assert_array_equal(read.image, pixels)
    assert (read.camera.camera.sdd_mm, read.turn_deg, read.landmarks["FH-l"].tolist()) == (1000, 180, [1, 2])


@pytest.mark.parametrize("name", ["pose.h5", "pose.tfm"])
def test_itk_transforms_come_back(tmp_path: Path, name: str) -> None:
    pose = torch.from_numpy(lps_from_world())
    write_transform(tmp_path / name, pose)
    torch.testing.assert_close(read_transform(tmp_path / name), pose, atol=1e-9, rtol=0)
    with pytest.raises((InputError, OSError)):
        write_transform(tmp_path / "none" / name, pose)


def test_a_transform_of_another_name_or_kind_is_refused(tmp_path: Path) -> None:
    pose = torch.eye(4, dtype=torch.float64)
    for name, matrix, says in (
        ("pose.foo", pose, "a name that ends in .h5 or .tfm or .txt was expected"),
        ("pose.tfm", 2 * pose, "not a rigid transform"),
        ("pose.tfm", pose[:3], "a 4×4 matrix was expected"),
    ):
        with pytest.raises(InputError, match=says):
            write_transform(tmp_path / name, matrix)
    assert list(tmp_path.iterdir()) == []


def test_a_transform_that_a_full_disk_cuts_off_is_told(tmp_path: Path) -> None:
    """As text; where HDF5 cannot close a file, ITK says so, and the process cannot end in order any more."""
    path, pose = tmp_path / "pose.tfm", torch.from_numpy(lps_from_world())
    write_transform(path, pose)
    size = path.stat().st_size
    path.unlink()
    for missing in (30, 60, size // 2):
        with full_after(size - missing), pytest.raises(OSError, match=r"disk full|too large"):
            write_transform(path, pose)
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("part", "value", "told"), [
    ("vol/spacing", np.array([[1.0], [0.0], [2.0]]), "spacing is not above 0"),
    ("vol/dir-mat", np.array([[1.0, 0.2, 0], [0, 1, 0], [0, 0, 1]]), "not at right angles"),
    ("vol-seg/image/pixels", np.full((8, 6, 5), 1.9), "labels are whole numbers from 0 to 255"),
    ("vol-seg/image/pixels", np.full((8, 6, 5), -1), "labels are whole numbers from 0 to 255"),
    ("vol-seg/image/pixels", np.ones((8, 6, 4), np.uint8), "another size than its CT"),
])  # fmt: skip
def test_a_specimen_that_cannot_be_is_refused(
    tmp_path: Path, full: Path, part: str, value: np.ndarray, told: str
) -> None:
    shutil.copy(full, tmp_path / "bad.h5")
    with h5py.File(tmp_path / "bad.h5", "a") as file:
        del file[f"17-1882/{part}"]
        file[f"17-1882/{part}"] = value
    with pytest.raises(InputError, match=told):
        read_specimen(tmp_path / "bad.h5", "17-1882")


def test_what_is_missing_is_named(tmp_path: Path, full: Path) -> None:
    (tmp_path / "text.h5").write_text("nothing", encoding="utf-8")
    for path, message in ((tmp_path / "no.h5", "no such file"), (tmp_path / "text.h5", "cannot be read as HDF5")):
        with pytest.raises(InputError, match=message):
            is_full_resolution(path)
    with pytest.raises(InputError, match="no projection data of xReg"):
        read_projections(full)
    with pytest.raises(InputError, match=r"`18-1109/vol-landmarks` is missing"):
        read_specimen(full, "18-1109")
