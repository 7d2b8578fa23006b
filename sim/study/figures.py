"""Plots of a study."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.stats import binomtest

from femoreg_torch.files import temporary_file
from sim.study.quantities import QUANTITIES
from sim.study.summary import Record

_COLOURS = {"procedural": "#3b6ea5", "real": "#c0602b"}
_FLOOR = 1e-3  # where a logarithmic axis starts, mm or °


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with temporary_file(path) as part:
        figure.savefig(part, dpi=110)


def error_figure(records: Sequence[Record], title: str) -> Figure:
    """A panel per quantity: every run as a point, median and quartiles as a box, procedural and real bones apart."""
    columns = 5
    figure = Figure(figsize=(14, 3.0 * -(-len(QUANTITIES) // columns)), layout="constrained")
    figure.suptitle(f"{title}\ndashed: mean of the paper; dotted: mean wanted of the preset “fast”", fontsize=11)
    axes = figure.subplots(-(-len(QUANTITIES) // columns), columns, squeeze=False).ravel()
    rng = np.random.default_rng(0)  # of the sideways scatter of the points
    for axis, quantity in zip(axes, QUANTITIES, strict=False):
        for place, (kind, colour) in enumerate(_COLOURS.items()):
            values = np.array([quantity.of(r["errors"]) for r in records if r["refused"] is None and r["kind"] == kind])
            values = values[~np.isnan(values)].clip(_FLOOR)
            if len(values) == 0:
                continue
            axis.boxplot(values, positions=[place], widths=0.5, showfliers=False, medianprops={"color": "black"})
            axis.plot(place + rng.uniform(-0.15, 0.15, len(values)), values, ".", color=colour, alpha=0.7, markersize=5)
        axis.axhline(quantity.paper, color="#777777", linestyle="--", linewidth=1)
        axis.axhline(quantity.wanted, color="#1b7f3b", linestyle=":", linewidth=1.2)
        axis.set_yscale("log")
        bottom, top = axis.get_ylim()
        axis.set_ylim(min(bottom, quantity.paper / 100), max(top, 2 * quantity.paper))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_xlim(-0.6, 1.6)
        axis.set_xticks([0, 1], list(_COLOURS))
        axis.set_title(f"{quantity.name}, {quantity.unit}", fontsize=10)
        axis.grid(axis="y", alpha=0.3)
    return figure


def capture_figure(
    sweeps: Mapping[str, Sequence[tuple[float, int, int]]], labels: Mapping[str, str], title: str
) -> Figure:
    """Success rate against start offset, a panel per sweep of (offset, successes, starts), with 95 % intervals."""
    figure = Figure(figsize=(3.4 * len(sweeps), 3.3), layout="constrained")
    figure.suptitle(title)
    axes = figure.subplots(1, len(sweeps), sharey=True, squeeze=False)[0]
    for axis, (name, points) in zip(axes, sweeps.items(), strict=True):
        offsets = [offset for offset, _, _ in points]
        rates = np.array([good / starts for _, good, starts in points])
        bounds = np.array([rate_interval(good, starts) for _, good, starts in points])
        axis.fill_between(offsets, 100 * bounds[:, 0], 100 * bounds[:, 1], color="#3b6ea5", alpha=0.2, linewidth=0)
        axis.plot(offsets, 100 * rates, "o-", color="#3b6ea5")
        axis.set_xlabel(labels[name])
        axis.set_title(name, fontsize=10)
        axis.set_ylim(-3, 103)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("success, %")
    return figure


def rate_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % interval of a rate (Wilson, J Am Stat Assoc 22 (1927) 209)."""
    found = binomtest(successes, trials).proportion_ci(method="wilson")
    return float(found.low), float(found.high)
