"""Slope and curvature of a stage's objective, against finite differences of its values."""

import math
from dataclasses import replace
from typing import Any

import pytest
import scipy.stats
import torch
from registration_scenes import CARM, REFERENCE_POINTS, VOLUMES, float64, make_scene, off, segmentations, true_poses

from femoreg_torch.geometry import centred_camera
from femoreg_torch.registration import imaging as drawing
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import (
    PLAIN,
    Imaging,
    below_white,
    below_white_slope,
    draw,
    draw_still,
    filled,
    filled_slope,
    hardened,
    hardened_slope,
)
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import Prior, stage_objective
from femoreg_torch.registration.scene import Body, reference_point_in_view
from femoreg_torch.registration.weights import Weighting
from femoreg_torch.similarity import GradNcc, Ncc, Similarity, derivative_taps, image_gradients

_LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
_SIMILARITY = GradNcc(patch_radius=5)
_SCALE = float64(*[math.radians(1)] * 3, 1.0, 1.0, 4.0)


def _joint_objective(  # type: ignore[no-untyped-def]
    prior: Prior | None = None,
    weights: tuple[Weighting, ...] = (),
    imaging: Imaging = PLAIN,
    similarity: Similarity = _SIMILARITY,
    white: torch.Tensor | None = None,
):
    """Every object and every C-arm but the first free, a little off the truth; saturated where it is `white` (H, W)."""
    poses = true_poses()
    scene = replace(make_scene(poses), segmentations=segmentations(poses), tissue=VOLUMES["femur"], scatter=0.1)
    metal = replace(scene.objects["device"], hardening=0.3)
    scene = replace(scene, objects=scene.objects | {"device": metal}, saturated={"anatomy": (white,) * 3})
    for name, point in REFERENCE_POINTS.items():
        poses = poses.with_object(name, off(poses.camera1_from[name], point, (0.5, -0.4, 0.6), (0.5, 0.4, -2)))
    objects = tuple(
        Body((name,), 0, reference_point_in_view(scene, poses, name, 0), _SCALE) for name in REFERENCE_POINTS
    )
    views = tuple(Body((), v, reference_point_in_view(scene, poses, "pelvis", v), _SCALE) for v in (1, 2))
    images = [(kind, view) for kind in ("anatomy", "device") for view in range(3)]
    render = tuple(REFERENCE_POINTS)
    costs = image_costs(scene, poses, (*objects, *views), render, images, _LEVEL, similarity, weights, imaging)
    return stage_objective(costs, (*objects, *views), prior)


