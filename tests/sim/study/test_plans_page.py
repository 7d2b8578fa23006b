"""The section that tells what plans are worth."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from femoreg_torch.planning.convergence import MeshRow
from femoreg_torch.planning.offsets import directions
from femoreg_torch.planning.response import Response
from sim.study.plans import SUBJECTS, Measured
from sim.study.plans_page import plans_text, write_plans

DRAWN: dict[str, Any] = {
    "gain_percent_median": 39.6,
    "gain_percent_p5": 38.0,
    "gain_percent_p95": 41.0,
    "planned_gain_percent": 40.0,
    "outcomes": {"draws": [{}] * 20},
    "study_runs": 59,
}
# 3 % per mm along one axis: with 2.64 mm in the mean, 1.654 mm along each axis, 5 % in the end
FLAT = Response(40.0, np.array([3.0, 0, 0, 0, 0]), np.zeros(5), 4.0, np.zeros(3), np.array([-60.0, 0, 30]))


def found(outcomes: dict[str, Any], meshes: list[MeshRow]) -> Measured:
    loads = {"baseline": 2000.0, "planned": 2800.0, "optimum": 3300.0}
    plan: dict[str, Any] = {name: {"yield_load_n": load} for name, load in loads.items()} | {"elements": 6400}
    cost = {"processor_s": 120.4, "wall_s": 130.0, "peak_gb": 1.23, "cores": 2}
    return Measured(SUBJECTS[0], cost, plan, outcomes, meshes, {"fall keyak": {"yield_load_n": 2000.0}}, DRAWN, FLAT)


def test_the_table_holds_loads_gains_and_what_was_not_run() -> None:
    gains = {
        "generic": 20,
        "superior": 41,
        "inferior": 35,
        "anterior": 33,
        "posterior": 42,
        "medial": 30,
        "lateral": 39,
    }
    outcomes: dict[str, Any] = {name: {"yield_load_n": 2000.0 * (1 + g / 100)} for name, g in gains.items()}
    text = plans_text([found(outcomes | {"baseline_n": 2000.0}, [])], "make plans", "mesh.png")
    assert "| 2000 | 2400 (+20 %) | 2800 (+40 %) | 3300 (+65 %) | +30 % to +42 % |" in text
    assert "| " + " | ".join(f"+{gains[name]} %" for name in directions("left")) + " |" in text
    assert "| 6400 | 120 | 130 | 1.2 |" in text
    assert "| 2000 | – | – | – |" in text
    assert "20 draws" in text
    assert "gain 39.6 % (5 to 95 %: 38.0 to 41.0 %), as planned 40.0 %" in text
    assert "(seed 315) 40 ± 5 %." in text
    assert "mesh.png" not in text
    bare = plans_text([found({}, [])], "make plans", "mesh.png")
    assert "| 2000 | – | 2800 (+40 %) | 3300 (+65 %) | – |" in bare


@pytest.mark.parametrize(
    ("load", "gain", "kept"), [(2090.0, 0.41, "3 mm, 2 mm"), (2110.0, 0.41, "2 mm"), (2010.0, 0.44, "2 mm")]
)
def test_meshes_are_held_against_the_finest(tmp_path: Path, load: float, gain: float, kept: str) -> None:
    rows = [MeshRow(3.0, 6400, load, gain, 8.0), MeshRow(2.0, 21000, 2000.0, 0.40, 40.0)]
    (tmp_path / "planning.md").write_text(
        "# Plan\n\nHead.\n\n## What was measured\n\nOld.\n\n## Last\n\nKept.\n", encoding="utf-8"
    )
    steady = [MeshRow(3.0, 8300, 3030.0, 0.30, 6.0), MeshRow(1.5, 63000, 3000.0, 0.32, 80.0)]
    other = replace(found({}, steady), subject=SUBJECTS[1])
    write_plans([found({}, rows), other, replace(found({}, []), subject=SUBJECTS[2])], "make plans", tmp_path)
    page = (tmp_path / "planning.md").read_text(encoding="utf-8")
    first, second = (line for line in page.splitlines() if line.startswith("- "))
    assert f"(seed 315): within both of the finest (2 mm): {kept}." in first
    assert ("**3 mm is not**" in first) == (kept == "2 mm")
    assert "Not run: 2.5 mm, 1.5 mm." in first
    assert "(STS_044), right: within both of the finest (1.5 mm): 3 mm, 1.5 mm. Not run: 2.5 mm, 2 mm." in second
    assert "| real CT (STS_044), right | 3 mm | 8300 | 3030 | +1.0 % | +30.0 % | -2.0 | 6 |" in page
    assert "Old." not in page
    assert page.startswith("# Plan\n\nHead.")
    assert page.endswith("## Last\n\nKept.\n")
    assert (tmp_path / "planning_mesh.png").stat().st_size > 10000
