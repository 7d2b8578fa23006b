"""Errors of a path: random moves from a study or a covariance, and the quadratic that a registration quotes."""

import dataclasses
from pathlib import Path as File
from typing import Any

import numpy as np
import pytest
import torch
from pyarrow import parquet, table

from femoreg_torch.case import ObjectQuality, Result, result_content
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.files import write_json
from femoreg_torch.geometry import Poses
from femoreg_torch.planning.offsets import end_axes, moved_by, normal_moves, read_covariance, study_moves, turned_ends
from femoreg_torch.planning.path import Path
from femoreg_torch.planning.quote import quoted_gain
from femoreg_torch.planning.response import Response, fit_response, read_response, response_content

ENTRY, TARGET = np.array([80.0, 5.0, -40.0]), np.array([20.0, -8.0, 15.0])
SLOPE, CURVATURE = np.array([-0.8, 0.3, 1.1, -0.6, 0.4]), np.array([-0.2, -0.1, 0.05, -0.3, -0.15])
PLANNED = 40.0
AXES = ("lr", "ap", "is")


def numbers_of(move: np.ndarray) -> np.ndarray:
    """The five numbers of a moved path, from where its ends then lie."""
    motion = moved_by(ENTRY, move)
    entry, target = (motion[:3, :3] @ point + motion[:3, 3] for point in (ENTRY, TARGET))
    swung = (target - TARGET) - (entry - ENTRY)
    return np.concatenate([entry - ENTRY, [swung @ axis for axis in end_axes(ENTRY, TARGET)]])


def gain_of(move: np.ndarray) -> float:
    q = numbers_of(move)
    return float(PLANNED + SLOPE @ q + CURVATURE @ q**2 / 2)


@pytest.fixture(scope="module")
def response() -> Response:
    path = Path(ENTRY, TARGET)
    ways = {
        "superior": [0, 0, 1], "inferior": [0, 0, -1], "anterior": [0, -1, 0], "posterior": [0, 1, 0],
        "medial": [-1, 0, 0], "lateral": [1, 0, 0],
    }  # fmt: skip
    moves = {name: np.array([*(4.0 * np.array(way)), 0, 0, 0]) for name, way in ways.items()} | turned_ends(path, 4.0)
    return fit_response(PLANNED, {name: gain_of(move) for name, move in moves.items()}, 4.0, ENTRY, TARGET, "left")


def test_turned_ends_swing_about_the_entry_point() -> None:
    length = np.linalg.norm(TARGET - ENTRY)
    for name, move in turned_ends(Path(ENTRY, TARGET), 2.0).items():
        q = numbers_of(move)
        np.testing.assert_allclose(q[:3], 0, atol=1e-12)
        expected = {"end superior": [2, 0], "end inferior": [-2, 0], "end anterior": [0, 2], "end posterior": [0, -2]}
        np.testing.assert_allclose(q[3:], expected[name], atol=2 * (2 / length) ** 2)
    up, front = end_axes(ENTRY, TARGET)
    assert up[2] > 0
    assert front[1] < 0
    np.testing.assert_allclose([up @ front, up @ (TARGET - ENTRY), front @ (TARGET - ENTRY)], 0, atol=1e-12)


def test_the_quadratic_is_found_again(response: Response) -> None:
    np.testing.assert_allclose(response.slope, SLOPE, atol=5e-3)  # the ends move on arcs
    np.testing.assert_allclose(response.curvature, CURVATURE, atol=5e-3)


def test_mean_and_deviation_are_those_of_many_moved_paths(response: Response) -> None:
    root = np.random.default_rng(1).normal(size=(6, 6))
    covariance = np.diag([1, 1, 1, 0.5, 0.5, 0.5]) @ (root @ root.T / 6) @ np.diag([1, 1, 1, 0.5, 0.5, 0.5])
    drawn = np.array([gain_of(move) for move in normal_moves(np.zeros(6), covariance, 2000, 0)])
    quoted = response.under(covariance)
    assert quoted.gain_percent == pytest.approx(drawn.mean(), abs=4 * drawn.std() / np.sqrt(len(drawn)))
    assert quoted.deviation_percent == pytest.approx(drawn.std(), rel=0.06)
    q = np.array([numbers_of(move) for move in normal_moves(np.zeros(6), covariance, 500, 1)])
    assert quoted.deviation_mm == pytest.approx(q.std(0).max(), rel=0.15)


