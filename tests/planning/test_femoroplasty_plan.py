"""The planner on a femur of simple solids: optimum, path and its limits, offsets, files, commands."""

import dataclasses
import json
from pathlib import Path as File
from typing import Any

import meshio
import numpy as np
import pytest
import torch
import trimesh
from pyarrow import parquet, table
from scipy import ndimage

from femoreg_torch.case import Case, read_case
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.files import write_json
from femoreg_torch.planning.offsets import carried_out, directions, normal_offsets, study_offsets
from femoreg_torch.planning.path import Ellipsoid, Path, Planner, Surroundings, Worth, covered, places
from femoreg_torch.planning.plan import FemoroplastyPlan, make_plan
from femoreg_torch.planning.prepare import Prepared, prepare
from femoreg_torch.planning.report import read_plan, write_plan
from femoreg_torch.planning.settings import Planning, load_planning
from femoreg_torch.volume import Volume, read_label_map, write_landmarks, write_volume

PRESET = """extends: default
calibration: {kind: uncalibrated}
mesh: {size_mm: 7}
distribution: {steps: 2}
path: {evaluations: 360, polish: 1, lowest_entry_mm: 70, clearance_mm: 4}
diffusion: {voxel_mm: 3}
offsets: {distance_mm: 4}
"""
ML = 6.0
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
        "plan: {entry_point: [86, 5, 100], target: FH}\ncarm: cios_fusion\n"
    )
    (made / "preset.yaml").write_text(PRESET)
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
    assert nothing.yield_load_n == plan.optimum.baseline.yield_load_n
    assert 0 < plan.gain < plan.optimum_gain
    assert plan.optimum.loads_n[0] < plan.optimum.loads_n[1] < plan.optimum.loads_n[2]
    assert plan.curve.yield_load_n == max(plan.polished)


