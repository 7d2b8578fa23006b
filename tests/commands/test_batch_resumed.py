"""`femoreg batch` of twenty procedures, killed in the middle and begun again: nothing is lost, and nothing differs."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import trimesh
import yaml

from femoreg_torch.case.poses import poses_content
from femoreg_torch.drr import project
from femoreg_torch.files import write_json
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import Poses, about_point, centred_camera, exp_se3
from femoreg_torch.volume import read_mesh, voxelise_mesh

CASES = 20
PRESET = """
steps:
  - name: block
    kind: stage
    images: all
    kinds: [all]
    render: [all]
    bodies: [{move: [all], rotation_deg: [3, 3, 3], translation_mm: [4, 4, 12]}]
    level: {pixel_mm: 3, step_mm: 2}
    similarity: {kind: grad_ncc, patch_radius: 4}
    optimiser: {kind: levenberg_marquardt, candidates: 40, starts: 2, max_iterations: 8}
"""


def write_case(folder: Path, number: int) -> None:
    """A block without symmetry in a biplane of small images; it starts off by some degrees and mm."""
    folder.mkdir()
    lengths = (60, 42, 30), (34, 20, 26), (18, 14, 22)
    middles = (0, 0, 0), (8, 14, 26), (-18, -12, 24)
    parts = [trimesh.creation.box(size).apply_translation(at) for size, at in zip(lengths, middles, strict=True)]
    trimesh.boolean.union(parts).export(folder / "block.stl")
    generator = torch.Generator().manual_seed(number)

    def twist(size: tuple[float, ...]) -> torch.Tensor:
        return torch.tensor(size, dtype=torch.float64) * torch.randn(6, generator=generator, dtype=torch.float64)

    place = torch.eye(4, dtype=torch.float64)
    place[:3, 3] = torch.tensor([5.0, -8.0, 660.0])
    true = place @ exp_se3(twist((0.4, 0.4, 0.4, 4, 4, 10)))
    start = about_point(exp_se3(twist((0.02, 0.02, 0.02, 2, 2, 6))), true[:3, 3]) @ true
    isocentre = torch.tensor([0.0, 0.0, 660.0], dtype=torch.float64)
    second = about_point(exp_se3(torch.tensor([0.0, 1.0, 0.0, 0, 0, 0], dtype=torch.float64)), isocentre)
    cameras = torch.stack([torch.eye(4, dtype=torch.float64), second])
    camera = centred_camera(1020.0, (3.0, 3.0), (64, 64))
    solid = voxelise_mesh(read_mesh(folder / "block.stl"), 1.5, 20)
    light = (-project(solid, cameras @ true, camera, 1.0)).exp()
    for view, image in enumerate(torch.poisson(30_000 * light, generator=generator).to(torch.uint16), 1):
        write_image(folder / f"view{view}.tif", image)
    content = {
        "version": 2,
        "objects": {"block": {"model": "block.stl", "hu": 0, "start": {"camera1_from": start.tolist()}}},
        "carm": {"sdd_mm": 1020, "pixel_mm": [3.0, 3.0], "shape": [64, 64]},
        "views": [{"image": "view1.tif"}, {"image": "view2.tif", "camera_from_camera1": second.tolist()}],
        "truth": "truth.json",
    }
    (folder / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    write_json(folder / "truth.json", poses_content(Poses(cameras, {"block": true}), "block"))


def command(cases: list[Path], out: Path, preset: Path) -> list[str]:
    run = [sys.executable, "-m", "femoreg_torch.commands.main", "batch", *map(str, cases)]
    return [*run, "--out", str(out), "--preset", str(preset), "--jobs", "2"]


def table(out: Path) -> list[dict[str, str]]:
    with (out / "table.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.long
def test_a_batch_that_is_killed_goes_on_without_loss(tmp_path: Path) -> None:
    cases = [tmp_path / f"case{number:02}" for number in range(CASES)]
    for number, case in enumerate(cases):
        write_case(case, number)
    (tmp_path / "preset.yaml").write_text(PRESET, encoding="utf-8")
    whole, killed = tmp_path / "whole", tmp_path / "killed"

    process = subprocess.Popen(command(cases, killed, tmp_path / "preset.yaml"), start_new_session=True)
    deadline = time.monotonic() + 900  # a busy machine takes minutes
    while len(list(killed.glob("case*/result.json"))) < 6:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)  # the command alone: its processes have to notice
    process.wait()
    while alive(process.pid):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    done = {path.parent.name: path.stat().st_mtime_ns for path in killed.glob("case*/result.json")}
    assert 6 <= len(done) < CASES
    for path in killed.glob("case*/result.json"):
        json.loads(path.read_text(encoding="utf-8"))  # whole

    for out in (killed, whole):
        subprocess.run(command(cases, out, tmp_path / "preset.yaml"), check=True)
    rows, expected = table(killed), table(whole)
    assert [row["case"] for row in rows] == [case.name for case in cases]
    assert {row["case"] for row in rows if row["status"] == "kept"} == set(done)
    assert all(killed.joinpath(name, "result.json").stat().st_mtime_ns == at for name, at in done.items())
    for row, other in zip(rows, expected, strict=True):
        assert other["status"] == "done"
        assert float(row["block_mm"]) < 1.0
        same = [key for key in row if key not in ("status", "seconds")]
        assert {key: row[key] for key in same} == {key: other[key] for key in same}
        found = [json.loads((out / row["case"] / "result.json").read_text(encoding="utf-8")) for out in (killed, whole)]
        assert found[0]["camera_from_block"] == found[1]["camera_from_block"]
    assert not [path for path in killed.iterdir() if path.name.startswith(".")]
