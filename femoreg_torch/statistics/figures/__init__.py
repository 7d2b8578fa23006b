"""Figures of a group of runs, in the sizes of a journal's page."""

import pandas as pd
from matplotlib import rc_context

from femoreg_torch.statistics.figures.correlations import correlations
from femoreg_torch.statistics.figures.deviations import deviations
from femoreg_torch.statistics.figures.distributions import distributions
from femoreg_torch.statistics.figures.histograms import histograms
from femoreg_torch.statistics.figures.limits import limits
from femoreg_torch.statistics.figures.origins import origins
from femoreg_torch.statistics.figures.style import STYLE, Picture, Plot, write_figures
from femoreg_torch.statistics.figures.varied import varied_figures

__all__ = ["Picture", "Plot", "all_figures", "paper_figures", "write_figures"]


def all_figures(rows: pd.DataFrame, bounds: pd.DataFrame | None = None) -> list[Plot]:
    """All figures that the runs of a study can fill, and its `bounds`, if there are any."""
    with rc_context(STYLE):
        plots = [distributions(rows), deviations(rows), origins(rows)]
        return paper_figures(rows, bounds) + [plot for plot in plots if plot is not None] + varied_figures(rows)


def paper_figures(rows: pd.DataFrame, bounds: pd.DataFrame | None = None) -> list[Plot]:
    """The paper's Figures 8 and 9 of a group of runs, as far as these can fill them, and errors beside `bounds`."""
    with rc_context(STYLE):
        plots = (histograms(rows), correlations(rows), limits(rows, bounds))
        return [plot for plot in plots if plot is not None]
