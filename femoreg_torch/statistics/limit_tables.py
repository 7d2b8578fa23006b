"""How far errors are from what images allow: Cramér–Rao bounds beside them, and what each image is worth.

`bounds.parquet` holds a row for each bound of a procedure, written by `python -m sim.study limits`: its `condition`,
`number` and `settings`; in `what` a `BOUND` (least root mean square of each error), the share of each image in the
squared bound (`NOISE`) or in what is known of each pose (`INFORMATION`), or the errors of a registration of images with
nothing but photon noise (`REGISTERED`); `unknown`, what else had to be found from the images; `images`, those that
there were; and the columns of the errors.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from femoreg_torch.errors import InputError
from femoreg_torch.statistics.formats import Table, number, percent
from femoreg_torch.statistics.outcome import told
from femoreg_torch.statistics.quantities import BY_COLUMN, POSES, QUANTITIES, Quantity

BOUNDS_NAME = "bounds.parquet"
BOUND, NOISE, INFORMATION, REGISTERED = "bound", "noise", "information", "registered"
ALL_IMAGES = "all"
POSES_ALONE, USUAL = "poses", "+ densities"  # unknown; the latter of bones and device parts, light and tissue too
_WORTH = tuple(BY_COLUMN[f"{key}_mm"] for key in (*POSES, "entry_point", "tip", "relative"))
_OF_RUN = ("condition", "number", "settings")
_NEEDED = (*_OF_RUN, "what", "unknown", "images")


def without_name(image: str) -> str:
    """What `images` says where one is left out."""
    return f"without {image}"


def first_views_name(count: int) -> str:
    """What `images` says of the first so many views."""
    return "view 1 alone" if count == 1 else f"views 1 to {count}"


def read_bounds(folder: Path) -> pd.DataFrame | None:
    """The bounds in a study's folder; None if it has none. Raises `InputError` for a file that is none of these."""
    path = folder / BOUNDS_NAME
    if not path.is_file():
        return None
    try:
        found = pd.read_parquet(path)
    except (OSError, ValueError) as error:  # pyarrow's own errors are ValueErrors
        raise InputError(f"{path}: cannot be read as Parquet ({' '.join(str(error).split())}).") from error
    if missing := [column for column in _NEEDED if column not in found]:
        raise InputError(f"{path}: has no column {', '.join(missing)}. Remove it, or write it by `sim.study limits`.")
    for column in [c for c in found if c == "number" or c in BY_COLUMN]:
        if not pd.api.types.is_numeric_dtype(found[column]):
            raise InputError(f"{path}, column {column}: numbers were expected. Write it anew by `sim.study limits`.")
    return found


def limit_tables(rows: pd.DataFrame, bounds: pd.DataFrame) -> list[Table]:
    """Of the runs of one condition: errors beside their bounds, and what images are worth."""
    own = bounds.merge(rows[list(_OF_RUN)].drop_duplicates(), on=list(_OF_RUN))  # those of other settings do not fit
    if own.empty or rows["condition"].nunique() > 1:
        return []
    return [limit_table(rows, own), worth_table(own), share_table(own)]


