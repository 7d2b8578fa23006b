"""What each way of saving time is worth: the same thing with it and without it, by turns in one process.

    python benchmarks/levers.py CASE [--seconds 3]

CASE is a case folder with a truth, such as `femoreg simulate` writes. Times are those of the processor, all threads
together, of the fastest turn; `apart` is the largest difference of the two results, relative to the largest value.
"""

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import femoreg_torch  # noqa: F401  # isort: skip  # before torch, whose threads else spend the processor on waiting
import numpy as np
import torch
from measure import machine, table, write_section
from samples import samples
from scipy import ndimage
from torch import Tensor

from femoreg_torch.case import read_case
from femoreg_torch.drr import cpu, project, project_with_jacobian
from femoreg_torch.drr.bricks import BrickedVolume, bricked
from femoreg_torch.fluoro import binned
from femoreg_torch.geometry import Camera, Poses, about_point, exp_se3, transform_points
from femoreg_torch.optimize import levenberg
from femoreg_torch.registration import Scene, Stage, load_plan, prepare_scene
from femoreg_torch.registration.compared import prepared
from femoreg_torch.registration.costs import ImageCosts, image_costs
from femoreg_torch.registration.imaging import draw, draw_still, tissue_integrals
from femoreg_torch.registration.level import Level, binning
from femoreg_torch.registration.scene import Body
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.registration.step import chosen_kinds, chosen_objects
from femoreg_torch.similarity import GradNcc
from femoreg_torch.similarity.curvature import patch_curvature
from femoreg_torch.similarity.kernels import image_gradients
from femoreg_torch.volume import Volume, looked_up
from femoreg_torch.volume.attenuation import _dilated

_CANDIDATES = 8
_STEP = 1e-4
_START_OFF = torch.tensor([0.02, -0.02, 0.01, 4.0, -3.0, 12.0], dtype=torch.float64)  # of view 2: rad and mm


@dataclass(frozen=True)
class Lever:
    """One way of saving time, and the same without it."""

    name: str
    part: str  # of the work that it saves in
    without: Callable[[], Tensor]
    with_it: Callable[[], Tensor]


def stage_named(name: str) -> Stage:
    found = next(step for step in load_plan("fast").steps if step.name == name)
    assert isinstance(found, Stage)
    return found


def costs_of(stage: Stage, scene: Scene, poses: Poses) -> ImageCosts:
    """The costs of a stage of `fast` in all views about the true poses, with the intrinsics of the C-arm's file."""
    views = tuple(range(scene.views))
    bodies = tuple(body for body in stage.moving(scene, poses, views) if isinstance(body, Body))
    images = scene.there(chosen_kinds(stage.kinds, scene), views)
    render = chosen_objects(stage.render, poses)
    return image_costs(
        scene, poses, bodies, render, images, stage.level, stage.similarity, stage.weights, stage.imaging
    )


def levers(scene: Scene, poses: Poses) -> Iterator[Lever]:
    """All that can be switched off by what the library offers."""
    yield from _of_the_projector(scene, poses)
    yield from _of_the_objective(scene, poses)
    yield from _of_the_similarity(scene, poses)
    yield from _of_the_descents(scene, poses)
    yield from _of_the_reading(scene)


