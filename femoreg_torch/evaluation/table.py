"""Errors as tables, with the means of the paper's simulation study beside the rows that have the same name there."""

from collections.abc import Iterator
from typing import Any

from rich.table import Table

from femoreg_torch.configs import load_preset

AXES = ("IS", "LR", "AP")

_PAPER = load_preset("paper", "gao2020")
# (mm along IS, LR, AP, total), (degrees about IS, LR, AP, total)
PAPER_POSES = {name: (tuple(row["mm"]), tuple(row["deg"])) for name, row in _PAPER["poses"].items()}
PAPER_METRICS: dict[str, float] = _PAPER["metrics"]
_NAMES = {
    "entry_point_mm": "entry point",
    "tip_mm": "guide tip",
    "relative_mm": "entry point to tip",
    "path_deg": "planned path",
    "guide_deg": "guide",
}
_MISSES = {"miss_mm": "entry point, after an exact correction", "miss_deg": "turn, after an exact correction"}

POSE_COLUMNS = ("", *(f"{axis} mm" for axis in AXES), "total mm", *(f"{axis} °" for axis in AXES), "total °")
METRIC_COLUMNS = ("", "error", "paper's mean")


def pose_rows(errors: dict[str, Any]) -> Iterator[list[str]]:
    """Cells of the paper's Table I: absolute errors of each pose, and below each the paper's mean."""
    for key, row in errors.items():
        if not isinstance(row, dict):
            continue
        name = _NAMES.get(key, key.replace("view", "view "))
        values = [*row["mm_xyz"], row["mm"], *row["deg_xyz"], row["deg"]]
        yield [name, *(f"{abs(value):.2f}" for value in values)]
        if key in PAPER_POSES:
            yield ["  paper", *(f"{value:.2f}" for part in PAPER_POSES[key] for value in part)]


def metric_rows(errors: dict[str, Any]) -> Iterator[list[str]]:
    """Cells of the paper's Table II: each metric and the paper's mean; below, what a correction leaves."""
    for key, name in (_NAMES | _MISSES).items():
        if key in errors:
            unit = "mm" if key.endswith("_mm") else "°"
            paper = f"{PAPER_METRICS[key]:.2f} {unit}" if key in PAPER_METRICS else "–"
            yield [name, f"{errors[key]:.2f} {unit}", paper]


def error_tables(errors: dict[str, Any]) -> list[Table]:
    """Both tables for the terminal: errors of one run beside the means of the paper's 1,000."""
    poses = Table(title="Pose errors (absolute, axes of view 1)", title_justify="left")
    metrics = Table(title="Errors that steer the drill", title_justify="left")
    for table, columns, rows in (
        (poses, POSE_COLUMNS, pose_rows(errors)),
        (metrics, METRIC_COLUMNS, metric_rows(errors)),
    ):
        for number, column in enumerate(columns):
            table.add_column(column, justify="right" if number else "left")
        for row in rows:
            table.add_row(*row, style="dim" if row[0].startswith("  ") else "")
    return [poses, metrics]