def limit_table(rows: pd.DataFrame, bounds: pd.DataFrame) -> Table:
    """Root mean squares of each error and of its bounds over the same procedures."""
    limits = bounds[bounds["what"].eq(BOUND) & bounds["images"].eq(ALL_IMAGES)]
    same = rows[rows["number"].isin(limits["number"])]
    noisy = bounds[bounds["what"].eq(REGISTERED)]
    kinds = list(dict.fromkeys(limits["unknown"]))
    lines, data = [], []
    for q in QUANTITIES:
        errors = told(same, q.column).dropna()
        if q.column not in limits or errors.empty:
            continue
        error = _rms(errors)
        own = limits[limits["number"].isin(same.loc[errors.index, "number"])]  # of the runs that gave this error
        found = {kind: _rms(own.loc[own["unknown"].eq(kind), q.column]) for kind in kinds}
        alone = _rms(noisy[q.column]) if q.column in noisy and len(noisy) else float("nan")
        ratio = error / found[USUAL] if found.get(USUAL, 0) > 0 else float("nan")
        cells = [_fine(value, q) for value in (error, alone, *found.values())]
        lines.append((q.label, str(len(errors)), *cells, number(ratio, 1)))
        data.append({"error": q.column, "unit": q.unit, "runs": len(errors), "rms": error, "noise_alone": alone}
                    | {f"bound {kind}": value for kind, value in found.items()} | {"ratio": ratio})  # fmt: skip
    note = (
        "Root mean squares over the runs that gave the error, and over their bounds. Bounds: the least that the noise "
        "of photons and electronics allows, with more and more unknown beside the poses. Ratio: error by the bound "
        f"`{USUAL}`. Noise alone: the last stage that moves all, on images that show what it draws, with photon noise, "
        f"of {noisy['number'].nunique()} procedures; – where none was registered."
    )
    columns = ("", "runs", "error", "noise alone", *(f"bound, {kind}" for kind in kinds), "ratio")
    return Table("limits", "How far from the limit", note, columns, tuple(lines), pd.DataFrame(data))


def worth_table(bounds: pd.DataFrame) -> Table:
    """Bounds with fewer images, by those of all of them."""
    usual = bounds[bounds["what"].eq(BOUND) & bounds["unknown"].eq(USUAL)]
    shown = [q for q in _WORTH if q.column in usual]
    every = {q.column: _rms(usual.loc[usual["images"].eq(ALL_IMAGES), q.column]) for q in shown}
    lines, data = [], []
    for images in dict.fromkeys(usual["images"]):
        part = usual[usual["images"].eq(images)]
        found = {q.column: _rms(part[q.column]) for q in shown}
        if images == ALL_IMAGES:
            cells = [f"{_fine(found[q.column], q)} {q.unit}" for q in shown]
        else:
            cells = [f"× {number(found[q.column] / every[q.column], 2)}" for q in shown]
        cells = ["–" if np.isnan(found[q.column]) else cell for q, cell in zip(shown, cells, strict=True)]
        lines.append((images, *cells))
        data.append({"images": images} | found)
    note = (
        f"Bounds (root mean square over {usual['number'].nunique()} procedures; unknown are poses {USUAL}) with all "
        "images, and by what factor they grow with fewer. ∞: these images do not fix it; –: there is no such view."
    )
    columns = ("images", *(q.name for q in shown))
    return Table("worth", "What each image is worth", note, columns, tuple(lines), pd.DataFrame(data))


def share_table(bounds: pd.DataFrame) -> Table:
    """Shares of every image in what is known of each pose, and in the noise that reaches the relative error."""
    about, noise = (bounds[bounds["what"].eq(what)] for what in (INFORMATION, NOISE))
    lines, data = [], []
    for image in dict.fromkeys(noise["images"]):
        known = {key: float(about.loc[about["images"].eq(image), f"{key}_mm"].mean()) for key in POSES}
        brought = float(noise.loc[noise["images"].eq(image), "relative_mm"].mean())
        lines.append((image, *map(percent, known.values()), percent(brought)))
        data.append({"image": image, **known, "relative_mm": brought})
    note = (
        "Of all that the images tell of a pose, were all else known: the share of each. Last column: of the squared "
        "bound of the error from entry point to tip, what the noise of each image brings. Both are means over "
        f"{noise['number'].nunique()} procedures."
    )
    columns = ("image", *POSES.values(), "noise of entry point to tip")
    return Table("shares", "Where the information comes from", note, columns, tuple(lines), pd.DataFrame(data))


def _rms(values: "pd.Series[float]") -> float:
    known = values.dropna().to_numpy(float)
    return float(np.sqrt((known**2).mean())) if len(known) else float("nan")


def _fine(value: float, quantity: Quantity) -> str:
    """Bounds are small: one digit more than errors have."""
    return number(value, quantity.digits + 1)
