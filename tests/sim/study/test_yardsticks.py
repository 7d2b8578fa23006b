"""The accuracy page's procedures and conditions are studies of the engine, on cases that are made once and kept."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from cheap_study import Cheap, study
from coarse import PROCEDURE, SIMULATION, stores_in

from femoreg_torch.errors import InputError
from femoreg_torch.files import write_json
from femoreg_torch.registration.plan import Plan, plan_from
from femoreg_torch.registration.scene import Scene
from femoreg_torch.registration.workflow import Outcome
from femoreg_torch.statistics.rows import read_rows
from femoreg_torch.statistics.summary import Rate
from sim.study import __main__ as command
from sim.study.capture import plan_capture, success_rates, write_capture
from sim.study.conditions import Imaged, body_of, made_once
from sim.study.executors import OnThisMachine
from sim.study.protocol import load_protocol
from sim.study.rows import TABLE_NAME, comparable, read_table
from sim.study.study import run_study
from sim.study.work import settings_of
from sim.study.yardsticks import plan_yardstick, take_earlier

pytestmark = pytest.mark.usefixtures("nothing_in_doubt")


def test_cases_are_made_once_and_runs_are_kept(coarse_root: Path, tmp_path: Path) -> None:
    protocol = replace(load_protocol("accuracy"), simulation=str(coarse_root / SIMULATION))
    (setting,) = settings_of(protocol, "accuracy").values()
    start_alone = {"uniform": replace(setting, plan=replace(setting.plan, steps=()))}
    imaged, out = Imaged(None, tmp_path / "conditions"), tmp_path / "fast"
    plan = plan_yardstick("accuracy", protocol, start_alone, [PROCEDURE], stores_in(coarse_root), imaged, out)
    assert run_study(plan, out, OnThisMachine(1)).status == {"done": 1}
    (row,) = comparable(read_table(out / TABLE_NAME))
    assert (row["study"], row["condition"], row["number"], row["seed"]) == ("accuracy", "uniform", 1, PROCEDURE.seed)
    assert row["femur_mm"] > 0
    image = tmp_path / "conditions" / "uniform" / PROCEDURE.name / "view1.tif"
    made_at = image.stat().st_mtime_ns
    told: list[tuple[int, int, int]] = []
    run_study(plan, out, OnThisMachine(1), begin=lambda *counts: told.append(counts))
    assert told == [(0, 1, 0)]
    body = body_of(PROCEDURE, stores_in(coarse_root), imaged, tmp_path)
    assert made_once(setting.variation, PROCEDURE, setting.simulation, body, imaged) == image.parent
    assert image.stat().st_mtime_ns == made_at


@pytest.fixture
def earlier(tmp_path: Path) -> Path:
    """What versions before the engine wrote: of procedures 1 to 3 of a study, the third of another seed."""
    for run in study(3, Cheap()).runs:
        number = run.procedure.number
        content: dict[str, Any] = {
            "number": number,
            "patient": run.procedure.patient,
            "side": run.procedure.side,
            "seed": run.procedure.seed + (number == 3),
            "kind": "procedural",
            "preset": "fast",
            "code": "an earlier one",
            "refused": "too dark" if number == 2 else None,
            "trusted": number == 1,
            "reasons": [],
        }
        if number == 1:
            content["errors"] = {"pelvis": {"mm": 0.5, "deg": 0.1, "mm_xyz": [0.5, 0, 0], "deg_xyz": [0.1, 0, 0]}}
        (tmp_path / "old").mkdir(exist_ok=True)
        write_json(tmp_path / "old" / f"{run.procedure.name}.json", content)
    return tmp_path / "old"


def test_what_earlier_versions_have_measured_is_taken_over_where_it_is_asked_for(earlier: Path, tmp_path: Path) -> None:
    plan, out = study(3, Cheap()), tmp_path / "out"
    assert take_earlier(plan, out, lambda run: earlier / f"{run.procedure.name}.json") == 2
    assert take_earlier(plan, out, lambda run: earlier / f"{run.procedure.name}.json") == 0
    told: list[tuple[int, int, int]] = []
    run_study(plan, out, OnThisMachine(1), reuse=True, begin=lambda *counts: told.append(counts))
    assert told == [(1, 2, 0)]
    first, second, third = comparable(read_table(out / TABLE_NAME))
    assert (first["code"], first["status"], first["pelvis_mm"]) == ("an earlier one", "done", 0.5)
    assert (second["status"], second["reason"]) == ("refused", "too dark")
    assert third["code"] != "an earlier one"
    run_study(plan, out, OnThisMachine(1), begin=lambda *counts: told.append(counts))
    assert told[1] == (2, 1, 0)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["conditions", "--only", "uniform,fog"], "no 'fog'"),
        (["accuracy", "--preset", "quickest"], "no registration preset 'quickest'"),
        (["accuracy", "--first", "2", "--data", "nowhere"], "bmf.npz: there is no such file"),
    ],
)
def test_bad_input_is_one_line_and_no_run_is_made(
    options: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert command.main([*options, "--out", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not list(tmp_path.glob("*/runs/*"))


def test_starts_at_the_truth_and_off_it_are_runs_of_a_study(coarse_root: Path, tmp_path: Path) -> None:
    protocol = replace(load_protocol("accuracy"), simulation=str(coarse_root / SIMULATION))
    (usual,) = settings_of(protocol, "accuracy").values()
    stage = {
        "name": "pelvis",
        "kind": "stage",
        "images": "first",
        "kinds": ["anatomy"],
        "render": ["pelvis"],
        "bodies": [{"move": ["pelvis", "femur"], "rotation_deg": [3, 3, 3], "translation_mm": [4, 4, 20]}],
        "level": {"pixel_mm": 6.2, "step_mm": 3.0},
        "similarity": {"kind": "grad_ncc", "patch_radius": 2},
        "optimiser": {"kind": "bobyqa", "max_evaluations": 16},
    }
    setting = replace(usual, plan=plan_from("short", {"steps": [stage]}))
    stores, out = stores_in(coarse_root), tmp_path / "capture"
    imaged = Imaged(None, tmp_path / "conditions")
    plan = plan_capture(setting, [PROCEDURE], stores, imaged, starts=1)
    assert run_study(plan, out, OnThisMachine(1)).status == {"done": 21}  # the truth, and five levels of four sweeps
    rates = success_rates(read_rows(out / TABLE_NAME))
    assert [[rate.of for _, rate in points] for points in rates.values()] == [[1] * 6] * 4
    assert rates["depth"][0][1].met == 1  # 16 evaluations do not lead far away from the truth
    assert rates["jointly"][-1][1].met == 0  # nor from 30°, 100 mm and 40 mm back to it
    text = write_capture(read_rows(out / TABLE_NAME), setting.plan, "the command", out, tmp_path)
    assert text.startswith("`the command`: ")
    assert "on 1 simulated procedures" in text
    assert (tmp_path / "capture_short.png").is_file()
    counts: list[tuple[int, int, int]] = []
    run_study(plan, out, OnThisMachine(1), begin=lambda *told: counts.append(told))
    assert counts == [(0, 21, 0)]


def test_a_start_from_which_a_plan_cannot_run_is_refused_and_no_defect(
    coarse_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(scene: Scene, plan: Plan, start: torch.Tensor, seed: int, *_: object) -> Outcome:
        counted.append(seed)
        if len(counted) > 1:
            raise InputError("view 1, anatomy image: weights [silhouette] leave no pixel to compare.")
        return Outcome(scene, scene.start(start), (), ())  # the first, from the truth, stays there

    counted: list[int] = []
    monkeypatch.setattr("sim.study.capture.run_plan", refuses)
    protocol = replace(load_protocol("accuracy"), simulation=str(coarse_root / SIMULATION))
    (setting,) = settings_of(protocol, "accuracy").values()
    stores, imaged = stores_in(coarse_root), Imaged(None, tmp_path / "conditions")
    plan = plan_capture(setting, [PROCEDURE], stores, imaged, starts=1)
    assert run_study(plan, tmp_path / "capture", OnThisMachine(1)).status == {"done": 1, "refused": 20}
    rates = success_rates(read_rows(tmp_path / "capture" / TABLE_NAME))
    assert rates["depth"] == [(20.0 * n, Rate(int(n == 0), 1)) for n in range(6)]
