"""The paper's Figure 8: translation against rotation errors of every pose, and the errors that steer the drill."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from femoreg_torch.statistics.figures.style import DOUBLE_MM, HEAT, OWN, PAPER, Plot, head, new_figure, reach
from femoreg_torch.statistics.formats import number
from femoreg_torch.statistics.outcome import asked, told
from femoreg_torch.statistics.quantities import METRICS, POSE_QUANTITIES, POSES, Quantity

_BINS = (8, 24)  # of a histogram, at least and at most


def histograms(rows: pd.DataFrame) -> Plot | None:
    """Two rows of panels, (a) to (e) and (f) to (j); None where no run has an error."""
    if not any(told(rows, q.column).notna().any() for q in METRICS) and not any(
        _pairs(rows, key).size for key in POSES
    ):
        return None
    figure = new_figure(DOUBLE_MM, 112)
    panels = figure.subplots(2, len(POSES))
    counts = {key: _counts(_pairs(rows, key)) for key in POSES}
    top = max((100 * values.max() / values.sum() for values, _, _ in counts.values() if values.sum()), default=1.0)
    image = None
    for letter, axes, key in zip("abcde", panels[0], POSES, strict=True):
        head(axes, f"({letter}) {POSES[key]}", _told_of_pose(rows, key))
        axes.set_xlabel("translation, mm")
        values, x, y = counts[key]
        if values.sum():
            shares = np.ma.masked_equal(100 * values.T / len(_pairs(rows, key)), 0)
            image = axes.pcolormesh(x, y, shares, cmap=HEAT, vmin=0, vmax=top, rasterized=True)
            axes.plot(*_pairs(rows, key).mean(0), "+", color="black", markersize=6, markeredgewidth=1)
    panels[0][0].set_ylabel("rotation, °")
    if image is not None:
        figure.colorbar(image, ax=list(panels[0]), label="runs, %", pad=0.01, aspect=12)
    for letter, axes, quantity in zip("fghij", panels[1], METRICS, strict=True):
        head(axes, f"({letter}) {quantity.name}", _told_of_metric(rows, quantity))
        axes.set_xlabel(f"error, {quantity.unit}")
        _histogram(axes, rows, quantity)
    panels[1][0].set_ylabel("runs, %")
    caption = (
        "After the paper's Figure 8. (a) to (e): share of runs by translation and rotation error of each pose; cross: "
        "mean. (f) to (j): share of runs by the errors that steer the drill; line: mean, dashed: the paper's mean "
        "where the axis reaches it. n: runs with an error, of those that should have one; beyond: runs outside the "
        "panel."
    )
    return Plot("histograms", "Errors of all runs", caption, figure)


def _pairs(rows: pd.DataFrame, key: str) -> np.ndarray:
    """Translation and rotation errors (N, 2) of the runs that have both."""
    found = pd.concat([told(rows, f"{key}_mm"), told(rows, f"{key}_deg")], axis=1)
    return found.dropna().to_numpy(float)


def _counts(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Histogram (x, y) and its edges; all 0 without pairs."""
    ends = [reach(column) for column in pairs.T] if len(pairs) else [1.0, 1.0]
    x, y = pairs.T
    return np.histogram2d(x, y, bins=_bins(len(pairs)), range=[(0, end) for end in ends])


def _told_of_pose(rows: pd.DataFrame, key: str) -> list[str]:
    quantities = [POSE_QUANTITIES[key][unit][-1] for unit in ("mm", "deg")]
    own = [number(float(told(rows, q.column).mean()), q.digits) for q in quantities]
    paper = [f"{q.paper.mean:.2f}" for q in quantities]
    held = _held(rows, f"{key}_mm", _beyond(_pairs(rows, key)))
    return [f"mean {own[0]} mm, {own[1]}°", f"paper {paper[0]} mm, {paper[1]}°", held]


def _histogram(axes: Axes, rows: pd.DataFrame, quantity: Quantity) -> None:
    values = told(rows, quantity.column).dropna().to_numpy(float)
    if not len(values):
        return
    end, paper = reach(values), quantity.paper.mean
    end = max(end, 1.05 * paper if paper < 1.2 * end else 0.0)  # its line stands clear of the edge
    axes.hist(
        values,
        bins=_bins(len(values)),
        range=(0, end),
        weights=np.full(len(values), 100 / len(values)),
        color=OWN,
        alpha=0.6,
    )
    axes.axvline(values.mean(), color="black")
    if paper < end:
        axes.axvline(paper, color=PAPER, linestyle="--")
    axes.set_xlim(0, end)


def _told_of_metric(rows: pd.DataFrame, quantity: Quantity) -> list[str]:
    unit = "°" if quantity.unit == "°" else " mm"
    mean = number(float(told(rows, quantity.column).mean()), quantity.digits)
    held = _held(rows, quantity.column, _beyond(told(rows, quantity.column).dropna().to_numpy(float)[:, None]))
    return [f"mean {mean}{unit}", f"paper {quantity.paper.mean:.2f}{unit}", held]


def _bins(count: int) -> int:
    """Of a histogram of `count` values: twice its cube root, within limits (Rice's rule)."""
    return min(max(round(2 * count ** (1 / 3)), _BINS[0]), _BINS[1])


def _beyond(values: np.ndarray) -> int:
    """How many of the points (N, k) lie outside a panel."""
    return int(np.any([column > reach(column) for column in values.T], axis=0).sum()) if len(values) else 0


def _held(rows: pd.DataFrame, column: str, beyond: int) -> str:
    count, of = int(told(rows, column).notna().sum()), int(asked(rows, column).sum())
    return (f"n = {count}" if count == of else f"n = {count} of {of}") + (f", {beyond} beyond" if beyond else "")
