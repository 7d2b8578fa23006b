"""The C-arm's intrinsics as degrees of freedom: derivatives, recovery of a wrong file, what is not known, and doubt."""

import math
from dataclasses import replace

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, float64, make_scene, off, true_poses
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import CameraChange, Poses, Uncertainty, about_point, exp_se3, rigid
from femoreg_torch.optimize import LevenbergMarquardt, Quadratic
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.doubts.carm import _common_shift, doubts_about_the_carm
from femoreg_torch.registration.evidence.covariance import IntrinsicsEstimate, pose_covariance
from femoreg_torch.registration.evidence.shifted_points import gain_of_shifted_points
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.registration.intrinsics import DISTANCE, POINTS, doubted, doubts
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import image_quadratic, stage_objective
from femoreg_torch.registration.quality import Limits, assess, assess_cameras, final_covariance
from femoreg_torch.registration.run import notes_on_the_carm, notes_on_the_views
from femoreg_torch.registration.scene import Body, Moving, Scene, intrinsics_of, moved, reference_point_in_view
from femoreg_torch.registration.stage import BodyPlan, Stage, run_stage
from femoreg_torch.similarity import GradNcc

_LEVEL = Level(pixel_mm=3.0, step_mm=1.0)
_SIMILARITY = GradNcc(patch_radius=5)
_SCALE = float64(0.02, 0.02, 0.02, 1.0, 1.0, 4.0)
AS_SEEN = (Display(),) * 3
_ALL = tuple(REFERENCE_POINTS)


def _saves(shift: Tensor) -> float:
    """A shift of all principal points that explains the images."""
    return 1.0


_MOVES = ([1.0, 1, 1], [1.0, 1, 4])


def _wrong(scene: Scene, factor: float, shift_mm: tuple[float, float] = (0.0, 0.0)) -> Scene:
    """The scene with a C-arm's file that is wrong."""
    return replace(scene, carm=replace(CARM, camera=CARM.camera.changed(CameraChange(factor, shift_mm))))


def _stage(waits: float | None = None, iterations: int = 8) -> Stage:
    bodies = [BodyPlan([name], *_MOVES) for name in REFERENCE_POINTS] + [BodyPlan(["views"], *_MOVES)]
    bodies += [BodyPlan(["intrinsics"], doubt=waits)]
    optimiser = LevenbergMarquardt(max_iterations=iterations, tol_x=0.01, tol_f=1e-7)
    return Stage("all", "all", ["all"], ["all"], bodies, _LEVEL, _SIMILARITY, optimiser)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(true_poses())


