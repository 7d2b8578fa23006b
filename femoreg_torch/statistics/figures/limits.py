"""Errors, and how small images allow them to be."""

import numpy as np
import pandas as pd

from femoreg_torch.statistics.figures.style import COLOURS, DOUBLE_MM, OWN, PAPER, QUIET, Plot, logarithmic, new_figure
from femoreg_torch.statistics.limit_tables import USUAL, limit_tables
from femoreg_torch.statistics.quantities import BY_COLUMN


def limits(rows: pd.DataFrame, bounds: pd.DataFrame | None) -> Plot | None:
    """Every error between its bound and the paper's mean; None where there are no bounds of these runs."""
    tables = [] if bounds is None else limit_tables(rows, bounds)
    if not tables:
        return None
    data = tables[0].data
    series = (
        (f"bound {USUAL}", "bound", "|", OWN),
        ("noise_alone", "noise of photons alone, registered", "x", COLOURS[3]),
        ("rms", "error", "o", COLOURS[0]),
        ("paper", "paper's mean", "D", PAPER),
    )
    data = data.assign(paper=[BY_COLUMN[column].paper.mean for column in data["error"]])
    figure = new_figure(DOUBLE_MM, 70)
    for axes, unit in zip(figure.subplots(1, 2), ("mm", "°"), strict=True):
        part = data[data["unit"].eq(unit)]
        lines = np.arange(len(part))
        shown = part[[column for column, *_ in series]].to_numpy(float)
        axes.hlines(lines, np.nanmin(shown, 1), np.nanmax(shown, 1), color=QUIET, linewidth=0.6)
        for column, label, marker, colour in series:
            if part[column].notna().any():
                axes.plot(part[column], lines, marker, color=colour, label=label, markersize=4.5, linestyle="none")
        axes.set_yticks(lines, [BY_COLUMN[column].name for column in part["error"]])
        axes.invert_yaxis()
        axes.set_xscale("log")
        logarithmic(axes.xaxis, 4)
        axes.set_xlabel(f"root mean square, {unit}")
        axes.grid(axis="x", linewidth=0.3, color="#dddddd")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return Plot("limits", tables[0].title, f"{tables[0].note} The paper's means are of another anatomy.", figure)
