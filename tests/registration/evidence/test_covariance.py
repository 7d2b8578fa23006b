"""The covariance of a solution, against the spread of solutions over images drawn anew."""

import math
from dataclasses import replace

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, make_scene, off, true_poses

from femoreg_torch.geometry import Poses, log_so3
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.evidence.covariance import PoseCovariance, pose_covariance
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body, Scene, moved, reference_point_in_view
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
_SIMILARITY = GradNcc(patch_radius=4)
_SCALE = torch.tensor([math.radians(1)] * 3 + [1.0, 1.0, 4.0], dtype=torch.float64)


def _solve(scene: Scene, poses: Poses) -> Poses:
    """Pelvis, femur, device and both C-arms refined together."""
    bodies = [Body((name,), 0, reference_point_in_view(scene, poses, name, 0), _SCALE) for name in REFERENCE_POINTS]
    bodies += [Body((), view, reference_point_in_view(scene, poses, "pelvis", view), _SCALE) for view in (1, 2)]
    images = [(kind, view) for kind in ("anatomy", "device") for view in range(3)]
    costs = image_costs(scene, poses, tuple(bodies), tuple(REFERENCE_POINTS), images, _LEVEL, _SIMILARITY)
    objective = stage_objective(costs, tuple(bodies), None)
    result = LevenbergMarquardt(max_iterations=4, tol_x=1e-3, tol_f=1e-7).minimise(objective, 30, seed=0)
    return moved(poses, tuple(bodies), result.delta)


@pytest.fixture(scope="module")
def solutions() -> tuple[list[Poses], PoseCovariance]:
    """Solutions of scenes that differ in their noise, and the covariance of the first one."""
    truth = true_poses()
    scenes = [make_scene(truth, seed=seed, noise=0.02) for seed in range(5)]
    found = [_solve(scene, truth) for scene in scenes]
    covariance = pose_covariance(scenes[0], found[0], _LEVEL, _SIMILARITY)
    return found, covariance


def test_the_prediction_is_of_the_size_of_the_spread(solutions: tuple[list[Poses], PoseCovariance]) -> None:
    found, covariance = solutions
    assert covariance.bodies == (*REFERENCE_POINTS, "view 2", "view 3")
    for name, point in REFERENCE_POINTS.items():
        places = torch.stack([p.camera1_from[name][:3, :3] @ point + p.camera1_from[name][:3, 3] for p in found])
        first = found[0].camera1_from[name][:3, :3]
        angles = torch.stack([log_so3(p.camera1_from[name][:3, :3] @ first.T) for p in found]).rad2deg()
        spread = torch.cat([angles.std(0), places.std(0)])
        rotation, translation = covariance.by_images(name)
        ratio = torch.tensor([*rotation, *translation]) / spread
        # Five samples know a deviation to a third; depth varies with what else is fitted.
        assert 0.4 < ratio.log().mean().exp() < 2.5, (name, ratio)


def test_a_device_held_in_a_wrong_place_is_pulled_back(solutions: tuple[list[Poses], PoseCovariance]) -> None:
    """The step of second order leads back to where the images agree, and leaves the pelvis where it is."""
    found, settled = solutions
    scene = make_scene(true_poses(), seed=0, noise=0.02)
    wrong = off(found[0].camera1_from["device"], REFERENCE_POINTS["device"], (0, 0, 0), (0.4, -0.3, 0))
    pulled = pose_covariance(scene, found[0].with_object("device", wrong), _LEVEL, _SIMILARITY)
    first = 6 * settled.bodies.index("device") + 3
    back = (pulled.step - settled.step)[first : first + 2]
    torch.testing.assert_close(back, torch.tensor([-0.4, 0.3], dtype=torch.float64), atol=0.15, rtol=0)
    assert pulled.pull("device")[3:].norm() > settled.pull("device")[3:].norm()
    assert pulled.pull("pelvis")[3:].norm() < 0.15


