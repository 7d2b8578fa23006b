"""The learning curves of a run as a picture."""

import csv
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from femoreg_torch.files import temporary_file

Point = tuple[int, float]


def draw_curves(metrics: Path, picture: Path) -> None:
    """Draw losses and landmark accuracy over the steps from Lightning's `metrics.csv` into a PNG."""
    with metrics.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(9, 3), layout="constrained")
    losses, accuracy = figure.subplots(1, 2)
    for name, colour in {"landmarks": "tab:blue", "segmentation": "tab:orange"}.items():
        _plot(losses, _column(rows, f"train/{name}"), f"{name}, training", colour, 0.4)
        _plot(losses, _column(rows, f"validation/{name}"), f"{name}, validation", colour, 1.0)
    _plot(accuracy, _column(rows, "validation/landmark_within_2px"), "landmarks within 6.2 mm", "tab:blue", 1.0)
    _plot(accuracy, _column(rows, "validation/visibility"), "visibility right", "tab:green", 1.0)
    _plot(accuracy, _column(rows, "validation/pixel_accuracy"), "labels right", "tab:orange", 1.0)
    losses.set(xlabel="step", ylabel="loss", yscale="log")
    accuracy.set(xlabel="step", ylabel="share, validation", ylim=(0, 1))
    for axes in (losses, accuracy):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    with temporary_file(picture) as part:
        figure.savefig(part, dpi=90)


def _column(rows: list[dict[str, str]], name: str) -> list[Point]:
    return [(int(row["step"]), float(row[name])) for row in rows if row.get(name)]


def _plot(axes: Axes, points: list[Point], label: str, colour: str, opacity: float) -> None:
    if points:
        axes.plot(*zip(*points, strict=True), label=label, color=colour, alpha=opacity)
