"""Errors against the truth, the paper's figures beside them, overlays, the report and the replay."""

from femoreg_torch.evaluation.errors import ReferencePoints, errors, path_displacements, path_miss, reference_points
from femoreg_torch.evaluation.overlay import overlay_figure
from femoreg_torch.evaluation.replay import REPLAY_NAMES, write_replay
from femoreg_torch.evaluation.run import EVALUATION_NAMES, evaluate, evaluation_page, write_report
from femoreg_torch.evaluation.table import PAPER_METRICS, PAPER_POSES, error_tables

__all__ = [
    "EVALUATION_NAMES",
    "PAPER_METRICS",
    "PAPER_POSES",
    "REPLAY_NAMES",
    "ReferencePoints",
    "error_tables",
    "errors",
    "evaluate",
    "evaluation_page",
    "overlay_figure",
    "path_displacements",
    "path_miss",
    "reference_points",
    "write_replay",
    "write_report",
]
