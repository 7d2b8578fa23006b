"""A device as a mesh and the same one as a labelled volume are registered to the same pose; devices have parts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh
from registration_scenes import CARM, VOLUMES, error, float64, make_scene, off, true_poses
from torch import Tensor

from femoreg_torch.case import Case, CaseObject, Model, Part, Start, View
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import binned
from femoreg_torch.geometry import CArm, centred_camera
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import BodyPlan, Level, OrbitSearch, Plan, Scene, Stage, run_plan
from femoreg_torch.registration.prepare.models import model_attenuation
from femoreg_torch.registration.prepare.scene import prepare_scene
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import voxelise_mesh
from femoreg_torch.volume.materials import material_hu

FINE = Level(pixel_mm=1.5, step_mm=0.5)
COARSE = Level(pixel_mm=3, step_mm=0.5)
FINE_CARM = replace(CARM, camera=centred_camera(1020.0, (1.5, 1.5), (176, 176)))
SIMILARITY = GradNcc(patch_radius=4)
TRUTH = true_poses()
CENTRE = float64(10, 4, 40)
BOXES = [((14, 14, 80), (7, 7, 40)), ((40, 10, 16), (20, 5, 20)), ((10, 30, 12), (6, 15, 60))]  # size and middle, mm


def as_mesh(path: Path) -> Model:
    parts = [trimesh.creation.box(size).apply_translation(middle) for size, middle in BOXES]
    trimesh.util.concatenate(parts).export(path)
    return Model(path, 5000.0)


def as_labels(path: Path) -> Model:
    """The same boxes as label 2, by which voxel centres lie inside them; 0.5 mm voxels."""
    z, y, x = np.meshgrid(*(np.arange(-2.25, high, 0.5) for high in (83, 33, 43)), indexing="ij")
    inside = np.zeros(x.shape, bool)
    for size, middle in BOXES:
        inside |= np.all([abs(c - m) < s / 2 for c, m, s in zip((x, y, z), middle, size, strict=True)], axis=0)
    image = sitk.GetImageFromArray(2 * inside.astype(np.uint8))
    image.SetSpacing((0.5,) * 3)
    image.SetOrigin((-2.25,) * 3)
    sitk.WriteImage(image, str(path))
    return Model(path, 5000.0, labels=(2,))


def scene_of(device: Model, images: tuple[Tensor, ...]) -> Scene:
    objects = {
        "pelvis": RigidObject(VOLUMES["pelvis"], float64(0, 0, 0), ("anatomy", "device")),
        "device": RigidObject(
            model_attenuation(device).volume,
            CENTRE,
            ("device",),
            Start(camera1_from=torch.eye(4, dtype=torch.float64)),
        ),
    }
    return Scene(FINE_CARM, objects, {"anatomy": images, "device": images})


def test_a_labelled_volume_registers_as_the_mesh(tmp_path: Path) -> None:
    mesh, labels = as_mesh(tmp_path / "device.stl"), as_labels(tmp_path / "device.nii.gz")
    fine = voxelise_mesh(trimesh.load_mesh(mesh.path), 0.25, 5000.0)
    camera = centred_camera(1020.0, (0.75, 0.75), (352, 352))  # twice as fine as what is registered
    true = TRUTH.camera1_from["device"].clone()
    true[:3, 3] = float64(10, 12, 560) - true[:3, :3] @ CENTRE  # its middle is well within all images
    placed = TRUTH.with_object("device", true)
    images = []
    for view in range(3):
        where = torch.stack([placed.camera_from(name)[view] for name in ("pelvis", "device")])[None]
        image = project([VOLUMES["pelvis"], fine], where, camera, 0.25)
        images.append(binned(image[0], 2))
    start = placed.with_object("device", off(true, CENTRE, (3, -2, 2), (3, -2, 4)))
    stage = Stage(
        "device",
        "all",
        ["device"],
        ["pelvis", "device"],
        [BodyPlan(["device"], [2, 2, 2], [3, 3, 3])],
        FINE,
        SIMILARITY,
        LevenbergMarquardt(max_iterations=20),
    )
    by_mesh, by_labels = (
        run_stage(scene_of(device, tuple(images)), start, stage, (0, 1, 2), seed=0).poses.camera1_from["device"]
        for device in (mesh, labels)
    )
    for found in (by_mesh, by_labels):
        mm, deg = error(found, true, CENTRE)
        assert mm < 0.15
        assert deg < 0.1
    x, y, depth = ((by_labels - by_mesh) @ torch.cat([CENTRE, float64(1)]))[:3].abs().tolist()
    assert max(x, y) < 0.03
    assert depth < 0.1  # views 25° apart


def write_two_boxes(folder: Path) -> Model:
    """A block of PEEK, 20 mm thick along z, and a plate of steel, 10 mm, on its far side, as bodies of one file."""
    block = trimesh.creation.box(bounds=[[-30, -20, -20], [30, 20, 0]])
    plate = trimesh.creation.box(bounds=[[-15, -10, 0], [15, 10, 10]])
    trimesh.Scene({"block": block, "plate": plate}).export(folder / "device.3mf")
    parts = [Part(folder / "device.3mf", material=m, body=b) for b, m in (("block", "peek"), ("plate", "steel"))]
    return Model(folder / "device.3mf", None, parts=tuple(parts))


def test_a_box_of_two_materials_projects_as_its_closed_form(tmp_path: Path) -> None:
    made = model_attenuation(write_two_boxes(tmp_path))
    mu = [(material_hu(name) + 1000) * 2.6828e-5 for name in ("peek", "steel")]
    for part, per_mm, volume in zip(made.parts, mu, (60 * 40 * 20, 30 * 20 * 10), strict=True):
        assert part.data.sum() * 0.125 == pytest.approx(per_mm * volume, rel=0.01)
        assert torch.equal(part.lps_from_index, made.volume.lps_from_index)
    assert torch.allclose(made.volume.data, made.parts[0].data + made.parts[1].data)
    camera = centred_camera(1000.0, (1.0, 1.0), (41, 61))
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 800
    image = project([made.volume], pose[None, None], camera, 0.1)[0]
    row, column = torch.meshgrid(torch.arange(41.0) - 20, torch.arange(61.0) - 30, indexing="ij")
    slant = (1 + (row**2 + column**2) / 1000**2).sqrt()  # every ray shown passes both boxes or the block alone
    behind = (column.abs() * 0.81 < 15) & (row.abs() * 0.81 < 10)  # the plate's far side, at a depth of 810 mm
    edge = ((column.abs() * 0.805 - 15).abs() < 1) | ((row.abs() * 0.805 - 10).abs() < 1)
    expected = slant * (20 * mu[0] + 10 * mu[1] * behind)
    assert torch.allclose(image[~edge].double(), expected[~edge].double(), rtol=0.01)


def test_parts_reach_the_scene(tmp_path: Path) -> None:
    """In files of their own, the sleeve through the handle; and how well the materials of each object are known."""
    trimesh.creation.box((10, 10, 60)).export(tmp_path / "sleeve.stl")
    trimesh.creation.box((30, 20, 20)).export(tmp_path / "handle.stl")
    sitk.WriteImage(sitk.GetImageFromArray(np.arange(81, dtype=np.float32).reshape(9, 9)), str(tmp_path / "view.tif"))
    handle, sleeve = (tmp_path / f"{name}.stl" for name in ("handle", "sleeve"))
    models = {
        "tool": Model(handle, None, parts=(Part(handle, hu=900), Part(sleeve, material="steel"))),
        "guess": Model(sleeve, 5000.0),
        "named": Model(sleeve, None, material="steel"),
    }
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = 500
    start = Start(camera1_from=pose)
    objects = {name: CaseObject(name, model=model, start=start) for name, model in models.items()}
    carm = CArm(centred_camera(1000.0, (1.0, 1.0), (9, 9)), (0.0, 0.0, 500.0), (0.0, 1.0, 0.0))
    case = Case(tmp_path, carm, objects, views=(View({"image": tmp_path / "view.tif"}, "log"),))
    made = prepare_scene(case).objects
    assert [len(thing.parts) for thing in made.values()] == [2, 1, 1]
    assert [thing.materials_known for thing in made.values()] == [True, False, True]
    assert made["guess"].parts[0] is made["guess"].volume
    steel = made["tool"].parts[1].data.sum() * 0.125 / ((material_hu("steel") + 1000) * 2.6828e-5)
    plastic = made["tool"].parts[0].data.sum() * 0.125 / (1900 * 2.6828e-5)
    assert [float(steel), float(plastic)] == pytest.approx([6000, 30 * 20 * 20 - 2000], rel=0.01)


def test_a_model_in_metres_is_refused(tmp_path: Path) -> None:
    trimesh.creation.box((0.01, 0.01, 0.06)).export(tmp_path / "device.stl")
    with pytest.raises(InputError, match=r"device\.stl: its longest edge is 0\.06 mm"):
        model_attenuation(Model(tmp_path / "device.stl", 5000.0))


def test_an_orbit_search_looks_at_the_kind_of_image_it_names() -> None:
    """The anatomy's images are blank here, so that only those with the device can tell the angle."""
    scene = make_scene(TRUTH)
    blank = tuple(torch.zeros_like(image) for image in scene.images["anatomy"])
    scene = replace(scene, images={**scene.images, "anatomy": blank})
    plan = Plan("test", (OrbitSearch("orbit", ["device"], ["device"], 20, 5, COARSE, SIMILARITY),))
    found = run_plan(scene, plan, TRUTH.camera1_from["pelvis"], 0, lambda *_: None).poses.camera_from_camera1
    for view in (1, 2):
        assert error(found[view], TRUTH.camera_from_camera1[view], float64(0, 0, 632))[1] < 3.0


def test_views_by_a_device_that_is_in_no_image_are_refused() -> None:
    scene = make_scene(TRUTH, with_device=False)
    plan = Plan("mine", (OrbitSearch("orbit", ["device"], ["device"], 20, 5, COARSE, SIMILARITY),))
    with pytest.raises(
        InputError, match=r"registration preset mine, step “orbit”: it finds the C-arm .* the kind “device”"
    ):
        run_plan(scene, plan, TRUTH.camera1_from["pelvis"], 0, lambda *_: None)
