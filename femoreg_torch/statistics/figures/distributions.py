"""Every error as the share of runs that stay below it, failures included."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from femoreg_torch.statistics.figures.style import COLOURS, DOUBLE_MM, OWN, PAPER, Plot, new_figure
from femoreg_torch.statistics.outcome import everything
from femoreg_torch.statistics.quantities import QUANTITIES, Quantity
from femoreg_torch.statistics.rows import DONE

_COLUMNS = 5
_STYLES = ("-", "--", ":")  # so that more conditions than colours stay apart


def distributions(rows: pd.DataFrame) -> Plot | None:
    """A panel per error, a line per condition; None where no run has an error."""
    parts = {str(name): part for name, part in rows.groupby("condition", sort=True)}
    quantities = [q for q in QUANTITIES if np.isfinite(everything(rows, q.column)).any()]
    if not quantities:
        return None
    lines = -(-len(quantities) // _COLUMNS)
    legend = 0 if len(parts) == 1 else 4 + 4 * -(-len(parts) // 4)
    figure = new_figure(DOUBLE_MM, 42 * lines + legend)
    panels = figure.subplots(lines, _COLUMNS, squeeze=False, sharey=True)
    for axes, quantity in zip(panels.flat, quantities, strict=False):
        _panel(axes, parts, quantity)
    for axes in panels.flat[len(quantities) :]:
        axes.remove()
    for axes in panels[:, 0]:
        axes.set_ylabel("runs, %")
    if len(parts) > 1:
        handles = {line.get_label(): line for axes in panels.flat[: len(quantities)] for line in axes.get_lines()}
        figure.legend(
            [handles[name] for name in parts if name in handles],
            [f"{name} ({len(part)})" for name, part in parts.items() if name in handles],
            loc="outside lower center",
            ncols=4,
        )
    caption = (
        "Share of all runs with an error of at most the value below; refused and failed runs never get there, so that "
        "a line may end below 100 %. Vertical, dashed: the paper's mean."
    )
    if len(parts) == 1:
        caption += f" n = {len(rows)}."
    if without := [f"{name} ({len(part)})" for name, part in parts.items() if not part["status"].eq(DONE).any()]:
        caption += f" Not one result, and so no line: {', '.join(without)}."
    return Plot("distributions", "Distribution of every error", caption, figure)


def _panel(axes: Axes, parts: dict[str, pd.DataFrame], quantity: Quantity) -> None:
    for place, (name, part) in enumerate(parts.items()):
        values = np.sort(everything(part, quantity.column))
        given = values[np.isfinite(values)]
        if len(given):
            colour = OWN if len(parts) == 1 else COLOURS[place % (len(COLOURS) - 1)]  # yellow is too light for a line
            style = _STYLES[place // (len(COLOURS) - 1) % len(_STYLES)]
            shares = 100 * np.arange(1, len(given) + 1) / len(values)
            axes.step(given.clip(1e-9), shares, where="post", color=colour, linestyle=style, label=name)
    axes.axvline(quantity.paper.mean, color=PAPER, linestyle="--", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_xlim(quantity.paper.mean / 200, max(2 * quantity.paper.mean, axes.get_xlim()[1]))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(0, 102)
    axes.set_xlabel(quantity.label, fontsize=7)
    axes.grid(axis="y", color="#dddddd", linewidth=0.5)
