"""`RUN/result.json`: a `Result` as JSON, and back."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from femoreg_torch.case.fields import Fields
from femoreg_torch.case.poses import poses_content
from femoreg_torch.case.quality import CameraQuality, ObjectQuality, ViewQuality
from femoreg_torch.case.result import LandmarkRecord, Result, StartRecord
from femoreg_torch.case.trace import Moment, Restart, StageRecord, changes_content, moments_content
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.geometry import CameraChange, Poses, poses_by_object
from femoreg_torch.paths import check_readable

RESULT_NAME = "result.json"
SCHEMA = 2
_KNOWN = (1, SCHEMA)
_NAN = float("nan")
_MANY = 2**53  # evaluations


def result_content(result: Result) -> dict[str, Any]:
    """Everything that `result.json` holds; matrices are tensors, mm."""
    content: dict[str, Any] = {"version": SCHEMA, **poses_content(result.poses, result.anchor)}
    if result.path is not None and result.object_from_tool is not None:
        content[f"{result.path[0]}_from_{result.path[1]}"] = result.object_from_tool
    if result.poses.changes:
        content["carm_refined"] = _cameras_content(result)
    content |= {
        "points_camera1": result.points_camera1,
        "directions_camera1": result.directions_camera1,
        **({} if result.path_covariance is None else {"path_covariance": result.path_covariance}),
        "quality": {name: asdict(value) for name, value in result.quality.items()},
        "trusted": result.verdict.trusted,
        "reasons": result.verdict.reasons,
        "doubts": result.doubts,
        "skipped": result.skipped,
    }
    if result.start is not None:
        content["start"] = _start_content(result.start)
    content |= {
        "stages": [_stage_content(stage) for stage in result.stages],
        "timings_s": result.timings_s,
        "preset": result.preset,
        "seed": result.seed,
        "versions": result.versions,
    }
    if result.inputs:
        content["inputs"] = result.inputs
    if result.case_files:
        content["case_files"] = result.case_files
    if result.errors is not None:
        content["errors"] = result.errors
    if result.case is not None:
        content["case"] = result.case
    return content


def _cameras_content(result: Result) -> list[dict[str, Any]]:
    """Every view's change against the C-arm's file, with the camera that it leads to where that is told."""
    cameras: list[dict[str, Any]] = [asdict(camera) for camera in result.cameras] or [{} for _ in result.poses.changes]
    return [camera | asdict(change) for camera, change in zip(cameras, result.poses.changes, strict=True)]


def _start_content(start: StartRecord) -> dict[str, Any]:
    return {
        "source": start.source,
        "landmarks": {name: asdict(mark) for name, mark in start.landmarks.items()},
        "reprojection_rms_px": start.reprojection_rms_px,
        "silhouette_overlap": start.silhouette_overlap,
        f"camera1_from_{start.object}": start.camera1_from_object,
    }


def _stage_content(stage: StageRecord) -> dict[str, Any]:
    return {
        "name": stage.name,
        "view": stage.view,
        "cost": stage.cost,
        "evaluations": stage.evaluations,
        "seconds": stage.seconds,
        "restarts": [asdict(restart) for restart in stage.restarts],
        "stop": stage.stop,
        "camera_from_camera1": stage.poses.camera_from_camera1,
        "camera1_from": stage.poses.camera1_from,
        **changes_content(stage.poses),
        "moments": moments_content(stage.moments),
    }


def read_result(run: Path) -> Result:
    """The result in the folder `run`; of a version that is not known, one that is not trusted.

    Raises `InputError` for a missing file, one that is no result, or a pose that is not rigid.
    """
    path = Path(run) / RESULT_NAME
    check_readable(path, "Name a folder with a result: `femoreg register CASE --out RUN` makes one.")
    top = Fields(read_json(path), str(path))
    poses = _poses(top)
    names = tuple(poses.camera1_from)
    views = len(poses.camera_from_camera1)
    return Result(
        poses=poses,
        quality=_quality(top, views),
        start=_start(top.mapping("start")) if "start" in top else None,
        cameras=_cameras(top),
        stages=tuple(_stage(stage, poses) for stage in (top.mappings("stages") if "stages" in top else [])),
        skipped=tuple(top.texts("skipped", "a list of sentences")) if top.content.get("skipped") else (),
        path=_path(top, names),
        points_camera1=_vectors(top, "points_camera1"),
        directions_camera1=_directions(top),
        path_covariance=top.matrix("path_covariance", (6, 6)) if "path_covariance" in top else None,
        timings_s=_numbers(top, "timings_s"),
        preset=str(top.content.get("preset", "")),
        seed=top.whole("seed", 0, 2**63 - 1) if "seed" in top else 0,
        versions={str(key): str(value) for key, value in _mapping(top, "versions").items()},
        inputs=str(top.content.get("inputs", "")),
        case_files=str(top.content.get("case_files", "")),
        errors=_mapping(top, "errors") if "errors" in top else None,
        case=top.text("case", "a folder") if "case" in top else None,
        doubts=tuple(_doubts(top)),
    )


def _doubts(top: Fields) -> list[str]:
    """What speaks against a result that was read, besides the quality of its objects."""
    doubts = top.texts("doubts", "a list of sentences") if top.content.get("doubts") else []
    version = top.content.get("version")
    if version not in _KNOWN or isinstance(version, bool):
        known = " and ".join(map(str, _KNOWN))
        doubts.append(f"its format is of version {str(version)[:20]}, and this FemoReg Torch knows {known}")
    if (
        top.content.get("trusted") is not True
        and not doubts
        and all(isinstance(q, dict) and q.get("trusted") is True for q in _mapping(top, "quality").values())
    ):
        doubts.append("the registration does not say that it can be trusted")
    return doubts


def _poses(top: Fields) -> Poses:
    """The poses, whatever the objects are called: one is known in every view, the others in camera 1."""
    anchors = [key for key in top.content if key.startswith("camera_from_") and key != "camera_from_camera1"]
    if len(anchors) != 1:
        raise InputError(
            f"{top.file}: holds no registration. One entry `camera_from_…` was expected, found {len(anchors)}."
        )
    others = [key for key in top.content if key.startswith("camera1_from_")]
    in_camera1 = {key.removeprefix("camera1_from_"): top.transform(key) for key in others}
    poses = poses_by_object(top.transforms(anchors[0]), anchors[0].removeprefix("camera_from_"), in_camera1)
    return replace(poses, changes=_changes(top, len(poses.camera_from_camera1)))


def _changes(fields: Fields, views: int) -> tuple[CameraChange, ...]:
    """How the cameras differ from the C-arm's file; nothing where they were not refined."""
    if "carm_refined" not in fields:
        return ()
    found = fields.mappings("carm_refined")
    if len(found) != views:
        raise InputError(f"{fields.where('carm_refined')}: {views} views were expected, found {len(found)}.")
    return tuple(_change(camera) for camera in found)