def test_a_certain_registration_quotes_the_plan(response: Response) -> None:
    quoted = response.under(np.zeros((6, 6)))
    assert (quoted.gain_percent, quoted.deviation_percent, quoted.within) == (PLANNED, 0.0, True)
    assert "40 ± 0.0 %" in quoted.sentence
    far = response.under(np.diag([9.0, 0, 0, 0, 0, 0]))
    assert not far.within
    assert far.sentence.endswith("beyond the offsets that the plan was computed for.")


def test_the_response_is_kept_in_the_plan(response: Response, tmp_path: File) -> None:
    file = tmp_path / "plan.json"
    plan: dict[str, Any] = {"plan": {"entry_point": ENTRY, "target": TARGET}}
    write_json(file, plan)
    assert read_response(file) is None
    write_json(file, plan | {"response": response_content(response)})
    again = read_response(file)
    assert again is not None
    covariance = np.diag([0.3, 0.2, 0.1, 0.2, 0.2, 0.2])
    kept, made = again.under(covariance), response.under(covariance)
    assert kept.gain_percent == pytest.approx(made.gain_percent)
    assert kept.deviation_percent == pytest.approx(made.deviation_percent)
    write_json(file, plan | {"response": {"slope_percent_per_mm": [1, 2]}})
    with pytest.raises(InputError, match="is not what `femoreg plan-offsets` writes"):
        read_response(file)


def test_only_a_trusted_result_with_a_covariance_is_quoted(response: Response) -> None:
    good = ObjectQuality((), 0.0, (0.0, 0.0), (0.1,) * 3, (0.1,) * 3, None, True, "all views agree")
    pose = torch.eye(4, dtype=torch.float64)
    result = Result(
        Poses(pose[None], {"femur": pose}), {"femur": good}, path_covariance=torch.eye(6, dtype=torch.float64)
    )
    quoted = quoted_gain(response, result)
    assert quoted is not None
    assert quoted == response.under(np.eye(6))
    assert quoted_gain(None, result) is None
    assert quoted_gain(response, dataclasses.replace(result, path_covariance=None)) is None
    bad = {"femur": dataclasses.replace(good, trusted=False, reason="view 1 does not hold it")}
    assert quoted_gain(response, dataclasses.replace(result, quality=bad)) is None


def test_random_moves_have_their_mean_and_covariance() -> None:
    covariance = np.array([[1.0, 0.3, 0], [0.3, 2, 0], [0, 0, 0.5]])
    drawn = normal_moves(np.array([1.0, -2, 0]), covariance, 20000, 0)
    assert (drawn[:, 3:] == 0).all()
    np.testing.assert_allclose(drawn[:, :3].mean(0), [1, -2, 0], atol=0.05)
    np.testing.assert_allclose(np.cov(drawn[:, :3].T), covariance, atol=0.06)
    turned = normal_moves(np.zeros(6), np.diag([0, 0, 0, 1.0, 4, 0]), 20000, 0)
    np.testing.assert_allclose(turned.std(0), [0, 0, 0, 1, 2, 0], atol=0.05)


@pytest.mark.parametrize(
    ("mean", "covariance", "told"),
    [
        (np.zeros(3), -np.eye(3), "variance below 0"),
        (np.zeros(3), np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]), "is not symmetric"),
        (np.zeros(3), np.eye(4), "3 × 3"),
        (np.zeros(6), np.eye(3), "mean: 3 numbers were expected"),
        (np.zeros(3), np.full((3, 3), np.nan), "infinite or no number"),
    ],
)
def test_what_is_no_covariance_is_told(mean: np.ndarray, covariance: np.ndarray, told: str) -> None:
    with pytest.raises(InputError, match=told):
        normal_moves(mean, covariance, 5, 0)


