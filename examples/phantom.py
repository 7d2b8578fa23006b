"""A phantom with nothing of a hip in it: two CAD models, no CT, and a C-arm of one's own.

A block with steps and a rod, each moved by itself, seen by a C-arm that tells where it stands.
"""

import sys
import tempfile
from pathlib import Path
from typing import Any

import torch
import trimesh
import yaml

import femoreg_torch as femoreg
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import about_point, exp_so3, pose_difference, rigid
from femoreg_torch.volume import read_mesh

CARM = "extends: cios_fusion\nsdd_mm: 1100\npixel_mm: [0.8, 0.8]\nshape: [384, 384]\nisocentre_mm: [0, 0, 680]\n"
# The shipped preset, but for the light scattered into the phantom's shadow, which was measured (share of open field).
SCATTER = 0.15
PRESET = f"""
extends: rigid
steps:
  - {{name: everything together, imaging: {{scatter: {SCATTER}}}}}
  - {{name: "everything together, fine", imaging: {{scatter: {SCATTER}}}}}
"""
PLASTIC_HU = 0


def float64(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def write_models(folder: Path) -> None:
    """A block with steps, and a rod with a knob at one end; mm."""
    steps = [trimesh.creation.box((110, 80 - 24 * n, 36)).apply_translation((12 * n, 8 * n, 36 * n)) for n in range(3)]
    trimesh.boolean.union(steps).export(folder / "block.stl")
    rod = trimesh.creation.cylinder(7, 160)
    knob = trimesh.creation.box((40, 18, 14)).apply_translation((11, 0, 72))
    trimesh.boolean.union([rod, knob]).export(folder / "rod.stl")


def write_case(folder: Path) -> femoreg.Poses:
    """Models, images and `case.yaml`; returns the true poses."""
    write_models(folder)
    (folder / "carm.yaml").write_text(CARM, encoding="utf-8")
    carm = femoreg.load_carm(folder / "carm.yaml")
    block = rigid(exp_so3(float64(0.4, 0.6, -0.2)), float64(-25, -10, 680))
    rod = rigid(exp_so3(float64(-0.3, 0.9, 0.4)), float64(40, 10, 640))
    camera2 = (
        about_point(rigid(exp_so3(float64(0.01, -0.004, 0.01))), float64(0, 0, 680)) @ carm.orbit(float64(-0.7))[0]
    )
    truth = femoreg.Poses(torch.stack([torch.eye(4, dtype=torch.float64), camera2]), {"block": block, "rod": rod})

    def moved(pose: torch.Tensor, turn: tuple[float, ...], shift: tuple[float, ...]) -> list[list[float]]:
        return (rigid(translation=float64(*shift)) @ pose @ rigid(exp_so3(float64(*turn)))).tolist()

    start = moved(block, (0.03, -0.02, 0.02), (4, -3, 15))
    beside = torch.linalg.inv(block) @ torch.tensor(moved(rod, (-0.02, 0.02, 0.01), (-2, 1, 4)), dtype=torch.float64)
    content: dict[str, Any] = {
        "version": 2,
        "objects": {
            "block": {"model": "block.stl", "hu": PLASTIC_HU, "start": {"camera1_from": start}},
            "rod": {
                "model": "rod.stl",
                "hu": PLASTIC_HU,
                "points": {"tip": [0, 0, -80], "base": [0, 0, 80]},
                "reference": [0, 0, 0],
                "start": {"beside": "block", "beside_from_object": beside.tolist()},
            },
        },
        "plan": {"object": "block", "entry_point": [55, 0, 0], "target": [-55, 0, 0], "tool": "rod"},
        "carm": "carm.yaml",
        "views": [{"image": "view1.tif"}, {"image": "view2.tif", "camera_from_camera1": camera2.tolist()}],
    }
    solids = [
        femoreg.voxelise_mesh(read_mesh(folder / f"{name}.stl"), 0.4, hu) for name, hu in (("block", 20), ("rod", 60))
    ]
    for view in range(2):
        poses = torch.stack([truth.camera_from(name)[view] for name in ("block", "rod")])[None]
        primary = (-femoreg.project(solids, poses, carm.camera, step_mm=0.3)[0]).exp()
        counts = torch.poisson(30_000 * (primary + SCATTER), generator=torch.Generator().manual_seed(view))
        write_image(folder / f"view{view + 1}.tif", counts.clamp(1, 65535).to(torch.uint16))
    (folder / "case.yaml").write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return truth


def main(folder: Path) -> dict[str, Any]:
    """Make the case, register it, and return how far the objects are off."""
    truth = write_case(folder)
    case = femoreg.read_case(folder)
    (folder / "preset.yaml").write_text(PRESET, encoding="utf-8")
    result = femoreg.register(case, folder / "preset.yaml")
    print(result.verdict.sentence)
    errors = {}
    for name, pose in result.poses.camera1_from.items():
        deg, mm = pose_difference(truth.camera1_from[name], pose, float64(0, 0, 0))
        errors[name] = {"mm": mm, "deg": deg}
        print(f"{name}: {mm:.2f} mm, {deg:.2f}°")
    return errors


if __name__ == "__main__":
    if len(sys.argv) > 1:
        out = Path(sys.argv[1])
        out.mkdir(parents=True, exist_ok=True)
        main(out)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
