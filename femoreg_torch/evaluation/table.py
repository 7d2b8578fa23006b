"""Errors as tables, with the means of the paper's simulation study beside them."""

from collections.abc import Iterator
from typing import Any

from rich.table import Table

AXES = ("IS", "LR", "AP")

# Gao et al., IEEE Trans Med Robot Bionics 2 (2020) 437, Table I: mean errors over 1,000 simulations,
# (mm along IS, LR, AP, total), (degrees about IS, LR, AP, total)
PAPER_POSES = {
    "pelvis": ((0.23, 0.11, 0.85, 0.92), (0.11, 0.08, 0.06, 0.17)),
    "femur": ((0.14, 0.12, 0.77, 0.81), (0.65, 0.25, 0.11, 0.73)),
    "device": ((0.22, 0.39, 0.85, 1.00), (0.13, 0.14, 0.08, 0.23)),
    "view2": ((0.36, 0.19, 1.23, 1.37), (0.09, 0.15, 0.10, 0.23)),
    "view3": ((0.22, 0.23, 0.55, 0.69), (0.10, 0.08, 0.05, 0.16)),
}
# Table II: means
PAPER_METRICS = {
    "entry_point_mm": 1.70,
    "tip_mm": 0.93,
    "relative_mm": 1.26,
    "path_deg": 0.63,
    "guide_deg": 0.17,
}
_NAMES = {
    "pelvis": "pelvis",
    "femur": "femur",
    "device": "device",
    "entry_point_mm": "entry point",
    "tip_mm": "guide tip",
    "relative_mm": "entry point to tip",
    "path_deg": "femur path",
    "guide_deg": "guide path",
}

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
    """Cells of the paper's Table II: each metric and the paper's mean."""
    for key, paper in PAPER_METRICS.items():
        if key in errors:
            unit = "mm" if key.endswith("_mm") else "°"
            yield [_NAMES[key], f"{errors[key]:.2f} {unit}", f"{paper:.2f} {unit}"]


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
