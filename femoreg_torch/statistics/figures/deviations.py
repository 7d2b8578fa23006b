"""Stated standard deviations against true errors."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from femoreg_torch.statistics.figures.style import COLOURS, DOUBLE_MM, QUIET, Plot, head, logarithmic, new_figure
from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import AXES, OBJECTS

_MARKS = ("o", "s", "^")
_FOOT = 0.02  # of the smallest deviation: errors below lie outside a panel, as a logarithm has no 0


def deviations(rows: pd.DataFrame) -> Plot | None:
    """A panel per object for mm and for degrees; None where no run states a deviation with an error."""
    objects = [name for name in OBJECTS if any(len(_pairs(rows, name, "mm", axis)[0]) for axis in AXES)]
    if not objects:
        return None
    figure = new_figure(DOUBLE_MM, 116)
    panels = figure.subplots(2, len(objects), squeeze=False)
    for line, unit in zip(panels, ("mm", "deg"), strict=True):
        for axes, name in zip(line, objects, strict=True):
            _panel(axes, rows, name, unit)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    caption = (
        "Absolute error of every run against the standard deviation that it states of itself, along (mm) and about (°) "
        "each axis of view 1. Below the solid line errors are within one deviation, below the dotted one within two: "
        "68.3 % and 95.4 % of them, if the deviations are right and the errors normal. Errors below a fiftieth of the "
        "smallest deviation lie outside a panel."
    )
    return Plot("deviations", "Stated deviations and true errors", caption, figure)


def _pairs(rows: pd.DataFrame, name: str, unit: str, axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Stated deviations and absolute errors (N,) of the runs that tell both."""
    sigma, error = told(rows, f"{name}_sigma_{unit}_{axis}"), told(rows, f"{name}_{unit}_{axis}")
    both = sigma.gt(0) & error.notna()
    return sigma[both].to_numpy(float), error[both].to_numpy(float)


def _panel(axes: Axes, rows: pd.DataFrame, name: str, unit: str) -> None:
    ratios = []
    for axis, colour, mark in zip(AXES, COLOURS[1:], _MARKS, strict=False):
        sigma, error = _pairs(rows, name, unit, axis)
        alpha = max(0.15, min(0.7, 60 / max(1, len(sigma))))
        axes.plot(
            sigma, error, mark, color=colour, markersize=2.2, markeredgewidth=0, alpha=alpha, label=axis.upper(),
            rasterized=True,
        )  # fmt: skip
        ratios.append(error / sigma)
    axes.set_xscale("log")
    axes.set_yscale("log")
    low, high = axes.get_xlim()
    ends = np.array([low, high])
    axes.plot(ends, ends, "-", color=QUIET, linewidth=0.8, label="1 σ")
    axes.plot(ends, 2 * ends, ":", color=QUIET, linewidth=0.8, label="2 σ")
    axes.set_xlim(low, high)
    axes.set_ylim(bottom=_FOOT * low)
    for scale, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        logarithmic(scale, np.log10(high / low))
    told_unit = "mm" if unit == "mm" else "°"
    axes.set_xlabel(f"stated deviation, {told_unit}")
    axes.set_ylabel(f"error, {told_unit}")
    every = np.concatenate(ratios)
    one, two = (f"{100 * (every <= times).mean():.0f} % within {times} σ" for times in (1, 2))
    head(axes, name, [f"{one}, {two}", f"n = {len(ratios[0])}"])
