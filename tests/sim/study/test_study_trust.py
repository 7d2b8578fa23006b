"""The table of sabotaged runs counts what is wrong and what says so."""

from pathlib import Path
from typing import Any

from sim.study.rows import frame_of
from sim.study.trust import SABOTAGES, write_trust


def record(number: int, kind: int, off_mm: float, trusted: bool) -> dict[str, Any]:
    row = {"mm": off_mm, "deg": 0.1, "mm_xyz": [off_mm, 0.0, 0.0], "deg_xyz": [0.1, 0.0, 0.0]}
    head = {"study": "trust", "condition": f"c{kind}", "number": number, "patient": "301", "side": "left", "seed": 1}
    head |= {"kind": "procedural", "preset": "fast", "code": "a", "settings": "s", "host": "h", "versions": {}}
    found = {"refused": None, "status": "done", "reason": "", "trusted": trusted, "reasons": []}
    errors = {"pelvis": row, "femur": row, "device": row, "relative_mm": off_mm}
    return head | found | {"errors": errors, "varied": {"sabotage": SABOTAGES[kind].name}}


def test_runs_are_counted_by_sabotage(tmp_path: Path) -> None:
    records = [record(1, 0, 0.3, True), record(1, 0, 9.0, False), record(1, 0, 9.0, False), record(2, 1, 30.0, True)]
    records = [each | {"settings": f"s{n}"} for n, each in enumerate(records)]
    text = write_trust(frame_of(records), "fast", tmp_path)
    rows = {line.split("|")[1].strip(): [c.strip() for c in line.split("|")[2:6]] for line in text.splitlines()[2:8]}
    assert rows[SABOTAGES[0].name] == ["1", "0", "0", "2"]
    assert rows[SABOTAGES[1].name] == ["0", "0", "1", "0"]
    assert "on 2 simulated procedures" in text
    assert text in (tmp_path / "accuracy.md").read_text(encoding="utf-8")


def test_every_sabotage_moves_something() -> None:
    for sabotage in SABOTAGES:
        moved = [offset for offset in (sabotage.pelvis, sabotage.device) if offset.rotation_deg and offset.depth_mm]
        assert len(moved) == 1
