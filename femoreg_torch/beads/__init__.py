"""Poses from metal beads in bone and on the device: the ground truth of a cadaver study, and how sure it is."""

from femoreg_torch.beads.bundle import Bundle, Sight, bundle
from femoreg_torch.beads.ct import find_beads
from femoreg_torch.beads.given import Given, Mark, read_beads
from femoreg_torch.beads.matching import Match, match_beads
from femoreg_torch.beads.measure import Measured, measure
from femoreg_torch.beads.model import Beads, check_beads
from femoreg_torch.beads.spots import Spots, find_spots
from femoreg_torch.beads.trials import Trial, read_trials
from femoreg_torch.beads.uncertainty import Uncertainty, metric_deviations, object_rows, pose_uncertainty
from femoreg_torch.beads.writing import UNCERTAINTY_NAME, bead_points, uncertainty_content, write_measured

__all__ = [
    "UNCERTAINTY_NAME",
    "Beads",
    "Bundle",
    "Given",
    "Mark",
    "Match",
    "Measured",
    "Sight",
    "Spots",
    "Trial",
    "Uncertainty",
    "bead_points",
    "bundle",
    "check_beads",
    "find_beads",
    "find_spots",
    "match_beads",
    "measure",
    "metric_deviations",
    "object_rows",
    "pose_uncertainty",
    "read_beads",
    "read_trials",
    "uncertainty_content",
    "write_measured",
]
