"""What a confidence is worth: how often landmarks of a stated confidence are where they are said to be."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor, nn

from femoreg_torch.detect import decode_heatmaps, normalise, to_network_grid
from femoreg_torch.detect.grid import NETWORK_PIXEL_MM
from femoreg_torch.detect.looks import Look, read_image
from femoreg_torch.files import temporary_file
from training.measure import LabelledImage

Array = NDArray[np.float64]

RIGHT_MM = 12.4  # 4 pixels of the heat map: the window whose probability the confidence is


def confidences(
    network: nn.Module, images: Sequence[LabelledImage], looks: tuple[Look, ...], temperatures: Sequence[float]
) -> tuple[Array, NDArray[np.bool_]]:
    """Confidence and whether it was right (T, N · 14), per temperature, of upright images on the network's grid.

    A landmark is right if it is in the image and less than 12.4 mm from where it was found.
    """
    confidence: list[list[Tensor]] = [[] for _ in temperatures]
    right: list[list[Tensor]] = [[] for _ in temperatures]
    for image in images:
        reading = read_image(network, normalise(to_network_grid(image.attenuation, image.camera)), looks)
        for n, temperature in enumerate(temperatures):
            found, sure = decode_heatmaps(reading.heatmaps / temperature, reading.absence / temperature)
            error = (2 * found + 0.5 - image.landmarks).norm(dim=1) * NETWORK_PIXEL_MM
            confidence[n].append(sure)
            right[n].append(image.visible & (error < RIGHT_MM))
    return torch.stack([torch.cat(c) for c in confidence]).numpy(), torch.stack([torch.cat(r) for r in right]).numpy()


def negative_log_likelihood(confidence: Array, right: NDArray[np.bool_]) -> float:
    """Mean over landmarks, in nats, of what happened under the stated confidences."""
    sure = confidence.clip(1e-6, 1 - 1e-6)
    return float(-np.where(right, np.log(sure), np.log1p(-sure)).mean())


def reliability(confidence: Array, right: NDArray[np.bool_], bins: int = 10) -> tuple[Array, Array, Array]:
    """Mean confidence, share that is right, and number of landmarks in each of `bins` equal bins that is not empty."""
    which = np.minimum((confidence * bins).astype(int), bins - 1)
    number = np.bincount(which, minlength=bins)
    full = number > 0
    stated = np.bincount(which, confidence, bins)[full] / number[full]
    true = np.bincount(which, right, bins)[full] / number[full]
    return stated, true, number[full].astype(float)


def calibration_error(confidence: Array, right: NDArray[np.bool_]) -> float:
    """Mean distance between stated confidence and share that is right, weighted by the number of landmarks."""
    stated, true, number = reliability(confidence, right)
    return float((np.abs(stated - true) * number).sum() / number.sum())


def draw_reliability(curves: dict[str, tuple[Array, NDArray[np.bool_]]], picture: Path) -> None:
    """PNG of the share that is right over the stated confidence, one curve per name."""
    figure = Figure(figsize=(4, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="grey", linestyle=":")
    for name, (confidence, right) in curves.items():
        stated, true, _ = reliability(confidence, right)
        label = f"{name}: {100 * calibration_error(confidence, right):.1f} % off in the mean"
        axes.plot(stated, true, marker="o", label=label)
    axes.set(xlabel="stated confidence", ylabel="share that is right", xlim=(0, 1), ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    with temporary_file(picture) as part:
        figure.savefig(part, dpi=110)
