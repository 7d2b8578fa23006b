"""Success rate against the offset of the start, as a figure."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib import rc_context

from femoreg_torch.statistics.figures.style import DOUBLE_MM, OWN, STYLE, Plot, new_figure
from femoreg_torch.statistics.intervals import rate_interval


def capture_figure(
    sweeps: Mapping[str, Sequence[tuple[float, int, int]]], labels: Mapping[str, str], name: str, title: str
) -> Plot:
    """A panel per sweep of (offset, successes, starts), with 95 % intervals."""
    with rc_context(STYLE):
        figure = new_figure(DOUBLE_MM, 55)
        panels = figure.subplots(1, len(sweeps), sharey=True, squeeze=False)[0]
        for axes, (sweep, points) in zip(panels, sweeps.items(), strict=True):
            offsets = [offset for offset, _, _ in points]
            rates = np.array([good / starts for _, good, starts in points])
            bounds = np.array([rate_interval(good, starts) for _, good, starts in points])
            axes.fill_between(offsets, 100 * bounds[:, 0], 100 * bounds[:, 1], color=OWN, alpha=0.2, linewidth=0)
            axes.plot(offsets, 100 * rates, "o-", color=OWN, markersize=3)
            axes.set_xlabel(labels[sweep])
            axes.set_title(sweep)
            axes.set_ylim(-3, 103)
        panels[0].set_ylabel("success, %")
    return Plot(name, title, "Shaded: 95 % interval.", figure)
