"""One coarse procedure through a short plan: what its record holds, refusals, fewer views, kept records."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from femoreg_torch.case import read_case, write_case
from femoreg_torch.files import write_json
from femoreg_torch.registration import Plan
from femoreg_torch.registration.plan import plan_from
from sim.commands import phantom, simulate
from sim.study.accuracy import line_of, register_all
from sim.study.capture import success_rates, sweep_starts
from sim.study.cases import Stores, ready
from sim.study.procedures import Procedure, Study, load_study
from sim.study.trial import run_trial

PROCEDURE = Procedure(number=1, patient="2", side="right", seed=5)
STUDY = load_study("accuracy")


def short_plan(max_evaluations: int) -> Plan:
    """One stage: the pelvis in the first view, on pixels of 3.1 mm."""
    stage = {
        "name": "pelvis",
        "kind": "stage",
        "images": "first",
        "kinds": ["anatomy"],
        "render": ["pelvis"],
        "bodies": [{"move": ["pelvis", "femur"], "rotation_deg": [3, 3, 3], "translation_mm": [4, 4, 20]}],
        "level": {"pixel_mm": 3.1, "step_mm": 3.0},
        "similarity": {"kind": "grad_ncc", "patch_radius": 4},
        "optimiser": {"kind": "bobyqa", "max_evaluations": max_evaluations},
    }
    return plan_from("short", {"steps": [stage]})


PLAN = short_plan(20)


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> Stores:
    """A coarse patient under a C-arm with 16 × 16 of its pixels in one, as the case of the procedure."""
    root = tmp_path_factory.mktemp("study")
    phantom(root / "patient", seed=2, side="right", spacing_mm=2.0)
    case = read_case(root / "patient")
    write_case(root / "patient", replace(case, carm=replace(case.carm, camera=case.carm.camera.downsampled(16))))
    stores = Stores(root / "cases", root / "patients", root / "data")
    simulate(root / "patient", out=stores.case(PROCEDURE), seed=5)
    return stores


@pytest.fixture(scope="module")
def record(stores: Stores) -> dict[str, Any]:
    return run_trial(stores.case(PROCEDURE), PROCEDURE, STUDY, PLAN)


def test_a_record_holds_start_result_and_cost(record: dict[str, Any]) -> None:
    assert record["refused"] is None
    assert set(record["errors"]) >= {"pelvis", "femur", "device", "view2", "view3", "relative_mm", "guide_deg"}
    assert set(record["start_errors"]) == {"pelvis", "femur", "device"}
    # detections of 3 mm in error: some millimetres across, some centimetres in depth
    assert 1 < record["start_errors"]["pelvis"]["mm"] < 100
    assert record["errors"]["device"] == record["start_errors"]["device"]  # the plan does not move it
    assert 4 <= record["landmarks_used"] <= 14
    assert [stage["name"] for stage in record["stages"]] == ["pelvis"]
    assert record["stages"][0]["evaluations"] == 20
    assert set(record["quality"]) == {"pelvis", "femur", "device"}
    assert "relative" in line_of(record)


def test_the_same_procedure_gives_the_same_result_bit_for_bit(record: dict[str, Any], stores: Stores) -> None:
    again = run_trial(stores.case(PROCEDURE), PROCEDURE, STUDY, PLAN)
    assert again["poses"] == record["poses"]
    assert again["errors"] == record["errors"]
    other = run_trial(stores.case(PROCEDURE), replace(PROCEDURE, seed=6), STUDY, PLAN)
    assert other["poses"] != record["poses"]


def test_a_refused_start_is_a_result(stores: Stores) -> None:
    blind: Study = replace(STUDY, detections=replace(STUDY.detections, missing=1.0))
    refused = run_trial(stores.case(PROCEDURE), PROCEDURE, blind, PLAN)
    assert "landmarks" in refused["refused"]
    assert refused["trusted"] is False
    assert refused["reasons"] == []
    assert "errors" not in refused
    assert "refused" in line_of(refused)


def test_fewer_views(stores: Stores) -> None:
    found = run_trial(stores.case(PROCEDURE), PROCEDURE, STUDY, PLAN, views=2)
    assert "view2" in found["errors"]
    assert "view3" not in found["errors"]


def test_records_are_kept_until_the_plan_changes(stores: Stores, tmp_path: Path) -> None:
    first = register_all([PROCEDURE], STUDY, stores, PLAN, tmp_path, jobs=1)[0]
    path = tmp_path / f"{PROCEDURE.name}.json"
    write_json(path, first | {"seed": -1})  # what was kept is known by this mark
    assert register_all([PROCEDURE], STUDY, stores, PLAN, tmp_path, jobs=1)[0]["seed"] == -1
    shorter = short_plan(15)
    assert register_all([PROCEDURE], STUDY, stores, shorter, tmp_path, jobs=1, reuse=True)[0]["seed"] == -1
    assert register_all([PROCEDURE], STUDY, stores, shorter, tmp_path, jobs=1)[0]["seed"] == PROCEDURE.seed


def test_starts_at_the_truth_and_off_it(stores: Stores) -> None:
    records = sweep_starts([stores.case(PROCEDURE)], PLAN, starts=1)
    rates = success_rates(records)
    assert [len(points) for points in rates.values()] == [6, 6, 6, 6]
    assert all(starts == 1 for points in rates.values() for _, _, starts in points)
    assert rates["depth"][0][1] == 1  # 20 evaluations do not lead far away from the truth
    assert rates["jointly"][-1][1] == 0  # nor from 30°, 100 mm and 40 mm back to it


def test_a_case_is_ready_once_its_origin_is_written(stores: Stores) -> None:
    assert not ready(PROCEDURE, STUDY, stores)
