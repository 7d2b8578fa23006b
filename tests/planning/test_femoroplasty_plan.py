"""The planner on a femur of simple solids: optimum, path and its limits, offsets, files, commands."""

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path as File
from typing import Any

import meshio
import numpy as np
import pytest
import torch
import trimesh
from pyarrow import parquet, table
from scipy import ndimage

from femoreg_torch.case import Case, ObjectQuality, Result, read_case, result_content, write_case
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation.report.parts import Material, Section
from femoreg_torch.evaluation.report.planning import planning
from femoreg_torch.files import write_json
from femoreg_torch.geometry import Poses
from femoreg_torch.planning.distribution import mechanism
from femoreg_torch.planning.model import with_cement
from femoreg_torch.planning.offsets import carried_out, check_run, directions, turned_ends
from femoreg_torch.planning.path import (
    Ellipsoid,
    Path,
    Planner,
    Surroundings,
    Worth,
    apart_mm,
    central_path,
    covered,
    places,
)
from femoreg_torch.planning.plan import FemoroplastyPlan, make_plan
from femoreg_torch.planning.prepare import Prepared, prepare
from femoreg_torch.planning.report import read_plan, write_plan
from femoreg_torch.planning.response import Response, read_response, response_content
from femoreg_torch.planning.settings import Planning, load_planning
from femoreg_torch.volume import Volume, read_ct, read_label_map, write_landmarks, write_volume

PRESET = """extends: default
calibration: {kind: uncalibrated}
mesh: {size_mm: 8, search_mm: 9}
distribution: {steps: 2}
path: {evaluations: 360, polish: 1, compared: 1, fine: 1, lowest_entry_mm: 70, clearance_mm: 4}
diffusion: {voxel_mm: 3}
offsets: {distance_mm: 4}
"""
ML = 6.0
ENDS = {"end superior", "end inferior", "end anterior", "end posterior"}
SIX = {"superior", "inferior", "anterior", "posterior", "medial", "lateral"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, solids: tuple[Volume, Volume, np.ndarray]) -> File:
    """A case on disk, and the preset beside it."""
    made = tmp_path_factory.mktemp("case")
    ct, labels, head = solids
    write_volume(made / "ct.nii.gz", ct)
    write_volume(made / "labels.nii.gz", labels.with_data(labels.data * 5))
    write_landmarks(made / "landmarks.json", {"FH-l": torch.from_numpy(head)})
    (made / "case.yaml").write_text(
        "version: 2\ntemplate: femoroplasty\nside: left\n"
        "ct: {image: ct.nii.gz, labels: labels.nii.gz, bones: femoreg}\nlandmarks: landmarks.json\n"
        "plan: {entry_point: [86, 5, 100], target: FH}\ncarm: cios_fusion\n",
        encoding="utf-8",
    )
    (made / "preset.yaml").write_text(PRESET, encoding="utf-8")
    return made


@pytest.fixture(scope="module")
def settings(folder: File) -> Planning:
    return load_planning(folder / "preset.yaml")


@pytest.fixture(scope="module")
def prepared(folder: File, settings: Planning) -> Prepared:
    return prepare(read_case(folder), settings)


@pytest.fixture(scope="module")
def plan(prepared: Prepared) -> FemoroplastyPlan:
    return make_plan(prepared, ML, 3)


@pytest.fixture(scope="module")
def written(folder: File, prepared: Prepared, plan: FemoroplastyPlan) -> File:
    out = folder / "plan"
    out.mkdir()
    write_plan(out, read_case(folder), prepared, plan, 3)
    return out


