"""Whether runs are good enough, whether they say so, and whether the deviations that they state hold."""

import pandas as pd

from femoreg_torch.statistics.cells import rate_cells, rate_numbers
from femoreg_torch.statistics.formats import Table, percent
from femoreg_torch.statistics.outcome import WRONG_DEG, WRONG_MM
from femoreg_torch.statistics.quantities import AXES, BY_COLUMN, OBJECTS, RELATIVE
from femoreg_torch.statistics.summary import confusion, coverage, right_runs, trusted_runs, within

_LIMITS_MM = (WRONG_MM, 2.0, 1.0)
_WRONG = f"wrong: off by more than {WRONG_MM:g} mm or {WRONG_DEG:g}°, or not found"

_NO_INTERVAL = "95 %: Wilson's interval; none where runs share a procedure."


def success_table(rows: pd.DataFrame) -> Table:
    """Shares of runs that are good enough; refused and failed runs are not."""
    rates = [(f"{RELATIVE.name} ≤ {limit:g} mm", within(rows, RELATIVE.column, limit)) for limit in _LIMITS_MM]
    rates += [
        (f"{BY_COLUMN[column].name} ≤ {WRONG_DEG:g}°", within(rows, column, WRONG_DEG))
        for column in ("path_deg", "guide_deg")
    ]
    rates += [
        (f"every pose within {WRONG_MM:g} mm and {WRONG_DEG:g}°, {RELATIVE.name} too", right_runs(rows)),
        ("trusted", trusted_runs(rows)),
    ]
    rates = [(name, rate) for name, rate in rates if rate.of]
    lines = tuple((name, f"{rate.met} of {rate.of}", *rate_cells(rate)) for name, rate in rates)
    data = pd.DataFrame([{"criterion": name, **rate_numbers(rate)} for name, rate in rates])
    note = "Refused and failed runs count as not met. " + _NO_INTERVAL
    return Table("success", "Success", note, ("", "runs", "rate", "95 %"), lines, data)


def trust_table(rows: pd.DataFrame) -> Table:
    """Right and wrong results against whether they say that they can be trusted."""
    lines, data = [], []
    for name in (None, *OBJECTS):
        if (found := confusion(rows, name)) is None:
            continue
        counts = (found.right_trusted, found.right_flagged, found.wrong_trusted, found.wrong_flagged)
        if not sum(counts):
            continue
        lines.append(("whole run" if name is None else name, *map(str, counts), *rate_cells(found.harm)))
        names = ("right_trusted", "right_flagged", "wrong_trusted", "wrong_flagged")
        data.append({"object": name or "run", **dict(zip(names, counts, strict=True)), **rate_numbers(found.harm)})
    columns = (
        "", "right, trusted", "right, flagged", "wrong, trusted", "wrong, flagged", "wrong of trusted", "95 %"
    )  # fmt: skip
    note = (
        f"{_WRONG[0].upper()}{_WRONG[1:]}; a whole run also if {RELATIVE.name} is off by more than {WRONG_MM:g} mm. "
        + _NO_INTERVAL
    )
    return Table("trust", "Trust", note, columns, tuple(lines), pd.DataFrame(data))


def coverage_table(rows: pd.DataFrame) -> Table:
    """Shares of errors within the standard deviations that the runs state."""
    lines, data = [], []
    for found in coverage(rows):
        unit = "mm" if found.unit == "mm" else "°"
        counts = sorted({rate.of for rate in (*found.within_1, *found.within_2)})
        lines.append(
            (
                f"{found.object}, {unit}",
                " to ".join(map(str, counts)),
                *(percent(rate.share) for rate in (*found.within_1, *found.within_2)),
            )
        )
        for times, rates in ((1, found.within_1), (2, found.within_2)):
            data += [
                {"object": found.object, "unit": found.unit, "axis": axis, "deviations": times, **rate_numbers(rate)}
                for axis, rate in zip(AXES, rates, strict=True)
            ]
    columns = ("", "runs", *(f"{axis.upper()} within {times} σ" for times in (1, 2) for axis in AXES))
    note = "A deviation that is right covers 68.3 % within 1 σ and 95.4 % within 2 σ of a normal error."
    return Table("coverage", "Coverage of stated deviations", note, columns, tuple(lines), pd.DataFrame(data))
