"""Means over all runs, refused ones told; counts of right and wrong runs against what they say of themselves."""

import math
from pathlib import Path
from typing import Any

import pytest

from sim.study.accuracy import section, write_results
from sim.study.page import write_section
from sim.study.procedures import load_study, procedures
from sim.study.quantities import QUANTITIES
from sim.study.summary import Confusion, confusion, rows_of_csv, run_is_wrong, stage_costs, statistics

PELVIS = next(q for q in QUANTITIES if q.path == ("pelvis", "mm"))
RELATIVE = next(q for q in QUANTITIES if q.path == ("relative_mm",))


def run(number: int, mm: float = 0.5, relative: float = 0.5, deg: float = 0.1, **changes: Any) -> dict[str, Any]:
    """A record as `run_trial` makes it."""
    row = {"mm": mm, "deg": deg, "mm_xyz": [mm, 0.0, 0.0], "deg_xyz": [deg, 0.0, 0.0]}
    metrics = {"entry_point_mm": mm, "tip_mm": mm, "relative_mm": relative, "path_deg": 0.1, "guide_deg": 0.1}
    names = ("pelvis", "femur", "device")
    record: dict[str, Any] = {
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
        "quality": {name: {"trusted": True, "reason": "all views agree"} for name in names},
        "stages": [
            {"name": "pelvis", "view": None, "evaluations": 100 * number, "seconds": float(number)},
            {"name": "others", "view": 2, "evaluations": 10, "seconds": 1.0},
            {"name": "others", "view": 3, "evaluations": 30, "seconds": 2.0},
        ],
        "timings_s": {"registration": 2.0, "total": 3.0},
        "threads": 1,
    }
    return record | changes


def refused(number: int) -> dict[str, Any]:
    keys = ("number", "patient", "side", "seed", "kind", "preset", "code")
    return {key: run(number)[key] for key in keys} | {
        "refused": "too few usable landmarks",
        "trusted": False,
        "reasons": [],
    }


def test_means_hold_the_failures() -> None:
    found = statistics([run(1, mm=1.0), run(2, mm=2.0), run(3, mm=60.0)], PELVIS)
    assert found.count == 3
    assert found.mean == pytest.approx(21.0)
    assert found.deviation == pytest.approx(math.sqrt((400 + 361 + 1521) / 2))
    assert (found.median, found.maximum) == (2.0, 60.0)


def test_refused_runs_are_infinitely_far_off_and_told() -> None:
    records = [run(1, mm=1.0), run(2, mm=3.0), refused(3), refused(4), refused(5)]
    found = statistics(records, PELVIS)
    assert (found.count, found.mean) == (2, 2.0)
    assert found.median == found.maximum == math.inf
    text = section(records, 60, "fast", None)
    assert "3 of 5 runs gave no pose" in text
    assert "5 of the 60 procedures" in text
    assert "within 4 mm: **2 of 5**" in text
    assert math.isnan(statistics([refused(1)], PELVIS).mean)


@pytest.mark.parametrize(
    ("record", "wrong"),
    [
        (run(1, mm=3.99, relative=3.99, deg=1.99), False),
        (run(1, relative=4.01), True),
        (run(1, mm=4.01), True),
        (run(1, deg=2.01), True),
        (run(1, relative=math.nan), True),
        (refused(1), True),
    ],
)
def test_wrong_is_beyond_4_mm_or_2_degrees(record: dict[str, Any], wrong: bool) -> None:
    assert run_is_wrong(record) == wrong


def test_confusion_counts_every_run_once() -> None:
    records = [run(1), run(2), run(3, trusted=False), run(4, mm=9.0), run(5, mm=9.0, trusted=False), refused(6)]
    assert confusion(records) == Confusion(right_trusted=2, right_flagged=1, wrong_trusted=1, wrong_flagged=2)
    text = section(records, 60, "fast", None)
    assert "wrong and trusted: **1**" in text
    assert "right runs flagged: **1 of 3**, 33.3 %" in text
    assert "| 4: bmf, left | 9.00 mm, 0.10° |" in text
    assert "| 6: bmf, left | – |" in text


def test_confusion_of_one_object_looks_at_that_object() -> None:
    bad = run(1)
    bad["errors"]["femur"]["deg"] = 5.0
    flagged = run(2)
    flagged["quality"]["pelvis"]["trusted"] = False
    assert confusion([bad, flagged, refused(3)], "femur") == Confusion(1, 0, 1, 1)
    assert confusion([bad, flagged, refused(3)], "pelvis") == Confusion(1, 1, 0, 1)


def test_a_stage_of_several_views_is_counted_per_run() -> None:
    pelvis, others = stage_costs([run(1), run(3), refused(4)])
    assert (pelvis.evaluations, pelvis.seconds) == (200, 2.0)
    assert (others.evaluations, others.seconds) == (40, 3.0)


def test_limits_are_met_or_not() -> None:
    lines = section([run(1, relative=0.61), run(2, relative=0.61)], 60, "fast", None).splitlines()
    assert any(line.startswith("| entry point to tip, mm") and "≤ 0.60 | not met" in line for line in lines)
    lines = section([run(1, relative=0.61), run(2, relative=0.61)], 60, "paper", None).splitlines()
    assert any(line.startswith("| entry point to tip, mm") and "< 1.26 | met" in line for line in lines)
    assert statistics([run(1, relative=0.61)], RELATIVE).mean == 0.61


def test_records_of_several_versions_are_told() -> None:
    assert "2 versions" in section([run(1), run(2, code="b")], 60, "fast", None)
    assert "versions of the code" not in section([run(1), run(2)], 60, "fast", None)


def test_everything_is_written(tmp_path: Path) -> None:
    records = [run(1), run(2, mm=5.0), refused(3)]
    write_results(records, 60, "fast", tmp_path / "out", tmp_path / "docs", None)
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == ["accuracy_fast.png", "runs.csv", "summary.json"]
    assert sorted(path.name for path in (tmp_path / "docs").iterdir()) == ["accuracy.md", "accuracy_fast.png"]
    lines = (tmp_path / "out" / "runs.csv").read_text().splitlines()
    assert len(lines) == 4
    assert len(rows_of_csv(records)) == 3


def test_a_section_takes_the_place_of_its_older_self(tmp_path: Path) -> None:
    for title, text in (("A", "first"), ("B", "second"), ("A", "third\n\n### part")):
        write_section(tmp_path, title, text)
    page = (tmp_path / "accuracy.md").read_text()
    assert "first" not in page
    assert page.index("third") < page.index("### part") < page.index("second")
    assert page.startswith("# Accuracy")


def test_the_procedures_are_those_of_the_protocol() -> None:
    study = load_study("accuracy")
    everything = procedures(study)
    assert len(everything) == 60
    assert len({p.seed for p in everything}) == len({p.name for p in everything}) == 60
    procedural = [p for p in everything if p.procedural]
    assert len({p.patient for p in procedural}) == 30
    for part in (everything, procedural, everything[:20]):
        assert sum(p.side == "left" for p in part) == len(part) / 2
    for subject in study.subjects:
        of_it = [p for p in everything if p.patient == subject]
        assert len(of_it) == 5
        assert {p.side for p in of_it} == {"left", "right"}
    assert {p.patient for p in everything[:20]} >= set(study.subjects)
    assert sum(p.procedural for p in everything[:20]) == 10
