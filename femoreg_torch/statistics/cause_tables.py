"""What errors depend on, and where they come from."""

import math

import pandas as pd

from femoreg_torch.statistics.formats import Table, between, number, percent
from femoreg_torch.statistics.intervals import Correlation, spearman
from femoreg_torch.statistics.origins import SOURCES, relative_origins
from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import BY_COLUMN, RELATIVE
from femoreg_torch.statistics.rows import plain_name, varied

_DEPENDENT = tuple(BY_COLUMN[column] for column in ("pelvis_mm", "femur_mm", "device_mm", "relative_mm"))


def dependence_table(rows: pd.DataFrame) -> Table:
    """Rank correlations of errors with every number that was varied."""
    quantities = [q for q in _DEPENDENT if told(rows, q.column).notna().any()]
    lines, data = [], []
    for key, part in varied(rows).items():
        if not pd.api.types.is_numeric_dtype(part[key]):
            continue
        found = [spearman(part[key].astype(float), told(part, q.column)) for q in quantities]
        if all(math.isnan(c.value) for c in found):
            continue
        lines.append((plain_name(key), *map(_correlation, found)))
        data += [{"varied": key, "error": q.column, **_correlated(c)} for q, c in zip(quantities, found, strict=True)]
    note = (
        "Spearman's ρ with its 95 % interval, over the runs that gave an error, taken as independent. An interval "
        "around 0 tells nothing."
    )
    columns = ("varied", *(q.name for q in quantities))
    return Table("dependence", "What errors depend on", note, columns, tuple(lines), pd.DataFrame(data))


def origin_table(rows: pd.DataFrame) -> Table:
    """What C-arm views, femur and device explain of the relative error."""
    lines, data = [], []
    for found in relative_origins(rows):
        shares = [percent(o.share) for o in found.origins]
        partials = [percent(o.partial) for o in found.origins]
        lines.append((found.response, str(found.count), percent(found.r2), percent(found.adjusted), *shares, *partials))
        data += [
            {"response": found.response, "runs": found.count, "r2": found.r2, "adjusted_r2": found.adjusted}
            | {"group": o.group, "share": o.share, "partial": o.partial}
            for o in found.origins
        ]
    columns = ("", "runs", "R²", "adjusted", *SOURCES, *(f"{group}, partial R²" for group in SOURCES))
    note = (
        "Linear regression on the errors of each. R² is divided by the mean over all orders of entry; what noise alone "
        "explains of few runs is in it, and taken off in `adjusted`. Partial R² is what a group explains of that which "
        "the others leave. Length: by lengths and angles; along an axis: by signed parts."
    )
    title = f"Where the error from {RELATIVE.name} comes from"
    return Table("origins", title, note, columns, tuple(lines), pd.DataFrame(data))


def _correlation(found: Correlation) -> str:
    return f"{number(found.value, 2)} ({between(found.interval, 2)})"


def _correlated(found: Correlation) -> dict[str, float]:
    return {"rho": found.value, "low": found.interval[0], "high": found.interval[1], "runs": found.count}