def test_no_cement_no_gain_and_cement_gains(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    nothing = prepared.curve(np.zeros(plan.cement.shape))
    assert nothing.yield_load_n == plan.baseline.yield_load_n
    assert 0 < plan.gain < plan.optimum_gain
    assert plan.optimum.loads_n[0] < plan.optimum.loads_n[1] < plan.optimum.loads_n[2]


def test_loads_are_told_by_finer_elements_than_those_of_the_first_search(
    prepared: Prepared, plan: FemoroplastyPlan
) -> None:
    coarse = prepared.on_elements(9.0)
    assert len(prepared.model.mesh.elements) > len(coarse.model.mesh.elements)
    assert plan.optimum.baseline.yield_load_n == coarse.curve().yield_load_n != plan.baseline.yield_load_n
    assert plan.optimum_curve.yield_load_n == prepared.curve(plan.optimum.cement).yield_load_n
    assert len(plan.tried_n) == 2  # the first and one anew
    assert len(plan.compared_n) == 2  # the better of them, and one sought on finer elements
    assert plan.curve.yield_load_n == max(plan.compared_n) == prepared.curve(plan.cement).yield_load_n


def test_the_cement_is_as_much_as_was_asked_and_in_the_marrow(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    for cement in (plan.optimum.cement, plan.cement):
        assert prepared.bone.cement_ml(cement) == pytest.approx(ML, rel=1e-6)
        assert (cement[~prepared.bone.marrow] == 0).all()
    assert sum(e.volume_ml for e in plan.path.ellipsoids) == pytest.approx(ML)


def test_cement_is_one_body(plan: FemoroplastyPlan) -> None:
    assert apart_mm(plan.path.ellipsoids) == 0
    assert ndimage.label(plan.cement >= 0.5)[1] == 1


def test_balls_of_cement_that_do_not_touch_are_apart() -> None:
    """1 ml is a ball of 6.204 mm radius, 8 ml one of twice that."""
    near, far, small = (Ellipsoid(depth, 10.0, 10.0, ml) for depth, ml in ((60.0, 8.0), (35.0, 1.0), (22.0, 1.0)))
    assert apart_mm([near, far]) == pytest.approx(25 - 3 * 6.2035, abs=1e-3)
    assert apart_mm([near, far, small]) == pytest.approx(25 - 3 * 6.2035 + 13 - 2 * 6.2035, abs=1e-3)
    assert apart_mm([far, dataclasses.replace(small, depth_mm=23.0)]) == 0
    assert apart_mm([near]) == apart_mm([]) == 0


def test_the_optimum_beats_cement_anywhere_else(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    bone = prepared.bone
    points = bone.femur.points(np.argwhere(bone.marrow))
    far = np.linalg.norm(points - bone.femur.frame.head, axis=1)
    elsewhere = np.zeros(bone.pores.shape)
    order = np.argsort(far)  # all of it around the middle of the head
    sums = np.cumsum(bone.pores[bone.marrow][order]) * bone.femur.voxel_ml
    chosen = np.zeros(len(order))
    chosen[order[sums < ML]] = 1
    elsewhere[bone.marrow] = chosen
    assert prepared.curve(elsewhere).yield_load_n < plan.optimum_curve.yield_load_n


def test_the_path_keeps_its_limits(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    """Depth by a distance transform of its own, along the path as it stands in the plan."""
    limits, path, femur = prepared.planning.path, plan.path, prepared.bone.femur
    assert plan.clearances.excess(limits) == 0
    depths = np.arange(limits.entry_free_mm, path.length_mm, 0.25)
    index = femur.index(path.entry + depths[:, None] * path.direction).T
    depth = ndimage.distance_transform_edt(femur.mask, sampling=femur.spacing)
    along = ndimage.map_coordinates(depth, index, order=1)
    assert along.min() >= limits.clearance_mm - 0.5
    assert np.linalg.norm(path.target - femur.frame.head) <= limits.target_mm + 1e-9
    on_surface = ndimage.map_coordinates(femur.depth(), femur.index(path.entry)[:, None], order=1)
    assert on_surface[0] == pytest.approx(0, abs=0.3)
    assert (path.entry - femur.frame.head) @ femur.frame.lateral > 20
    assert [e.depth_mm for e in path.ellipsoids] == sorted((e.depth_mm for e in path.ellipsoids), reverse=True)


def planner(prepared: Prepared, plan: FemoroplastyPlan, **limits: Any) -> Planner:
    searched = prepared.on_elements(prepared.planning.mesh.search_mm)
    worth = places(prepared.bone, searched.model, plan.optimum.mechanisms, prepared.planning.cement)
    return Planner(Surroundings(prepared.bone), worth, ML, dataclasses.replace(prepared.planning.path, **limits))


def test_same_seed_same_plan(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    first, again, other = (planner(prepared, plan, evaluations=250).search(np.random.default_rng(n)) for n in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert prepared.curve(plan.cement).yield_load_n == plan.curve.yield_load_n


def test_a_mechanism_bounds_what_cement_can_bear(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    """Of its own state a mechanism tells the load that it had; of all others it is told that none bears much more."""
    model, bone, cement = prepared.model, prepared.bone, prepared.planning.cement
    rise = cement.strength_mpa * model.fill - model.material.tension
    placed = [np.zeros(bone.pores.shape), plan.optimum.cement, plan.cement]
    with_it = [with_cement(model, bone, share, cement) for share in placed]
    curves = [prepared.press.curve(material, prepared.planning.curve) for material in with_it]
    loads = [curve.yield_load_n for curve in curves]
    ways = [mechanism(curve, material) for curve, material in zip(curves, with_it, strict=True)]
    for own, way in enumerate(ways):
        alone, more = way.bound(model.material.tension, rise)
        bounds = [alone + float((more * model.cement_share(share)).sum()) for share in placed]
        assert bounds[own] == pytest.approx(loads[own], rel=0.02)  # voxels mix before they are averaged
        for bound, load in zip(bounds, loads, strict=True):
            assert bound > 0.8 * load  # yield comes before the limit load, so it is a bound only about
    worth = places(bone, model, ways, cement)
    assert worth.load(np.zeros(len(worth.room_ml))) == pytest.approx(min(worth.base))
    assert worth.base[0] == pytest.approx(1.0)
    everywhere = worth.base[0] + worth.worth[0] @ worth.room_ml  # all of the marrow
    alone, more = ways[0].bound(model.material.tension, rise)
    filled = alone + float((more * model.cement_share(bone.marrow.astype(float))).sum())
    assert everywhere == pytest.approx(filled / loads[0], rel=0.05)


def test_an_ellipsoid_of_some_volume_has_its_axes() -> None:
    points = np.argwhere(np.ones((60, 60, 60))) * 0.5 - 14.75
    worth = Worth(points, np.full(len(points), 0.5**3 / 1000), np.ones(1), np.ones((1, len(points))))
    axes = np.array([[2.0, 1.0]])
    filled, _, scale = covered(np.array([0, 0, 1.0]), np.zeros((1, 3)), axes, worth, 2.0)
    assert scale == pytest.approx((2000 / (4 / 3 * np.pi * 2)) ** (1 / 3), rel=0.01)
    assert np.abs(points[filled][:, 2]).max() == pytest.approx(2 * scale, abs=0.5)


def test_limits_that_no_path_keeps_and_too_much_cement_are_told(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    with pytest.raises(InputError, match=r"path: none keeps all limits\. The nearest one: .* mm to the cortex"):
        planner(prepared, plan, clearance_mm=30.0, evaluations=200).search(np.random.default_rng(0))
    with pytest.raises(InputError, match="volume_ml: 500 ml of cement, but the marrow space"):
        make_plan(prepared, 500.0, 0)


def test_offsets_move_along_the_patient_and_not_moved_is_as_planned(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    assert set(directions("left")) == SIX
    np.testing.assert_array_equal(directions("left")["medial"], -directions("right")["medial"])
    around = Surroundings(prepared.bone)
    for moves in ("path", "pattern"):
        still = carried_out(prepared, around, plan.path, plan.cement, np.zeros(6), moves)  # type: ignore[arg-type]
        assert still.yield_load_n == pytest.approx(plan.curve.yield_load_n, rel=1e-9)
    assert still.clearance_mm == pytest.approx(plan.clearances.cortex_mm)
    away = np.array([0.0, 80.0, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="the path leaves the bone"):
        carried_out(prepared, around, plan.path, plan.cement, away, "path")


def test_files_tell_the_plan(
    written: File,
    folder: File,
    prepared: Prepared,
    plan: FemoroplastyPlan,
    against_schema: Callable[[str, Any], list[str]],
) -> None:
    content = json.loads((written / "plan.json").read_text(encoding="utf-8"))
    assert not against_schema("plan", content)
    assert against_schema("plan", content | {"unit": "m"})
    np.testing.assert_allclose(content["plan"]["entry_point"], plan.path.entry, atol=1e-9)
    assert content["planned"]["gain"] == pytest.approx(plan.gain)
    assert content["calibrated"] is False
    text = (folder / "case.yaml").read_text(encoding="utf-8")
    replaced = text.replace("plan: {entry_point: [86, 5, 100], target: FH}", f"plan: {json.dumps(content['plan'])}")
    other = written / "case"
    other.mkdir()
    (other / "case.yaml").write_text(replaced, encoding="utf-8")
    for name in ("ct.nii.gz", "labels.nii.gz", "landmarks.json"):
        (other / name).symlink_to(folder / name)
    read = read_case(other).plan  # as a case takes it
    assert read is not None
    np.testing.assert_allclose(read.entry_point, plan.path.entry, atol=1e-9)
    labels = read_label_map(written / "cement.nii.gz")
    assert labels.data.shape == prepared.ct.data.shape
    assert int(labels.data.sum()) == int((plan.cement >= 0.5).sum())
    voxels = np.argwhere(labels.data.numpy().transpose(2, 1, 0))
    middle = (voxels.min(0) + voxels.max(0)) / 2 @ prepared.ct.lps_from_index.numpy()[:3, :3].T
    middle += prepared.ct.lps_from_index.numpy()[:3, 3]
    surface = trimesh.load(written / "cement.stl")
    np.testing.assert_allclose(surface.bounds.mean(0), middle, atol=1e-6)  # type: ignore[union-attr]
    assert surface.volume / 1000 == pytest.approx(  # type: ignore[union-attr]
        int(labels.data.sum()) * prepared.bone.femur.voxel_ml, rel=0.25
    )
    fields = meshio.read(written / "fields.vtu")
    assert len(fields.cells[0].data) == len(prepared.model.mesh.elements)
    corners = fields.points[fields.cells[0].data[0]]
    sides = np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1)
    np.testing.assert_allclose(sides[[0, 1, 2, 4, 5, 6]], 8.0)  # VTK's order: round the bottom, then round the top
    stored = read_plan(written)
    assert stored.planning == prepared.planning
    assert stored.path.length_mm == pytest.approx(plan.path.length_mm)
    line = json.loads((written / "path.mrk.json").read_text(encoding="utf-8"))["markups"][0]
    np.testing.assert_allclose(line["controlPoints"][1]["position"], plan.path.target, atol=1e-9)


def test_commands_end_to_end(
    folder: File, capsys: pytest.CaptureFixture[str], against_schema: Callable[[str, Any], list[str]]
) -> None:
    out = folder / "command"
    case, preset = str(folder), str(folder / "preset.yaml")
    assert main(["plan", case, "--out", str(out), "--volume-ml", "6", "--preset", preset, "--seed", "3"]) == 0
    assert "Calibration: uncalibrated" in capsys.readouterr().out
    assert {"plan.json", "curves.png", "overlay.png", "fields.vtu", "cement.stl"} <= {p.name for p in out.iterdir()}
    assert main(["plan-offsets", str(out)]) == 0
    offsets = json.loads((out / "offsets.json").read_text(encoding="utf-8"))
    assert set(offsets["outcomes"]) == SIX | ENDS
    content = json.loads((out / "plan.json").read_text(encoding="utf-8"))
    assert "response" in content
    assert not against_schema("plan", content)
    planned = content["planned"]["yield_load_n"]
    response = read_response(out / "plan.json")
    assert response is not None
    medial = np.array([-response.distance_mm, 0, 0, 0, 0])  # of a left femur; the quadratic goes through what was run
    quadratic = response.gain_percent + response.slope @ medial + response.curvature @ medial**2 / 2
    assert quadratic == pytest.approx(offsets["outcomes"]["medial"][0]["gain_percent"])
    assert offsets["planned_n"] == pytest.approx(planned, rel=1e-6)
    study = folder / "study"
    study.mkdir()
    columns = {f"miss_{unit}_{axis}": [0.0, 0.0] for unit in ("mm", "deg") for axis in ("lr", "ap", "is")}
    parquet.write_table(table(columns), study / "runs.parquet")
    assert main(["plan-robustness", str(out), "--study", str(study), "--draws", "1"]) == 0
    found = json.loads(
        (out / "robustness.json").read_text(encoding="utf-8")
    )  # nothing misses: the path is where it was planned
    assert found["gain_percent_median"] == pytest.approx(found["planned_gain_percent"])
    assert found["study_runs"] == 2
    assert "The errors are those of 2 trusted runs of the study" in " ".join(capsys.readouterr().out.split())
    (folder / "sure.csv").write_text("0,0,0\n0,0,0\n0,0,0\n", encoding="utf-8")
    shift = ["--covariance", str(folder / "sure.csv"), "--mean", f"[{-response.distance_mm}, 0, 0]", "--draws", "1"]
    assert main(["plan-robustness", str(out), *shift]) == 0
    found = json.loads((out / "robustness.json").read_text(encoding="utf-8"))
    assert found["gain_percent_median"] == pytest.approx(offsets["outcomes"]["medial"][0]["gain_percent"])
    assert found["draws_without_marrow"] == 0
    (folder / "wide.csv").write_text("900,0,0\n0,900,0\n0,0,900\n", encoding="utf-8")
    wide = ["--covariance", str(folder / "wide.csv"), "--draws", "4", "--seed", "2"]
    assert main(["plan-robustness", str(out), *wide]) == 0
    lost = json.loads((out / "robustness.json").read_text(encoding="utf-8"))["draws_without_marrow"]
    assert 0 < lost < 4
    assert f"In {lost} of 4 draws an injection finds no marrow" in capsys.readouterr().out
    assert main(["plan-offsets", str(out), "--distance-mm", "80"]) == 2
    assert "Give a smaller --distance-mm" in capsys.readouterr().err
    bad = folder / "bad"
    bad.mkdir()
    (bad / "sure.csv").write_bytes(b"\xff\xfe1 2 3")
    hostile = {"words": columns | {"miss_mm_lr": ["a", "b"]}, "empty": {name: [] for name in [*columns, "trusted"]}}
    for name, content in hostile.items():
        (bad / name).mkdir()
        parquet.write_table(table(content), bad / name / "runs.parquet")
    (bad / "cut").mkdir()
    (bad / "cut" / "runs.parquet").write_bytes((study / "runs.parquet").read_bytes()[:99])
    for words, told in (
        (["--study", str(bad / "words")], "numbers were expected"),
        (["--study", str(bad / "empty")], "no trusted run"),
        (["--study", str(bad / "cut")], "cannot be read as Parquet"),
        (["--covariance", str(bad / "sure.csv")], "sure.csv, line 1: numbers were expected"),
        ([*wide, "--mean", "[200, 0, 0]"], "in none of 4 draws"),
        ([], "either --study or --covariance"),
        (["--covariance", str(folder / "no.csv")], "no such file"),
        (["--covariance", str(folder / "sure.csv"), "--mean", "[1, 2]"], "mean: 3 numbers"),
    ):
        assert main(["plan-robustness", str(out), *words]) == 2
        line = capsys.readouterr().err
        assert told in line
        assert line.count("\n") == 1


def other_case(place: File, folder: File, side: str) -> File:
    """A case like the planned one, of a side."""
    place.mkdir()
    text = (folder / "case.yaml").read_text(encoding="utf-8")
    (place / "case.yaml").write_text(text.replace("side: left", f"side: {side}"), encoding="utf-8")
    write_landmarks(place / "landmarks.json", {"FH-l": plan_head(), "FH-r": plan_head()})
    for name in ("ct.nii.gz", "labels.nii.gz"):
        (place / name).symlink_to(folder / name)
    return place


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("weak", r"holds a yield load of \d+ N without cement, the case .*other now gives \d+ N"),
        ("cement", r"holds a yield load of \d+ N as planned, the case .* now gives \d+ N"),
        ("moved", r"does not fit the case .*other: injection at .* from any marrow"),
        ("side", r"is a plan for the left femur, the case .*other is of the right side"),
    ],
)
def test_another_case_than_the_planned_one_is_refused(
    kind: str, told: str, written: File, folder: File, tmp_path: File, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan"
    shutil.copytree(written, plan, ignore=shutil.ignore_patterns("case"))
    other = other_case(tmp_path / "other", folder, "right" if kind == "side" else "left")
    ct, labels = read_ct(folder / "ct.nii.gz"), read_label_map(folder / "labels.nii.gz")
    if kind == "weak":  # the same grid, and bone that absorbs less
        (other / "ct.nii.gz").unlink()
        weak = torch.where(labels.data > 0, 0.6 * ct.data, ct.data)
        write_volume(other / "ct.nii.gz", ct.with_data(weak))
    if kind == "moved":  # the same femur in another place
        away = torch.eye(4, dtype=torch.float64)
        away[0, 3] = 300
        for name, volume in (("ct", ct), ("labels", labels)):
            (other / f"{name}.nii.gz").unlink()
            write_volume(other / f"{name}.nii.gz", Volume(volume.data, away @ volume.lps_from_index))
        write_landmarks(other / "landmarks.json", {"FH-l": plan_head() + away[:3, 3]})
    if kind == "cement":
        content = json.loads((plan / "plan.json").read_text(encoding="utf-8"))
        content["planned"]["yield_load_n"] *= 1.02
        write_json(plan / "plan.json", content)
    (tmp_path / "sure.csv").write_text("0,0,0\n0,0,0\n0,0,0\n", encoding="utf-8")
    before = sorted(path.name for path in plan.iterdir())
    commands = [["plan-offsets"], ["plan-robustness", "--covariance", str(tmp_path / "sure.csv")]]
    for name, *options in commands if kind != "moved" else commands[:1]:
        assert main([name, str(plan), "--case", str(other), *options]) == 2
        line = capsys.readouterr().err
        assert re.search(told, line)
        assert line.count("\n") == 1
    assert sorted(path.name for path in plan.iterdir()) == before


def test_a_turned_path_keeps_its_entry_and_is_run_anew(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    around = Surroundings(prepared.bone)
    move = turned_ends(plan.path, 3.0)["end superior"]
    found = {
        moves: carried_out(prepared, around, plan.path, plan.cement, move, moves)  # type: ignore[arg-type]
        for moves in ("path", "pattern")
    }
    for outcome in found.values():
        assert outcome.offset_mm == (0.0, 0.0, 0.0)
        assert np.linalg.norm(outcome.turn_deg) == pytest.approx(np.degrees(3.0 / plan.path.length_mm))
        assert outcome.yield_load_n != plan.curve.yield_load_n
    assert found["path"].cement_ml == pytest.approx(ML)


def test_the_path_of_a_plan_is_read_by_a_case(written: File, folder: File, plan: FemoroplastyPlan) -> None:
    text = (folder / "case.yaml").read_text(encoding="utf-8")
    other = folder / "by_file"
    other.mkdir()
    for name in ("ct.nii.gz", "labels.nii.gz", "landmarks.json"):
        (other / name).symlink_to(folder / name)
    by_file = text.replace("{entry_point: [86, 5, 100], target: FH}", "{file: ../plan/plan.json}")
    (other / "case.yaml").write_text(by_file, encoding="utf-8")
    case = read_case(other)
    assert case.plan is not None
    np.testing.assert_allclose(case.plan.entry_point, plan.path.entry, atol=1e-9)
    assert case.plan.file == other / "../plan/plan.json"
    (folder / "again").mkdir()
    write_case(folder / "again", case)
    again = read_case(folder / "again").plan
    assert again is not None
    assert again.file is not None
    assert again.file.resolve() == (written / "plan.json").resolve()
    for changed, told in (
        (by_file.replace("plan.json}", "plan.json, target: FH}"), "stands in the `file` of the plan already"),
        (by_file.replace("side: left", "side: right"), "is a plan for the left femur"),
    ):
        (other / "case.yaml").write_text(changed, encoding="utf-8")
        write_landmarks(folder / "again" / "landmarks.json", {"FH-l": plan_head(), "FH-r": plan_head()})
        (other / "landmarks.json").unlink(missing_ok=True)
        (other / "landmarks.json").symlink_to(folder / "again" / "landmarks.json")
        with pytest.raises(InputError, match=told):
            read_case(other)


def test_a_registration_of_another_case_than_the_plans_is_refused(
    written: File, folder: File, tmp_path: File, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the other side, or of another patient; one of the case itself, or whose case is gone, passes."""
    good = ObjectQuality((), 0.0, (0.0, 0.0), (0.1,) * 3, (0.1,) * 3, None, True, "all views agree")
    pose = torch.eye(4, dtype=torch.float64)
    covariance = torch.eye(6, dtype=torch.float64)
    result = Result(Poses(pose[None], {"femur": pose}), {"femur": good}, path_covariance=covariance)
    case = read_case(folder)
    other = tmp_path / "other"
    shutil.copytree(folder, other, symlinks=True)
    run = tmp_path / "run"
    run.mkdir()
    for place, side, told in (
        (folder, "left", None),
        (tmp_path / "gone", "right", None),
        (folder, "right", "of the left side, and the plan is for the right one"),
        (other, "left", "whose femoral head lies 9 mm from that of the plan's case"),
    ):
        marks = {name: point + (9 if place == other else 0) * torch.eye(3)[0] for name, point in case.landmarks.items()}
        write_landmarks(other / "landmarks.json", marks)
        write_json(run / "result.json", result_content(dataclasses.replace(result, case=str(place))))
        with nullcontext() if told is None else pytest.raises(InputError, match=told):
            check_run(run / "result.json", case, side)
    words = ["--covariance", str(run / "result.json"), "--case", str(folder)]
    assert main(["plan-robustness", str(written), *words]) == 2
    assert "Give a registration of the plan's case" in " ".join(capsys.readouterr().err.split())


def test_the_report_tells_the_plan(written: File, folder: File, plan: FemoroplastyPlan) -> None:
    case = read_case(folder)
    assert case.plan is not None
    good = ObjectQuality((), 0.0, (0.0, 0.0), (0.1,) * 3, (0.1,) * 3, None, True, "all views agree")
    pose = torch.eye(4, dtype=torch.float64)
    covariance = torch.diag(torch.tensor([0.04, 0.04, 0.04, 0.01, 0.01, 0.01], dtype=torch.float64))
    result = Result(Poses(pose[None], {"femur": pose}), {"femur": good}, path_covariance=covariance)
    assert planning(Material(case, None, result, None, None)) is None  # its path is no plan's
    file = folder / "with_response.json"
    content = json.loads((written / "plan.json").read_text(encoding="utf-8"))
    sloped = Response(100 * plan.gain, np.array([5.0, 0, 0, 0, 0]), np.zeros(5), 4.0, plan.path.entry, plan.path.target)
    write_json(file, content | {"response": response_content(sloped)})
    case = dataclasses.replace(case, plan=dataclasses.replace(case.plan, file=file))
    section = planning(Material(case, None, result, None, None))
    assert isinstance(section, Section)
    assert "the modelled gain is" in section.paragraphs[0]
    assert "± 1.0 %" in section.paragraphs[0]  # 5 % per mm, 0.2 mm
    assert "research software" in section.paragraphs[-1].lower()
    loads, injections = section.tables
    assert [row[0] for row in loads.rows] == ["baseline", "planned", "optimum"]
    assert loads.rows[1][1] == f"{plan.curve.yield_load_n:.0f}"
    assert len(injections.rows) == len(plan.path.ellipsoids)


def plan_head() -> torch.Tensor:
    return torch.tensor([20.0, 0.0, 130.0], dtype=torch.float64)


def test_the_central_line_runs_along_the_neck_to_the_head(prepared: Prepared) -> None:
    around = Surroundings(prepared.bone)
    line = central_path(around, ML, prepared.planning.path)
    np.testing.assert_allclose(line.target, prepared.bone.femur.frame.head)
    np.testing.assert_allclose(-line.direction, around.neck, atol=1e-9)
    assert sum(e.volume_ml for e in line.ellipsoids) == pytest.approx(ML)
    assert [e.depth_mm / line.length_mm for e in line.ellipsoids] == pytest.approx([0.75, 0.5, 0.25])


def test_commands_tell_bad_input_in_one_line(folder: File, capsys: pytest.CaptureFixture[str]) -> None:
    preset = str(folder / "preset.yaml")
    assert main(["plan", str(folder), "--out", str(folder / "no"), "--volume-ml", "99", "--preset", preset]) == 2
    told = capsys.readouterr().err
    assert told.startswith("femoreg: volume_ml: 99 ml")
    assert told.count("\n") == 1
    assert not (folder / "no").exists()
    (folder / "wrong").mkdir()
    write_json(folder / "wrong" / "plan.json", {"version": 1})
    assert main(["plan-offsets", str(folder / "wrong")]) == 2
    assert "is no plan of `femoreg plan`" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("cut", "the left femur is cut off by the CT at the top"),
        ("pieces", "the left femur has 2 pieces"),
        ("hollow", "the left femur has holes of"),
        ("no air", "calibration: the CT has no peak of air"),
    ],
)
def test_a_case_that_cannot_be_planned_is_told_in_one_line(
    folder: File, tmp_path: File, capsys: pytest.CaptureFixture[str], change: str, told: str
) -> None:
    ct, labels = read_ct(folder / "ct.nii.gz"), read_label_map(folder / "labels.nii.gz")
    hu, data = ct.data.clone(), labels.data.clone()
    if change == "cut":
        hu, data = hu[:66], data[:66]
    elif change == "pieces":
        data[2:20, 2:8, 2:8] = 5
    elif change == "hollow":
        data[40:60, 17:23, 39:45] = 0
    else:
        hu = hu.clamp(min=-95)  # a CT cropped to the patient
    for file in ("case.yaml", "landmarks.json"):
        (tmp_path / file).symlink_to(folder / file)
    write_volume(tmp_path / "ct.nii.gz", Volume(hu, ct.lps_from_index))
    write_volume(tmp_path / "labels.nii.gz", Volume(data, labels.lps_from_index))
    preset = [] if change == "no air" else ["--preset", str(folder / "preset.yaml")]
    assert main(["plan", str(tmp_path), "--out", str(tmp_path / "out"), *preset]) == 2
    line = capsys.readouterr().err
    assert told in line
    assert line.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_path_that_leaves_the_bone_is_told_in_one_line(
    written: File, tmp_path: File, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads((written / "plan.json").read_text(encoding="utf-8"))
    for point in content["plan"].values():
        point[1] += 60.0
    (tmp_path / "cement.nii.gz").symlink_to(written / "cement.nii.gz")
    write_json(tmp_path / "plan.json", content)
    assert main(["plan-offsets", str(tmp_path)]) == 2
    line = capsys.readouterr().err
    assert "the path leaves the bone" in line
    assert line.count("\n") == 1


def test_a_case_without_a_head_is_refused(folder: File, settings: Planning) -> None:
    case: Case = read_case(folder)
    with pytest.raises(InputError, match="landmark FH-l"):
        prepare(dataclasses.replace(case, landmarks={}), settings)
    with pytest.raises(InputError, match="side: missing"):
        prepare(dataclasses.replace(case, side=None), settings)


def test_a_path_keeps_its_order() -> None:
    parts = (Ellipsoid(50.0, 8.0, 6.0, 2.0), Ellipsoid(20.0, 8.0, 6.0, 1.0))
    path = Path(np.array([0.0, 0, 0]), np.array([0.0, 0, 60]), parts)
    np.testing.assert_allclose([i.point[2] for i in path.injections()], [50, 20])
    assert [i.volume_ml for i in path.injections()] == [2.0, 1.0]