def _of_the_projector(scene: Scene, poses: Poses) -> Iterator[Lever]:
    volume, pose = scene.objects["pelvis"].volume, poses.camera_from("pelvis")[:1]
    camera = scene.carm.camera.downsampled(4)
    affine = torch.linalg.inv(pose @ volume.lps_from_index)[:, :3].numpy()
    bricks = bricked(volume)
    full = replace(bricks, leap=np.zeros_like(bricks.leap))
    offsets = np.zeros(1)

    def cast(chosen: BrickedVolume) -> Tensor:
        return torch.from_numpy(cpu.projection(chosen, affine, camera, offsets, 1.0))

    taken = " against ".join(f"{samples(b, affine, camera, offsets, 1.0) / 1e6:.0f}" for b in (bricks, full))
    yield Lever(
        f"empty space is leapt over ({taken} million samples)",
        "one image, 384²",
        lambda: cast(full),
        lambda: cast(bricks),
    )
    edges = cpu._packet_edges

    def single() -> Tensor:
        cpu._packet_edges = lambda *numbers: np.ones_like(edges(*numbers))
        try:
            return cast(bricks)
        finally:
            cpu._packet_edges = edges

    yield Lever("rays go in packets", "one image, 384²", single, lambda: cast(bricks))

    for fewer, step_mm in ((8, 2.0), (16, 4.0)):
        coarse, fitting = scene.carm.camera.downsampled(fewer), Level(1.0, step_mm).volume(volume)
        taken = " against ".join(f"{_samples(v, pose, coarse, step_mm) / 1e3:.0f}" for v in (fitting, volume))
        yield Lever(
            f"voxels of {max(fitting.spacing_mm):.0f} mm, as large as the steps allow ({taken} thousand samples)",
            f"one image, {coarse.shape[0]}²",
            partial(project, volume, pose, coarse, step_mm),
            partial(project, fitting, pose, coarse, step_mm),
        )

    centre = transform_points(pose[0], volume.centre()[None])[0]
    steps = _STEP * torch.eye(6, dtype=torch.float64)

    def differences() -> Tensor:
        around = about_point(exp_se3(torch.cat([steps, -steps])), centre) @ pose
        above, below = project(volume, around, camera).double().split(6)
        project(volume, pose, camera)
        return (above - below) / (2 * _STEP)

    yield Lever(
        "image and derivatives by one walk along the rays, not by 13 images",
        "one Jacobian, 384²",
        differences,
        lambda: project_with_jacobian(volume, pose, camera, centre)[1][0].movedim(-1, 0).double(),
    )


def _samples(volume: Volume, pose: Tensor, camera: Camera, step_mm: float) -> int:
    """Samples of one image of a volume."""
    affine = torch.linalg.inv(pose @ volume.lps_from_index)[:, :3].numpy()
    return samples(bricked(volume), affine, camera, np.zeros(1), step_mm)


def _of_the_objective(scene: Scene, poses: Poses) -> Iterator[Lever]:
    stage = stage_named("everything together")
    joint = costs_of(stage, scene, poses)
    generator = torch.Generator().manual_seed(0)
    deltas = 0.3 * torch.randn(_CANDIDATES, len(joint.still), generator=generator, dtype=torch.float64)
    apart = [replace(joint, targets=(target,)) for target in joint.targets]
    yield Lever(
        "what images of one view show alike is drawn once",
        f"{_CANDIDATES} costs, joint stage",
        lambda: torch.cat([one(deltas) for one in apart], 1),
        lambda: joint(deltas),
    )
    yield Lever(
        "the same for image and derivatives",
        "a quadratic, joint stage",
        lambda: torch.stack([one.quadratics(joint.still)[0].hessian for one in apart]),
        lambda: torch.stack([model.hessian for model in joint.quadratics(joint.still)]),
    )

    stage = stage_named("device in all views, coarse")
    device = costs_of(stage, scene, poses)
    few = 0.3 * torch.randn(_CANDIDATES, len(device.still), generator=generator, dtype=torch.float64)
    level = stage.level
    volumes = {name: level.volume(thing.volume) for name, thing in scene.objects.items()}

    def again() -> Tensor:
        for target in device.targets:
            still = [n for n in scene.shown(poses.camera1_from, "device") if n not in target.moving]
            where = torch.stack([poses.camera_from(n)[target.view] for n in still]).expand(_CANDIDATES, -1, 4, 4)
            project([volumes[n] for n in still], where, target.camera, level.step_mm)
        return device(few)

    yield Lever("what stands still is drawn once", f"{_CANDIDATES} costs, device stage", again, lambda: device(few))

    stage = stage_named("C-arm of the other views, coarse")
    views = (1,)
    bodies = stage.moving(scene, poses, views)
    images = scene.there(chosen_kinds(stage.kinds, scene), views)
    render = chosen_objects(stage.render, poses)
    coarse = image_costs(scene, poses, bodies, render, images, stage.level, stage.similarity)
    fine = coarse
    for name in render:
        fine = fine.with_object(name, scene.objects[name])
    some = 0.3 * torch.randn(_CANDIDATES, len(coarse.still), generator=generator, dtype=torch.float64)
    yield Lever(
        "voxels as large as the steps allow",
        f"{_CANDIDATES} costs, coarse C-arm",
        lambda: fine(some),
        lambda: coarse(some),
    )

    level = Level(pixel_mm=0.78, step_mm=0.5)
    every = [image for of in scene.images.values() for image in of if image is not None]
    factor = binning(level.pixel_mm, scene.carm.camera)
    yield Lever(
        "images are averaged once for all stages of a level",
        "six images",
        lambda: torch.stack([binned(image, factor) for image in every]),
        lambda: torch.stack([level.image(image, scene.carm.camera) for image in every]),
    )
    if scene.tissue is not None:
        tissue, camera = scene.tissue, level.camera(scene.carm.camera)
        pose = poses.camera_from(scene.anchor)[0]
        yield Lever(
            "soft tissue is drawn on coarse pixels and interpolated",
            "one image, 384²",
            lambda: project([tissue], pose[None, None], camera, 3.0)[0],
            lambda: tissue_integrals(tissue, pose, camera),
        )

    finest, pelvis, where = Level(pixel_mm=0.39, step_mm=0.5), scene.objects["pelvis"], poses.camera_from("pelvis")[0]
    yield Lever(
        "what stands still is drawn on pixels that fit its voxels, and interpolated",
        "the pelvis, 768²",
        lambda: draw([pelvis], where[None, None], finest.camera(scene.carm.camera), finest.step_mm)[0],
        lambda: draw_still(pelvis, where, finest.camera(scene.carm.camera), finest.step_mm),
    )


