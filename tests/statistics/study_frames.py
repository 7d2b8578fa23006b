"""Made-up studies whose statistics are known."""

import numpy as np
import pandas as pd

from femoreg_torch.statistics.quantities import AXES, OBJECTS, POSES

DEVIATIONS = {"mm": (0.1, 0.2, 0.5), "deg": (0.3, 0.2, 0.1)}  # of the errors along, and about, IS, LR and AP


def made_up(count: int = 60, seed: int = 0, condition: str = "plain", scale: float = 1.0) -> pd.DataFrame:
    """Runs with normal errors of these deviations times `scale`, which the runs state rightly; all done and trusted."""
    rng = np.random.default_rng(seed)
    numbers = np.arange(1, count + 1)
    columns = {
        "study": "made up",
        "condition": condition,
        "number": numbers,
        "patient": [f"p{n}" for n in numbers],
        "kind": np.where(numbers % 2, "procedural", "real"),
        "side": np.where(numbers % 3, "left", "right"),
        "seed": 1000 + numbers,
        "preset": "fast",
        "code": "abc",
        "settings": "0123456789abcdef",
        "status": "done",
        "reason": "",
        "trusted": True,
        "reasons": "",
        "varied_turn_deg": rng.uniform(0, 10, count),
        "varied_bed": np.where(numbers % 2, "wood", "carbon"),
        "seconds_total": rng.uniform(5, 15, count),
        "host": "one",
        "version_torch": "2.15.0",
    }
    for key in POSES:
        for unit, deviations in DEVIATIONS.items():
            parts = rng.normal(0, scale * np.array(deviations), (count, 3))
            columns |= {f"{key}_{unit}_{axis}": parts[:, n] for n, axis in enumerate(AXES)}
            columns[f"{key}_{unit}"] = np.linalg.norm(parts, axis=1)
            if key in OBJECTS:
                columns |= {f"{key}_sigma_{unit}_{a}": scale * s for a, s in zip(AXES, deviations, strict=True)}
                columns[f"{key}_trusted"] = True
    rows = pd.DataFrame(columns)
    points = {}
    for point, key in (("entry_point", "femur"), ("tip", "device")):
        points[point] = rows[[f"{key}_mm_{axis}" for axis in AXES]].to_numpy() + rng.normal(0, 0.02 * scale, (count, 3))
        rows[f"{point}_mm"] = np.linalg.norm(points[point], axis=1)
        rows = rows.assign(**{f"{point}_mm_{axis}": points[point][:, n] for n, axis in enumerate(AXES)})
    rows["relative_mm"] = np.linalg.norm(points["entry_point"] - points["tip"], axis=1)
    rows["path_deg"], rows["guide_deg"] = 0.5 * rows["femur_deg"], 0.5 * rows["device_deg"]
    return rows


def refuse(
    rows: pd.DataFrame, places: list[int], status: str = "refused", reason: str = "no landmarks"
) -> pd.DataFrame:
    """The same study with some of its runs, by position, refused or failed."""
    rows = rows.copy()
    errors = [c for c in rows if c.endswith(("_mm", "_deg")) or "_mm_" in c or "_deg_" in c]
    errors = [c for c in errors if not c.startswith("varied_")]
    index = rows.index[places]
    rows.loc[index, errors] = np.nan
    rows.loc[index, "status"] = status
    rows.loc[index, "reason"] = reason
    rows.loc[index, ["trusted", *(f"{name}_trusted" for name in OBJECTS)]] = False
    return rows
