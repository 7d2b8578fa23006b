"""Speed and memory of patch Grad-NCC beside nanodrr's: same images, patch and smoothing, one run.

    python benchmarks/similarity.py [--case FOLDER] [--device cpu|cuda] [--seconds 5] [--peer-candidates 1]

Images are 384 × 384 projections of the pelvis of benchmarks/drr.py. Every row is measured in a process of its own.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from measure import Timing, in_own_process, machine, measure, missing, resident_mib, table, write_section
from scene import CAMERA, default_case, pelvis, poses
from torch import Tensor

from femoreg_torch.drr import project
from femoreg_torch.similarity import GradNcc

_RADIUS = 5  # patches of 11 × 11 pixels
_SMOOTHING_PX = 1.1


def femoreg(fixed: Tensor) -> Callable[[Tensor], Tensor]:
    """This project: costs (B,) of images (B, H, W)."""
    return GradNcc(_RADIUS, _SMOOTHING_PX).against(fixed)


def nanodrr(fixed: Tensor) -> Callable[[Tensor], Tensor]:
    """nanodrr's patch gradient NCC, turned into a cost."""
    from nanodrr.metrics import GradientNormalizedCrossCorrelation2d

    similarity = GradientNormalizedCrossCorrelation2d(2 * _RADIUS + 1, _SMOOTHING_PX).to(fixed.device)
    return lambda images: 1 - similarity(fixed[None, None].expand(len(images), -1, -1, -1), images[:, None])


SIMILARITIES = {"FemoReg Torch": femoreg, "nanodrr": nanodrr}


def run_row(stored: Path, name: str, task: str, count: int, device: str, seconds: float) -> tuple[Timing, float]:
    """Timing of one similarity over `count` candidates in this process, and the first candidate's cost."""
    images = torch.load(stored, weights_only=True).to(device)
    fixed, moving = images[0], images[1 : count + 1].clone()
    small = SIMILARITIES[name](fixed[:48, :48].contiguous())
    small(moving[:1, :48, :48].contiguous().requires_grad_()).sum().backward()  # compiles what is to be compiled
    before = resident_mib(device)
    similarity = SIMILARITIES[name](fixed)

    def value() -> Tensor:
        with torch.no_grad():
            return similarity(moving)

    def gradient() -> None:
        candidates = moving.clone().requires_grad_()
        similarity(candidates).sum().backward()

    return measure({"value": value, "gradient": gradient}[task], device, seconds, before), value()[0].item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, default=default_case(), help="folder with ct.nii.gz and labels.nii.gz")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--seconds", type=float, default=5.0, help="time spent on each row")
    parser.add_argument(
        "--peer-candidates", type=int, default=1, help="largest batch of nanodrr; each takes about 1 GiB"
    )
    options = parser.parse_args()
    volume, name = pelvis(options.case)
    counts = {"FemoReg Torch": {1, 32}, "nanodrr": {1, options.peer_candidates}}
    if reason := missing("nanodrr"):
        print(reason)
        del counts["nanodrr"]
    cells, medians = [], {}
    with tempfile.TemporaryDirectory() as folder:
        stored = Path(folder) / "images.pt"
        torch.save(project([volume], poses(volume, 33)[:, None], CAMERA), stored)
        for renderer, sizes in counts.items():
            for count in sorted(sizes):
                for task in ("value", "gradient"):
                    timing, cost = in_own_process(
                        run_row, stored, renderer, task, count, options.device, options.seconds
                    )
                    medians[renderer, task, count] = timing.median
                    peak, value = f"{timing.peak_mib:.0f}", f"{cost:.5f}"
                    cells.append([renderer, task, str(count), timing.per(count), peak, value])
                    print(cells[-1], flush=True)
    ratios = []
    for task in ("value", "gradient"):
        if peer := medians.get(("nanodrr", task, 1)):
            ratio = peer / medians["FemoReg Torch", task, 1]
            ratios.append(f"- {task} of one pair: nanodrr takes **{ratio:.3g} times** as long")
    header = ["similarity", "task", "candidates", "ms per candidate: median (p10–p90)", "peak MiB", "cost of the first"]
    side, size = 2 * _RADIUS + 1, f"{CAMERA.shape[0]} × {CAMERA.shape[1]}"
    text = f"""{machine(options.device, ["nanodrr"] if "nanodrr" in counts else [])}

{size} projections of the {name}, {options.device}, float32.
Patches of {side} × {side} pixels, Gaussian of {_SMOOTHING_PX} px. `gradient` is value and gradient with respect to the
candidates' images. The two definitions differ where the Gaussian is cut (nanodrr at 3 σ, here at 2 σ), at the edges of
the image and in the floor of the variance.

{table(header, cells)}

{chr(10).join(ratios)}"""
    write_section(f"Patch Grad-NCC on {options.device}", text)


if __name__ == "__main__":
    main()
