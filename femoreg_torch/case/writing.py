"""A `Case` into its folder: `case.yaml`, `landmarks.json` and `truth.json`."""

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import yaml

from femoreg_torch.case.model import Case, Device, Truth
from femoreg_torch.case.reading import VERSION
from femoreg_torch.configs import preset_names
from femoreg_torch.files import plain, write_json, write_text
from femoreg_torch.geometry import CArm, load_carm
from femoreg_torch.volume import write_landmarks


def write_case(folder: Path, case: Case) -> None:
    """Write `case.yaml` and what it refers to as text; volumes, images and the device's model must stand in place.

    Paths are written relative to `folder`, which must exist. `case.folder` is not looked at.
    """
    folder = Path(folder).resolve()
    ct: dict[str, Any] = {"image": _relative(case.ct_path, folder)}
    if case.labels_path is not None:
        ct["labels"] = _relative(case.labels_path, folder)
    if case.structures:
        ct["structures"] = {name: list(ids) for name, ids in case.structures.items()}
    at_head = torch.equal(case.target, case.femoral_head)
    content: dict[str, Any] = {
        "version": VERSION,
        "side": case.side,
        "ct": ct,
        "landmarks": "landmarks.json",
        "plan": {"entry_point": case.entry_point, "target": "FH" if at_head else case.target},
    }
    if case.device is not None:
        content["device"] = _device(case.device, folder)
    content["carm"] = _carm(case.carm)
    if case.views:
        content["views"] = [
            {key: _relative(path, folder) for key, path in (("anatomy", v.anatomy), ("device", v.device)) if path}
            | {"intensity": v.intensity}
            for v in case.views
        ]
    if case.truth is not None:
        write_json(folder / "truth.json", _truth(case.truth))
        content["truth"] = "truth.json"
    write_landmarks(folder / "landmarks.json", case.landmarks)
    text = yaml.safe_dump(plain(content), sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    write_text(folder / "case.yaml", text)


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(Path(path).resolve(), folder)).as_posix()


def _device(device: Device, folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = {}
    is_volume = device.labels is not None or device.hu is None
    content["volume" if is_volume else "model"] = _relative(device.model_path, folder)
    if device.labels is not None:
        content["labels"] = list(device.labels)
    if device.hu is not None:
        content["hu"] = device.hu
    return content | {
        "points": device.points,
        "camera1_from_device": device.camera1_from_device,
    }


def _carm(carm: CArm) -> str | dict[str, Any]:
    """The name of the preset that equals `carm`, or all its settings."""
    for name in preset_names("carm"):
        if load_carm(name) == carm:
            return name
    return asdict(carm.camera) | {"isocentre_mm": carm.isocentre_mm, "orbit_axis": carm.orbit_axis}


def _truth(truth: Truth) -> dict[str, Any]:
    return {name: poses for name, poses in asdict(truth).items() if poses is not None}