def _change(camera: Fields) -> CameraChange:
    x, y = camera.numbers("principal_point_shift_mm", 2)
    factor = camera.number("sdd_factor")
    if not factor > 0:
        raise InputError(f"{camera.where('sdd_factor')}: a positive number was expected, found {factor}.")
    return CameraChange(factor, (x, y))


def _cameras(top: Fields) -> tuple[CameraQuality, ...]:
    found = top.mappings("carm_refined") if "carm_refined" in top else []
    return tuple(
        CameraQuality(
            camera.number("sdd_mm"),
            _several(camera, "principal_point_px", 2),
            _number(camera, "sdd_deviation_mm"),
            _several(camera, "principal_point_deviation_px", 2),
        )
        for camera in found
        if "sdd_mm" in camera
    )


def _path(top: Fields, names: Sequence[str]) -> tuple[str, str | None] | None:
    """The object with the planned path and its tool, from the entry `<object>_from_<tool>`."""
    for name in names:
        for tool in names:
            if name != tool and f"{name}_from_{tool}" in top:
                top.transform(f"{name}_from_{tool}")
                return name, tool
    return None


def _mapping(top: Fields, key: str) -> dict[str, Any]:
    return top.mapping(key).content if key in top else {}


def _vectors(top: Fields, key: str) -> dict[str, Tensor]:
    if key not in top:
        return {}
    fields = top.mapping(key)
    return {name: fields.point(name) for name in fields.content if name in fields}


def _directions(top: Fields) -> dict[str, Tensor]:
    directions = _vectors(top, "directions_camera1")
    for name, direction in directions.items():
        if abs(float(direction.norm()) - 1) > 1e-3:
            raise InputError(
                f"{top.where('directions_camera1')}.{name}: a direction of length 1 was expected, found "
                f"{float(direction.norm()):.3g}. Register again."
            )
    return directions


def _numbers(top: Fields, key: str) -> dict[str, float]:
    fields = top.mapping(key) if key in top else Fields({}, top.file)
    return {name: fields.number(name) for name in fields.content}


def _start(start: Fields) -> StartRecord:
    poses = [key for key in start.content if key.startswith("camera1_from_")]
    if len(poses) != 1:
        raise InputError(f"{start.file}, {start.path}: one entry `camera1_from_…` was expected, found {len(poses)}.")
    marks = start.mapping("landmarks") if "landmarks" in start else Fields({}, start.file)
    return StartRecord(
        object=poses[0].removeprefix("camera1_from_"),
        camera1_from_object=start.transform(poses[0]),
        source=start.text("source", "where the start came from") if "source" in start else "landmarks of the network",
        landmarks={name: _landmark(marks.mapping(name)) for name in marks.content},
        reprojection_rms_px=_number_or_none(start, "reprojection_rms_px"),
        silhouette_overlap=_number_or_none(start, "silhouette_overlap"),
    )


