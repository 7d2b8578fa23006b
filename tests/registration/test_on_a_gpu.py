"""Everything a GPU does in a registration, on a pretended one here and on a real one where there is one.

Against the CPU: costs, derivatives, whole plans, quality, detection and simulated images; and how often it is waited
for, which is once per evaluation.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
import torch
from pretended_gpu import PretendedGpu, pretended_gpu
from registration_scenes import (
    CARM,
    REFERENCE_POINTS,
    VOLUMES,
    error,
    float64,
    make_scene,
    off,
    segmentations,
    true_poses,
)
from rich.console import Console
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.commands.main import main
from femoreg_torch.commands.telling import tell_device
from femoreg_torch.detect import detect, load_network
from femoreg_torch.drr import chosen_device
from femoreg_torch.geometry import Poses, centred_camera, first_view_only
from femoreg_torch.optimize import LevenbergMarquardt, SmoothObjective
from femoreg_torch.registration import BodyPlan, Level, OrbitSearch, Plan, Scene, Stage, run_plan
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.doubts.device import doubts_about_the_models
from femoreg_torch.registration.evidence.bent_pictures import bent_pictures
from femoreg_torch.registration.evidence.ct_shape import ct_shape
from femoreg_torch.registration.evidence.fitted_alone import gain_alone
from femoreg_torch.registration.evidence.handedness import handedness
from femoreg_torch.registration.evidence.motion import MotionBetween
from femoreg_torch.registration.evidence.rigidity import bend, images_of
from femoreg_torch.registration.evidence.shifted_points import gain_of_shifted_points
from femoreg_torch.registration.imaging import PLAIN, Imaging
from femoreg_torch.registration.materials.calibration import Calibration
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.quality import Limits, assess, final_covariance, finer_joint_turns
from femoreg_torch.registration.scene import Body, Moving, Outline, intrinsics_of, reference_point_in_view
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.registration.start.silhouette import refine_by_silhouette
from femoreg_torch.similarity import GradientOrientation, GradNcc, Ncc, Similarity
from sim.physics.fluoroscopy import fluoroscopy
from sim.theatre.posed_tissue import PosedTissue, areal_posed_tissue
from sim.theatre.settings import load_simulation

TRUTH = true_poses()
LEVEL = Level(pixel_mm=3.0, step_mm=3.0)
SIMILARITY = GradNcc(patch_radius=4)
CUDA = torch.device("cuda")


@pytest.fixture(scope="module")
def scene() -> Scene:
    shaded = torch.ones(CARM.camera.shape, dtype=torch.bool)
    shaded[:, :9] = False
    made = make_scene(TRUTH)
    tissue = made.objects["pelvis"].volume
    return replace(
        made,
        fields={"anatomy": (shaded, None, None)},
        segmentations=segmentations(TRUTH),
        tissue=tissue.with_data(0.1 * (tissue.data > 0)),
    )


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[PretendedGpu | None]:
    """A pretended GPU; nothing where there is a real one."""
    if torch.cuda.is_available():
        yield None
        return
    with pretended_gpu(monkeypatch) as gpu:
        yield gpu


def stage(optimiser: LevenbergMarquardt, bodies: list[BodyPlan], kinds: list[str]) -> Stage:
    render = ["all"]
    return Stage("stage", "all", kinds, render, bodies, LEVEL, SIMILARITY, optimiser, weights=["bones"])


def objective(scene: Scene, similarity: Similarity, imaging: Imaging, intrinsics: bool) -> SmoothObjective:
    scale = float64(0.02, 0.02, 0.02, 2, 2, 5)
    bodies: list[Moving] = [
        Body((name,), 0, reference_point_in_view(scene, TRUTH, name, 0), scale) for name in ("pelvis", "device")
    ]
    bodies.append(Body((), 1, reference_point_in_view(scene, TRUTH, "pelvis", 1), scale))
    if intrinsics:
        bodies.append(intrinsics_of(scene, TRUTH, list(TRUTH.camera1_from)))
    moving = tuple(bodies)
    images = scene.there(["anatomy", "device"], (0, 1))
    costs = image_costs(scene, TRUTH, moving, list(TRUTH.camera1_from), images, LEVEL, similarity, ["bones"], imaging)
    return stage_objective(costs, moving, None)


@pytest.mark.parametrize(
    ("similarity", "imaging", "intrinsics"),
    [
        (SIMILARITY, Imaging(scatter=0.1, tissue=0.8), False),
        (SIMILARITY, PLAIN, True),
        (Ncc(patch_radius=4), PLAIN, False),
        (Ncc(), PLAIN, False),
    ],
)
def test_value_gradient_and_curvature_are_those_of_the_cpu(
    scene: Scene, similarity: Similarity, imaging: Imaging, intrinsics: bool, gpu: PretendedGpu | None
) -> None:
    here = objective(scene, similarity, imaging, intrinsics)
    there = objective(scene.to(CUDA), similarity, imaging, intrinsics)
    n = 18 + 7 * intrinsics
    deltas = 0.5 * torch.randn(3, n, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    if gpu is not None:
        gpu.waits.clear()
    torch.testing.assert_close(there.values(deltas), here.values(deltas), rtol=2e-5, atol=2e-6)
    if gpu is not None:
        assert dict(gpu.waits) == {"download": 1}
    found, expected = there.quadratic(deltas[0]), here.quadratic(deltas[0])
    if gpu is not None:
        assert dict(gpu.waits) == {"download": 2}
    assert found.value == pytest.approx(expected.value, rel=2e-5)
    for ours, theirs in ((found.gradient, expected.gradient), (found.hessian, expected.hessian)):
        assert ours.device.type == "cpu"
        assert float((ours - theirs).norm() / theirs.norm()) < 1e-4


def test_gradient_orientation_has_the_costs_of_the_cpu(scene: Scene, gpu: PretendedGpu | None) -> None:
    deltas = 0.3 * torch.randn(2, 18, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    here, there = (objective(s, GradientOrientation(), PLAIN, False).values for s in (scene, scene.to(CUDA)))
    torch.testing.assert_close(there(deltas), here(deltas), rtol=1e-3, atol=1e-3)  # directions jump at flat places


@pytest.mark.long
def test_a_plan_ends_where_it_ends_on_the_cpu(scene: Scene, gpu: PretendedGpu | None) -> None:
    """All kinds of steps, and what is asked of the result."""
    search = LevenbergMarquardt(max_iterations=6, candidates=8, starts=1)
    pelvis = BodyPlan(["pelvis", "femur"], [2, 2, 2], [3, 3, 12])
    device = BodyPlan(["device"], [2, 2, 2], [3, 3, 6])
    everything = [BodyPlan(["each"], [1, 1, 1], [1, 1, 4]), BodyPlan(["views"], [1, 1, 1], [1, 1, 4])]
    joint = LevenbergMarquardt(max_iterations=6)
    plan = Plan(
        "test",
        (
            replace(stage(search, [pelvis], ["anatomy"]), images="first"),
            OrbitSearch("orbit", ["anatomy"], ["pelvis", "femur"], 20, 2, LEVEL, SIMILARITY, 20),
            stage(search, [device], ["device"]),
            Calibration("materials"),
            stage(joint, everything, ["all"]),
        ),
    )
    start = {
        "pelvis": off(TRUTH.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (1, -1, 1), (2, -2, 8)),
        "device": off(TRUTH.camera1_from["device"], REFERENCE_POINTS["device"], (2, 1, -1), (2, -2, 3)),
    }
    scene = replace(make_scene(TRUTH, camera1_from_device=start["device"]), segmentations=scene.segmentations)
    here, there = (run_plan(s, plan, start["pelvis"], seed=1) for s in (scene, scene.to(CUDA)))
    for name, expected in here.poses.camera1_from.items():
        mm, deg = error(there.poses.camera1_from[name], expected, REFERENCE_POINTS[name])
        assert mm < 0.4, name  # rounding stops a search in another ripple
        assert deg < 0.4, name
        assert error(expected, TRUTH.camera1_from[name], REFERENCE_POINTS[name])[0] < 5, name
    assert there.trace[-1].cost == pytest.approx(here.trace[-1].cost, abs=1e-3)
    assert there.scene.objects["device"].volume.data.device.type == "cuda"
    told = doubts_about_the_models(scene, here.scene, here.poses)
    assert doubts_about_the_models(scene.to(CUDA), there.scene, there.poses) == told

    # what is asked of a result, at the same poses
    scenes, poses = (here.scene, here.scene.to(CUDA)), here.poses
    covariances = [final_covariance(one, poses) for one in scenes]
    deviations = covariances[0].matrix.diagonal().sqrt()
    apart = (covariances[1].matrix - covariances[0].matrix) / torch.outer(deviations, deviations)
    assert float(apart.abs().max()) < 0.02
    qualities = [
        assess(one, poses, Limits(), PLAIN, here.trace, found) for one, found in zip(scenes, covariances, strict=True)
    ]
    for name, quality in qualities[0].items():
        for ours, theirs in zip(qualities[1][name].views, quality.views, strict=True):
            assert ours.similarity == pytest.approx(theirs.similarity, abs=1e-4)
            assert ours.gain == pytest.approx(theirs.gain, abs=1e-4)
    fits = [handedness(one, poses, "pelvis", PLAIN) for one in scenes]
    assert fits[1].similarity == pytest.approx(fits[0].similarity, abs=1e-4)
    assert fits[1].mirrored == pytest.approx(fits[0].mirrored, abs=0.01)
    bent = [bend(one, poses, "femur", 0.5, images_of(one, poses, "femur", PLAIN)) for one in scenes]
    assert bent[0] is not None
    assert bent[1] is not None
    assert bent[1].apart_mm == pytest.approx(bent[0].apart_mm, abs=0.02)


def test_what_is_looked_at_twice_is_as_on_the_cpu(scene: Scene, gpu: PretendedGpu | None) -> None:
    """Bones 2 % too short, pictures of which one half lies lower, a device and a leg that moved, principal points."""
    squeezed = torch.eye(4, dtype=torch.float64)
    squeezed[2, 2] = 0.98
    objects = dict(scene.objects)
    for name in ("pelvis", "femur"):
        volume = objects[name].volume
        objects[name] = replace(objects[name], volume=replace(volume, lps_from_index=squeezed @ volume.lps_from_index))
    halves = tuple(
        None if image is None else torch.cat([image[:, :44], image[:, 44:].roll(1, 0)], 1)
        for image in scene.images["anatomy"]
    )
    squeezed_ct = replace(scene, objects=objects)
    stretch, also = (
        {each.way: each.amount.value for each in ct_shape(s, TRUTH, ("pelvis", "femur"), PLAIN)}
        for s in (squeezed_ct, squeezed_ct.to(CUDA))
    )
    assert "stretch" in stretch
    assert also == pytest.approx(stretch, rel=0.05, abs=2e-4)
    here = replace(scene, images=scene.images | {"anatomy": halves})
    there = here.to(CUDA)
    bends, also_bent = (
        {bend.way.name: bend.amounts[-1].value for bend in bent_pictures(s, TRUTH, ("pelvis", "femur"), PLAIN)}
        for s in (here, there)
    )
    assert "columns" in bends
    assert also_bent == pytest.approx(bends, rel=0.05, abs=0.02)
    nowhere = torch.ones(6, dtype=torch.float64)
    drift = MotionBetween("device", (1,), ("device",), nowhere, nowhere, 1.0)
    alone = [gain_alone(s, off_by_a_little(TRUTH), drift, PLAIN) for s in (here, there)]
    assert alone[0] > 0.01
    assert alone[1] == pytest.approx(alone[0], rel=0.01)
    shift = torch.tensor([1.5, -1.0], dtype=torch.float64)
    tried = [gain_of_shifted_points(s, off_by_a_little(TRUTH), shift, PLAIN) for s in (here, there)]
    assert abs(tried[0]) > 1e-6
    assert tried[1] == pytest.approx(tried[0], rel=0.01, abs=1e-6)
    turns, also_turns = (finer_joint_turns(s, TRUTH) for s in (here, there))
    assert turns
    assert [turn.degrees for turn in also_turns] == pytest.approx([turn.degrees for turn in turns], rel=0.01, abs=1e-3)


def off_by_a_little(poses: Poses) -> Poses:
    return poses.with_object(
        "device", off(poses.camera1_from["device"], REFERENCE_POINTS["device"], (2, 1, -1), (2, -2, 3))
    )


def test_a_stage_waits_once_per_evaluation(scene: Scene, gpu: PretendedGpu | None) -> None:
    if gpu is None:
        pytest.skip("a real GPU does not count what it is waited for")
    poses = first_view_only(TRUTH.camera1_from, 3)
    there = scene.to(CUDA)
    one = replace(
        stage(LevenbergMarquardt(max_iterations=4), [BodyPlan(["pelvis"], [2, 2, 2], [3, 3, 12])], ["anatomy"]),
        images="first",
    )
    run_stage(there, poses, one, (0,), 0)  # what is kept for later stages is made here
    waits = []
    for iterations in (1, 4):
        gpu.waits.clear()
        optimiser = LevenbergMarquardt(max_iterations=iterations, tol_x=0, tol_f=0)
        evaluations = run_stage(there, poses, replace(one, optimiser=optimiser), (0,), 0).evaluations
        waits.append((evaluations, gpu.waits.total()))
    (few, waited), (many, longer) = waits
    assert longer - waited == many - few > 0
    assert waited - few < 15  # images, weights and fields are looked at once, before the search


def test_outlines_are_followed_as_on_the_cpu(scene: Scene, gpu: PretendedGpu | None) -> None:
    solid = scene.objects["pelvis"].volume
    outline = Outline(solid.with_data((solid.data > 0.002).float()), ("hip_left", "hip_right"))
    seen = segmentations(TRUTH)[0]
    # hip bones and nothing else, in the classes of the anatomy
    probabilities = torch.zeros(1 + len(HIP.bones), *seen.camera.shape)
    probabilities[next(iter(HIP.classes(outline.bones)))] = seen.probabilities[1:3].sum(0)
    start = off(TRUTH.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (2, -1, 1), (2, 2, 10))
    ends = []
    for place in (torch.device("cpu"), CUDA):
        mask = Outline(outline.mask.to(place), outline.bones)
        found = replace(seen, probabilities=probabilities.to(place))
        image = scene.image("anatomy", 0).to(place)
        covariance = torch.diag(float64(0.03, 0.03, 0.03, 3, 3, 15)).square()
        ends.append(refine_by_silhouette(mask, HIP, start, start[:3, 3], covariance, found, image, scene.carm.camera))
    assert max(error(ends[1].camera_from_ct, ends[0].camera_from_ct, REFERENCE_POINTS["pelvis"])) < 0.05
    assert ends[1].overlap == pytest.approx(ends[0].overlap, abs=1e-3)


def test_the_network_finds_the_same(gpu: PretendedGpu | None) -> None:
    image = torch.rand(96, 96, generator=torch.Generator().manual_seed(3))
    camera = centred_camera(1020.0, (3.0, 3.0), (96, 96))
    here, there = (detect(load_network(device=place), image, camera) for place in (torch.device("cpu"), CUDA))
    torch.testing.assert_close(there.pixels, here.pixels, rtol=1e-3, atol=1e-2)
    # a GPU rounds the factors of convolutions to ten bits
    torch.testing.assert_close(there.segmentation, here.segmentation, rtol=1e-3, atol=3e-3)
    assert there.segmentation.device.type == "cpu"


def test_simulated_images_are_the_same(gpu: PretendedGpu | None) -> None:
    model = load_simulation("paper").xray
    camera = centred_camera(1020.0, (3.0, 3.0), (64, 64))
    pelvis, femur = (VOLUMES[name].with_data(20 * VOLUMES[name].data) for name in ("pelvis", "femur"))
    images = []
    for place in (torch.device("cpu"), CUDA):
        tissue = PosedTissue(pelvis, pelvis, femur, torch.eye(4, dtype=torch.float64)).to(place)
        areal = areal_posed_tissue(tissue, TRUTH.camera1_from["pelvis"], camera, 2.0)
        images.append(fluoroscopy(areal, camera, model, torch.Generator().manual_seed(0)).int())
    assert images[1].device.type == "cpu"
    # the same draws, but for quanta whose expectation rounding has moved over an edge; blurred, each is seen by many
    # pixels. The noise of a pixel is some hundreds.
    assert float(((images[0] - images[1]).abs() > 200).float().mean()) < 0.02


def test_the_kernels_through_the_interpreter_have_the_objective_of_the_cpu() -> None:
    pytest.importorskip("triton")
    file = Path(__file__).with_name("interpreted_objective.py")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(file)],
        env=os.environ | {"TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        check=False,
        encoding="utf-8",
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize(
    "command",
    [
        ["register", "case", "--out", "run"],
        ["detect", "image.png", "--out", "found"],
        ["simulate", "patient", "--out", "case"],
        ["batch", "case", "--out", "runs"],
        ["train", "quick", "--out", "run"],
    ],
)
def test_a_gpu_that_is_not_there_is_one_line(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main([*command, "--device", "cuda"]) == 2
    told = capfd.readouterr().err
    assert "--device cuda" in told
    assert len(told.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_auto_takes_the_cpu_where_there_is_no_gpu_and_says_why(
    monkeypatch: pytest.MonkeyPatch, gpu: PretendedGpu | None
) -> None:
    assert chosen_device("auto") == CUDA
    console = Console(file=StringIO(), width=200)
    for built, why in ((None, "built for the CPU alone"), ("13.0", "built for CUDA 13.0, but sees no GPU")):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        monkeypatch.setattr(torch.version, "cuda", built)
        assert tell_device(console, "auto").type == "cpu"
        assert why in console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("use", "says"),
    [
        (lambda a, b: a + b, "two devices"),
        (lambda a, b: a.numpy(), "numpy"),
        (lambda a, b: torch.stack([a, b]), "two devices"),
        (lambda a, b: a[b.long()], "two devices"),
    ],
)
def test_the_pretended_gpu_sees_what_a_real_one_refuses(
    use: Callable[[Tensor, Tensor], Tensor], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pretended_gpu(monkeypatch) as gpu:
        there = torch.ones(3).to(CUDA, non_blocking=True)
        assert there.device == (there * 2)[:1].device == torch.device("cuda:0")
        assert gpu.waits.total() == 0
        assert float(there.sum()) == 3
        assert dict(gpu.waits) == {"__float__": 1}
        with pytest.raises((RuntimeError, TypeError), match=says):
            use(there, torch.ones(3))
