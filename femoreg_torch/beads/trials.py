"""A folder of trials on a specimen: errors of their registrations against the poses that beads tell.

A measured error is the registration's and the truth's together, and where the two are independent their squares add.
"""

from dataclasses import dataclass
from pathlib import Path

from femoreg_torch.beads.writing import UNCERTAINTY_NAME, bead_points
from femoreg_torch.case import RESULT_NAME, Result, read_case, read_result
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import PAPER_METRICS, errors
from femoreg_torch.evaluation.fit import check_fits
from femoreg_torch.files import read_json
from femoreg_torch.paths import check_readable


@dataclass(frozen=True)
class Trial:
    """One registration against beads."""

    name: str
    side: Side | None
    errors: dict[str, float]  # by the keys of the paper's Table III: mm and degrees
    truth: dict[str, float]  # root mean square of what the beads leave open of each
    result: Result


def read_trials(folder: Path, run: str = "run") -> list[Trial]:
    """All trials of a folder, by name: sub-folders that `femoreg beads` wrote, with the results in their `run` folder.

    Raises `InputError` for a folder without any, or a trial without a result.
    """
    check_readable(folder, expected="folder")
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
    missing = [key for key in PAPER_METRICS if key not in found]
    if missing:
        raise InputError(
            f"{place}: has no {missing[0]}: beads and result must both place the object with the planned path and its "
            "tool."
        )
    path = place / UNCERTAINTY_NAME
    sure = Fields(read_json(path), str(path)).mapping("metrics")
    return Trial(
        place.name,
        case.side,
        {key: found[key] for key in PAPER_METRICS},
        {key: sure.number(key) for key in PAPER_METRICS},
        result,
    )
