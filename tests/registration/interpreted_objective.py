"""The objective of a stage with the Triton kernels, through Triton's interpreter, against the CPU.

Run by `test_on_a_gpu.py` in a process of its own, as the interpreter must be chosen before Triton is imported.
"""

import math

import pytest
import torch
from pretended_gpu import pretended_gpu
from registration_scenes import bone, float64

from femoreg_torch.geometry import CArm, Poses, centred_camera, exp_so3, rigid
from femoreg_torch.optimize import SmoothObjective
from femoreg_torch.registration import Level, RigidObject, Scene
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body
from femoreg_torch.similarity import GradNcc

CAMERA = centred_camera(1020.0, (8.0, 8.0), (16, 16))
CARM = CArm(CAMERA, (0.0, 0.0, 632.0), (0.0, 1.0, 0.0))
LEVEL = Level(pixel_mm=8.0, step_mm=5.0)


def poses() -> Poses:
    pelvis = rigid(exp_so3(float64(0.1, -0.2, 0.05)), float64(0, 0, 700))
    femur = rigid(exp_so3(float64(-0.2, 0.1, 0.3)), float64(14, -8, 680))
    return Poses(CARM.orbit(float64(0.0, 0.2)), {"pelvis": pelvis, "femur": femur})


def scene() -> Scene:
    generator = torch.Generator().manual_seed(0)
    middle = float64(0, 0, 0)
    objects = {
        "pelvis": RigidObject(bone(4, (18, 14, 20), 0.06), middle, ("anatomy",)),
        "femur": RigidObject(bone(5, (14, 12, 12), 0.06), middle, ("anatomy",)),
    }
    images = tuple(torch.rand(CAMERA.shape, generator=generator) for _ in range(2))
    return Scene(CARM, objects, {"anatomy": images})


def objective(scene: Scene) -> SmoothObjective:
    scale = float64(0.05, 0.05, 0.05, 3, 3, 8)
    bodies = (
        Body(("pelvis", "femur"), 0, float64(0, 0, 700), scale),
        Body(("femur",), 0, float64(14, -8, 680), scale),
        Body((), 1, float64(0, 0, 700), scale),
    )
    images = scene.there(["anatomy"], (0, 1))
    similarity = GradNcc(patch_radius=3)
    names = list(scene.objects)
    costs = image_costs(scene, poses(), bodies, names, images, LEVEL, similarity, imaging=Imaging(scatter=0.1))
    return stage_objective(costs, bodies, None)


def test_the_objective_with_triton_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    deltas = 0.3 * torch.randn(2, 18, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    here = objective(scene())
    values, model = here.values(deltas), here.quadratic(deltas[0])
    assert 0.1 < float(values[0]) < 1.9
    with pretended_gpu(monkeypatch, interpreted=True):
        there = objective(scene().to(torch.device("cuda")))
        torch.testing.assert_close(there.values(deltas), values, rtol=1e-4, atol=1e-5)
        found = there.quadratic(deltas[0])
    assert math.isclose(found.value, model.value, rel_tol=1e-4)
    for ours, theirs in ((found.gradient, model.gradient), (found.hessian, model.hessian)):
        assert theirs.norm() > 0
        assert float((ours - theirs).norm() / theirs.norm()) < 1e-3
