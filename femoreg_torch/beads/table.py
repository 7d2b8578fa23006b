"""Table III of the paper: errors of registrations against the poses that beads tell, over a folder of trials.

Gao et al., IEEE Trans Med Robot Bionics 2 (2020) 437. The paper gives its errors as they are; here what the beads
themselves leave open stands beside them. A measured error is the registration's and the truth's together, and where
the two are independent their squares add.
"""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from femoreg_torch.beads.writing import UNCERTAINTY_NAME, bead_points
from femoreg_torch.case import RESULT_NAME, read_case, read_result
from femoreg_torch.configs import load_preset
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import errors
from femoreg_torch.evaluation.fit import check_fits
from femoreg_torch.files import read_json, temporary_file

_PAPER = load_preset("paper", "gao2020_cadaver")
PAPER_TRIALS: dict[str, list[float]] = _PAPER["metrics"]
NAMES = {
    "entry_point_mm": "Entry Point (mm)",
    "tip_mm": "Guide Tip (mm)",
    "relative_mm": "Relative (mm)",
    "path_deg": "Femur Path (°)",
    "guide_deg": "Guide Path (°)",
}


@dataclass(frozen=True)
class Trial:
    """One registration against beads."""

    name: str
    errors: dict[str, float]  # by the keys of `NAMES`
    truth: dict[str, float]  # root mean square of what the beads leave open of each
    trusted: bool  # by the registration's own verdict


def read_trials(folder: Path, run: str = "run") -> list[Trial]:
    """All trials of a folder, by name: sub-folders that `femoreg beads` wrote, with the results in their `run` folder.

    Raises `InputError` for a folder without any, or a trial without a result.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder.")
    places = sorted(place for place in folder.iterdir() if (place / UNCERTAINTY_NAME).is_file())
    if not places:
        raise InputError(
            f"{folder}: none of its folders holds {UNCERTAINTY_NAME}. Write them with `femoreg beads CASE --beads FILE "
            f"--out {folder}/TRIAL`."
        )
    return [read_trial(place, run) for place in places]


def read_trial(place: Path, run: str) -> Trial:
    """One trial. Raises `InputError` if its result is missing or does not place what the beads do."""
    if not (place / run / RESULT_NAME).is_file():
        raise InputError(
            f"{place / run}: holds no {RESULT_NAME}. Write it with `femoreg register {place} --out {place / run}`."
        )
    case, result = read_case(place), read_result(place / run)
    check_fits(case, result)
    if case.truth is None:
        raise InputError(f"{place}/case.yaml, truth: missing. Write it anew with `femoreg beads`.")
    points = bead_points(case, tuple(case.truth.camera1_from))
    found = errors(case.truth, result.poses, points)
    missing = [key for key in NAMES if key not in found]
    if missing:
        raise InputError(
            f"{place}: has no {missing[0]}: beads and result must both place the object with the planned path and its "
            "tool."
        )
    sure = read_json(place / UNCERTAINTY_NAME)["metrics"]
    return Trial(
        place.name, {key: found[key] for key in NAMES}, {key: sure[key] for key in NAMES}, result.verdict.trusted
    )


def summary(values: list[float]) -> tuple[float, float]:
    """Mean and standard deviation, that of a sample as in the paper (nan of a single one)."""
    return float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")


def table_three(trials: list[Trial]) -> Table:
    """The table for the terminal."""
    table = Table(title="Errors against beads, as the paper's Table III", title_justify="left")
    for number, column in enumerate(_header(trials)):
        table.add_column(column, justify="right" if number else "left")
    for row in _rows(trials):
        table.add_row(*row, style="dim" if row[0].startswith("  ") else "")
    return table


def _header(trials: list[Trial]) -> list[str]:
    return ["", *(trial.name + ("" if trial.trusted else " *") for trial in trials), "mean ± SD"]


def _rows(trials: list[Trial]) -> list[list[str]]:
    rows = []
    for key, name in NAMES.items():
        values, own = [t.errors[key] for t in trials], [t.truth[key] for t in trials]
        rows.append([name, *(f"{value:.2f}" for value in values), _told(values)])
        rows.append(
            ["  beads alone", *(f"{value:.2f}" for value in own), f"{np.sqrt(np.mean(np.square(own))):.2f} rms"]
        )
        paper = PAPER_TRIALS[key]
        shown = [f"{value:.2f}" for value in paper] if len(paper) == len(trials) else [""] * len(trials)
        rows.append(["  paper", *shown, _told(paper)])
    return rows


def _told(values: list[float]) -> str:
    mean, deviation = summary(values)
    return f"{mean:.2f} ± {deviation:.2f}" if deviation == deviation else f"{mean:.2f}"


def write_rows(path: Path, trials: list[Trial]) -> None:
    """One row per trial as CSV: `trial`, `trusted`, the errors, and `beads_<error>`, what beads leave open of each."""
    with temporary_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["trial", "trusted", *NAMES, *(f"beads_{key}" for key in NAMES)])
        writer.writeheader()
        for trial in trials:
            row: dict[str, Any] = {"trial": trial.name, "trusted": int(trial.trusted)}
            row |= {key: f"{value:.6f}" for key, value in trial.errors.items()}
            row |= {f"beads_{key}": f"{value:.6f}" for key, value in trial.truth.items()}
            writer.writerow(row)
