"""The accuracy page: means over all runs, those without a pose told; limits; every run that is wrong or flagged."""

from pathlib import Path
from typing import Any

import pandas as pd

from femoreg_torch.statistics.costs import stage_costs
from sim.study.accuracy_page import WANTED, section, write_results
from sim.study.conditions_page import write_conditions
from sim.study.page import write_section
from sim.study.rows import frame_of


def run(number: int, mm: float = 0.5, relative: float = 0.5, deg: float = 0.1, **changes: Any) -> dict[str, Any]:
    """A record as a run of the engine leaves it."""
    row = {"mm": mm, "deg": deg, "mm_xyz": [mm, 0.0, 0.0], "deg_xyz": [deg, 0.0, 0.0]}
    metrics = {"entry_point_mm": mm, "tip_mm": mm, "relative_mm": relative, "path_deg": 0.1, "guide_deg": 0.1}
    names = ("pelvis", "femur", "device")
    deviations = {"translation_deviation_mm": [1.0] * 3, "rotation_deviation_deg": [0.05] * 3}
    record: dict[str, Any] = {
        "study": "accuracy",
        "condition": "uniform",
        "varied": {},
        "settings": "s",
        "host": "here",
        "versions": {},
        "status": "done",
        "reason": "",
        "number": number,
        "patient": "301" if number % 2 else "bmf",
        "side": "left",
        "seed": number,
        "kind": "procedural" if number % 2 else "real",
        "preset": "fast",
        "code": "a",
        "refused": None,
        "trusted": True,
        "reasons": [],
        "errors": {**{name: dict(row) for name in (*names, "view2", "view3")}, **metrics},
        "start_errors": {name: dict(row) for name in names},
        "quality": {name: {"trusted": True} | deviations for name in names},
        "stages": [
            {"name": "pelvis in view 1", "view": None, "evaluations": 100 * number, "seconds": float(number)},
            {"name": "others", "view": 2, "evaluations": 10, "seconds": 1.0},
            {"name": "others", "view": 3, "evaluations": 30, "seconds": 2.0},
        ],
        "timings_s": {"registration": 2.0, "total": 3.0},
    }
    return record | changes


def without_pose(number: int, status: str = "refused") -> dict[str, Any]:
    why = "/home/somebody/case: too few usable landmarks"
    kept = {key: value for key, value in run(number).items() if key not in ("errors", "quality", "stages", "timings_s")}
    return kept | {"start_errors": None, "status": status, "reason": why, "refused": why, "trusted": False}


def rows(*records: dict[str, Any]) -> pd.DataFrame:
    return frame_of(records)


def test_refused_and_failed_runs_are_infinitely_far_off_and_told() -> None:
    some = rows(run(1, mm=1.0), run(2, mm=3.0), without_pose(3), without_pose(4), without_pose(5, "failed"))
    text = section(some, 60, "fast", None)
    assert "**3 of 5 runs gave no pose** (2 refused, 1 failed)" in text
    assert "5 of the 60 procedures (3 on procedural patients, 2 on real bone shapes)" in text
    assert "within 4 mm: **2 of 5**" in text
    assert "| pelvis, mm | 0.92 | **2.00** ± 1.41 | ∞ | ∞ | 1.00 | 3.00 | ≤ 0.45 | not met |" in text
    assert "| 4: bmf, left | – | – | – | – | refused | case: too few usable landmarks |" in text


def test_every_run_is_counted_once_and_the_doubtful_are_listed() -> None:
    flagged = {"trusted": False, "reasons": ["view 2 disagrees"]}
    some = [run(1), run(2), run(3, **flagged), run(4, mm=9.0), run(5, mm=9.0, **flagged), without_pose(6)]
    text = section(rows(*some), 60, "fast", None)
    assert "| whole run | 2 | 1 | 1 | 2 |" in text
    assert "wrong and trusted: **1**" in text
    assert "right runs flagged: **1 of 3**, 33.3 %" in text
    assert "| 4: bmf, left | 9.00 mm, 0.10° |" in text
    assert (
        "| 3: 301, left | 0.50 mm, 0.10° | 0.50 mm, 0.10° | 0.50 mm, 0.10° | 0.50 mm | flagged | view 2 disagrees |"
        in text
    )


def test_a_stage_of_several_views_is_counted_per_run() -> None:
    pelvis, others = stage_costs(rows(run(1), run(3), without_pose(4)))
    assert (pelvis.name, pelvis.evaluations, pelvis.seconds) == ("pelvis in view 1", 200, 2.0)
    assert (others.name, others.evaluations, others.seconds) == ("others", 40, 3.0)


def test_limits_are_met_or_not() -> None:
    lines = section(rows(run(1, relative=0.61), run(2, relative=0.61)), 60, "fast", None).splitlines()
    assert any(line.startswith("| entry point to tip, mm") and "≤ 0.60 | not met" in line for line in lines)
    lines = section(rows(run(1, relative=0.61), run(2, relative=0.61)), 60, "paper", None).splitlines()
    assert any(line.startswith("| entry point to tip, mm") and "< 1.26 | met" in line for line in lines)
    assert len(WANTED) == 15


def test_records_of_several_versions_are_told() -> None:
    assert "2 versions" in section(rows(run(1), run(2, code="b")), 60, "fast", None)
    assert "versions of the code" not in section(rows(run(1), run(2)), 60, "fast", None)


def test_section_and_figure_are_written(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_results(rows(run(1), run(2, mm=5.0), without_pose(3)), 60, "fast", tmp_path / "out", tmp_path / "docs", None)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["accuracy_fast.png", "accuracy_fast.svg"]
    assert sorted(path.name for path in (tmp_path / "docs").iterdir()) == ["accuracy.md", "accuracy_fast.png"]
    text = section(rows(without_pose(1)), 60, "fast", None)  # nothing to draw, and no error
    assert "| pelvis, mm | 0.92 | **–** | ∞ | ∞ | – | – | ≤ 0.45 | not met |" in text


def test_conditions_stand_side_by_side(tmp_path: Path) -> None:
    blind = {"condition": "no_device_images", "asked": ["pelvis", "femur"]}
    without = run(1, **blind)
    without["errors"] = {key: value for key, value in without["errors"].items() if key in ("pelvis", "femur", "view2")}
    some = rows(run(1), run(2, mm=9.0), without)
    text = write_conditions(some, ["uniform", "no_device_images"], "fast", 2, "the command", tmp_path)
    page = (tmp_path / "accuracy.md").read_text(encoding="utf-8")
    assert page.count("## Conditions: `fast`, first 2 procedures") == 1
    lines = text.splitlines()
    (uniform,) = [line for line in lines if line.startswith("| uniform |")]
    assert uniform.startswith("| uniform | 2 | 4.75 |")
    assert uniform.endswith("| 0 of 1 | 1 |")
    (other,) = [line for line in lines if line.startswith("| no_device_images |")]
    assert other.endswith("| – | – | 0 of 1 | 0 |")  # no tip, so no relative error either
    assert "| pelvis, mm | 50, 50 | 100, 100 | 100, 100 |" in text


def test_a_section_takes_the_place_of_its_older_self(tmp_path: Path) -> None:
    for title, text in (("A", "first"), ("B", "second"), ("A", "third\n\n### part")):
        write_section(tmp_path, title, text)
    page = (tmp_path / "accuracy.md").read_text(encoding="utf-8")
    assert "first" not in page
    assert page.index("third") < page.index("### part") < page.index("second")
    assert page.startswith("# Accuracy")
