"""Cases that are made wrong stay cases, and are wrong in the way that their name says."""

from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh

from femoreg_torch.case.femoroplasty import DEVICE
from femoreg_torch.files import read_json, write_json
from femoreg_torch.geometry import transform_points
from femoreg_torch.volume import (
    Volume,
    axis_aligned,
    read_ct,
    read_labels,
    read_landmarks,
    write_landmarks,
    write_volume,
)
from sim.patient import Patient
from sim.study.faults import (
    FAULTS,
    break_femur,
    mirror_device,
    mirror_patient,
    mirror_second_view,
    read_case_file,
    repeat_first_view,
    take_another_patient,
    write_case_file,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A left femur that reaches further out than the right one, a lopsided device, and three views that differ."""
    labels = torch.zeros(10, 10, 40, dtype=torch.uint8)
    labels[2:8, 2:8, 30:38] = 5
    labels[2:8, 2:8, 4:8] = 6
    affine = axis_aligned((2.0, 2.0, 2.0), (-39.0, -9.0, -9.0))
    write_volume(tmp_path / "labels.nii.gz", Volume(labels, affine))
    write_volume(tmp_path / "ct.nii.gz", Volume(torch.where(labels > 0, 300.0 + labels, -1000.0), affine))
    write_landmarks(
        tmp_path / "landmarks.json",
        {"FH-l": torch.tensor([28.0, 1.0, 2.0]).double(), "FH-r": torch.tensor([-27.0, 0.0, 1.0]).double()},
    )
    trimesh.creation.box((4, 6, 30)).apply_translation((3, 0, 0)).export(tmp_path / f"{DEVICE}.stl")
    views = []
    for view in (1, 2, 3):
        names = {"anatomy": f"view{view}.tif", DEVICE: f"view{view}_device.tif"}
        for number, name in enumerate(names.values()):
            ramp = np.tile(np.arange(8, dtype=np.uint16), (6, 1)) + 10 * view + 100 * number
            sitk.WriteImage(sitk.GetImageFromArray(ramp.astype(np.uint16)), str(tmp_path / name))
        views.append(names)
    write_case_file(
        tmp_path, {"side": "left", "plan": {"entry_point": [31.0, 2.0, 3.0], "target": "FH"}, "views": views}
    )
    poses = [np.diag([1.0, 1, 1, 1]).tolist(), np.diag([-1.0, -1, 1, 1]).tolist()]
    write_json(tmp_path / "truth.json", {"camera_from_pelvis": poses})
    return tmp_path


def test_a_mirrored_patient_keeps_its_sides(folder: Path) -> None:
    before = read_labels(folder / "labels.nii.gz", read_ct(folder / "ct.nii.gz"))
    mirror_patient(folder)
    ct = read_ct(folder / "ct.nii.gz")
    after = read_labels(folder / "labels.nii.gz", ct)
    for volume, sign, bone in ((before, 1, 5), (after, 1, 5), (before, -1, 6), (after, -1, 6)):
        x = transform_points(volume.lps_from_index, (volume.data == bone).nonzero().flip(1).double())[:, 0]
        assert (sign * x > 0).all()
    assert (after.data == 5).sum() == (before.data == 6).sum()  # what was the right femur
    assert torch.equal(ct.data == 300 + 6, after.data == 5)
    points = read_landmarks(folder / "landmarks.json")
    torch.testing.assert_close(points["FH-l"], torch.tensor([27.0, 0.0, 1.0]).double())
    assert read_case_file(folder)["plan"]["entry_point"] == pytest.approx([30.0, 1.0, 2.0])


def test_a_mirrored_view_and_a_repeated_one(folder: Path) -> None:
    def read(name: str) -> np.ndarray:
        return sitk.GetArrayFromImage(sitk.ReadImage(str(folder / name)))

    second, first = read("view2_device.tif"), read("view1_device.tif")
    mirror_second_view(folder)
    np.testing.assert_array_equal(read("view2_device.tif"), second[:, ::-1])
    np.testing.assert_array_equal(read("view1_device.tif"), first)
    repeat_first_view(folder)
    np.testing.assert_array_equal(read("view2_device.tif"), first)
    np.testing.assert_array_equal(read("view3.tif"), read("view1.tif"))
    poses = read_json(folder / "truth.json")["camera_from_pelvis"]
    assert poses[1] == poses[0]


def test_a_mirrored_device_is_a_closed_surface_on_the_other_side(folder: Path) -> None:
    mirror_device(folder)
    mesh = trimesh.load_mesh(folder / f"{DEVICE}.stl")
    assert mesh.is_volume
    assert mesh.volume == pytest.approx(4 * 6 * 30)
    assert mesh.center_mass == pytest.approx([-3, 0, 0], abs=1e-6)


def test_another_patient_takes_the_place_of_the_right_one_and_keeps_the_plan(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, float]] = []

    def small(seed: int, spacing_mm: float) -> Patient:
        asked.append((seed, spacing_mm))
        ct = Volume(torch.linspace(-1000, 900, 1000).reshape(10, 10, 10), axis_aligned((2.0,) * 3, (0.0,) * 3))
        points = {"FH-l": torch.tensor([1.0, 2.0, 3.0]).double(), "FH-r": torch.zeros(3).double()}
        return Patient(ct, ct.with_data((ct.data > 0).to(torch.uint8)), points, {})

    monkeypatch.setattr("sim.study.faults.make_patient", small)
    take_another_patient(folder)
    assert asked == [(990001, pytest.approx(2.0))]
    assert read_ct(folder / "ct.nii.gz").data.shape == (10, 10, 10)
    assert set(read_landmarks(folder / "landmarks.json")) == {"FH-l", "FH-r"}
    assert read_case_file(folder)["plan"]["entry_point"] == pytest.approx([4.0, 3.0, 4.0])  # 3, 1, 1 from the head


def test_the_neck_breaks_and_the_shaft_stays(tmp_path: Path) -> None:
    """A straight femur along x from its head at the origin: what is nearer than 32 mm has turned by 20° about y."""
    affine = axis_aligned((1.0, 1.0, 1.0), (-10.0, -10.0, -40.0))
    labels = torch.zeros(81, 21, 91, dtype=torch.uint8)
    labels[35:46, 5:16, 5:86] = 5  # x from -5 to 75, z from -5 to 5
    labels[70:, :, :] = 1  # the pelvis, out of reach
    write_volume(tmp_path / "labels.nii.gz", Volume(labels, affine))
    write_volume(tmp_path / "ct.nii.gz", Volume(torch.where(labels == 5, 500.0, -100.0), affine))
    write_landmarks(tmp_path / "landmarks.json", {"FH-l": torch.zeros(3).double()})
    write_case_file(tmp_path, {"side": "left", "plan": {"entry_point": [75.0, 0.0, 0.0], "target": "FH"}})
    break_femur(tmp_path)
    ct = read_ct(tmp_path / "ct.nii.gz")
    after = read_labels(tmp_path / "labels.nii.gz", ct)
    x = torch.arange(91) - 10
    assert torch.equal(after.data[..., x > 33], labels[..., x > 33])
    assert torch.equal(after.data == 1, labels == 1)
    neck = (after.data == 5)[..., (x > 18) & (x < 22)].nonzero()[:, 0].double() - 40
    assert abs(neck.mean().item()) == pytest.approx(20 * np.tan(np.radians(20)), abs=1)
    assert (ct.data[after.data == 5] > 200).float().mean() > 0.9
    assert (ct.data[(labels == 5) & (after.data == 0)] == 40).all()  # soft tissue where the neck was


@pytest.mark.parametrize(("fault", "bend_mm"), [("bent device", 12), ("slightly bent device", 6)])
def test_a_bent_device_is_closed_and_its_base_stays(fault: str, bend_mm: float, folder: Path) -> None:
    straight = trimesh.load_mesh(folder / f"{DEVICE}.stl")
    FAULTS[fault](folder)
    bent = trimesh.load_mesh(folder / f"{DEVICE}.stl")
    assert bent.is_volume
    assert bent.volume == pytest.approx(straight.volume)
    shift = bent.bounds[1] - straight.bounds[1]
    assert shift == pytest.approx([0, bend_mm * 0.15**2, 0])