def _landmark(mark: Fields) -> LandmarkRecord:
    column, row = mark.numbers("pixel", 2)
    confidence = mark.number("confidence")
    return LandmarkRecord(
        (column, row), confidence, mark.content.get("visible") is True, mark.content.get("used") is True
    )


def _number_or_none(fields: Fields, key: str) -> float | None:
    return fields.number(key) if key in fields else None


def _quality(top: Fields, views: int) -> dict[str, ObjectQuality]:
    if "quality" not in top:
        return {}
    fields = top.mapping("quality")
    return {name: _object_quality(fields.mapping(name), views) for name in fields.content}


def _object_quality(fields: Fields, count: int) -> ObjectQuality:
    """The quality of one object in so many views; a measure that is missing or was no number is nan."""
    views = fields.mappings("views") if "views" in fields else []
    displacement = fields.numbers("displacement", 2) if "displacement" in fields else None
    reason = fields.content.get("reason")
    return ObjectQuality(
        views=tuple(
            ViewQuality(
                view=view.whole("view", 1, count),
                similarity=_number(view, "similarity"),
                gain=_number(view, "gain"),
                pull_mm=_several(view, "pull_mm", 2),
            )
            for view in views
        ),
        in_plane_uncertainty_mm=_number(fields, "in_plane_uncertainty_mm"),
        common_pull=_several(fields, "common_pull", 2),
        rotation_deviation_deg=_several(fields, "rotation_deviation_deg", 3),
        translation_deviation_mm=_several(fields, "translation_deviation_mm", 3),
        displacement=None if displacement is None else (displacement[0], displacement[1]),
        trusted=fields.content.get("trusted") is True,
        reason=reason if isinstance(reason, str) else "no reason given",
        turn_told=fields.content.get("turn_told") is not False,
        rotation_deviation_with_carm_deg=_several(fields, "rotation_deviation_with_carm_deg", 3),
        translation_deviation_with_carm_mm=_several(fields, "translation_deviation_with_carm_mm", 3),
    )


def _number(fields: Fields, key: str) -> float:
    return fields.number(key) if key in fields else _NAN


def _several(fields: Fields, key: str, count: int) -> Any:
    """So many numbers; those that stand as null, and all where the key is missing, are nan."""
    if key not in fields:
        return (_NAN,) * count
    value = fields.content[key]
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"{fields.where(key)}: {count} numbers were expected.")
    items = fields.inside({f"{key}[{n}]": item for n, item in enumerate(value)})
    return tuple(_number(items, name) for name in items.content)


def _stage(stage: Fields, poses: Poses) -> StageRecord:
    """One step of a registration that ended at `poses`."""
    placed = _placed(stage, replace(poses, changes=()))
    return StageRecord(
        name=stage.text("name", "the name of the stage"),
        view=stage.whole("view", 1, len(poses.camera_from_camera1)) if "view" in stage else None,
        cost=_number(stage, "cost"),
        evaluations=stage.whole("evaluations", 0, _MANY),
        seconds=_number(stage, "seconds"),
        stop=str(stage.content.get("stop", "")),
        poses=placed,
        restarts=tuple(
            Restart(_number(end, "cost"), _number(end, "apart_deg"), _number(end, "apart_mm"))
            for end in (stage.mappings("restarts") if "restarts" in stage else [])
        ),
        moments=tuple(
            Moment(moment.whole("evaluations", 0, _MANY), _number(moment, "cost"), _placed(moment, placed))
            for moment in (stage.mappings("moments") if "moments" in stage else [])
        ),
    )


def _placed(fields: Fields, otherwise: Poses) -> Poses:
    """The poses of a stage or a moment; those that it does not tell are `otherwise`."""
    poses = otherwise
    if "camera_from_camera1" in fields:
        cameras = fields.transforms("camera_from_camera1")
        if len(cameras) != len(otherwise.camera_from_camera1):
            raise InputError(
                f"{fields.where('camera_from_camera1')}: {len(otherwise.camera_from_camera1)} views were expected, "
                f"found {len(cameras)}."
            )
        poses = replace(poses, camera_from_camera1=cameras)
    if "carm_refined" in fields:
        poses = replace(poses, changes=_changes(fields, len(poses.camera_from_camera1)))
    placed = fields.mapping("camera1_from")
    for name in placed.content:
        poses = poses.with_object(name, placed.transform(name))
    return poses
