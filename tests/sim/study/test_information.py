"""The Cramér–Rao bound: against closed forms, finite differences, and estimates from noisy images."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from femoreg_torch.case import PlannedPath
from femoreg_torch.drr import project, project_with_jacobian
from femoreg_torch.evaluation import ReferencePoints, errors, path_displacements
from femoreg_torch.fluoro.display import Source
from femoreg_torch.geometry import Camera, CArm, Poses, about_point, centred_camera, exp_se3, rigid, transform_points
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import PLAIN, Imaging
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body, RigidObject, Scene, moved
from femoreg_torch.similarity import Ncc
from femoreg_torch.statistics.quantities import QUANTITIES
from femoreg_torch.volume import Volume, axis_aligned
from sim.study.exposures import Drawn, drawn_images, with_noise
from sim.study.information import Bound, bound, image_information, known_before, shares_of_information
from sim.study.responses import centres_in, error_responses
from sim.study.rows import flat_errors

CARM = CArm(centred_camera(1000.0, (3.2, 3.2), (96, 96)), (0.0, 0.0, 640.0), (0.0, 1.0, 0.0))
POSES = ("pelvis", "femur", "device", "view2", "view3")
TOTALS = [quantity.column for quantity in QUANTITIES]
PHOTONS, STEP_MM = 5e4, 1.5


def lumps(seed: int, count: int, size_mm: float, mu: float) -> Volume:
    """Gaussian lumps of 5 to 8 mm at random places; attenuation in 1/mm on voxels of 3 mm."""
    generator = torch.Generator().manual_seed(seed)
    n = round(size_mm / 3) + 14
    axis = (torch.arange(n) - (n - 1) / 2) * 3.0
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    data = torch.zeros(n, n, n)
    for _ in range(count):
        middle = (torch.rand(3, generator=generator) - 0.5) * size_mm
        width = 5 + 3 * torch.rand((), generator=generator)
        data += mu * torch.exp(-0.5 * ((grid - middle) / width).square().sum(-1))
    return Volume(data, axis_aligned((3.0,) * 3, (float(axis[0]),) * 3))


def at(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.fixture(scope="module")
def poses() -> Poses:
    """Three views, with pelvis and femur 740 mm from the source and the device in front of them."""
    views = torch.stack([rigid(), CARM.orbit(at(0.25)[0]), CARM.orbit(at(-0.35)[0])])
    return Poses(
        views,
        {
            "pelvis": exp_se3(at(0.1, -0.2, 0.05, 0, 0, 0)) + _shift(-25, -5, 740),
            "femur": exp_se3(at(-0.1, 0.1, 0.3, 0, 0, 0)) + _shift(35, 20, 735),
            "device": exp_se3(at(0.2, 0.9, 0.3, 0, 0, 0)) + _shift(10, 12, 560),
        },
    )


def _shift(x: float, y: float, z: float) -> Tensor:
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    matrix[:3, 3] = at(x, y, z)
    return matrix


@pytest.fixture(scope="module")
def points() -> ReferencePoints:
    objects = {"pelvis": at(3, 0, -4), "femur": at(0, 6, 2), "device": at(1, 2, 3)}
    plan = PlannedPath("femur", at(20, 5, -9), at(-4, 8, 7), "device")
    return ReferencePoints(objects, plan, (at(0, 0, 40), at(0, 2, -30)))


@pytest.fixture(scope="module")
def scene(points: ReferencePoints) -> Scene:
    """Without images yet."""
    volumes = {"pelvis": lumps(1, 14, 60, 0.02), "femur": lumps(2, 8, 40, 0.03), "device": lumps(3, 6, 40, 0.06)}
    shown = {"pelvis": ("anatomy", "device"), "femur": ("anatomy", "device"), "device": ("device",)}
    objects = {name: RigidObject(volumes[name], points.objects[name], shown[name]) for name in volumes}
    blank = (torch.zeros(CARM.camera.shape),) * 3
    return Scene(CARM, objects, {"anatomy": blank, "device": blank})


@pytest.fixture(scope="module")
def drawn(scene: Scene, poses: Poses, points: ReferencePoints) -> list[Drawn]:
    return drawn_images(scene, poses, points, STEP_MM, PLAIN, PHOTONS)


def told(found: Bound, poses: Poses, points: ReferencePoints) -> Tensor:
    """The bounds of all totals of the tables."""
    responses = error_responses(poses, points)
    return torch.tensor([found.deviation(responses[column]) for column in TOTALS])


def test_a_blob_is_known_as_well_as_its_closed_form_says() -> None:
    """A Gaussian of width s and line integral A s √2π, seen from afar under white noise of variance v.

    With pixels of q mm at its depth z: F = π² A² s² / (v q²) across, 4 π² A² s⁴ / (v q² z²) in depth.
    """
    s, a, z, v = 5.0, 0.02, 800.0, 1e-4
    axis = torch.arange(61) - 30.0
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    blob = Volume(a * torch.exp(-0.5 * (grid / s).square().sum(-1)), axis_aligned((1.0,) * 3, (-30.0,) * 3))
    camera = centred_camera(1000.0, (1.0, 1.0), (101, 101))
    centre = at(0, 0, z)
    _, changes = project_with_jacobian(blob, rigid(translation=centre)[None], camera, centre, 0.5)
    planes = changes[0].movedim(-1, 0).flatten(1)
    parts = [image_information("one", {"blob": planes}, torch.full(planes.shape[1:], v))]
    found, q = bound(parts, ["blob"]), 1.0 * z / 1000
    across, depth = (found.deviation({"blob": torch.eye(6)[n : n + 1]}) for n in (3, 5))
    assert across == pytest.approx(math.sqrt(v) * q / (math.pi * a * s), rel=0.02)  # voxels of s / 5 blur it
    assert depth == pytest.approx(math.sqrt(v) * q * z / (2 * math.pi * a * s**2), rel=0.03)
    turn = found.deviation({"blob": torch.eye(6)[:1]})
    assert turn > 20 * across / s  # a ball looks the same however it is turned


def test_what_no_image_tells_is_open_and_the_rest_is_not() -> None:
    changes = {"seen": torch.ones(1, 4), "unseen": torch.zeros(1, 4)}
    found = bound([image_information("one", changes, torch.ones(4))], ["seen", "unseen"])
    assert found.deviation({"seen": torch.ones(1, 1)}) == pytest.approx(0.5)
    assert found.deviation({"unseen": torch.ones(1, 1)}) == math.inf
    both = {"a": torch.ones(1, 4), "b": torch.ones(1, 4)}  # only their sum is seen
    found = bound([image_information("one", both, torch.ones(4))], ["a", "b"])
    assert found.deviation({"a": torch.ones(1, 1)}) == math.inf
    assert found.deviation({"a": torch.ones(1, 1), "b": torch.ones(1, 1)}) == pytest.approx(0.5)


def test_what_is_known_before_adds_up_with_what_is_seen() -> None:
    parts = [image_information("one", {"a": torch.ones(1, 4)}, torch.ones(4)), known_before("file", {"a": 0.5})]
    assert bound(parts, ["a"]).deviation({"a": torch.ones(1, 1)}) == pytest.approx(math.sqrt(1 / 8))
    assert bound(parts, ["a"]).shares_of_noise({"a": torch.ones(1, 1)}) == pytest.approx({"one": 0.5, "file": 0.5})


def test_four_times_the_dose_halves_every_bound(
    scene: Scene, poses: Poses, points: ReferencePoints, drawn: list[Drawn]
) -> None:
    more = drawn_images(scene, poses, points, STEP_MM, PLAIN, 4 * PHOTONS)
    once, again = (told(bound([i.information for i in images], POSES), poses, points) for images in (drawn, more))
    assert once.isfinite().all()
    torch.testing.assert_close(again, once / 2, rtol=1e-5, atol=0)


def test_fewer_images_more_unknowns_and_scattered_light_never_help(
    scene: Scene, poses: Poses, points: ReferencePoints, drawn: list[Drawn]
) -> None:
    parts = [image.information for image in drawn]
    everything = told(bound(parts, POSES), poses, points)
    for left_out in parts:
        fewer = told(bound([part for part in parts if part is not left_out], POSES), poses, points)
        assert (fewer >= everything * (1 - 1e-9)).all()
        assert (fewer > everything * 1.01).any()
    light = [block for part in parts for block in part.widths if block.startswith(("exposure", "scatter"))]
    unsure = told(bound(parts, [*POSES, *light]), poses, points)
    assert (unsure >= everything * (1 - 1e-9)).all()
    assert (unsure > everything * 1.001).any()
    hazy = drawn_images(scene, poses, points, STEP_MM, Imaging(scatter=0.4), PHOTONS)
    assert (told(bound([image.information for image in hazy], POSES), poses, points) > everything).all()


def test_one_image_of_the_device_leaves_it_open_nowhere_none_everywhere(
    poses: Poses, points: ReferencePoints, drawn: list[Drawn]
) -> None:
    anatomy = [image.information for image in drawn if image.kind == "anatomy"]
    found = dict(zip(TOTALS, told(bound(anatomy, POSES), poses, points).tolist(), strict=True))
    without = {"device_mm", "device_deg", "tip_mm", "relative_mm", "guide_deg"}
    assert {column for column, value in found.items() if value == math.inf} == without


def test_shares_sum_to_one_and_go_to_the_images_that_show_it(
    poses: Poses, points: ReferencePoints, drawn: list[Drawn]
) -> None:
    parts = [image.information for image in drawn]
    noise = bound(parts, POSES).shares_of_noise(error_responses(poses, points)["relative_mm"])
    told_of_device = shares_of_information(parts, "device")
    for shares in (noise, told_of_device):
        assert sum(shares.values()) == pytest.approx(1)
        assert min(shares.values()) >= 0
    assert [told_of_device[f"anatomy {n}"] for n in (1, 2, 3)] == [0, 0, 0]
    assert all(told_of_device[f"device {n}"] > 0.1 for n in (1, 2, 3))


def twisted(poses: Poses, points: ReferencePoints, block: str, twist: Tensor) -> Poses:
    """The poses after a twist of one block, made from the definitions."""
    if block in points.objects:
        motion = about_point(exp_se3(twist), centres_in(poses, points, 0)[block])
        return poses.with_object(block, motion @ poses.camera1_from[block])
    view = int(block.removeprefix("view")) - 1
    motion = about_point(exp_se3(twist), centres_in(poses, points, view)["pelvis"])
    return poses.with_view(view, motion @ poses.camera_from_camera1[view])


@pytest.mark.parametrize("source", ["anterior", "left"])
@pytest.mark.parametrize("block", POSES)
def test_responses_are_what_the_evaluation_tells(
    poses: Poses, points: ReferencePoints, block: str, source: Source
) -> None:
    points = replace(points, source=source)
    generator = torch.Generator().manual_seed(5)
    twist = 1e-4 * torch.randn(6, generator=generator, dtype=torch.float64) * at(1, 1, 1, 50, 50, 50)
    there = twisted(poses, points, block, twist)
    found = errors(poses, there, points)
    moves = path_displacements(poses, there, points)
    assert set(moves) == {"entry_point", "tip"}
    for column, response in error_responses(poses, points).items():
        change = response[block] @ twist if block in response else torch.zeros(1, dtype=torch.float64)
        key, _, end = column.rpartition("_")
        if end in ("is", "lr", "ap"):
            row, unit = key.rsplit("_", 1)
            expected = found[row][f"{unit}_xyz"][("is", "lr", "ap").index(end)]
            assert float(change) == pytest.approx(expected, rel=5e-3, abs=2e-5), column
        else:
            expected = found[column] if column in found else found[key][end]
            assert float(change.norm()) == pytest.approx(expected, rel=5e-3, abs=2e-5), column


@pytest.mark.parametrize("block", [*POSES, "source distance", "principal point 2"])
def test_changes_of_the_images_are_those_of_images_drawn_anew(
    scene: Scene, poses: Poses, points: ReferencePoints, drawn: list[Drawn], block: str
) -> None:
    image = next(image for image in drawn if (image.kind, image.view) == ("device", 2 if block == "view3" else 1))

    def photons(twist: Tensor) -> Tensor:
        camera: Camera = CARM.camera
        there = poses
        if block in POSES:
            there = twisted(poses, points, block, twist)
        elif block == "source distance":
            camera = Camera(1000 * math.exp(float(twist[0])), camera.pixel_mm, camera.shape, camera.principal_point_px)
        else:
            column, row = (c + float(d) / 3.2 for c, d in zip(camera.principal_point_px, twist, strict=True))
            camera = Camera(camera.sdd_mm, camera.pixel_mm, camera.shape, (column, row))
        where = torch.stack([there.camera_from(name)[image.view] for name in scene.objects])[None]
        volumes = [thing.volume for thing in scene.objects.values()]
        return PHOTONS * torch.exp(-project(volumes, where, camera, STEP_MM)[0])

    changes = image.changes.get(block, torch.zeros(6, *CARM.camera.shape))
    steps = at(1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1) if block in POSES else at(*{1: [1e-3], 2: [0.3, 0.3]}[len(changes)])
    for n, size in enumerate(steps.tolist()):
        step = torch.zeros(len(steps), dtype=torch.float64)
        step[n] = size
        expected = (photons(step) - photons(-step)) / (2 * size)
        assert (changes[n] - expected).abs().max() < 0.1 * expected.abs().max()
    if block == "view3":
        other = next(image for image in drawn if image.view == 1)
        assert block not in other.changes


def test_estimates_from_noisy_images_reach_the_bound(
    scene: Scene, poses: Poses, points: ReferencePoints, drawn: list[Drawn]
) -> None:
    """One step of maximum likelihood from the truth is as good as the bound; the library's NCC comes near to it.

    Over 20 draws and 30 unknowns the mean squared ratio is known to some 1/√300 for the former; NCC weighs all pixels
    alike and finds a contrast and an offset of every image besides. Four of its draws know a ratio to a fifth.
    """
    found = bound([image.information for image in drawn], POSES)
    responses = error_responses(poses, points)
    inverse = found.basis * found.variances @ found.basis.T
    places = dict(zip(found.widths, range(0, 30, 6), strict=True))
    generator = torch.Generator().manual_seed(1)
    likelihood, correlation = torch.zeros(len(TOTALS)), torch.zeros(len(TOTALS))
    draws, fewer, chi = 20, 4, 0.0
    for number in range(draws):
        noisy = with_noise(scene, drawn, PHOTONS, generator)
        score = torch.zeros(30, dtype=torch.float64)
        for image in drawn:
            push = (PHOTONS * torch.exp(-noisy.image(image.kind, image.view)) / image.expected - 1).double()
            for block, start in places.items():
                if block in image.changes:
                    score[start : start + 6] += (image.changes[block].double() * push).sum((1, 2))
        step = inverse @ score
        chi += float(step @ score) / (30 * draws)
        moves = {block: step[start : start + 6] for block, start in places.items()}
        likelihood += lengths(responses, moves) ** 2 / draws
        if number < fewer:
            told_by = flat_errors(errors(poses, registered(noisy, poses, points), points))
            correlation += torch.tensor([told_by[column] for column in TOTALS]) ** 2 / fewer
    least = told(found, poses, points)
    assert chi == pytest.approx(1, abs=0.2)  # four deviations
    ratio = likelihood.sqrt() / least
    assert float(ratio.log().mean().exp()) == pytest.approx(1, abs=0.15)
    assert ((ratio > 0.6) & (ratio < 1.5)).all()
    ratio = correlation.sqrt() / least
    assert 0.9 < float(ratio.log().mean().exp()) < 2, ratio


def lengths(responses: dict[str, dict[str, Tensor]], moves: dict[str, Tensor]) -> Tensor:
    """The errors of the totals that small motions make."""
    return torch.tensor(
        [float(torch.stack([rows @ moves[b] for b, rows in responses[c].items()]).sum(0).norm()) for c in TOTALS]
    )


def registered(scene: Scene, poses: Poses, points: ReferencePoints) -> Poses:
    """Everything refined together from the truth, by the library's NCC of whole images."""
    scale = at(0.01, 0.01, 0.01, 0.5, 0.5, 2)
    bodies = [Body((name,), 0, centre, scale) for name, centre in centres_in(poses, points, 0).items()]
    bodies += [Body((), view, centres_in(poses, points, view)["pelvis"], scale) for view in (1, 2)]
    images = scene.there(scene.images, range(3))
    level = Level(pixel_mm=3.2, step_mm=STEP_MM)
    costs = image_costs(scene, poses, tuple(bodies), tuple(scene.objects), images, level, Ncc())
    result = LevenbergMarquardt(max_iterations=3, tol_x=1e-4, tol_f=1e-9).minimise(
        stage_objective(costs, tuple(bodies), None), 30, seed=0
    )
    return moved(poses, tuple(bodies), result.delta)


def test_the_middle_of_the_twist_is_the_reference_point(poses: Poses, points: ReferencePoints) -> None:
    for name, centre in centres_in(poses, points, 0).items():
        expected = transform_points(poses.camera1_from[name], points.objects[name][None])[0]
        torch.testing.assert_close(centre, expected)
