"""A case folder into a `Case`, every field checked."""

from pathlib import Path
from typing import Any, cast

import torch
import yaml
from torch import Tensor

from femoreg_torch.case.fields import Fields
from femoreg_torch.case.model import DEVICE_POINTS, STRUCTURES, Case, Device, Intensity, Side, Truth, View
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.geometry import CArm, carm_from_dict, load_carm
from femoreg_torch.volume import LANDMARK_STEMS, read_landmarks

VERSION = 1
VOLUME_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd")  # of a device's volume


def read_case(folder: Path) -> Case:
    """The case whose `case.yaml` stands in `folder`. Images and volumes are not opened yet, but must exist.

    Raises `InputError` that names file and key for anything missing, unknown or of another kind than expected.
    """
    folder = Path(folder)
    path = folder / "case.yaml"
    if not path.is_file():
        raise InputError(f"{folder}: not a case folder, it holds no case.yaml. Make one with `femoreg simulate`.")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as YAML ({' '.join(str(error).split())}).") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: a mapping of keys and values was expected, found {type(content).__name__}.")
    top = Fields(content, str(path)).only(
        "version", "side", "ct", "landmarks", "plan", "device", "carm", "views", "truth"
    )
    if (version := top.value("version", str(VERSION))) != VERSION:
        raise InputError(f"{top.where('version')}: this FemoReg Torch reads version {VERSION}, found {version!r}.")
    side = cast(Side, top.choice("side", ("left", "right")))
    ct = top.mapping("ct").only("image", "labels", "structures")
    landmarks = read_landmarks(top.file_path("landmarks", folder))
    if f"FH-{side[0]}" not in landmarks:
        raise InputError(f"{top.where('landmarks')}: FH-{side[0]}, the head of the operated femur, is missing.")
    plan = top.mapping("plan").only("entry_point", "target")
    views = tuple(_view(view, folder) for view in top.mappings("views")) if "views" in top else ()
    device = _device(top.mapping("device"), folder) if "device" in top else None
    return Case(
        folder=folder,
        side=side,
        ct_path=ct.file_path("image", folder, may_be_folder=True),
        labels_path=ct.file_path("labels", folder) if "labels" in ct else None,
        structures=_structures(ct, side) if "structures" in ct or "labels" in ct else {},
        landmarks=landmarks,
        entry_point=plan.point("entry_point"),
        target=_target(plan, landmarks, side),
        device=device,
        carm=_carm(top),
        views=views,
        truth=_truth(top.file_path("truth", folder), len(views), device is not None) if "truth" in top else None,
    )


def _structures(ct: Fields, side: Side) -> dict[str, tuple[int, ...]]:
    structures = ct.mapping("structures").only(*STRUCTURES)
    for name in ("pelvis", f"femur_{side}"):
        structures.value(name, "a list of label ids")
    found: dict[str, tuple[int, ...]] = {}
    for name in structures.content:
        ids = _label_ids(structures, name)
        for other, taken in found.items():
            if shared := set(ids) & set(taken):
                raise InputError(f"{structures.where(name)}: label {min(shared)} belongs to {other} already.")
        found[name] = ids
    return found


def _label_ids(fields: Fields, key: str) -> tuple[int, ...]:
    ids = fields.value(key, "a list of label ids")
    if not isinstance(ids, list) or not ids or not all(type(n) is int and 0 < n < 256 for n in ids):
        raise InputError(f"{fields.where(key)}: a list of label ids (1 to 255) was expected, found {ids!r}.")
    return tuple(ids)


def _target(plan: Fields, landmarks: dict[str, Tensor], side: Side) -> Tensor:
    target = plan.value("target", "a landmark, as FH, or a point [x, y, z]")
    if not isinstance(target, str):
        return plan.point("target")
    if target not in LANDMARK_STEMS:
        raise InputError(
            f"{plan.where('target')}: one of {', '.join(LANDMARK_STEMS)} (of the operated side) or a point [x, y, z] "
            f"in LPS mm was expected, found {target!r}."
        )
    name = f"{target}-{side[0]}"
    if name not in landmarks:
        raise InputError(f"{plan.where('target')}: landmark {name} is not in the landmark file.")
    return landmarks[name]


def _device(device: Fields, folder: Path) -> Device:
    device.only("model", "volume", "labels", "hu", "points", "camera1_from_device")
    points = device.mapping("points").only(*DEVICE_POINTS)
    found = {name: points.point(name) for name in DEVICE_POINTS}
    if torch.equal(found["tip"], found["base"]):
        raise InputError(f"{points.where('tip')}: tip and base are the same point, so the guide has no direction.")
    path, labels = _device_model(device, folder)
    hu = device.number("hu") if "model" in device or labels else None
    return Device(path, hu, found, device.transform("camera1_from_device"), labels)


def _device_model(device: Fields, folder: Path) -> tuple[Path, tuple[int, ...] | None]:
    """The device's mesh or volume, and the labels of its voxels if it is a labelled volume."""
    if "model" in device and "volume" in device:
        raise InputError(f"{device.where('volume')}: `model` (a mesh) is given too. Keep one of the two.")
    if "volume" not in device:
        if "labels" in device:
            raise InputError(f"{device.where('labels')}: only a `volume` has labels, found `model` (a mesh).")
        path = device.file_path("model", folder)
        if path.name.lower().endswith(VOLUME_SUFFIXES):
            raise InputError(f"{device.where('model')}: a mesh was expected, found {path.name}. Give it as `volume`.")
        return path, None
    path = device.file_path("volume", folder)
    if not path.name.lower().endswith(VOLUME_SUFFIXES):
        raise InputError(
            f"{device.where('volume')}: a volume ({', '.join(VOLUME_SUFFIXES)}) was expected, found {path.name}. "
            "Give a mesh as `model`."
        )
    if "labels" in device:
        return path, _label_ids(device, "labels")
    if "hu" in device:
        raise InputError(
            f"{device.where('hu')}: a `volume` without `labels` holds HU itself. Name the labels, or drop `hu`."
        )
    return path, None


def _carm(top: Fields) -> CArm:
    value: Any = top.value("carm", "the name of a C-arm preset or {sdd_mm, pixel_mm, shape}")
    if isinstance(value, dict):
        return carm_from_dict(value, top.where("carm"))
    try:
        return load_carm(value)
    except InputError as error:
        raise InputError(f"{top.where('carm')}: {error}") from error


def _view(view: Fields, folder: Path) -> View:
    view.only("anatomy", "device", "intensity")
    return View(
        view.file_path("anatomy", folder),
        view.file_path("device", folder) if "device" in view else None,
        cast(Intensity, view.choice("intensity", ("raw", "log")) if "intensity" in view else "raw"),
    )


def _truth(path: Path, n_views: int, has_device: bool) -> Truth:
    truth = Fields(read_json(path), str(path)).only("camera_from_pelvis", "camera1_from_femur", "camera1_from_device")
    poses = truth.transforms("camera_from_pelvis")
    if n_views and len(poses) != n_views:
        raise InputError(f"{truth.where('camera_from_pelvis')}: {len(poses)} poses, but the case has {n_views} views.")
    if has_device:
        truth.value("camera1_from_device", "a 4×4 matrix (the case has a device)")
    device = truth.transform("camera1_from_device") if "camera1_from_device" in truth else None
    return Truth(poses, truth.transform("camera1_from_femur"), device)
