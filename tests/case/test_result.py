"""Results: what is written comes back, whatever the objects are called; and one verdict that fails closed."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from femoreg_torch.case import (
    CameraQuality,
    LandmarkRecord,
    ObjectQuality,
    Result,
    StageRecord,
    StartRecord,
    ViewQuality,
    read_result,
    result_content,
    write_json,
)
from femoreg_torch.case.trace import Moment, Restart
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import CameraChange, exp_se3, poses_by_object


def pose(seed: int) -> torch.Tensor:
    return exp_se3(torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))


def unit(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


GOOD = ObjectQuality(
    views=(ViewQuality(1, 0.4, 0.02, (0.1, -0.2)), ViewQuality(2, 0.5, float("nan"), (float("nan"), 0.0))),
    in_plane_uncertainty_mm=0.1,
    common_pull=(0.02, 0.3),
    rotation_deviation_deg=(0.1, 0.2, 0.3),
    translation_deviation_mm=(0.1, 0.2, 0.4),
    displacement=(1.0, 2.0),
    trusted=True,
    reason="all views agree",
    translation_deviation_with_carm_mm=(1.3, 1.2, 2.1),
)


def example(first: str = "pelvis", other: str = "femur", tool: str = "device") -> Result:
    poses = poses_by_object(torch.stack([pose(1), pose(2)]), first, {other: pose(3), tool: pose(4)})
    before = poses.with_object(other, pose(6))
    return Result(
        poses=poses,
        quality=dict.fromkeys((first, other, tool), GOOD),
        start=StartRecord(
            first, pose(5), "landmarks", {"FH-l": LandmarkRecord((10.5, 20.25), 0.9, True, True)}, 3.0, 0.96
        ),
        stages=(
            StageRecord(
                "all together", None, 0.3, 12, 1.5, "the step became small", poses, (Restart(0.01, 2.0, 3.0),),
                (Moment(1, 0.5, before), Moment(12, 0.3, poses)),
            ),
        ),
        skipped=("there are no lateral images",),
        path=(other, tool),
        points_camera1={"entry_point": unit(1, 2, 3), "tip": unit(1, 2, 4)},
        directions_camera1={"path": unit(0, 0, 1), "guide": unit(0, 0.6, 0.8)},
        timings_s={"total": 9.5},
        preset="fast",
        seed=3,
        versions={"torch": "2"},
        errors={"relative_mm": 0.1},
        case="../case",
    )  # fmt: skip


def written(folder: Path, result: Result) -> dict[str, Any]:
    write_json(folder / "result.json", result_content(result))
    return json.loads((folder / "result.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("names", [("pelvis", "femur", "device"), ("shank", "tibia", "wire")])
def test_a_result_comes_back(tmp_path: Path, names: tuple[str, str, str]) -> None:
    result = example(*names)
    content = written(tmp_path, result)
    first, other, tool = names
    assert {f"camera_from_{first}", f"camera1_from_{other}", f"camera1_from_{tool}", f"{other}_from_{tool}"} <= set(
        content
    )
    again = read_result(tmp_path)
    assert list(again.poses.camera1_from) == list(names)
    for name in names:
        torch.testing.assert_close(again.poses.camera_from(name), result.poses.camera_from(name), atol=1e-8, rtol=0)
    assert again.verdict == result.verdict
    assert again.verdict.trusted
    assert again.path == (other, tool)
    assert again.skipped == result.skipped
    assert (again.preset, again.seed, again.case, again.timings_s) == ("fast", 3, "../case", {"total": 9.5})
    assert again.quality[other].rotation_deviation_deg == GOOD.rotation_deviation_deg
    assert again.quality[other].translation_deviation_with_carm_mm == GOOD.translation_deviation_with_carm_mm
    assert again.quality[other].views[0] == GOOD.views[0]
    assert again.start is not None
    assert again.start.landmarks == result.start.landmarks  # type: ignore[union-attr]
    (stage,) = again.stages
    assert (stage.name, stage.view, stage.evaluations, stage.restarts) == (
        "all together",
        None,
        12,
        (Restart(0.01, 2, 3),),
    )
    torch.testing.assert_close(stage.moments[0].poses.camera1_from[other], pose(6), atol=1e-8, rtol=0)
    torch.testing.assert_close(stage.moments[0].poses.camera1_from[tool], pose(4), atol=1e-8, rtol=0)


def test_the_keys_of_a_femoroplasty_are_those_of_version_1(tmp_path: Path) -> None:
    content = written(tmp_path, example())
    assert {
        "camera_from_pelvis", "camera1_from_femur", "camera1_from_device", "femur_from_device", "points_camera1",
        "directions_camera1", "quality", "trusted", "start", "stages", "case", "timings_s", "preset", "seed",
        "versions", "errors",
    } <= set(content)  # fmt: skip
    assert {"landmarks", "reprojection_rms_px", "silhouette_overlap", "camera1_from_pelvis"} <= set(content["start"])


def test_a_result_without_a_device_comes_back(tmp_path: Path) -> None:
    content = result_content(example())
    bare = {key: value for key, value in content.items() if "device" not in key}
    del bare["quality"]["device"]
    write_json(tmp_path / "result.json", bare)
    again = read_result(tmp_path)
    assert list(again.poses.camera1_from) == ["pelvis", "femur"]
    assert again.object_from_tool is None
    assert again.verdict.trusted


DOUBTFUL: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda c: c.pop("quality"), "does not say how good it is"),
    (lambda c: c.update(quality={}), "does not say how good it is"),
    (lambda c: c.update(version=99), "version 99"),
    (lambda c: c.update(version=True), "version True"),
    (lambda c: c.pop("version"), "version None"),
    (lambda c: c.update(trusted=False), "does not say that it can be trusted"),
    (lambda c: c.pop("trusted"), "does not say that it can be trusted"),
    (lambda c: c.update(trusted="yes"), "does not say that it can be trusted"),
    (lambda c: c["quality"].pop("femur"), "femur: the result does not say how good its pose is"),
    (lambda c: c["quality"]["femur"].update(trusted=1), "femur: all views agree"),
    (lambda c: c["quality"]["femur"].pop("trusted"), "femur: all views agree"),
    (lambda c: c["quality"]["device"].update(trusted=False, reason="it is blurred"), "device: it is blurred"),
]  # fmt: skip


@pytest.mark.parametrize("n", range(len(DOUBTFUL)))
def test_what_is_not_known_to_be_trusted_is_not(tmp_path: Path, n: int) -> None:
    change, reason = DOUBTFUL[n]
    content = written(tmp_path, example())
    change(content)
    write_json(tmp_path / "result.json", content)
    verdict = read_result(tmp_path).verdict
    assert not verdict.trusted
    assert any(reason in told for told in verdict.reasons), verdict.reasons
    assert verdict.sentence.startswith("Not trusted: ")


def test_a_result_that_says_nothing_of_its_objects_is_not_trusted() -> None:
    assert not replace(example(), quality={}).verdict.trusted
    assert example().verdict.trusted
    assert result_content(replace(example(), quality={}))["trusted"] is False


SCALED = [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera1_from_femur": SCALED}, r"result\.json, camera1_from_femur: not a rigid"),
        ({"camera_from_pelvis": None}, r"camera_from_pelvis: is missing"),
        ({"points_camera1": 3}, r"points_camera1: a mapping"),
        ({"directions_camera1": {"guide": [0, 0, 0]}}, r"directions_camera1\.guide: a direction of length 1"),
        ({"quality": 3}, r"quality: a mapping"),
        ({"quality": {"femur": 1}}, r"quality\.femur: a mapping"),
        ({"stages": 4}, r"stages: a list"),
        ({"camera_from_sacrum": [SCALED]}, r"One entry `camera_from_…` was expected, found 2"),
        ({"seed": "a"}, r"seed: a whole number"),
    ],
)
def test_bad_results(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=r"result\.json"):
        read_result(tmp_path)
    content = written(tmp_path, example())
    write_json(tmp_path / "result.json", content | change)
    with pytest.raises(InputError, match=message):
        read_result(tmp_path)


def test_refined_cameras_come_back(tmp_path: Path) -> None:
    result = example()
    changes = (CameraChange(0.97, (1.0, -2.0)), CameraChange(0.97, (0.5, 0.25)))
    (stage,) = result.stages
    refined = replace(stage, poses=stage.poses.with_changes(changes))
    cameras = (
        CameraQuality(990.0, (767.5, 700.0), 2.0, (3.0, 4.0)),
        CameraQuality(990.0, (760.0, 701.0), 2.0, (3.0, 4.0)),
    )
    doubts = ("the images fit a source distance of 940 mm",)
    given = replace(
        result, poses=refined.poses, cameras=cameras, stages=(stage, refined), doubts=doubts
    )  # fmt: skip
    content = written(tmp_path, given)
    assert content["carm_refined"][0]["sdd_mm"] == 990.0
    assert content["carm_refined"][1]["principal_point_deviation_px"] == [3.0, 4.0]
    found = read_result(tmp_path)
    assert found.poses.changes == changes
    assert found.cameras == cameras
    assert [s.poses.changes for s in found.stages] == [(), changes]
    assert found.doubts == doubts
    assert found.verdict == given.verdict
    assert not found.verdict.trusted


def test_cameras_of_another_number_of_views_are_refused(tmp_path: Path) -> None:
    content = written(tmp_path, example())
    content["carm_refined"] = [{"sdd_factor": 1.0, "principal_point_shift_mm": [0, 0]}]
    (tmp_path / "result.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(InputError, match="carm_refined: 2 views were expected"):
        read_result(tmp_path)
