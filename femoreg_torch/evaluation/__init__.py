"""Errors against the truth, the paper's figures beside them, overlays and the report."""

from femoreg_torch.evaluation.errors import ReferencePoints, errors, reference_points
from femoreg_torch.evaluation.overlay import draw_edges, overlay_figure
from femoreg_torch.evaluation.replay import write_replay
from femoreg_torch.evaluation.run import evaluate_run, poses_of
from femoreg_torch.evaluation.table import PAPER_METRICS, PAPER_POSES, error_tables

__all__ = [
    "PAPER_METRICS",
    "PAPER_POSES",
    "ReferencePoints",
    "draw_edges",
    "error_tables",
    "errors",
    "evaluate_run",
    "overlay_figure",
    "poses_of",
    "reference_points",
    "write_replay",
]