def _of_the_similarity(scene: Scene, poses: Poses) -> Iterator[Lever]:
    level = Level(pixel_mm=0.78, step_mm=0.5)
    camera = level.camera(scene.carm.camera)
    fixed = prepared(scene, (scene.first_kind, 0), level, GradNcc(patch_radius=5))
    image, jacobians = torch.zeros(camera.shape), []
    for name in ("pelvis", "femur"):
        pose = poses.camera_from(name)[:1]
        centre = transform_points(pose[0], scene.objects[name].reference_point[None])[0]
        one, jacobian = project_with_jacobian(scene.objects[name].volume, pose, camera, centre, level.step_mm)
        image, jacobians = image + one[0], [*jacobians, jacobian[0].movedim(-1, 0)]
    twelve = torch.cat(jacobians)
    mix = torch.randn(30, 12, generator=torch.Generator().manual_seed(0))

    def thirty() -> Tensor:
        planes = torch.einsum("nm,mhw->nhw", mix, twelve)
        return fixed.curvature(image, planes, 4)

    def mapped() -> Tensor:
        return mix.double() @ fixed.curvature(image, twelve, 4) @ mix.double().T

    yield Lever("derivatives by six twists per object, not by 30 degrees of freedom", "one image", thirty, mapped)

    def plane_by_plane() -> Tensor:
        maps = image_gradients(torch.cat([image[None], twelve]), fixed.taps)
        both = [
            patch_curvature(maps[0, d], maps[1:, d], fixed.fixed[d], fixed.scale[d], fixed.weights, fixed.radius, 4)
            for d in range(2)
        ]
        return (both[0] + both[1]) / 2

    yield Lever(
        "derivatives are filtered and summed in one compiled pass",
        "one image, 12 planes",
        plane_by_plane,
        lambda: fixed.curvature(image, twelve, 4),
    )
    moving = image[None].clone().requires_grad_()

    def plain() -> Tensor:
        return torch.autograd.grad(1 - fixed._reference(moving)[0], moving)[0]

    yield Lever(
        "Grad-NCC and its gradient compiled",
        "one image, 384²",
        plain,
        lambda: torch.autograd.grad(fixed(moving)[0], moving)[0],
    )
    yield Lever(
        "and in one pass",
        "one image, 384²",
        lambda: torch.autograd.grad(fixed(moving)[0], moving)[0],
        lambda: fixed._with_slope(image)[1],
    )


