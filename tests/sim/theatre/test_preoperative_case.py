"""Planning on a femur of known shape, and folders that lack something."""

from dataclasses import replace

import pytest
import torch

from femoreg_torch.anatomy import label_table
from femoreg_torch.case import Model, Part, write_case
from femoreg_torch.case.femoroplasty import with_device
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points
from femoreg_torch.volume import Volume, axis_aligned, write_landmarks, write_volume
from sim.theatre.nominal_poses import nominal_ap
from sim.theatre.planned_path import neck_axis_entry
from sim.theatre.preoperative_case import read_preoperative
from sim.theatre.settings import load_simulation

IDS = label_table("femoreg")
HEAD = torch.tensor([80.0, -10.0, 5.0], dtype=torch.float64)
NECK = torch.nn.functional.normalize(torch.tensor([0.75, 0.2, -0.6], dtype=torch.float64), dim=0)
SHAFT_X = HEAD[0] + 45  # middle of the shaft; its lateral face is 14 mm farther out


def left_hip():
    """Labels at 1.5 mm of a left femur: spherical head, cylindrical neck along NECK, upright shaft; and pelvis."""
    affine = axis_aligned((1.5, 1.5, 1.5), (20.0, -60.0, -110.0))
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (110, 70, 90)), indexing="ij")
    points = torch.stack([x, y, z], -1) * 1.5 + affine[:3, 3]
    arm = points - HEAD
    along = arm @ NECK
    neck = ((arm - along[..., None] * NECK).norm(dim=-1) < 12) & (along > 0) & (along < 60)
    shaft_y = HEAD[1] + 45 / NECK[0] * NECK[1]
    shaft = ((points[..., 0] - SHAFT_X) ** 2 + (points[..., 1] - shaft_y) ** 2 < 14**2) & (points[..., 2] < HEAD[2] - 5)
    femur = (arm.norm(dim=-1) < 23) | (neck & (points[..., 0] < SHAFT_X)) | shaft
    labels = torch.zeros(points.shape[:3], dtype=torch.uint8)
    labels[femur] = IDS["femur_left"][0]
    labels[(points[..., 0] < 45) & ~femur] = IDS["hip_left"][0]
    return Volume(labels, affine)


@pytest.fixture
def folder(tmp_path):
    labels = left_hip()
    hu = torch.full(labels.data.shape, 40.0)
    hu[labels.data > 0] = 500
    hu[:, :2] = -1000  # air in front
    write_volume(tmp_path / "ct.nii.gz", labels.with_data(hu))
    write_volume(tmp_path / "labels.nii.gz", labels)
    write_landmarks(tmp_path / "landmarks.json", {"FH-l": HEAD})
    return tmp_path


def test_the_path_leaves_through_the_lateral_cortex_along_the_neck():
    entry = neck_axis_entry(left_hip(), IDS["femur_left"], HEAD)
    axis = torch.nn.functional.normalize(entry - HEAD, dim=0)
    assert torch.rad2deg(torch.acos(axis @ NECK)) < 3
    assert entry[0].item() == pytest.approx(SHAFT_X + 14, abs=1.5)
    assert entry[2] < HEAD[2] - 30


def test_a_bare_folder_becomes_a_planned_case_with_a_device(folder):
    settings = load_simulation("paper")
    known = read_preoperative(folder, "left", 3, settings, folder / "device.stl")
    case = known.case
    assert (folder / "device.stl").is_file()
    assert torch.equal(case.plan.target, HEAD)
    assert case.plan.tool == "device"
    assert list(case.objects) == ["pelvis", "femur", "device"]
    assert case.views == ()
    assert case.truth is None
    guide = transform_points(
        known.device.start.camera1_from, torch.stack([known.device.points[k] for k in ("base", "tip")])
    )
    path = nominal_ap(HEAD, "left", settings.acquisition)[:3, :3] @ (case.plan.target - case.plan.entry_point)
    assert ((guide[1] - guide[0]) @ path) > 0
    assert guide[:, 2].tolist() == pytest.approx([guide[0, 2].item()] * 2)
    assert settings.acquisition.device_depth_mm == pytest.approx(guide[:, 2].mean().item(), abs=30)


def test_the_seed_decides_the_device(folder):
    settings = load_simulation("paper")
    tips = [
        read_preoperative(folder, "left", seed, settings, folder / f"{n}.stl").device.points["tip"]
        for n, seed in enumerate((3, 3, 4))
    ]
    assert torch.equal(tips[0], tips[1])
    assert not torch.equal(tips[0], tips[2])


@pytest.mark.parametrize("missing", ["ct.nii.gz", "labels.nii.gz", "landmarks.json"])
def test_a_missing_file_is_named(folder, missing):
    (folder / missing).unlink()
    with pytest.raises(InputError, match=missing):
        read_preoperative(folder, "left", 1, load_simulation("paper"), folder / "device.stl")


def test_a_side_without_its_head_is_refused(folder):
    with pytest.raises(InputError, match="FH-r"):
        read_preoperative(folder, "right", 1, load_simulation("paper"), folder / "device.stl")


def test_a_head_far_from_the_femur_is_refused():
    with pytest.raises(InputError, match="FH"):
        neck_axis_entry(left_hip(), IDS["femur_left"], -HEAD)


def with_model(folder, model):
    """A case of the folder whose device has another model, beside a mesh that was written for it."""
    settings = load_simulation("paper")
    known = read_preoperative(folder, "left", 3, settings, folder / "device.stl")
    device = replace(known.device, model=model)
    write_case(folder, with_device(replace(known.case, folder=folder), device))
    return settings


def test_a_device_of_a_named_material_is_imaged_as_the_settings_say(folder):
    path = folder / "device.stl"
    settings = with_model(folder, Model(path, None, material="steel"))
    known = read_preoperative(folder, "left", 3, settings, folder / "unused.stl")
    assert known.device.model.hu == settings.acquisition.device_hu
    assert known.device.model.material is None


def test_a_device_of_parts_is_refused(folder):
    path = folder / "device.stl"
    settings = with_model(folder, Model(path, None, parts=(Part(path, material="steel"),)))
    with pytest.raises(InputError, match="has parts, but a simulation images one mesh"):
        read_preoperative(folder, "left", 3, settings, folder / "unused.stl")
