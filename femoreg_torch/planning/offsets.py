"""What a plan is worth when it is carried out some mm beside: in six directions, and under errors of registration."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as File
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from femoreg_torch.case.model import Side
from femoreg_torch.errors import InputError
from femoreg_torch.planning.diffusion import diffuse
from femoreg_torch.planning.path import Ellipsoid, Path, Surroundings
from femoreg_torch.planning.prepare import Prepared

Array = NDArray[np.float64]

_AXES = ("lr", "ap", "is")  # of a study's signed columns, as LPS: to the left, to the back, to the head


@dataclass(frozen=True)
class Outcome:
    """A plan carried out beside its place."""

    offset_mm: tuple[float, float, float]  # LPS
    yield_load_n: float
    clearance_mm: float  # of the path to the surface, but near the entry; below 0 it leaves the bone
    cement_ml: float


def directions(side: Side) -> dict[str, Array]:
    """Unit vectors (3,), LPS, of the six directions, in the patient."""
    medial = np.array([-1.0 if side == "left" else 1.0, 0, 0])
    front, up = np.array([0, -1.0, 0]), np.array([0, 0, 1.0])
    return {
        "superior": up, "inferior": -up, "anterior": front, "posterior": -front, "medial": medial, "lateral": -medial
    }  # fmt: skip


def carried_out(
    prepared: Prepared,
    around: Surroundings,
    path: Path,
    cement: Array,
    offset: Array,
    moves: Literal["path", "pattern"],
) -> Outcome:
    """The plan moved by an offset (3,), LPS mm.

    path: the path is moved, and cement spreads from it anew. pattern: the cement (X, Y, Z) itself is moved, and what
    would come to lie outside the marrow is lost. Raises `InputError` where a moved injection finds no marrow.
    """
    moved = Path(path.entry + offset, path.target + offset, tuple(Ellipsoid(**vars(e)) for e in path.ellipsoids))
    if moves == "pattern":
        shift = np.linalg.solve(prepared.bone.femur.lps_from_index[:3, :3], offset)
        there = ndimage.shift(cement, shift, order=1, mode="constant") * prepared.bone.marrow
    else:
        there = diffuse(prepared.bone, moved.injections(), prepared.planning.diffusion)
    load = prepared.curve(there).yield_load_n
    clearance = around.clearances(moved, prepared.planning.path).cortex_mm
    x, y, z = (float(v) for v in offset)
    return Outcome((x, y, z), load, clearance, prepared.bone.cement_ml(there))


def normal_offsets(mean: Array, covariance: Array, draws: int, seed: int) -> Array:
    """Random offsets (draws, 3), LPS mm, of a normal distribution. Raises `InputError` for what is no covariance."""
    mean, covariance = np.asarray(mean, float), np.asarray(covariance, float)
    right = mean.shape == (3,) and covariance.shape == (3, 3) and np.allclose(covariance, covariance.T)
    if not right or np.linalg.eigvalsh(covariance).min() < -1e-9:
        raise InputError("errors: a mean of 3 values and a symmetric 3 × 3 covariance, in mm, were expected.")
    return np.random.default_rng(seed).multivariate_normal(mean, covariance, size=draws)


def study_offsets(folder: File, draws: int, seed: int) -> Array:
    """Offsets (draws, 3), LPS mm, drawn from the runs of a study with replacement.

    `folder` holds `runs.parquet` or `runs.csv` with signed errors (estimate minus truth) `femur_mm_lr|ap|is` and
    `device_mm_lr|ap|is`. The robot brings the device where both are believed to fit, so that it ends beside the
    planned place in the bone by the femur's error minus the device's. Runs that were not trusted would not have been
    carried out, and are left out. Raises `InputError` for a missing file or column, or if no run is left.
    """
    table = _read_runs(folder)
    columns = [f"{name}_mm_{axis}" for name in ("femur", "device") for axis in _AXES]
    missing = [name for name in columns if name not in table]
    if missing:
        raise InputError(f"{folder}: the runs have no column {missing[0]}. Signed errors along each axis are needed.")
    values = np.array([table[name] for name in columns], float).T
    kept = np.isfinite(values).all(1)
    if "trusted" in table:
        kept &= np.array([str(value).lower() in ("true", "1") for value in table["trusted"]])
    if not kept.any():
        raise InputError(f"{folder}: no trusted run with errors of femur and device.")
    offsets = values[kept, :3] - values[kept, 3:]
    return np.asarray(offsets[np.random.default_rng(seed).integers(len(offsets), size=draws)])


def _read_runs(folder: File) -> dict[str, Sequence[Any]]:
    parquet, text = File(folder) / "runs.parquet", File(folder) / "runs.csv"
    if parquet.is_file():
        from pyarrow import parquet as reader

        found: dict[str, Sequence[Any]] = reader.read_table(parquet).to_pydict()
        return found
    if not text.is_file():
        raise InputError(f"{folder}: holds neither runs.parquet nor runs.csv. Give the folder of a study.")
    import csv

    with text.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] or "nan" for row in rows] for name in (rows[0] if rows else {})}
