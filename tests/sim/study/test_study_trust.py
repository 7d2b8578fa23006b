"""The table of sabotaged runs counts what is wrong and what says so."""

from pathlib import Path
from typing import Any

from sim.study.trust import SABOTAGES, write_trust


def record(kind: int, off_mm: float, trusted: bool) -> dict[str, Any]:
    row = {"mm": off_mm, "deg": 0.1}
    return {
        "sabotage": SABOTAGES[kind].name,
        "case": f"case{kind}",
        "refused": None,
        "errors": {"pelvis": row, "femur": row, "device": row, "relative_mm": off_mm},
        "quality": {},
        "trusted": trusted,
    }


def test_runs_are_counted_by_sabotage(tmp_path: Path) -> None:
    records = [record(0, 0.3, True), record(0, 9.0, False), record(0, 9.0, False), record(1, 30.0, True)]
    text = write_trust(records, "fast", tmp_path, tmp_path)
    rows = {line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:6]] for line in text.splitlines()[2:8]}
    assert rows[SABOTAGES[0].name] == ["1", "0", "0", "2"]
    assert rows[SABOTAGES[1].name] == ["0", "0", "1", "0"]
    assert "on 2 simulated procedures" in text
    assert text in (tmp_path / "accuracy.md").read_text(encoding="utf-8")
    assert (tmp_path / "trust_fast.json").is_file()


def test_every_sabotage_moves_something() -> None:
    for sabotage in SABOTAGES:
        moved = [offset for offset in (sabotage.pelvis, sabotage.device) if offset.rotation_deg and offset.depth_mm]
        assert len(moved) == 1
