"""Success rate against the offset of the start, as a figure."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context

from femoreg_torch.statistics.figures.style import DOUBLE_MM, OWN, STYLE, Plot, new_figure
from femoreg_torch.statistics.summary import Rate


def capture_figure(
    sweeps: Mapping[str, Sequence[tuple[float, Rate]]], labels: Mapping[str, str], name: str, title: str
) -> Plot:
    """A panel per sweep of (offset, rate), with the 95 % intervals of rates that have one."""
    with rc_context(STYLE):
        figure = new_figure(DOUBLE_MM, 55)
        panels = figure.subplots(1, len(sweeps), sharey=True, squeeze=False)[0]
        for axes, (sweep, points) in zip(panels, sweeps.items(), strict=True):
            offsets = [offset for offset, _ in points]
            shares = np.array([rate.share for _, rate in points])
            bounds = np.array([rate.interval for _, rate in points])
            if np.isfinite(bounds).any():
                axes.fill_between(offsets, 100 * bounds[:, 0], 100 * bounds[:, 1], color=OWN, alpha=0.2, linewidth=0)
            axes.plot(offsets, 100 * shares, "o-", color=OWN, markersize=3)
            axes.set_xlabel(labels[sweep])
            axes.set_title(sweep)
            axes.set_ylim(-3, 103)
        panels[0].set_ylabel("success, %")
    return Plot(name, title, shading(sweeps), figure)


def shading(sweeps: Mapping[str, Sequence[tuple[float, Rate]]]) -> str:
    """What the shading of the figure is, or why there is none, as a sentence."""
    if all(rate.independent for points in sweeps.values() for _, rate in points):
        return "Shaded: 95 % interval."
    return "Starts on one procedure are not independent, so rates over several of them have no interval."
