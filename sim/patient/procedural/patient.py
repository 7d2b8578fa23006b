"""The procedural patient of a seed. Everything is computed, no data file is read."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from sim.patient.landmarks import find_landmarks
from sim.patient.parameters import draw_parameters
from sim.patient.procedural.bones import build_skeleton
from sim.patient.scan import Patient, scan_skeleton
from sim.patient.skeleton import LABEL_IDS

BELOW_MM = 190.0  # femur in the scan below the heads


def make_patient(seed: int, spacing_mm: float = 1.0) -> Patient:
    """Patient of one seed: the same seed gives the same bits, and the same patient at every voxel size.

    Args:
        seed: not negative.
        spacing_mm: voxel size, 0.5 to 2 mm.

    Returns:
        CT in HU and labels (ids of the label table `femoreg`) on one grid along the LPS axes, whose origin lies
        midway between the femoral heads; landmarks in LPS mm; parameters.
    """
    return make_scans(seed, (spacing_mm,))[0]


def make_scans(seed: int, spacings_mm: Sequence[float]) -> list[Patient]:
    """The patient of one seed at several voxel sizes, as `make_patient` gives each."""
    if seed < 0:
        raise InputError(f"patient: seed is {seed}, expected 0 or more.")
    for spacing_mm in spacings_mm:
        if not 0.5 <= spacing_mm <= 2:
            raise InputError(f"patient: spacing is {spacing_mm} mm, expected 0.5 to 2 mm.")
    shape_seed, *scan_seeds = np.random.SeedSequence(seed).spawn(3 + len(LABEL_IDS))
    shape_rng = np.random.default_rng(shape_seed)
    parameters = draw_parameters(shape_rng)
    skeleton = build_skeleton(parameters, shape_rng)
    landmarks = find_landmarks(skeleton)
    points = {name: torch.from_numpy(landmarks[name].copy()) for name in HIP.landmark_names}
    numbers = {k: float(v) for k, v in asdict(parameters).items()}
    scans = scan_skeleton(skeleton, parameters, -BELOW_MM, scan_seeds, spacings_mm)
    return [Patient(ct, labels, points, numbers) for ct, labels in scans]