def test_the_cement_is_as_much_as_was_asked_and_in_the_marrow(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    for cement in (plan.optimum.cement, plan.cement):
        assert prepared.bone.cement_ml(cement) == pytest.approx(ML, rel=1e-6)
        assert (cement[~prepared.bone.marrow] == 0).all()
    assert sum(e.volume_ml for e in plan.path.ellipsoids) == pytest.approx(ML)


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
    assert prepared.curve(elsewhere).yield_load_n < plan.optimum.curve.yield_load_n


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
    worth = places(prepared.bone, prepared.model.grid.spread(plan.optimum.worth))
    return Planner(Surroundings(prepared.bone), worth, ML, dataclasses.replace(prepared.planning.path, **limits))


def test_same_seed_same_plan(prepared: Prepared, plan: FemoroplastyPlan) -> None:
    first, again, other = (planner(prepared, plan, evaluations=250).search(np.random.default_rng(n)) for n in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert prepared.curve(plan.cement).yield_load_n == plan.curve.yield_load_n


def test_an_ellipsoid_of_some_volume_has_its_axes() -> None:
    points = np.argwhere(np.ones((60, 60, 60))) * 0.5 - 14.75
    worth = Worth(points, np.full(len(points), 0.5**3 / 1000), np.ones(len(points)))
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
        still = carried_out(prepared, around, plan.path, plan.cement, np.zeros(3), moves)  # type: ignore[arg-type]
        assert still.yield_load_n == pytest.approx(plan.curve.yield_load_n, rel=1e-9)
    assert still.clearance_mm == pytest.approx(plan.clearances.cortex_mm)
    away = np.array([0.0, 80.0, 0.0])
    with pytest.raises(InputError, match="the path leaves the bone"):
        carried_out(prepared, around, plan.path, plan.cement, away, "path")


def test_random_offsets_have_their_mean_and_covariance(tmp_path: File) -> None:
    covariance = np.array([[1.0, 0.3, 0], [0.3, 2, 0], [0, 0, 0.5]])
    drawn = normal_offsets(np.array([1.0, -2, 0]), covariance, 20000, 0)
    np.testing.assert_allclose(drawn.mean(0), [1, -2, 0], atol=0.05)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=0.06)
    with pytest.raises(InputError, match="symmetric 3 × 3"):
        normal_offsets(np.zeros(3), -np.eye(3), 5, 0)


@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_offsets_of_a_study_are_those_of_its_trusted_runs(tmp_path: File, suffix: str) -> None:
    columns: dict[str, Any] = {
        f"femur_mm_{axis}": [n, 9.0, n] for axis, n in zip(("lr", "ap", "is"), (1.0, 2.0, 3.0), strict=True)
    }
    columns |= {f"device_mm_{axis}": [0.5, 9.0, 0.5] for axis in ("lr", "ap", "is")}
    columns["trusted"] = [True, False, True]
    if suffix == "parquet":
        parquet.write_table(table(columns), tmp_path / "runs.parquet")
    else:
        lines = [",".join(columns), *(",".join(str(values[n]) for values in columns.values()) for n in range(3))]
        (tmp_path / "runs.csv").write_text("\n".join(lines) + "\n")
    np.testing.assert_allclose(study_offsets(tmp_path, 50, 0), np.tile([0.5, 1.5, 2.5], (50, 1)))
    with pytest.raises(InputError, match="neither"):
        study_offsets(tmp_path / "elsewhere", 1, 0)


def test_files_tell_the_plan(written: File, folder: File, prepared: Prepared, plan: FemoroplastyPlan) -> None:
    content = json.loads((written / "plan.json").read_text())
    np.testing.assert_allclose(content["plan"]["entry_point"], plan.path.entry, atol=1e-9)
    assert content["planned"]["gain"] == pytest.approx(plan.gain)
    assert content["calibrated"] is False
    text = (folder / "case.yaml").read_text()
    replaced = text.replace("plan: {entry_point: [86, 5, 100], target: FH}", f"plan: {json.dumps(content['plan'])}")
    other = written / "case"
    other.mkdir()
    (other / "case.yaml").write_text(replaced)
    for name in ("ct.nii.gz", "labels.nii.gz", "landmarks.json"):
        (other / name).symlink_to(folder / name)
    read = read_case(other).plan  # as a case takes it
    assert read is not None
    np.testing.assert_allclose(read.entry_point, plan.path.entry, atol=1e-9)
    labels = read_label_map(written / "cement.nii.gz")
    assert labels.data.shape == prepared.ct.data.shape
    assert int(labels.data.sum()) == int((plan.cement >= 0.5).sum())
    middle = np.argwhere(labels.data.numpy().transpose(2, 1, 0)).mean(0) @ prepared.ct.lps_from_index.numpy()[:3, :3].T
    middle += prepared.ct.lps_from_index.numpy()[:3, 3]
    surface = trimesh.load(written / "cement.stl")
    np.testing.assert_allclose(surface.bounds.mean(0), middle, atol=6)  # type: ignore[union-attr]
    assert surface.volume / 1000 == pytest.approx(  # type: ignore[union-attr]
        int(labels.data.sum()) * prepared.bone.femur.voxel_ml, rel=0.25
    )
    fields = meshio.read(written / "fields.vtu")
    assert len(fields.cells[0].data) == len(prepared.model.mesh.elements)
    corners = fields.points[fields.cells[0].data[0]]
    sides = np.linalg.norm(corners - np.roll(corners, -1, 0), axis=1)
    np.testing.assert_allclose(sides[[0, 1, 2, 4, 5, 6]], 7.0)  # VTK's order: round the bottom, then round the top
    stored = read_plan(written)
    assert stored.planning == prepared.planning
    assert stored.path.length_mm == pytest.approx(plan.path.length_mm)
    line = json.loads((written / "path.mrk.json").read_text())["markups"][0]
    np.testing.assert_allclose(line["controlPoints"][1]["position"], plan.path.target, atol=1e-9)


def test_commands_end_to_end(folder: File, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "command"
    case, preset = str(folder), str(folder / "preset.yaml")
    assert main(["plan", case, "--out", str(out), "--volume-ml", "6", "--preset", preset, "--seed", "3"]) == 0
    assert "Calibration: uncalibrated" in capsys.readouterr().out
    assert {"plan.json", "curves.png", "overlay.png", "fields.vtu", "cement.stl"} <= {p.name for p in out.iterdir()}
    assert main(["plan-offsets", str(out)]) == 0
    offsets = json.loads((out / "offsets.json").read_text())
    assert set(offsets["outcomes"]) == SIX
    planned = json.loads((out / "plan.json").read_text())["planned"]["yield_load_n"]
    assert offsets["planned_n"] == pytest.approx(planned, rel=1e-6)
    study = folder / "study"
    study.mkdir()
    columns = {f"{name}_mm_{axis}": [0.4, -0.7] for name in ("femur", "device") for axis in ("lr", "ap", "is")}
    parquet.write_table(table(columns), study / "runs.parquet")
    assert main(["plan-robustness", str(out), "--study", str(study), "--draws", "2"]) == 0
    found = json.loads((out / "robustness.json").read_text())  # both err alike: the path is where it was planned
    assert found["gain_percent_median"] == pytest.approx(found["planned_gain_percent"])
    capsys.readouterr()


def test_commands_tell_bad_input_in_one_line(folder: File, capsys: pytest.CaptureFixture[str]) -> None:
    preset = str(folder / "preset.yaml")
    assert main(["plan", str(folder), "--out", str(folder / "no"), "--volume-ml", "400", "--preset", preset]) == 2
    told = capsys.readouterr().err
    assert told.startswith("femoreg: volume_ml: 400 ml")
    assert told.count("\n") == 1
    assert not (folder / "no").exists()
    (folder / "wrong").mkdir()
    write_json(folder / "wrong" / "plan.json", {"version": 1})
    assert main(["plan-offsets", str(folder / "wrong")]) == 2
    assert "is no plan of `femoreg plan`" in capsys.readouterr().err


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
