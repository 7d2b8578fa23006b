"""A device as a mesh and the same one as a labelled volume are registered to the same pose."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
import torch
import trimesh
from registration_scenes import CARM, VOLUMES, error, float64, make_scene, off, true_poses
from torch import Tensor

from femoreg_torch.case import Model, Start
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import BodyPlan, Level, OrbitSearch, Plan, Scene, Stage, prepare, run_plan
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import voxelise_mesh

LEVEL = Level(pixel_mm=3, step_mm=0.5)
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
            prepare.model_attenuation(device),
            CENTRE,
            ("device",),
            Start(camera1_from=torch.eye(4, dtype=torch.float64)),
        ),
    }
    return Scene(CARM, objects, {"anatomy": images, "device": images})


def test_a_labelled_volume_registers_as_the_mesh(tmp_path: Path) -> None:
    mesh, labels = as_mesh(tmp_path / "device.stl"), as_labels(tmp_path / "device.nii.gz")
    fine = voxelise_mesh(trimesh.load_mesh(mesh.path), 0.25, 5000.0)
    camera = centred_camera(1020.0, (1.5, 1.5), (176, 176))  # twice as fine as what is registered
    true = TRUTH.camera1_from["device"].clone()
    true[:3, 3] = float64(10, 12, 560) - true[:3, :3] @ CENTRE  # its middle is well within all images
    placed = TRUTH.with_object("device", true)
    images = []
    for view in range(3):
        where = torch.stack([placed.camera_from(name)[view] for name in ("pelvis", "device")])[None]
        image = project([VOLUMES["pelvis"], fine], where, camera, 0.25)
        images.append(torch.nn.functional.avg_pool2d(image[None], 2)[0, 0])
    start = placed.with_object("device", off(true, CENTRE, (3, -2, 2), (3, -2, 4)))
    stage = Stage(
        "device",
        "all",
        ["device"],
        ["pelvis", "device"],
        [BodyPlan(["device"], [2, 2, 2], [3, 3, 3])],
        LEVEL,
        SIMILARITY,
        LevenbergMarquardt(max_iterations=20),
    )
    by_mesh, by_labels = (
        run_stage(scene_of(device, tuple(images)), start, stage, (0, 1, 2), seed=0).poses.camera1_from["device"]
        for device in (mesh, labels)
    )
    for found in (by_mesh, by_labels):
        mm, deg = error(found, true, CENTRE)
        assert mm < 0.35
        assert deg < 0.2
    x, y, depth = ((by_labels - by_mesh) @ torch.cat([CENTRE, float64(1)]))[:3].abs().tolist()
    assert max(x, y) < 0.1
    assert depth < 0.5  # views 25° apart on pixels of 3 mm: either is that far from the truth in depth by itself


def test_an_orbit_search_looks_at_the_kind_of_image_it_names() -> None:
    """The anatomy's images are blank here, so that only those with the device can tell the angle."""
    scene = make_scene(TRUTH)
    blank = tuple(torch.zeros_like(image) for image in scene.images["anatomy"])
    scene = replace(scene, images={**scene.images, "anatomy": blank})
    plan = Plan("test", (OrbitSearch("orbit", ["device"], ["device"], 20, 5, LEVEL, SIMILARITY),))
    found = run_plan(scene, plan, TRUTH.camera1_from["pelvis"], 0, lambda *_: None).poses.camera_from_camera1
    for view in (1, 2):
        assert error(found[view], TRUTH.camera_from_camera1[view], float64(0, 0, 632))[1] < 3.0


def test_views_by_a_device_that_is_in_no_image_are_refused() -> None:
    scene = make_scene(TRUTH, with_device=False)
    plan = Plan("mine", (OrbitSearch("orbit", ["device"], ["device"], 20, 5, LEVEL, SIMILARITY),))
    with pytest.raises(
        InputError, match=r"registration preset mine, step “orbit”: it finds the C-arm .* the kind “device”"
    ):
        run_plan(scene, plan, TRUTH.camera1_from["pelvis"], 0, lambda *_: None)
