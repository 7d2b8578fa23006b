"""Errors against each thing that was varied."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from femoreg_torch.statistics.figures.style import COLOURS, DOUBLE_MM, OWN, PAPER, Plot, head, new_figure, reach
from femoreg_torch.statistics.formats import between, number
from femoreg_torch.statistics.intervals import spearman
from femoreg_torch.statistics.outcome import asked, told
from femoreg_torch.statistics.quantities import BY_COLUMN, Quantity
from femoreg_torch.statistics.rows import VARIED, folder_name, plain_name, varied

_QUANTITIES = tuple(BY_COLUMN[column] for column in ("femur_mm", "device_mm", "relative_mm", "path_deg"))
_KINDS = 8  # a number with at most so many values is drawn value by value
_DEFAULT = "not varied"
_LETTERS = 24  # that fit below a panel
_PER_BIN, _BINS = 10, 10  # runs in a bin at least; bins at most


def varied_figures(rows: pd.DataFrame) -> list[Plot]:
    """A figure for every thing that was varied in these runs."""
    quantities = [q for q in _QUANTITIES if told(rows, q.column).notna().any()]
    return [_figure(part, key, quantities) for key, part in varied(rows).items() if quantities]


def _figure(rows: pd.DataFrame, key: str, quantities: list[Quantity]) -> Plot:
    numeric = pd.api.types.is_numeric_dtype(rows[key]) and not pd.api.types.is_bool_dtype(rows[key])
    by_value = not numeric or rows[key].nunique() <= _KINDS
    figure = new_figure(DOUBLE_MM, 62)
    panels = figure.subplots(1, len(quantities), squeeze=False)[0]
    for axes, quantity in zip(panels, quantities, strict=True):
        (_by_value if by_value else _by_number)(axes, rows, key, quantity)
    name = plain_name(key)
    figure.supxlabel(name, fontsize=8)
    how = (
        "points: runs, box: quartiles, line: median"
        if by_value
        else f"points: runs, line: median, band: 10th to 90th percentile of runs with like values (at least {_PER_BIN})"
    )
    caption = (
        f"Errors against {name}: {how}. Crosses at the top: refused, failed, or beyond the axis, where the former "
        "count as infinitely far off. Dashed: the paper's mean, where the axis reaches it."
    )
    return Plot(f"varied_{folder_name(key.removeprefix(VARIED))}", f"Errors against {name}", caption, figure)


def _values(rows: pd.DataFrame, key: str, quantity: Quantity) -> tuple[pd.Series, np.ndarray, float]:
    """What was varied and the errors, infinite where a run gave none, of all runs; and where the axis ends."""
    chosen = rows[asked(rows, quantity.column)]
    errors = told(chosen, quantity.column).fillna(np.inf).to_numpy(float)
    given = errors[np.isfinite(errors)]
    return chosen[key], errors, 1.15 * reach(given) if len(given) else 1.0


def _finish(axes: Axes, quantity: Quantity, end: float) -> None:
    if quantity.paper.mean < end:
        axes.axhline(quantity.paper.mean, color=PAPER, linestyle="--", linewidth=0.8)
    axes.set_ylim(0, end)


def _points(axes: Axes, x: np.ndarray, errors: np.ndarray, end: float) -> None:
    inside = errors < end
    alpha = max(0.12, min(0.6, 60 / max(1, len(x))))
    axes.plot(x[inside], errors[inside], ".", color=OWN, markersize=2.5, alpha=alpha, rasterized=True)
    axes.plot(x[~inside], np.full((~inside).sum(), 0.985 * end), "x", color=COLOURS[2], markersize=3, rasterized=True)


def _by_number(axes: Axes, rows: pd.DataFrame, key: str, quantity: Quantity) -> None:
    values, errors, end = _values(rows, key, quantity)
    there = values.notna().to_numpy()  # a place along the axis
    x, errors = values[there].to_numpy(float), errors[there]
    _points(axes, x, errors, end)
    bins = min(_BINS, len(x) // _PER_BIN)
    if bins > 1:
        parts = np.array_split(np.argsort(x, kind="stable"), bins)
        middles = [np.median(x[part]) for part in parts]
        low, middle, high = np.minimum(
            [np.quantile(errors[part], (0.1, 0.5, 0.9), method="higher") for part in parts], 2 * end
        ).T
        axes.fill_between(middles, low, high, color=OWN, alpha=0.2, linewidth=0)
        axes.plot(middles, middle, "-", color="black")
    found = spearman(x, np.where(np.isfinite(errors), errors, np.nan))
    head(axes, quantity.label, [f"ρ = {number(found.value, 2)} ({between(found.interval, 2)})", f"n = {len(x)}"])
    _finish(axes, quantity, end)


def _by_value(axes: Axes, rows: pd.DataFrame, key: str, quantity: Quantity) -> None:
    values, errors, end = _values(rows, key, quantity)
    values = values.astype(object).where(values.notna(), _DEFAULT)
    kinds = sorted(values.unique(), key=lambda kind: (kind != _DEFAULT, isinstance(kind, str), kind))
    head(axes, quantity.label, [])
    rng = np.random.default_rng(0)  # of the sideways scatter of the points
    upright = sum(len(str(kind)) for kind in kinds) > _LETTERS or len(kinds) > 4
    break_ = " " if upright else "\n"
    labels = []
    for place, kind in enumerate(kinds):
        own = errors[(values == kind).to_numpy()]
        low, middle, high = np.minimum(np.quantile(own, (0.25, 0.5, 0.75), method="higher"), 2 * end)
        _points(axes, place + rng.uniform(-0.25, 0.25, len(own)), own, end)
        axes.bar(place, high - low, 0.6, low, facecolor="none", edgecolor="black", linewidth=0.7)
        axes.plot([place - 0.3, place + 0.3], [middle, middle], color="black", linewidth=1.4)
        text = f"{kind:g}" if isinstance(kind, int | float | np.number) else str(kind)
        labels.append(f"{text}{break_}({len(own)})")
    axes.set_xticks(range(len(kinds)), labels, rotation=90 if upright else 0)
    axes.set_xlim(-0.6, len(kinds) - 0.4)
    _finish(axes, quantity, end)
