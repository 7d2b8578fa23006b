"""The paper's Figure 9: how the pelvis's error goes into the femur's, and what goes into the relative error."""

import pandas as pd
from matplotlib.axes import Axes

from femoreg_torch.statistics.figures.style import DOUBLE_MM, OWN, Plot, head, new_figure, reach
from femoreg_torch.statistics.formats import between, number
from femoreg_torch.statistics.intervals import Correlation, pearson, spearman
from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import BY_COLUMN, PAPER_CORRELATIONS, PELVIS_AT_HEAD
from femoreg_torch.statistics.rows import procedures

_PAIRS = (  # the paper's two first
    (PELVIS_AT_HEAD, "femur_mm"),
    (PELVIS_AT_HEAD, "entry_point_mm"),
    ("femur_mm", "entry_point_mm"),
    ("femur_mm", "relative_mm"),
    ("device_mm", "relative_mm"),
    ("view2_mm", "relative_mm"),
)


def correlations(rows: pd.DataFrame) -> Plot | None:
    """Six scatter plots with Pearson's r and Spearman's ρ; None where no run has two errors."""
    at_head = told(rows, PELVIS_AT_HEAD).notna().any()
    pairs = [("pelvis_mm" if x == PELVIS_AT_HEAD and not at_head else x, y) for x, y in _PAIRS]
    if not any((told(rows, x) + told(rows, y)).notna().any() for x, y in pairs):
        return None
    figure = new_figure(DOUBLE_MM, 132)
    for letter, axes, (x, y), (of_paper, _) in zip("abcdef", figure.subplots(2, 3).flat, pairs, _PAIRS, strict=True):
        axes.set_xlabel("pelvis at the femoral head, mm" if x == PELVIS_AT_HEAD else BY_COLUMN[x].label)
        axes.set_ylabel(BY_COLUMN[y].label)
        paper = PAPER_CORRELATIONS.get(y) if of_paper == PELVIS_AT_HEAD else None
        _scatter(axes, f"({letter})", told(rows, x), told(rows, y), paper)
    where = (
        "at the femoral head, as in the paper"
        if at_head
        else "at its own reference point: the study does not tell it at the femoral head, where the paper takes it"
    )
    caption = (
        f"(a), (b) after the paper's Figure 9, with the pelvis's error {where}; (c) to (f): what else goes along. "
        "r: Pearson, ρ: Spearman, with 95 % intervals over all n runs, "
        "also those beyond the axes."
    )
    if procedures(rows).nunique() < len(rows):
        caption += " Runs of one procedure are taken as independent here, so that these intervals are too narrow."
    return Plot("correlations", "Errors that go together", caption, figure)


def _scatter(axes: Axes, title: str, x: pd.Series, y: pd.Series, paper: float | None) -> None:
    both = x.notna() & y.notna()
    if not both.any():
        return
    a, b = x[both].to_numpy(float), y[both].to_numpy(float)
    axes.plot(a, b, ".", color=OWN, markersize=3, alpha=max(0.15, min(0.7, 60 / len(a))), rasterized=True)
    axes.set_xlim(0, 1.05 * reach(a))
    axes.set_ylim(0, 1.05 * reach(b))
    last = [f"n = {len(a)}"]
    if beyond := int(((a > reach(a)) | (b > reach(b))).sum()):
        last.append(f"{beyond} beyond")
    if paper is not None:
        last.append(f"paper: r = {paper:.2f}")
    head(axes, title, [_told("r", pearson(a, b)), _told("ρ", spearman(a, b)), ", ".join(last)])


def _told(letter: str, found: Correlation) -> str:
    return f"{letter} = {number(found.value, 2)} ({between(found.interval, 2)})"