def test_the_gradient_by_the_intrinsics_is_the_slope_of_the_values(scene: Scene) -> None:
    poses = true_poses()
    for name, point in REFERENCE_POINTS.items():
        poses = poses.with_object(name, off(poses.camera1_from[name], point, (0.5, -0.4, 0.6), (0.5, 0.4, -2)))
    poses = poses.with_changes((CameraChange(1.01, (1.0, -0.5)),) * 3)
    body = Body(("pelvis",), 0, reference_point_in_view(scene, poses, "pelvis", 0), _SCALE)
    bodies: tuple[Moving, ...] = (body, intrinsics_of(scene, poses, _ALL))
    images = [("device", view) for view in range(3)]
    level = Level(pixel_mm=3.0, step_mm=0.25)  # a slide along coarse steps is rough
    costs = image_costs(scene, poses, bodies, tuple(REFERENCE_POINTS), images, level, _SIMILARITY)
    objective = stage_objective(costs, bodies, None)
    delta = 0.2 * torch.randn(13, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    model = objective.quadratic(delta)
    h = 0.1
    steps = h * torch.eye(13, dtype=torch.float64)
    slope = (objective(delta + steps) - objective(delta - steps)) / (2 * h)
    assert abs(model.value - float(objective(delta[None])[0])) < 1e-7
    assert (model.gradient[6:] - slope[6:]).norm() < 0.1 * slope[6:].norm()
    assert abs(float(model.gradient[6] - slope[6])) < 0.1 * abs(float(slope[6]))


def test_a_slide_leaves_the_reference_point_where_it_is_seen(scene: Scene) -> None:
    poses = true_poses()
    refined = intrinsics_of(scene, poses, _ALL)
    after = moved(poses, (refined,), float64(1.5, 1, -1, 0.5, 0, 0, 2))
    assert after.changes[1].sdd_factor == pytest.approx(1.0304545)  # exp(1.5 · 2 %)
    for view in range(3):
        pixels = [
            scene.camera(p, view).matrix() @ reference_point_in_view(scene, p, "pelvis", view) for p in (poses, after)
        ]
        first, second = (p[:2] / p[2] for p in pixels)
        torch.testing.assert_close(first, second, atol=1e-9, rtol=0)


def test_a_wrong_source_distance_is_recovered(scene: Scene) -> None:
    factor = 1.03
    wrong, start = _wrong(scene, factor), _slid(scene, factor)
    fixed = replace(_stage(), bodies=_stage().bodies[:-1])
    held = run_stage(wrong, start, fixed, (0, 1, 2), 0).poses
    refined = run_stage(wrong, held, _stage(), (0, 1, 2), 0).poses
    assert refined.changes[0].sdd_factor * factor == pytest.approx(1.0, abs=0.01)
    assert _apart(refined) < 0.5 * _apart(held)


def _slid(scene: Scene, factor: float) -> Poses:
    """Where a file that says `factor` times the source distance puts everything by the size in which it is seen."""
    delta = float64(math.log(factor) / 0.02, *[0.0] * 6)
    return replace(moved(true_poses(), (intrinsics_of(scene, true_poses(), _ALL),), delta), changes=())


def _apart(poses: Poses) -> float:
    """By how many mm the device is in a wrong place beside the pelvis, along the depth."""
    truth = true_poses()
    device, pelvis = ((poses.camera1_from[name] - truth.camera1_from[name])[2, 3] for name in ("device", "pelvis"))
    return abs(float(device - pelvis))


def test_a_right_file_is_not_doubted_and_stays(scene: Scene) -> None:
    assert run_stage(scene, true_poses(), _stage(waits=2.5, iterations=1), (0, 1, 2), 0).poses.changes == ()


def test_a_wrong_file_is_doubted(scene: Scene) -> None:
    wrong = _wrong(scene, 1.04)
    assert run_stage(wrong, _slid(scene, 1.04), _stage(waits=2.5, iterations=1), (0, 1, 2), 0).poses.changes != ()


def test_a_file_that_is_not_doubted_changes_nothing(scene: Scene) -> None:
    """The images are asked once all else has settled: until then the stage is that without the intrinsics."""
    aside = true_poses()
    for name in aside.camera1_from:
        aside = aside.with_object(name, rigid(translation=float64(1.5, -1, 2)) @ aside.camera1_from[name])
    waiting = run_stage(scene, aside, _stage(waits=2.5), (0, 1, 2), 0)
    without = run_stage(scene, aside, replace(_stage(), bodies=_stage().bodies[:-1]), (0, 1, 2), 0)
    assert waiting.poses.changes == ()
    assert waiting.evaluations == without.evaluations
    for name, pose in without.poses.camera1_from.items():
        assert torch.equal(waiting.poses.camera1_from[name], pose)
    assert torch.equal(waiting.poses.camera_from_camera1, without.poses.camera_from_camera1)


def _images_that_ask(sdd: float, shifts_mm: list[tuple[float, float]]) -> Quadratic:
    """Images of three views, 100 tiles each, whose steps of Newton along each of the intrinsics are these.

    One unit is 2 % or 2 mm. Tiles of each view alone fix the source distance within 0.2 % and a shift within 2 mm; one
    rigid degree of freedom has nothing to do with it.
    """
    curvature = 0.01
    scores = torch.zeros(300, 8, dtype=torch.float64)
    signs = torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(50)
    for view, shift in enumerate(shifts_mm):
        tiles = scores[100 * view : 100 * view + 100]
        tiles[:, 1] = curvature * (-sdd / 0.02 / 100 + 0.1 * signs / 10) / 3
        for axis, mm in enumerate(shift):
            tiles[:, 2 + 2 * view + axis] = curvature * (-mm / 2 / 100 + signs / 10)
    return Quadratic(0.5, scores, curvature * torch.eye(8, dtype=torch.float64))


@pytest.mark.parametrize(
    ("sdd", "shifts_mm", "to_refine"),
    [
        (0.0, [(0, 0), (0, 0), (0, 0)], set()),
        (0.03, [(0, 0), (0, 0), (0, 0)], {DISTANCE, POINTS}),
        (-0.03, [(0, 0), (0, 0), (0, 0)], {DISTANCE, POINTS}),
        (0.0, [(0, 0), (0, 0), (0, -12)], set()),  # a single view asks for what the file cannot have wrong
        (0.0, [(8, 0), (-12, 0), (6, 0)], set()),
        (0.0, [(12, 0), (12, 0), (12, 0)], {POINTS}),  # the distance, which nothing speaks against, stays
        (0.0, [(0, -12), (0, -12), (0, -12)], {POINTS}),
    ],
)
def test_the_file_is_doubted_where_all_views_ask_alike(
    scene: Scene, sdd: float, shifts_mm: list[tuple[float, float]], to_refine: set[str]
) -> None:
    intrinsics = intrinsics_of(scene, true_poses(), _ALL)
    assert doubted(_images_that_ask(sdd, shifts_mm), intrinsics, 3) == to_refine


def test_what_the_file_holds_is_not_doubted(scene: Scene) -> None:
    sure = Uncertainty(sdd_percent=0.0, principal_point_mm=0.0)
    held = replace(scene, carm=replace(CARM, uncertainty=sure))
    model = _images_that_ask(0.03, [(12, 12)] * 3)
    rigid = Quadratic(model.value, model.scores[:, :1], model.hessian[:1, :1])
    assert doubts(rigid, intrinsics_of(held, true_poses(), _ALL)) == {DISTANCE: 0, POINTS: 0}


def test_a_stage_that_does_not_ask_refines_what_was_refined_before(scene: Scene) -> None:
    wrong, start = _wrong(scene, 1.04), _slid(scene, 1.04)
    silent = _stage(waits=math.inf, iterations=1)
    assert run_stage(wrong, start, silent, (0, 1, 2), 0).poses.changes == ()
    begun = start.with_changes((CameraChange(1 / 1.02),) * 3)
    after = run_stage(wrong, begun, silent, (0, 1, 2), 0).poses.changes
    assert after
    assert after[0].sdd_factor != begun.changes[0].sdd_factor


def test_where_the_principal_points_were_refined_alone_the_source_distance_stays(scene: Scene) -> None:
    begun = true_poses().with_changes((CameraChange(principal_point_shift_mm=(1.5, 0.0)),) * 3)
    after = run_stage(scene, begun, _stage(waits=math.inf, iterations=2), (0, 1, 2), 0).poses.changes
    assert [change.sdd_factor for change in after] == [1, 1, 1]
    assert all(after[view] != begun.changes[view] for view in range(3))


def test_a_stage_that_goes_on_with_free_intrinsics_counts_both_parts(scene: Scene) -> None:
    wrong, start = _wrong(scene, 1.04), _slid(scene, 1.04)
    record = run_stage(wrong, start, _stage(waits=2.5, iterations=1), (0, 1, 2), 0)
    assert record.evaluations == 4  # a start and a step each
    counted = [moment.evaluations for moment in record.moments]
    assert counted == sorted(counted)
    assert counted[-1] <= record.evaluations


def test_what_the_file_holds_does_not_move(scene: Scene) -> None:
    held = replace(scene, carm=replace(CARM, uncertainty=Uncertainty(sdd_percent=0.0, principal_point_mm=1.0)))
    refined = intrinsics_of(held, true_poses(), _ALL)
    assert refined.free.tolist() == [1, 2, 3, 4, 5, 6]
    assert refined.changes(torch.ones(6, dtype=torch.float64))[0] == CameraChange(1.0, (1.0, 1.0))


def test_the_covariance_grows_with_what_is_not_known_of_the_carm(scene: Scene) -> None:
    found = []
    for percent, mm in ((0.0, 0.0), (0.1, 0.1), (2.0, 2.0)):
        unsure = replace(scene, carm=replace(CARM, uncertainty=Uncertainty(percent, mm)))
        covariance = pose_covariance(unsure, true_poses(), _LEVEL, _SIMILARITY)
        torch.testing.assert_close(covariance.matrix, covariance.matrix.T)
        assert torch.linalg.eigvalsh(covariance.matrix).min() > -1e-9
        assert min(covariance.deviations("pelvis")[1]) > 0
        found.append(covariance)
    depths = [covariance.deviations("pelvis")[1][2] for covariance in found]
    beside = [covariance.relative_mm("device", "pelvis")[2] for covariance in found]
    assert depths[0] == pytest.approx(found[0].by_images("pelvis")[1][2])
    assert depths[0] < depths[1] < depths[2]
    assert beside[0] < beside[1] < beside[2] < depths[2]
    assert found[0].relative_mm("pelvis", "pelvis") == [0, 0, 0]


@pytest.mark.parametrize("shift_mm", [(2.0, 0.0), (0.0, -2.0)])
def test_deviations_with_the_carm_cover_what_a_wrong_principal_point_does(
    scene: Scene, shift_mm: tuple[float, float]
) -> None:
    """By one deviation of a file that says nothing, in all views: all objects go aside together, unseen."""
    wrong = _wrong(scene, 1.0, shift_mm)
    fixed = replace(_stage(), bodies=_stage().bodies[:-1])
    poses = run_stage(wrong, true_poses(), fixed, (0, 1, 2), 0).poses
    for name, quality in assess(wrong, poses, Limits()).items():
        point = torch.cat([REFERENCE_POINTS[name], float64(1)])
        off_mm = ((poses.camera1_from[name] - true_poses().camera1_from[name]) @ point)[:3].abs()
        images, with_carm = (
            float64(*of) for of in (quality.translation_deviation_mm, quality.translation_deviation_with_carm_mm)
        )
        assert quality.trusted
        assert float((off_mm / images).max()) > 4
        assert float((off_mm / with_carm).max()) < 2


def test_where_the_file_says_how_uncertain_it_is_both_deviations_are_one(scene: Scene) -> None:
    told = replace(scene, carm=replace(CARM, uncertainty=Uncertainty()))
    for quality in assess(told, true_poses(), Limits()).values():
        assert quality.translation_deviation_with_carm_mm == quality.translation_deviation_mm
        assert quality.rotation_deviation_with_carm_deg == quality.rotation_deviation_deg


@pytest.mark.parametrize(
    ("display", "place"),
    [
        (Display(), (50.0, 41.0)),
        (Display("posterior"), (37.0, 41.0)),  # mirrored: 87 - 50
        (Display(turned_deg=90), (46.0, 50.0)),  # clockwise: the column 87 - 41, the row 50
    ],
)
def test_refined_cameras_are_told_as_the_pictures_are_stored(
    scene: Scene, display: Display, place: tuple[float, float]
) -> None:
    """As the C-arm's file counts its principal point: of 88 × 88 pixels."""
    assert CARM.camera.shape == (88, 88)
    (column, row), (rows_mm, columns_mm) = CARM.camera.principal_point_px, CARM.camera.pixel_mm
    shift = ((50 - column) * columns_mm, (41 - row) * rows_mm)
    covariance = final_covariance(scene, true_poses())
    poses = true_poses().with_changes((CameraChange(principal_point_shift_mm=shift),) * 3)
    told = assess_cameras(scene, poses, covariance, (display,) * 3)[0]
    assert told.principal_point_px == pytest.approx(place)
    upright = assess_cameras(scene, poses, covariance, AS_SEEN)[0].principal_point_deviation_px
    turned = upright[::-1] if display.turned_deg else upright
    assert told.principal_point_deviation_px == pytest.approx(turned)


def test_a_file_far_from_what_the_images_fit_is_told(scene: Scene) -> None:
    """Ten per cent where two are allowed for, after a refinement that found the right distance."""
    wrong = _wrong(scene, 1.10)
    poses = true_poses().with_changes((CameraChange(1 / 1.10),) * 3)
    covariance = final_covariance(wrong, poses)
    (told,) = doubts_about_the_carm(wrong, poses, covariance, Limits(), AS_SEEN, _saves)
    assert "the C-arm's file says 1122 mm" in told
    assert "a source distance of 10" in told
    camera = assess_cameras(wrong, poses, covariance, AS_SEEN)[0]
    assert camera.sdd_mm == pytest.approx(1020)
    assert 0 < camera.sdd_deviation_mm < 0.02 * 1020
    assert (
        doubts_about_the_carm(scene, true_poses(), final_covariance(scene, true_poses()), Limits(), AS_SEEN, _saves)
        == ()
    )


@pytest.mark.parametrize(("shift_mm", "doubted"), [(0.9, False), (2.4, True)])
def test_a_principal_point_that_refinement_moved_far_is_told(scene: Scene, shift_mm: float, doubted: bool) -> None:
    """Two millimetres of the file are one deviation; the images themselves are those of a right file."""
    poses = true_poses()
    covariance = final_covariance(scene, poses)
    still, shifted = CameraChange(), CameraChange(principal_point_shift_mm=(0.3, -shift_mm))
    told = doubts_about_the_carm(
        scene, poses.with_changes((still, shifted, still)), covariance, Limits(), AS_SEEN, _saves
    )
    assert len(told) == doubted
    assert all("principal point of view 2 by 2.4 mm" in sentence for sentence in told)


@pytest.mark.parametrize(
    ("x_of_views", "deviation", "gain", "doubted"),
    [
        ((-2.3, -1.7, -2.0), 0.77, 0.0016, True),  # 12 mm off in all views, of which the images see a part
        ((-2.3, -1.7, -2.0), 0.77, math.nan, True),  # and leave nothing to try it on
        ((-2.3, -1.7, -2.0), 0.77, 0.0003, False),  # a right file: the shift explains nothing
        ((-2.3, 1.7, -2.0), 0.77, 0.0016, False),  # each view asks for something else
        ((-0.2, -1.0, -0.4), 0.8, 0.0016, False),  # a right file
        ((-1.0, -1.0, -1.0), 0.1, 0.0016, False),  # sure, but no more than the file's own deviation
    ],
)
def test_a_shift_of_all_principal_points_alike_is_told(
    scene: Scene, x_of_views: tuple[float, ...], deviation: float, gain: float, doubted: bool
) -> None:
    poses = true_poses()
    covariance = final_covariance(scene, poses)
    mean = torch.zeros_like(covariance.intrinsics.mean)
    mean[1::2] = torch.tensor(x_of_views)
    found = replace(covariance, intrinsics=IntrinsicsEstimate(mean, torch.full_like(mean, deviation)))
    told = doubts_about_the_carm(scene, poses, found, Limits(), AS_SEEN, lambda shift: gain)
    assert len(told) == doubted
    assert all("the images of all views fit principal points some (-3, 0) pixels" in sentence for sentence in told)


def test_a_shift_that_is_tried_saves_most_where_it_is_right(scene: Scene) -> None:
    """Of images whose principal points were told 40 mm off; poses make up for most of that."""
    wrong = _wrong(scene, 1.0, (40.0, 0.0))
    free = intrinsics_of(wrong, true_poses(), ("pelvis", "femur"))
    off = float64(0, *(40.0, 0.0) * 3) / free.scale
    poses = true_poses().slid(free.slides(off[None])[0], ("pelvis", "femur"))
    shift = float64(-40.0 / scene.carm.assumed_uncertainty.principal_point_mm, 0)
    gains = [gain_of_shifted_points(wrong, poses, k * shift, PLAIN) for k in (0, 0.5, 1, -1)]
    assert gains[0] == pytest.approx(0, abs=1e-7)
    assert gains[2] > gains[1] > 0.0005
    assert gains[3] < 0
    dark = replace(wrong, saturated={"anatomy": tuple(torch.ones(88, 88, dtype=torch.bool) for _ in range(3))})
    assert math.isnan(gain_of_shifted_points(dark.where_unsaturated(), poses, shift, PLAIN))


def test_a_file_that_says_how_uncertain_it_is_is_not_doubted_within_that(scene: Scene) -> None:
    """The images ask for 10 mm, and the file is uncertain by 2 or by 10 mm; and a file that is sure."""
    covariance = final_covariance(scene, true_poses())
    sure = replace(scene, carm=replace(scene.carm, uncertainty=Uncertainty(0.0, 0.0)))
    assert (
        doubts_about_the_carm(sure, true_poses(), final_covariance(sure, true_poses()), Limits(), AS_SEEN, _saves) == ()
    )
    for principal_point_mm, sentences in ((2.0, 1), (10.0, 0)):
        own = replace(scene.carm.assumed_uncertainty, principal_point_mm=principal_point_mm)
        asked, deviation = 10.0 / principal_point_mm, 2.0 / principal_point_mm  # of each view, without the file
        precision = deviation**-2
        mean = torch.zeros_like(covariance.intrinsics.mean)
        mean[1::2] = asked * precision / (1 + precision)
        found = IntrinsicsEstimate(mean, torch.full_like(mean, (1 + precision) ** -0.5))
        uncertain = replace(scene, carm=replace(scene.carm, uncertainty=own))
        told = doubts_about_the_carm(
            uncertain, true_poses(), replace(covariance, intrinsics=found), Limits(), AS_SEEN, _saves
        )
        assert len(told) == sentences


def test_a_common_shift_is_what_images_say_without_the_file() -> None:
    """A prior of deviation one, and two views that ask for 3 and 5 with deviations of 0.5 and 1."""
    asked, own = torch.tensor([3.0, 5.0]), torch.tensor([0.5, 1.0])
    together = 1 / (1 + own**-2)
    mean, deviation = torch.zeros(5), torch.ones(5)
    mean[1::2], deviation[1::2] = together * asked * own**-2, together.sqrt()
    shift, sureness = _common_shift(IntrinsicsEstimate(mean, deviation))
    assert shift.tolist() == pytest.approx([(3 / 0.25 + 5) / (4 + 1), 0.0], abs=1e-5)
    assert sureness == pytest.approx(17 / 5 * 5**0.5, rel=1e-5)


@pytest.mark.parametrize(("factor", "doubted"), [(1.05, False), (1.107, True), (0.93, True)])
def test_a_source_distance_that_refinement_moved_far_is_told(scene: Scene, factor: float, doubted: bool) -> None:
    """As with the CT of another patient: 11 % off, and images that say nothing of it at the end."""
    poses = true_poses().with_changes((CameraChange(factor),) * 3)
    covariance = final_covariance(scene, true_poses())
    told = doubts_about_the_carm(scene, poses, covariance, Limits(), AS_SEEN, _saves)
    assert len(told) == doubted
    assert all(f"to {factor * CARM.camera.sdd_mm:.0f} mm" in sentence for sentence in told)


def test_a_source_distance_that_was_refined_is_noted(scene: Scene) -> None:
    poses = true_poses()
    assert notes_on_the_carm(scene.carm, poses) == ()
    changed = poses.with_changes((CameraChange(1.02, (0.0, 0.0)),) * scene.views)
    (note,) = notes_on_the_carm(scene.carm, changed)
    assert f"from the {scene.carm.camera.sdd_mm:.0f} mm of the C-arm's file" in note
    assert f"to {1.02 * scene.carm.camera.sdd_mm:.0f} mm" in note
    shifted = poses.with_changes((CameraChange(1.0, (1.0, 0.0)),) * scene.views)
    assert notes_on_the_carm(scene.carm, shifted) == ()


def test_a_wrong_file_that_was_not_refined_is_not_trusted(scene: Scene) -> None:
    wrong = _wrong(scene, 1.05)
    end = run_stage(wrong, _slid(scene, 1.05), replace(_stage(), bodies=_stage().bodies[:-1]), (0, 1, 2), 0)
    assert not assess(wrong, end.poses, Limits())["device"].trusted


def test_words_of_a_preset_are_checked() -> None:
    with pytest.raises(InputError, match="takes `doubt` alone"):
        BodyPlan(["intrinsics"], [1, 1, 1], [1, 1, 1])
    with pytest.raises(InputError, match="`doubt` is for"):
        BodyPlan(["pelvis"], [1, 1, 1], [1, 1, 1], doubt=2)
    with pytest.raises(InputError, match="needs `images: all`"):
        replace(_stage(), images="first")


def test_the_quadratic_of_the_images_has_no_prior(scene: Scene) -> None:
    poses = true_poses().with_changes((CameraChange(1.02),) * 3)
    bodies: tuple[Moving, ...] = (intrinsics_of(scene, poses, _ALL),)
    costs = image_costs(scene, poses, bodies, ("pelvis",), [("anatomy", 0)], _LEVEL, _SIMILARITY)
    model = stage_objective(costs, bodies, None).quadratic(costs.still)
    plain = image_quadratic(costs, costs.still)
    assert float(model.gradient[0] - plain.gradient[0]) > 0  # the penalty pulls back to the file


def test_what_is_not_drawn_does_not_slide(scene: Scene) -> None:
    """A device that has not been looked for yet stays at its nominal pose."""
    refined = intrinsics_of(scene, true_poses(), ("pelvis", "femur"))
    after = moved(true_poses(), (refined,), float64(1.0, *[0.0] * 6))
    assert torch.equal(after.camera1_from["device"], true_poses().camera1_from["device"])
    assert not torch.equal(after.camera1_from["femur"], true_poses().camera1_from["femur"])


def test_one_view_and_views_from_one_place_are_noted(scene: Scene) -> None:
    assert notes_on_the_views(scene, true_poses()) == ()
    alone = replace(scene, images={kind: (images[0],) for kind, images in scene.images.items()})
    one = notes_on_the_views(alone, true_poses().first_views(1))
    assert len(one) == len(scene.objects)
    assert all(note.startswith("one view alone shows ") for note in one)
    poses = true_poses()
    near = about_point(exp_se3(float64(0, 0.02, 0, 0, 0, 0)[None]), float64(0, 0, 600))[0]
    twice = poses.with_view(2, near @ poses.camera_from_camera1[1])
    (note,) = notes_on_the_views(scene, twice)
    assert note.startswith("views 2 and 3 were taken from one place (1.1°, 12 mm apart)")
