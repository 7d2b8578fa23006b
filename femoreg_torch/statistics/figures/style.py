"""How figures look: sizes of a journal, colours that the colour-blind can tell apart, and files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from femoreg_torch.files import temporary_file

SINGLE_MM, DOUBLE_MM = 88.0, 180.0  # one and two columns of a journal's page
DPI = 200
# Okabe & Ito, Color Universal Design (2008): black, blue, vermilion, green, orange, purple, sky blue, yellow
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "#F0E442")
OWN, PAPER, QUIET = COLOURS[1], COLOURS[2], "#777777"
HEAT = "cividis_r"  # light where there is little; reads alike without red and green
STYLE: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "svg.hashsalt": "femoreg",  # the same figure is the same file
}
_SMALL = 6.5  # points, of small print
_FAR = 3.0  # times the 90th percentile: beyond it an axis leaves out what it says


@dataclass(frozen=True)
class Picture:
    """A figure as it was written."""

    name: str
    title: str
    caption: str
    png: bytes


@dataclass(frozen=True)
class Plot:
    """A figure, its file's name, and what has to be known to read it."""

    name: str
    title: str
    caption: str
    figure: Figure


def new_figure(width_mm: float, height_mm: float) -> Figure:
    """An empty figure of this size."""
    return Figure(figsize=(width_mm / 25.4, height_mm / 25.4), layout="constrained")


def head(axes: Axes, title: str, lines: Sequence[str]) -> None:
    """The title of a panel, and below it, above the axes, what is to be told of it in small print."""
    text = axes.text(
        0, 1.03, "\n".join(lines), transform=axes.transAxes, fontsize=_SMALL, linespacing=1.2, ha="left", va="bottom"
    )
    text.set_in_layout(False)  # it may be wider than its panel
    axes.set_title(title, loc="left", pad=6 + 1.35 * _SMALL * len(lines))


def reach(values: np.ndarray) -> float:
    """Where a linear axis ends: just beyond the values (N,) but for those that press all others into a corner."""
    return max(1.03 * float(values[values <= _FAR * np.quantile(values, 0.9)].max()), 1e-6)


def logarithmic(axis: Axis, decades: float) -> None:
    """Plain numbers along a logarithmic axis, more of them where it covers few decades."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if decades < 1.7 else (1,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def write_figures(plots: list[Plot], folder: Path) -> list[Picture]:
    """Write every figure as NAME.png and NAME.svg into an existing folder."""
    pictures = []
    for plot in plots:
        with rc_context(STYLE):
            plot.figure.draw_without_rendering()  # places everything, once for both files
        plot.figure.set_layout_engine("none")
        for suffix, settings in (("png", {"dpi": DPI}), ("svg", {"dpi": DPI, "metadata": {"Date": None}})):
            with rc_context(STYLE), temporary_file(folder / f"{plot.name}.{suffix}") as part:
                plot.figure.savefig(part, **settings)
        png = (folder / f"{plot.name}.png").read_bytes()
        pictures.append(Picture(plot.name, plot.title, plot.caption, png))
    return pictures