def test_covariances_are_read_from_text_and_from_results(tmp_path: File) -> None:
    wanted = np.diag([1.0, 2.0, 3.0])
    (tmp_path / "a.csv").write_text("1, 0, 0\n0,2,0\n0,0,3\n", encoding="utf-8")
    (tmp_path / "a.txt").write_text("1 0 0\n0 2 0\n\n0 0 3\n", encoding="utf-8")
    (tmp_path / "excel.csv").write_bytes(b"\xef\xbb\xbf1,0,0\r\n0,2,0\r\n0,0,3\r\n")
    (tmp_path / "commas.csv").write_text("1,0 0,5 0\n0 2 0\n0 0 3\n", encoding="utf-8")
    (tmp_path / "bad.txt").write_text("1 0 0\n0 two 0\n", encoding="utf-8")
    for name in ("a.csv", "a.txt", "excel.csv"):
        np.testing.assert_array_equal(read_covariance(tmp_path / name), wanted)
    (tmp_path / "other.json").write_text("{}", encoding="utf-8")
    bad = {
        "other.json": "a result is read by its name",
        "bad.txt": "line 2: numbers were expected, found '0 two 0'",
        "no.txt": "no such file",
    }
    bad["commas.csv"] = "line 2: 3 numbers were found, and 5 in the lines before"
    for name, told in bad.items():
        with pytest.raises(InputError, match=told):
            read_covariance(tmp_path / name)
    good = ObjectQuality((), 0.0, (0.0, 0.0), (0.1,) * 3, (0.1,) * 3, None, True, "all views agree")
    pose = torch.eye(4, dtype=torch.float64)
    result = Result(
        Poses(pose[None], {"femur": pose}), {"femur": good}, path_covariance=2 * torch.eye(6, dtype=torch.float64)
    )
    kept = tmp_path / "result.json"
    write_json(kept, result_content(result))
    np.testing.assert_array_equal(read_covariance(kept), 2 * np.eye(6))
    for other, told in (
        (dataclasses.replace(result, path_covariance=None), "no path_covariance"),
        (dataclasses.replace(result, doubts=("the device moved",)), "is not trusted.*the device moved"),
    ):
        write_json(kept, result_content(other))
        with pytest.raises(InputError, match=told):
            read_covariance(kept)


@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_moves_of_a_study_are_those_of_its_trusted_runs(tmp_path: File, suffix: str) -> None:
    columns: dict[str, Any] = {f"miss_mm_{axis}": [1.5, 9.0, 1.5] for axis in AXES}
    columns |= {f"miss_deg_{axis}": [n, 9.0, n] for axis, n in zip(AXES, (0.0, 0.1, 0.2), strict=True)}
    columns["trusted"] = [True, False, True]
    write_runs(tmp_path, columns, suffix)
    moves, runs = study_moves(tmp_path, "left", 9, 0)
    assert runs == 2
    np.testing.assert_allclose(moves, np.tile([1.5, 1.5, 1.5, 0, 0.1, 0.2], (9, 1)), atol=1e-12)
    columns["side"] = ["right", "left", "right"]
    write_runs(tmp_path, columns, suffix)
    mirrored = np.tile([-1.5, 1.5, 1.5, 0, -0.1, -0.2], (9, 1))
    np.testing.assert_allclose(study_moves(tmp_path, "left", 9, 0)[0], mirrored, atol=1e-12)
    columns["side"] = ["Right ", "left", "RIGHT"]
    write_runs(tmp_path, columns, suffix)
    np.testing.assert_allclose(study_moves(tmp_path, "left", 9, 0)[0], mirrored, atol=1e-12)
    columns["side"] = ["right", "left", "r"]
    write_runs(tmp_path, columns, suffix)
    with pytest.raises(InputError, match="left or right, found 'r'"):
        study_moves(tmp_path, "left", 1, 0)
    columns["side"] = ["", "left", None]  # not told
    write_runs(tmp_path, columns, suffix)
    as_it_is = np.tile([1.5, 1.5, 1.5, 0, 0.1, 0.2], (9, 1))
    np.testing.assert_allclose(study_moves(tmp_path, "left", 9, 0)[0], as_it_is, atol=1e-12)
    with pytest.raises(InputError, match="neither"):
        study_moves(tmp_path / "elsewhere", "left", 1, 0)


def test_errors_where_the_tool_was_imaged_are_no_moves(tmp_path: File) -> None:
    """Tables of older versions: a turn error of the tool grows along the way to the bone, whose length they lack."""
    columns = {
        f"{name}_{unit}_{axis}": [0.1] * 3 for name in ("femur", "device") for unit in ("mm", "deg") for axis in AXES
    }
    columns |= {f"{name}_mm_{axis}": [0.1] * 3 for name in ("entry_point", "tip") for axis in AXES}
    write_runs(tmp_path, columns, "csv")
    with pytest.raises(InputError, match=r"no column miss_mm_lr.*Run the study again"):
        study_moves(tmp_path, "left", 9, 0)


def write_runs(folder: File, columns: dict[str, Any], suffix: str) -> None:
    if suffix == "parquet":
        parquet.write_table(table(columns), folder / "runs.parquet")
        return
    lines = [",".join(columns), *(",".join(str(values[n]) for values in columns.values()) for n in range(3))]
    (folder / "runs.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.mark.parametrize("order", [["plan-offsets"], ["plan-robustness", "--study", "none"]])
def test_a_case_in_the_place_of_a_plan_is_told(
    order: list[str], tmp_path: File, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "case.yaml").touch()
    assert main([order[0], str(tmp_path), *order[1:]]) == 2
    assert "holds no plan.json. Give the folder that `femoreg plan` wrote." in capsys.readouterr().err