def _of_the_descents(scene: Scene, poses: Poses) -> Iterator[Lever]:
    stage = stage_named("C-arm of the other views, coarse")
    isocentre = torch.tensor(scene.carm.isocentre_mm, dtype=torch.float64)
    moved = about_point(exp_se3(_START_OFF[None]), isocentre)[0]
    off = poses.with_view(1, moved @ poses.camera_from_camera1[1])

    def found() -> Tensor:
        return run_stage(scene, off, stage, (1,), seed=0).poses.camera_from_camera1[1]

    def to_the_end() -> Tensor:
        kept, levenberg._SAME = levenberg._SAME, 0.0
        try:
            return found()
        finally:
            levenberg._SAME = kept

    yield Lever(
        "a descent that comes where another ended is given up",
        "coarse C-arm of a view",
        to_the_end,
        found,
    )
    together, views = stage_named("everything together"), tuple(range(scene.views))

    def settled() -> Tensor:
        return run_stage(scene, poses, together, views, seed=0).poses.camera_from_camera1

    def by_damping_alone() -> Tensor:
        kept, levenberg._SHORTER = levenberg._SHORTER, 1 - 1e-9
        try:
            return settled()
        finally:
            levenberg._SHORTER = kept

    yield Lever("a step that fits worse is halved", "everything together", by_damping_alone, settled)


def _of_the_reading(scene: Scene) -> Iterator[Lever]:
    bone = (scene.objects["pelvis"].volume.data > 0).numpy()
    labels, table = bone.astype(np.uint8), np.arange(256, dtype=np.float32)
    yield Lever(
        "labels are looked up by OpenCV, not by NumPy",
        "labels about the pelvis",
        lambda: torch.from_numpy(table[labels]),
        lambda: torch.from_numpy(looked_up(table, labels)),
    )
    inside = ndimage.binary_erosion(bone, iterations=2)
    yield Lever(
        "masks of bones grow by shifts, not by SciPy's dilation",
        "the pelvis",
        lambda: torch.from_numpy(ndimage.binary_dilation(inside, iterations=2, mask=bone)),
        lambda: torch.from_numpy(_dilated(inside, bone, 2)),
    )


def seconds_of(calls: tuple[Callable[[], Tensor], Callable[[], Tensor]], seconds: float) -> tuple[float, float, float]:
    """Processor time of both, each its fastest turn, and how far their results are apart."""
    first, second = (call().detach().double() for call in calls)
    apart = float((first - second).abs().max() / first.abs().max())
    found: tuple[list[float], list[float]] = ([], [])
    began = time.perf_counter()
    while time.perf_counter() - began < seconds or len(found[0]) < 3:
        for call, times in zip(calls, found, strict=True):
            start = time.process_time()
            call()
            times.append(time.process_time() - start)
    return min(found[0]), min(found[1]), apart


def main() -> None:
    """Measure and write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", type=Path, help="case folder with a truth")
    parser.add_argument("--seconds", type=float, default=3.0, help="for each lever")
    settings = parser.parse_args()
    case = read_case(settings.case)
    if case.truth is None:
        raise SystemExit(f"{settings.case}: has no truth to place its objects by.")
    scene = prepare_scene(case)
    rows = []
    for lever in levers(scene, case.truth):
        before, after, apart = seconds_of((lever.without, lever.with_it), settings.seconds)
        rows.append(
            [
                lever.name,
                lever.part,
                f"{1e3 * before:.3g}",
                f"{1e3 * after:.3g}",
                f"{before / after:.1f}",
                f"{apart:.0e}",
            ]
        )
        print(rows[-1], flush=True)
    header = ["lever", "in", "without: ms", "with: ms", "times", "apart"]
    text = (
        f"{machine('cpu', ())}\n\nOne simulated procedure with six images of 1,536 × 1,536 pixels, at its true poses; "
        "stages and levels are those of `fast`. Processor time of all threads, the fastest turn of each, by turns in "
        "one process. `apart`: largest difference of the two results, relative to the largest value; where it is not "
        "rounding, the lever approximates.\n\n" + table(header, rows)
    )
    write_section("Each lever by itself, on cpu", text)


if __name__ == "__main__":
    main()
