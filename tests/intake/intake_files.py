"""A pelvis and two femora of boxes and balls, with everything of a case, as files that 3D Slicer and others write."""

import json
from pathlib import Path
from typing import Any

import cv2
import nibabel
import numpy as np
import trimesh
import yaml

from femoreg_torch.anatomy import HIP, label_table

SPACING = 4.0
SIZE = (80, 52, 60)  # x, y, z
ORIGIN = np.array([-158.0, -102.0, -118.0])  # LPS mm, of the first voxel
HEAD, ENTRY = (110.0, 0.0, -40.0), (148.0, 0.0, -70.0)  # of the left side
_LEFT = {
    "FH": HEAD, "GSN": (60.0, 38.0, 10.0), "IOF": (60.0, -18.0, -38.0), "MOF": (45.0, 10.0, -38.0),
    "SPS": (42.0, -18.0, 0.0), "IPS": (42.0, -18.0, -36.0), "ASIS": (90.0, -18.0, 58.0),
}  # fmt: skip
TIP, BASE = (0.0, 0.0, 50.0), (0.0, 0.0, -50.0)


def landmarks() -> dict[str, tuple[float, ...]]:
    """All 14, LPS mm."""
    sides = {"l": 1.0, "r": -1.0}
    points = {f"{name}-{s}": (sign * x, y, z) for name, (x, y, z) in _LEFT.items() for s, sign in sides.items()}
    return {name: points[name] for name in HIP.landmark_names}


def bones() -> dict[str, np.ndarray]:
    """Masks (x, y, z) by name; none overlap."""
    x, y, z = np.meshgrid(*(np.arange(n) * SPACING + o for n, o in zip(SIZE, ORIGIN, strict=True)), indexing="ij")
    found = {}
    for side, s in (("left", x), ("right", -x)):
        ball = (s - HEAD[0]) ** 2 + y**2 + (z - HEAD[2]) ** 2 < 22**2
        shaft = (s > 118) & (s < 150) & (abs(y) < 16) & (z < -36)
        found[f"femur_{side}"] = ball | shaft
        found[f"hip_{side}"] = (
            (s > 36) & (s < 100) & (y > -22) & (y < 42) & (z > -42) & (z < 62) & ~found[f"femur_{side}"]
        )
    found["sacrum"] = (abs(x) < 26) & (y > 42) & (y < 70) & (z > 0) & (z < 62)
    return found


def hu() -> np.ndarray:
    """The CT (x, y, z): air, a body, and bones in it."""
    x, y, _ = np.meshgrid(*(np.arange(n) * SPACING + o for n, o in zip(SIZE, ORIGIN, strict=True)), indexing="ij")
    values = np.where((x / 157) ** 2 + (y / 95) ** 2 < 1, 40, -1000).astype(np.int16)
    for mask in bones().values():
        values[mask] = 600
    return values


def ras_affine() -> np.ndarray:
    affine = np.diag([-SPACING, -SPACING, SPACING, 1.0])
    affine[:3, 3] = ORIGIN * [-1, -1, 1]
    return affine


def label_values() -> np.ndarray:
    values = np.zeros(SIZE, np.uint8)
    for name, (number, *_) in label_table("femoreg").items():
        if name in bones():
            values[bones()[name]] = number
    return values


def markups(points: dict[str, Any], space: str = "LPS", kind: str = "Fiducial") -> str:
    """As 3D Slicer writes them."""
    sign = np.array([1, 1, 1] if space == "LPS" else [-1, -1, 1])
    placed = [
        {"id": str(n), "label": name, "position": (sign * point).tolist(), "positionStatus": "defined"}
        for n, (name, point) in enumerate(points.items(), 1)
    ]
    return json.dumps({"markups": [{"type": kind, "coordinateSystem": space, "controlPoints": placed}]})


def write_files(folder: Path) -> Path:
    """CT, label map, landmarks, plan, device with its points, six images and a C-arm; no case.yaml."""
    folder.mkdir(exist_ok=True)
    nibabel.save(nibabel.Nifti1Image(hu(), ras_affine()), folder / "ct.nii.gz")
    nibabel.save(nibabel.Nifti1Image(label_values(), ras_affine()), folder / "labels.nii.gz")
    (folder / "landmarks.mrk.json").write_text(markups(landmarks()), encoding="utf-8")
    (folder / "plan.mrk.json").write_text(markups({"L-1": ENTRY, "L-2": HEAD}, "RAS", "Line"), encoding="utf-8")
    trimesh.creation.cylinder(radius=4, height=100, sections=12).export(folder / "device.stl")
    (folder / "points.mrk.json").write_text(markups({"tip": TIP, "base": BASE}), encoding="utf-8")
    generator = np.random.default_rng(1)
    for kind in ("", "_device"):
        for view in (1, 2, 3):
            image = generator.integers(1000, 50000, (48, 40)).astype(np.uint16)
            cv2.imwrite(str(folder / f"view{view}{kind}.png"), image)
    (folder / "carm.yaml").write_text("{sdd_mm: 1000, pixel_mm: [4, 4], shape: [48, 40]}\n", encoding="utf-8")
    return folder


def case_content() -> dict[str, Any]:
    """What case.yaml holds."""
    return {
        "version": 2,
        "template": "femoroplasty",
        "side": "left",
        "ct": {"image": "ct.nii.gz", "labels": "labels.nii.gz", "bones": "femoreg"},
        "landmarks": "landmarks.mrk.json",
        "plan": {"entry_point": list(ENTRY), "target": "FH"},
        "device": {
            "model": "device.stl",
            "hu": 5000,
            "points": {"tip": list(TIP), "base": list(BASE), "center": [0, 0, 0]},
            "start": {"guide": "along the planned path", "before_entry_mm": 20},
        },
        "carm": "carm.yaml",
        "views": [{"anatomy": f"view{n}.png", "device": f"view{n}_device.png"} for n in (1, 2, 3)],
    }


def write_content(folder: Path, content: dict[str, Any]) -> None:
    (folder / "case.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
