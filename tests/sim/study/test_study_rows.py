"""The table of a study: names, axes, types, and a row for every round of a closed loop."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from cheap_study import Cheap, study

from femoreg_torch.statistics.summary import coverage
from sim.study.executors import OnThisMachine
from sim.study.rows import TABLE_NAME, frame_of, read_table, rows_of, table_of
from sim.study.store import Store
from sim.study.study import run_study

HEAD = ["study", "condition", "number", "patient", "kind", "side", "seed", "preset", "code", "settings"]


@pytest.fixture(scope="module")
def records(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    out = tmp_path_factory.mktemp("study")
    plan = study(8, Cheap())
    run_study(plan, out, OnThisMachine(1))
    found = [Store(out, "").record(run) for run in plan.runs]
    return [record for record in found if record is not None]


def test_the_columns_are_those_that_were_agreed_on(records: list[dict[str, Any]]) -> None:
    table = table_of(records)
    assert table.column_names[:10] == HEAD
    wanted = {
        "varied_dose",
        "status",
        "reason",
        "trusted",
        "reasons",
        "asked",
        "pelvis_trusted",
        "host",
        "version_torch",
    }
    wanted |= {
        f"{prefix}pelvis_{unit}{axis}"
        for prefix in (
            "",
            "start_",
        )
        for unit in ("mm", "deg")
        for axis in ("", "_is", "_lr", "_ap")
    }
    wanted |= {f"pelvis_sigma_{unit}_{axis}" for unit in ("mm", "deg") for axis in ("is", "lr", "ap")}
    wanted |= {"tip_mm", "tip_mm_is", "tip_mm_lr", "tip_mm_ap", "seconds_run", "seconds_total"}
    wanted |= {f"miss_{unit}{axis}" for unit in ("mm", "deg") for axis in ("", "_is", "_lr", "_ap")}
    wanted |= {"evaluations_pelvis_in_view_1", "seconds_pelvis_in_view_1"}
    assert wanted <= set(table.column_names)


def test_a_first_run_that_tells_little_leaves_the_columns_in_their_order(records: list[dict[str, Any]]) -> None:
    names = table_of([records[6] | {"varied": {}}, *records]).column_names
    assert names[:12] == [*HEAD, "varied_dose", "status"]
    assert names[-1] == "host"
    assert names.index("pelvis_mm") < names.index("evaluations_pelvis_in_view_1") < names.index("seconds_run")


def test_errors_are_named_and_signed(records: list[dict[str, Any]]) -> None:
    (row,) = rows_of(records[0])
    error = records[0]["errors"]["pelvis"]
    assert row["pelvis_mm"] == error["mm"]
    assert [row[f"pelvis_deg_{axis}"] for axis in ("is", "lr", "ap")] == error["deg_xyz"]
    assert row["tip_mm"] == records[0]["errors"]["tip_mm"]
    assert [row[f"miss_mm_{axis}"] for axis in ("is", "lr", "ap")] == records[0]["miss"]["mm_xyz"]
    assert row["start_pelvis_deg"] == records[0]["start_errors"]["pelvis"]["deg"]


def test_deviations_lie_along_the_axes_of_the_errors(records: list[dict[str, Any]]) -> None:
    """Deviations are told along the camera's x, y and z, errors along IS (−y), LR (x) and AP (z)."""
    done = [record for record in records if record["refused"] is None]
    found = {(c.object, c.unit): c for c in coverage(frame_of(records))}
    for unit, key in (("mm", "translation_deviation_mm"), ("deg", "rotation_deviation_deg")):
        errors = np.abs([record["errors"]["pelvis"][f"{unit}_xyz"] for record in done])
        stated = np.array([record["quality"]["pelvis"][key] for record in done])[:, [1, 0, 2]]
        assert [rate.share for rate in found["pelvis", unit].within_1] == pytest.approx((errors <= stated).mean(0))


def test_deviations_of_a_view_from_a_side_have_lr_for_their_depth(records: list[dict[str, Any]]) -> None:
    done = next(record for record in records if record["refused"] is None)
    (row,) = rows_of(done | {"source": "left"})
    x, y, z = done["quality"]["pelvis"]["translation_deviation_mm"]
    assert [row[f"pelvis_sigma_mm_{axis}"] for axis in ("is", "lr", "ap")] == [y, z, x]


def test_types_hold_what_all_rows_have(records: list[dict[str, Any]], tmp_path: Path) -> None:
    mixed = [records[0] | {"varied": {"dose": value}} for value in (5, "open", None)]
    assert table_of(mixed)["varied_dose"].to_pylist() == ["5", "open", None]
    numbers = [records[0] | {"varied": {"dose": value}} for value in (5, 0.5)]
    assert table_of(numbers)["varied_dose"].type == pa.float64()
    table = table_of(records)
    assert table["number"].type == pa.int64()
    assert table["trusted"].type == pa.bool_()
    assert table["evaluations_pelvis_in_view_1"].type == pa.int64()
    assert table.num_rows == 8
    assert table["patient"].type == pa.string()


def test_pandas_reads_it(tmp_path: Path) -> None:
    run_study(study(8, Cheap()), tmp_path, OnThisMachine(1))
    frame = pd.read_parquet(tmp_path / TABLE_NAME)
    assert frame.pelvis_mm.notna().sum() == 7
    assert frame.trusted.dtype == bool
    assert read_table(tmp_path / TABLE_NAME).num_rows == len(frame)


def test_a_closed_loop_has_a_row_for_each_round(records: list[dict[str, Any]]) -> None:
    done = {"refused": None, "trusted": True, "reasons": [], "status": "done", "reason": ""}
    gap = {"before_mm": 9.0, "before_deg": 4.0, "left_mm": 0.5, "left_deg": 0.2}
    refused = {"refused": "dark", "trusted": False, "reasons": [], "status": "refused", "reason": "dark"}
    rounds = [{**done, **gap, "round": 1, "timings_s": {"total": 2.0}}, {**refused, **gap, "round": 2}]
    head = {
        key: records[0][key]
        for key in (
            "study",
            "condition",
            "varied",
            "number",
            "patient",
            "side",
            "seed",
            "kind",
            "preset",
            "code",
            "settings",
            "host",
            "versions",
        )
    }
    first, second = rows_of(head | done | {"rounds": rounds, "run_s": 5.0})
    assert (first["round"], first["left_mm"], first["status"], first["seconds_total"]) == (1, 0.5, "done", 2.0)
    assert (second["round"], second["status"], second["reason"], second["trusted"]) == (2, "refused", "dark", False)
    assert first["seed"] == second["seed"]
