"""How the projector's time grows with pixels, samples and poses.

    python benchmarks/scaling.py [--case FOLDER] [--device cpu|cuda] [--seconds 5]

Writes benchmarks/RESULTS.md and benchmarks/drr_scaling.png.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from measure import RESULTS, machine, measure, write_section
from numpy.typing import NDArray
from scene import CAMERA, default_case, pelvis, poses

from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, load_carm
from femoreg_torch.volume.grid import Volume

_SIDES = (96, 192, 384, 768, 1536)
_STEPS_MM = (2.0, 1.0, 0.5, 0.25)
_BATCHES = (1, 2, 4, 8, 16, 32)


@dataclass(frozen=True)
class Growth:
    """Milliseconds (N,) over a count (N,), and the straight line a + b · count of least relative squares."""

    counts: NDArray[np.float64]
    times: NDArray[np.float64]

    def line(self) -> tuple[float, float]:
        """Offset a in ms and slope b in ms."""
        design = np.stack([np.ones_like(self.counts), self.counts], 1) / self.times[:, None]
        offset, slope = np.linalg.lstsq(design, np.ones_like(self.times), rcond=None)[0]
        return float(offset), float(slope)

    def deviation(self) -> float:
        """Largest relative distance of a time from the line."""
        offset, slope = self.line()
        return float(np.abs((offset + slope * self.counts) / self.times - 1).max())


@dataclass(frozen=True)
class Scaling:
    """Forward times: over the pixels of one pose, over the samples per mm of 384 × 384, over the poses of a batch."""

    pixels: Growth
    samples: Growth
    batch: Growth
    one_by_one: Growth  # the same poses, each in a call of its own


def measure_scaling(volume: Volume, device: str, seconds: float) -> Scaling:
    """Median times on `device`; every point gets about a quarter of `seconds`."""
    whole = load_carm("cios_fusion").camera
    posed = Volume(volume.data.to(device), volume.lps_from_index)

    def milliseconds(camera: Camera, count: int, step_mm: float = 1.0, at_once: bool = True) -> float:
        many = poses(volume, count)[:, None].to(device)
        parts = [many] if at_once else many.split(1)
        return (
            1e3
            * measure(lambda: [project([posed], part, camera, step_mm) for part in parts], device, seconds / 4).median
        )

    def growth(counts: list[float], times: list[float]) -> Growth:
        return Growth(np.array(counts, float), np.array(times))

    batches = [float(n) for n in _BATCHES]
    return Scaling(
        growth([float(side**2) for side in _SIDES], [milliseconds(whole.downsampled(1536 // n), 1) for n in _SIDES]),
        growth([1 / step for step in _STEPS_MM], [milliseconds(CAMERA, 1, step) for step in _STEPS_MM]),
        growth(batches, [milliseconds(CAMERA, n) for n in _BATCHES]),
        growth(batches, [milliseconds(CAMERA, n, at_once=False) for n in _BATCHES]),
    )


def describe(scaling: Scaling) -> str:
    """The measured numbers and the lines through them, as one paragraph of Markdown."""
    pixels, samples = scaling.pixels.line(), scaling.samples.line()
    sides = ", ".join(f"{side}²: {t:.3g}" for side, t in zip(_SIDES, scaling.pixels.times, strict=True))
    steps = ", ".join(f"{step:g} mm: {t:.3g}" for step, t in zip(_STEPS_MM, scaling.samples.times, strict=True))
    pairs = zip(_BATCHES, scaling.batch.times, scaling.one_by_one.times, strict=True)
    batches = ", ".join(f"{n}: {at_once / n:.3g} against {alone / n:.3g}" for n, at_once, alone in pairs)
    return (
        f"Forward time in ms over the image side: {sides}; a straight line, {pixels[0]:.3g} ms + "
        f"{1e6 * pixels[1]:.3g} ns per pixel, within {scaling.pixels.deviation():.0%}. "
        f"Over the step: {steps}; {samples[0]:.3g} ms + {samples[1]:.3g} ms times the samples per mm, within "
        f"{scaling.samples.deviation():.0%}. The offset is the search for empty space, once per packet of rays; "
        "a finer image has no more packets. "
        f"Time per pose of a batch against the same poses one by one: {batches}."
    )


def plot(scaling: Scaling, path: Path) -> None:
    """The three growths with their lines."""
    figure = Figure(figsize=(12, 4), layout="constrained")
    pixels, samples, batch = figure.subplots(1, 3)
    _draw(pixels, scaling.pixels, [f"{side}²" for side in _SIDES], "pixels, one pose")
    _draw(samples, scaling.samples, [f"{1 / step:g}" for step in _STEPS_MM], "samples per mm, 384 × 384 pixels")
    _draw(batch, scaling.batch, [str(n) for n in _BATCHES], "poses, 384 × 384 pixels")
    batch.loglog(scaling.one_by_one.counts, scaling.one_by_one.times, "x", label="one by one")
    batch.legend()
    figure.savefig(path, dpi=110)


def _draw(axes: Axes, growth: Growth, ticks: list[str], label: str) -> None:
    offset, slope = growth.line()
    axes.loglog(growth.counts, growth.times, "o", label="measured")
    axes.loglog(growth.counts, offset + slope * growth.counts, "k:", label="straight line")
    axes.set_xticks(growth.counts, ticks)
    axes.set_yticks(growth.times, [f"{time:.3g}" for time in growth.times])
    axes.minorticks_off()
    axes.set_xlabel(label)
    axes.set_ylabel("forward, ms (median)")
    axes.grid(visible=True, which="major", alpha=0.3)
    axes.legend()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", type=Path, default=default_case(), help="folder with ct.nii.gz and labels.nii.gz")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--seconds", type=float, default=5.0, help="four times the time spent on each point")
    options = parser.parse_args()
    volume, name = pelvis(options.case)
    growth = measure_scaling(volume, options.device, options.seconds)
    picture = RESULTS.with_name("drr_scaling.png" if options.device == "cpu" else "drr_scaling_cuda.png")
    plot(growth, picture)
    about = f"{machine(options.device, [])}\n\n{name}, 1 mm steps unless said otherwise, float32."
    text = f"{about}\n\n{describe(growth)}\n\n![Time over pixels, samples and poses]({picture.name})"
    write_section(f"Growth of the projector's time on {options.device}", text)


if __name__ == "__main__":
    main()
