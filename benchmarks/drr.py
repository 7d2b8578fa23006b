"""Speed, memory and error of the projector beside nanodrr and DiffDRR: same volume, camera, poses and step, one run.

    python benchmarks/drr.py [--case FOLDER] [--device cpu|cuda] [--seconds 5] [--peer-poses 4]

The case folder needs ct.nii.gz and labels.nii.gz, with ids as in the label table `femoreg`; without one
a phantom serves.
Every row is measured in a process of its own. Writes benchmarks/RESULTS.md.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from measure import (
    Timing,
    in_own_process,
    machine,
    measure,
    missing,
    resident_mib,
    table,
    write_section,
)
from renderers import RENDERERS
from scene import CAMERA, default_case, pelvis, poses
from torch import Tensor

from femoreg_torch.drr import project_with_jacobian
from femoreg_torch.drr.reference import march
from femoreg_torch.volume.grid import Volume, axis_aligned

_COARSE = CAMERA.window(
    slice(4, None, 8), slice(4, None, 8)
)  # every 8th pixel, 2,304 in all, where the error is measured


@dataclass(frozen=True)
class Row:
    """One measured line."""

    renderer: str
    task: str
    poses: int
    timing: Timing
    error: float | None = None


def run_row(scene: Path, name: str, task: str, count: int, device: str, seconds: float) -> Row:
    """Measure one renderer at one task in this process; `scene` holds the volume and the march of the first pose."""
    stored = torch.load(scene, weights_only=True)
    volume = Volume(stored["data"], stored["lps_from_index"])
    many = poses(volume, count)
    weights = torch.randn(count, *CAMERA.shape, generator=torch.Generator().manual_seed(1)).to(device)

    def forward() -> Tensor:
        with torch.no_grad():
            return render(many)

    def gradient() -> None:
        moving = many.clone().requires_grad_()
        (render(moving) * weights).sum().backward()

    def jacobian() -> None:
        project_with_jacobian(volume, many, CAMERA, torch.tensor([0, 0, 800.0], dtype=torch.float64))

    warm_up(name, device)
    before = resident_mib(device)
    title, render = RENDERERS[name][1](volume, CAMERA, device)
    calls: dict[str, Callable[[], object]] = {"forward": forward, "gradient": gradient, "jacobian": jacobian}
    timing = measure(calls[task], device, seconds, before)
    error = None
    if task == "forward" and count == 1:
        gap = forward()[0, 4::8, 4::8].cpu().double() - stored["march"]
        error = (gap.square().mean().sqrt() / stored["march"].square().mean().sqrt()).item()
    return Row(title, task, count, timing, error)


def warm_up(name: str, device: str) -> None:
    """Load and compile what a renderer needs, on a small volume and image."""
    camera = CAMERA.downsampled(16)
    small = Volume(torch.ones(8, 8, 8), axis_aligned((20.0, 20.0, 20.0), (-70.0, -70.0, -70.0)))
    pose = poses(small, 1).requires_grad_()
    RENDERERS[name][1](small, camera, device)[1](pose).sum().backward()
    if device == "cpu":
        project_with_jacobian(small, pose.detach(), camera, torch.zeros(3, dtype=torch.float64))


def store_scene(volume: Volume, path: Path) -> None:
    """The volume and, for the first pose, a float64 march at 0.1 mm on the coarse pixels."""
    index_from_camera = torch.linalg.inv(poses(volume, 1) @ volume.lps_from_index)
    exact = march(volume.data.double(), index_from_camera, _COARSE, torch.zeros(1), 0.1)[0]
    torch.save({"data": volume.data, "lps_from_index": volume.lps_from_index, "march": exact}, path)


def comparison(volume: Volume, device: str, seconds: float, peer_poses: int) -> list[Row]:
    """All rows, each in its own process; a peer that cannot be imported is left out and said so."""
    tasks = {"femoreg": [("forward", 1), ("gradient", 1), ("forward", 32), ("gradient", 32)]}
    if device == "cpu":
        tasks["femoreg"].append(("jacobian", 1))
    for name in RENDERERS:
        if name != "compiled" or device == "cpu":  # for a GPU, torch.compile was still at it after a minute and a half
            tasks.setdefault(name, [("forward", 1), ("gradient", 1)])
    if peer_poses > 1:
        tasks["nanodrr"].append(("forward", peer_poses))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.pt"
        store_scene(volume, scene)
        for name, wanted in tasks.items():
            package = RENDERERS[name][0]
            if package and (reason := missing(package)):
                print(reason)
                continue
            for task, count in wanted:
                rows.append(in_own_process(run_row, scene, name, task, count, device, seconds))
                print(rows[-1], flush=True)
    return rows


def ratios(rows: list[Row]) -> str:
    """How many times faster than each peer at the same task, per pose, one pose each."""
    ours = {row.task: row for row in rows if row.renderer == "FemoReg Torch" and row.poses == 1}
    lines = []
    for row in rows:
        if row.renderer != "FemoReg Torch" and row.poses == 1:
            ratio = row.timing.median / ours[row.task].timing.median
            lines.append(f"- {row.renderer}, {row.task}: **{ratio:.3g} times** the time of this project")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, default=default_case(), help="folder with ct.nii.gz and labels.nii.gz")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--seconds", type=float, default=5.0, help="time spent on each row")
    parser.add_argument(
        "--peer-poses", type=int, default=4, help="largest batch of the peers; each pose takes about 1 GiB"
    )
    options = parser.parse_args()
    volume, name = pelvis(options.case)
    rows = comparison(volume, options.device, options.seconds, options.peer_poses)
    size = " × ".join(str(n) for n in reversed(volume.data.shape))
    header = ["renderer", "task", "poses", "ms per pose: median (p10–p90)", "peak MiB", "NRMSE to float64 at 0.1 mm"]
    cells = [
        [
            row.renderer,
            row.task,
            str(row.poses),
            row.timing.per(row.poses),
            f"{row.timing.peak_mib:.0f}",
            "" if row.error is None else f"{row.error:.1e}",
        ]
        for row in rows
    ]
    peers = [p for p in ("nanodrr", "diffdrr") if missing(p) is None]
    pixel = f"{CAMERA.shape[0]} × {CAMERA.shape[1]} pixels of {CAMERA.pixel_mm[0]:g} mm"
    voxel = f"{size} voxels of {' × '.join(f'{s:.3g}' for s in volume.spacing_mm)} mm"
    text = f"""{machine(options.device, peers)}

{pixel}, {name}, {voxel}, {options.device}, float32.
`gradient` is forward and backward to the poses, `jacobian` the image and its six derivatives. Peak memory is what the
call adds to a process that holds the volume. NRMSE is the root mean square difference over 2,304 pixels, divided by the
root mean square of the march; Siddon's volume is constant within voxels, so that its difference is one of model.

{table(header, cells)}

{ratios(rows)}"""
    write_section(f"Projector on {options.device}", text)


if __name__ == "__main__":
    main()
