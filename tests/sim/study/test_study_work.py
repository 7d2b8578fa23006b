"""A run of a study is a case that is simulated, registered and measured; a recorded case is registered just so."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import yaml
from coarse import PROCEDURE, SIMULATION, stores_in

from femoreg_torch.errors import InputError
from sim.study.executors import OnThisMachine
from sim.study.protocol import Protocol, load_protocol
from sim.study.rows import TABLE_NAME, comparable, read_table
from sim.study.store import Run
from sim.study.study import plan_study, run_study
from sim.study.work import Setting, Simulated, settings_of

pytestmark = pytest.mark.usefixtures("nothing_in_doubt")
SHORT = {  # one stage: the pelvis in the first view, on pixels of 3.1 mm
    "steps": [
        {
            "name": "pelvis",
            "kind": "stage",
            "images": "first",
            "kinds": ["anatomy"],
            "render": ["pelvis"],
            "bodies": [{"move": ["pelvis", "femur"], "rotation_deg": [3, 3, 3], "translation_mm": [4, 4, 20]}],
            "level": {"pixel_mm": 3.1, "step_mm": 3.0},
            "similarity": {"kind": "grad_ncc", "patch_radius": 4},
            "optimiser": {"kind": "bobyqa", "max_evaluations": 20},
        }
    ]
}
DETECTIONS = {"mean_error_mm": 3, "missing": 0.2, "gross": 0.02}


@pytest.fixture(scope="module")
def protocol(coarse_root: Path) -> Protocol:
    (coarse_root / "short.yaml").write_text(yaml.safe_dump(SHORT), encoding="utf-8")
    content: dict[str, Any] = {
        "simulation": str(coarse_root / SIMULATION),
        "preset": str(coarse_root / "short.yaml"),
        "detections": DETECTIONS,
        "vary": [
            {"name": "plain"},
            {"name": "dark", "xray": {"dose_ugy": 20}, "views": 2},
            {"name": "off", "start": {"rotation_deg": 3, "depth_mm": 12, "lateral_mm": 5}},
        ],
    }
    (coarse_root / "protocol.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return load_protocol(coarse_root / "protocol.yaml")


@pytest.fixture(scope="module")
def settings(protocol: Protocol) -> dict[str, Setting]:
    return settings_of(protocol, "coarse")


@pytest.fixture(scope="module")
def records(coarse_root: Path, settings: dict[str, Setting]) -> dict[str, dict[str, Any]]:
    (coarse_root / "scratch").mkdir()
    work = Simulated(settings, stores_in(coarse_root), coarse_root / "overlays", coarse_root / "kept")
    make = work(PROCEDURE, coarse_root / "scratch")
    return {name: make(run_of(name)) for name in settings}


def run_of(name: str) -> Run:
    return Run("coarse", name, PROCEDURE, "s" * 16, "real", "short")


def test_a_record_is_that_of_its_condition(records: dict[str, dict[str, Any]]) -> None:
    for record in records.values():
        assert record["refused"] is None
        assert record["timings_s"]["simulation"] > 0
        assert record["errors"]["pelvis"]["mm"] < record["start_errors"]["pelvis"]["mm"] + 10
        assert set(record["displacements_mm"]) == {"entry_point", "tip"}
        for point, shift in record["displacements_mm"].items():
            assert sum(part**2 for part in shift) ** 0.5 == pytest.approx(record["errors"][f"{point}_mm"], abs=1e-6)
    assert "view3" in records["plain"]["errors"]
    assert "view3" not in records["dark"]["errors"]
    off = records["off"]["start_errors"]["pelvis"]
    assert (off["mm"], off["deg"]) == pytest.approx((13, 3), abs=1e-4)  # 12 mm deep and 5 mm aside


def test_a_record_comes_with_a_picture_and_the_error_of_the_pelvis_at_the_head(
    coarse_root: Path, records: dict[str, dict[str, Any]]
) -> None:
    picture = cv2.imread(str(coarse_root / "overlays" / f"{run_of('plain').name}.jpg"))
    assert picture is not None
    assert picture.shape[1] == 900
    assert picture.std() > 10
    pelvis = records["plain"]["errors"]["pelvis"]
    arm_mm = 200  # the head is nearer to the middle of the pelvis
    turned = arm_mm * pelvis["deg"] * math.pi / 180
    assert abs(records["plain"]["pelvis_at_head_mm"] - pelvis["mm"]) < turned


def test_cases_are_gone_unless_they_are_kept(
    coarse_root: Path, settings: dict[str, Setting], records: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    assert (coarse_root / "kept" / run_of("plain").name / "case.yaml").is_file()
    work = Simulated({"plain": settings["plain"]}, stores_in(coarse_root), coarse_root / "overlays")
    again = work(PROCEDURE, tmp_path)(run_of("plain"))
    assert {path.name for path in tmp_path.iterdir()} == {"body"}
    for key in ("errors", "start_errors", "poses"):
        assert again[key] == records["plain"][key]


def test_a_recorded_case_is_registered_as_it_is(
    coarse_root: Path, records: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    kept = coarse_root / "kept" / run_of("plain").name
    content = {"cases": [str(coarse_root / "kept" / "plain*")], "preset": str(coarse_root / "short.yaml")}
    content |= {"detections": DETECTIONS, "vary": [{"name": "again"}]}
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    plan = plan_study(str(tmp_path / "own.yaml"), None, tmp_path / "out", None, False)
    (run,) = plan.runs
    assert (run.kind, run.procedure.patient, run.procedure.side) == ("recorded", kept.name, "right")
    run_study(plan, tmp_path / "out", OnThisMachine(1))
    (row,) = comparable(read_table(tmp_path / "out" / TABLE_NAME))
    assert row["status"] == "done"
    assert row["pelvis_mm"] < records["plain"]["start_errors"]["pelvis"]["mm"] + 30
    # another image in the folder makes it another run
    (kept / "view1.tif").write_bytes((kept / "view2.tif").read_bytes())
    (changed,) = plan_study(str(tmp_path / "own.yaml"), None, tmp_path / "out", None, False).runs
    assert changed.settings != run.settings
    more = content | {"vary": [{"name": "again", "views": 9}]}
    (tmp_path / "more.yaml").write_text(yaml.safe_dump(more), encoding="utf-8")
    with pytest.raises(InputError, match=r"again, views: .* 1 to 3 views were expected, so many there are; found 9"):
        plan_study(str(tmp_path / "more.yaml"), None, tmp_path / "out", None, False)
    # and without a truth nothing can be drawn from it
    (kept / "truth.json").unlink()
    case = yaml.safe_load((kept / "case.yaml").read_text(encoding="utf-8"))
    case.pop("truth")
    (kept / "case.yaml").write_text(yaml.safe_dump(case), encoding="utf-8")
    with pytest.raises(InputError, match="has no truth"):
        plan_study(str(tmp_path / "own.yaml"), None, tmp_path / "out", None, False)


def test_settings_are_those_of_the_whole_condition(settings: dict[str, Setting]) -> None:
    plain = settings["plain"]
    assert plain.digest == replace(plain, variation=replace(plain.variation, varied={"x": 1})).digest
    assert len({setting.digest for setting in settings.values()}) == 3
    assert replace(plain, detections=None).digest != plain.digest