def test_what_pulls_all_objects_alike_pulls_none_beside_another(
    solutions: tuple[list[Poses], PoseCovariance],
) -> None:
    """A turn about the pelvis and a shift carry device and femur along; what the device does besides is told."""
    _, covariance = solutions
    turn, shift = torch.tensor([0.1, -0.4, 0.3]).double(), torch.tensor([0.2, 0.1, 1.5]).double()
    step = torch.zeros_like(covariance.step)
    for name in ("pelvis", "femur", "device"):
        i = 6 * covariance.bodies.index(name)
        arm = covariance.centre(name) - covariance.centre("pelvis")
        step[i : i + 6] = torch.cat([turn, shift + torch.linalg.cross(torch.deg2rad(turn), arm)])
    alike = replace(covariance, step=step)
    for name in ("femur", "device"):
        assert alike.pull(name)[3:].norm() > 1
        torch.testing.assert_close(alike.pull_beside(name, "pelvis"), torch.zeros(6).double(), atol=1e-9, rtol=0)
    own = torch.tensor([0.0, 0.2, 0, 0.3, 0, -0.6]).double()
    i = 6 * covariance.bodies.index("device")
    besides = replace(alike, step=step.index_add(0, torch.arange(i, i + 6), own))
    torch.testing.assert_close(besides.pull_beside("device", "pelvis"), own)


def test_what_is_unsure_of_a_device_counts_as_what_it_does_to_its_pose() -> None:
    """The device's right half denser by a tenth, or not: against the step that the denser device would make."""
    truth = true_poses()
    scene = make_scene(truth, noise=0.0)
    device = scene.objects["device"]
    half = device.volume.data.clone()
    half[..., : half.shape[2] // 2] = 0
    difference = device.volume.with_data(0.1 * half)
    denser = replace(device, volume=device.volume.with_data(device.volume.data + difference.data))
    known, unsure, other = (
        pose_covariance(replace(scene, objects=scene.objects | {"device": thing}), truth, _LEVEL, _SIMILARITY)
        for thing in (device, replace(device, unsure=(difference,)), denser)
    )
    first = 6 * known.bodies.index("device")
    added = (unsure.images - known.images)[first : first + 6, first : first + 6].diagonal().sqrt()
    step = (other.step - known.step)[first : first + 6].abs()
    assert float(added.norm()) == pytest.approx(float(step.norm()), rel=0.25)
    assert float(added @ step) > 0.9 * float(added.norm() * step.norm())
    pelvis = 6 * known.bodies.index("pelvis")
    assert (unsure.images - known.images).diagonal()[pelvis : pelvis + 5].max() < 1e-3  # depth is common to all


def test_bones_seen_twice_by_the_same_image_are_known_no_better() -> None:
    """What a CT has wrong is wrong in both images of a view: a second one with the same mistakes tells nothing new."""
    scene = make_scene(true_poses(), noise=0.02)
    bones = {name: thing for name, thing in scene.objects.items() if name != "device"}
    twice = {name: replace(thing, shown_in=("anatomy", "again")) for name, thing in bones.items()}
    truth = Poses(true_poses().camera_from_camera1, {name: true_poses().camera1_from[name] for name in bones})
    images = scene.images["anatomy"]
    once = replace(scene, objects=bones, images={"anatomy": images})
    again = replace(scene, objects=twice, images={"anatomy": images, "again": images})
    first, second = (pose_covariance(each, truth, _LEVEL, _SIMILARITY) for each in (once, again))
    torch.testing.assert_close(second.images, first.images)


def test_one_image_of_one_tile_has_a_covariance() -> None:
    """A small detector: that nothing is known of its spread is no division by zero."""
    truth = true_poses()
    scene = make_scene(truth)
    alone = replace(scene, objects={"pelvis": scene.objects["pelvis"]}, images={"anatomy": scene.images["anatomy"][:1]})
    poses = Poses(truth.camera_from_camera1[:1], {"pelvis": truth.camera1_from["pelvis"]})
    coarse = Level(pixel_mm=6.0, step_mm=4.0)  # 44 pixels: one tile of patches of radius 5
    found = pose_covariance(alone, poses, coarse, GradNcc(patch_radius=5))
    assert torch.isfinite(found.matrix).all()