@pytest.mark.parametrize(
    ("weights", "imaging", "similarity"),
    [
        ((), PLAIN, _SIMILARITY),
        (("bones",), PLAIN, _SIMILARITY),
        ((), Imaging(scatter=0.4, tissue=0.8), _SIMILARITY),
        (("bones",), PLAIN, Ncc()),
        (("bones",), PLAIN, Ncc(5)),
    ],
)
def test_the_gradient_is_the_slope_of_the_values_and_the_curvature_is_never_negative(
    weights: tuple[Weighting, ...], imaging: Imaging, similarity: Similarity
) -> None:
    joint = _joint_objective(Prior(rotation_deg=5, translation_mm=10, weight=0.1), weights, imaging, similarity)
    delta = 0.3 * torch.randn(30, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    model = joint.quadratic(delta)
    h = 0.04 if imaging.scatter else 0.02  # with less contrast a small step drowns in single precision
    moved = delta + h * torch.cat([torch.eye(30), -torch.eye(30)]).double()
    values = joint(moved)
    slope = (values[:30] - values[30:]) / (2 * h)
    assert abs(model.value - float(joint(delta[None])[0])) < 1e-7
    assert (model.gradient - slope).norm() < 0.03 * slope.norm()
    assert torch.linalg.eigvalsh(model.hessian).min() > 0


def test_the_gradient_is_the_slope_of_the_values_before_saturated_light_too() -> None:
    white = torch.zeros(88, 88, dtype=torch.bool)
    white[:, 55:] = True
    joint = _joint_objective(white=white)
    delta = 0.3 * torch.randn(30, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    model, h = joint.quadratic(delta), 0.04
    values = joint(delta + h * torch.cat([torch.eye(30), -torch.eye(30)]).double())
    slope = (values[:30] - values[30:]) / (2 * h)
    assert abs(model.value - float(joint(delta[None])[0])) < 1e-7
    assert (model.gradient - slope).norm() < 0.06 * slope.norm()  # patches before the white hold little
    assert model.value != pytest.approx(_joint_objective().quadratic(delta).value, abs=1e-3)


def test_before_saturated_light_faint_things_are_not_drawn_and_dense_ones_are() -> None:
    white = torch.tensor([True, True, True, False])
    integrals = torch.tensor([0.3, 0.8, 4.0, 0.3], dtype=torch.float64, requires_grad=True)
    seen = below_white(integrals, white)
    assert seen[0] < 0.02
    assert seen[1] < 0.25
    assert seen[2:].tolist() == pytest.approx([4.0, 0.3], abs=0.01)
    (slope,) = torch.autograd.grad(seen.sum(), integrals)
    torch.testing.assert_close(below_white_slope(integrals.detach(), white), slope)
    assert below_white(integrals, None) is integrals


def test_at_the_solution_the_curvature_is_that_of_the_values() -> None:
    """Depth is left out: its part of the second derivative that no first derivative tells is as large as the rest."""
    poses = true_poses()
    scene = make_scene(poses)
    body = Body(("pelvis", "femur"), 0, reference_point_in_view(scene, poses, "pelvis", 0), _SCALE)
    costs = image_costs(scene, poses, (body,), ("pelvis", "femur"), [("anatomy", 0)], _LEVEL, _SIMILARITY)
    single = stage_objective(costs, (body,), None)
    hessian = single.quadratic(torch.zeros(6, dtype=torch.float64)).hessian
    for axis in range(5):
        step = torch.zeros(3, 6, dtype=torch.float64)
        step[0, axis], step[2, axis] = -0.6, 0.6
        below, here, above = single(step).tolist()
        assert abs((below + above - 2 * here) / 0.6**2 / float(hessian[axis, axis]) - 1) < 0.25, axis


def test_scatter_fills_dark_shadows() -> None:
    """I = exp(−L) + s, seen as −log I: thin parts hardly change, and thick metal cannot be darker than the scatter."""
    integrals = torch.tensor([0.0, 1.0, 30.0], dtype=torch.float64, requires_grad=True)
    light = torch.tensor(0.25, dtype=torch.float64)
    seen = filled(integrals, light)
    expected = [-math.log(1.25), -math.log(math.exp(-1) + 0.25), -math.log(0.25)]
    assert seen.tolist() == pytest.approx(expected)
    assert filled(integrals, None) is integrals
    slope = torch.autograd.grad(seen.sum(), integrals)[0]
    assert torch.allclose(slope, filled_slope(integrals.detach(), light))
    assert filled_slope(integrals, None).tolist() == [1, 1, 1]


@pytest.mark.parametrize("hardening", [0.05, 0.35])
def test_metal_hardens_the_beam_as_a_spectrum_of_attenuations_does(hardening: float) -> None:
    """Of attenuations spread as a gamma distribution, whose squared coefficient of variation is h, by quadrature."""
    integrals = torch.tensor([0.0, 0.3, 2.0, 6.0], dtype=torch.float64, requires_grad=True)
    spectrum = scipy.stats.gamma(1 / hardening, scale=hardening)  # mean 1
    expected = [-math.log(spectrum.expect(lambda a, path=path: math.exp(-a * path))) for path in integrals.tolist()]
    seen = hardened(integrals, hardening)
    assert seen.tolist() == pytest.approx(expected, abs=1e-6)
    slope = torch.autograd.grad(seen.sum(), integrals)[0]
    assert torch.allclose(slope, hardened_slope(seen.detach(), hardening))
    assert hardened(integrals, 0) is integrals


def test_less_than_nothing_does_not_harden() -> None:
    """Beside the edges of sharpened volumes; there 1 + h L might not even be positive."""
    integrals = torch.tensor([-20.0, -0.1, 0.0, 1e-4], dtype=torch.float64, requires_grad=True)
    seen = hardened(integrals, 0.2)
    assert seen.tolist() == pytest.approx([-20.0, -0.1, 0.0, 1e-4], abs=1e-8)
    slope = torch.autograd.grad(seen.sum(), integrals)[0]
    expected = hardened_slope(seen.detach(), 0.2)
    assert expected.tolist() == pytest.approx([1, 1, 1, 1], abs=1e-4)
    away_from_the_bend = [0, 1, 3]
    assert torch.allclose(slope[away_from_the_bend], expected[away_from_the_bend])


def test_scatter_that_the_images_tell_stands_in_for_a_guess_that_is_far_off() -> None:
    poses = true_poses()
    nothing = torch.zeros(1, 0, dtype=torch.float64)

    def cost(told: float | None, guess: float) -> float:
        scene = replace(make_scene(poses), scatter=told)
        images = [("anatomy", 0)]
        costs = image_costs(scene, poses, (), ("pelvis",), images, _LEVEL, _SIMILARITY, (), Imaging(guess))
        return float(costs(nothing))

    assert cost(1.0, 0.3) == cost(None, 1.0) != cost(None, 0.3)
    assert cost(0.05, 0.3) == cost(None, 0.05)
    assert cost(0.5, 0.3) == cost(0.15, 0.3) == cost(None, 0.3)  # as good as the guess
    assert cost(1.0, 0.0) == cost(None, 0.0)  # none was asked for


def test_a_scene_without_soft_tissue_draws_none() -> None:
    poses = true_poses()
    nothing = torch.zeros(1, 0, dtype=torch.float64)
    plain, asked = (
        image_costs(make_scene(poses), poses, (), ("pelvis",), [("anatomy", 0)], _LEVEL, _SIMILARITY, (), imaging)
        for imaging in (Imaging(), Imaging(tissue=1.0))
    )
    assert torch.equal(plain(nothing), asked(nothing))


def test_what_two_images_of_a_view_show_alike_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = true_poses()
    scene = make_scene(poses)
    bodies = tuple(
        Body((name,), 0, reference_point_in_view(scene, poses, name, 0), _SCALE) for name in REFERENCE_POINTS
    )
    render, images = tuple(REFERENCE_POINTS), [(kind, view) for view in (2, 0) for kind in ("device", "anatomy")]
    together = image_costs(scene, poses, bodies, render, images, _LEVEL, _SIMILARITY)
    apart = [image_costs(scene, poses, bodies, render, [image], _LEVEL, _SIMILARITY) for image in images]
    deltas = 0.3 * torch.randn(3, 18, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    torch.testing.assert_close(together(deltas), torch.cat([costs(deltas) for costs in apart], 1), atol=1e-6, rtol=0)
    for one, alone in zip(together.quadratics(deltas[0]), (c.quadratics(deltas[0])[0] for c in apart), strict=True):
        torch.testing.assert_close(one.gradient, alone.gradient)
        torch.testing.assert_close(one.hessian, alone.hessian)
    monkeypatch.setattr("numba.get_num_threads", lambda: 1)  # the deltas stay in one batch
    drawn: list[str] = []
    for name in ("project", "project_with_jacobian"):
        whole = getattr(drawing, name)

        def counted(*arguments: Any, name: str = name, whole: Any = whole, **options: Any) -> Any:
            drawn.append(name)
            return whole(*arguments, **options)

        monkeypatch.setattr(drawing, name, counted)
    together.quadratics(deltas[0])
    assert drawn == ["project_with_jacobian"] * 6  # three objects in two views
    drawn.clear()
    anatomy_first = image_costs(scene, poses, bodies, render, sorted(images), _LEVEL, _SIMILARITY)
    drawn.clear()
    anatomy_first(deltas)
    assert drawn == ["project"] * 6  # two bones in two views, then the device in each


def test_coarse_voxels_are_drawn_on_coarse_pixels_with_the_same_edges() -> None:
    """Voxels of 3 mm on pixels of 0.5 mm, and of an odd number, as every other is; on pixels of 3 mm as before."""
    scene, pose = make_scene(true_poses()), true_poses().camera_from("pelvis")[1]
    bone, taps = scene.objects["pelvis"], derivative_taps(1.1, torch.device("cpu"))
    fine = centred_camera(1020.0, (0.5, 0.5), (527, 525))
    exact, found = draw([bone], pose[None, None], fine, 0.5)[0], draw_still(bone, pose, fine, 0.5)
    assert found.shape == exact.shape
    assert not torch.equal(found, exact)
    edges, mistakes = (image_gradients(of[None], taps)[0].square().sum(0).mean() for of in (exact, found - exact))
    assert mistakes < 2e-3 * edges
    assert torch.equal(draw_still(bone, pose, CARM.camera, 0.5), draw([bone], pose[None, None], CARM.camera, 0.5)[0])
