"""The projector's small images, with fine voxels and with voxels that fit the image, by two versions by turns.

    git worktree add ../before COMMIT
    python benchmarks/small_images.py 2b18154=../before now=. [--case FOLDER] [--turns 5] [--seconds 1]

The coarse levels of a registration draw 96 × 96 and 192 × 192 pixels of 3.1 and 1.6 mm. Voxels of 4 and 2 mm, with
steps as long, fit them. Writes a section of benchmarks/RESULTS.md.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

_SIDES_AND_MERGED = ((96, 1), (96, 4), (192, 1), (192, 2), (384, 1))  # pixels along a side, and voxels made one
_COUNTS = (1, 16)


def measure_tree(scene: Path, seconds: float) -> dict[str, float]:
    """Milliseconds per pose of each kind of call, by the version that this process imports."""
    import torch
    from measure import measure
    from torch import Tensor

    from femoreg_torch.drr import project, project_with_jacobian
    from femoreg_torch.geometry import Camera, load_carm
    from femoreg_torch.volume.grid import Volume

    stored = torch.load(scene, weights_only=True)
    centre = torch.tensor([0, 0, 800.0], dtype=torch.float64)

    def merged(count: int) -> Volume:
        """The stored volume with `count` voxels along each axis made one, by their mean."""
        data = torch.nn.functional.avg_pool3d(stored["data"][None, None], count)[0, 0].contiguous()
        corner = torch.tensor([(count - 1) / 2] * 3 + [1.0], dtype=torch.float64)
        lps_from_index = stored["lps_from_index"].clone()
        lps_from_index[:3, 3] = (lps_from_index @ corner)[:3]
        lps_from_index[:3, :3] *= count
        return Volume(data, lps_from_index)

    def forward(volume: Volume, poses: Tensor, camera: Camera, step_mm: float) -> None:
        with torch.no_grad():
            project(volume, poses, camera, step_mm)

    def gradient(volume: Volume, poses: Tensor, camera: Camera, step_mm: float) -> None:
        project(volume, poses.clone().requires_grad_(), camera, step_mm).sum().backward()

    def jacobian(volume: Volume, poses: Tensor, camera: Camera, step_mm: float) -> None:
        project_with_jacobian(volume, poses, camera, centre, step_mm)

    found = {}
    for side, count in _SIDES_AND_MERGED:
        volume, camera = merged(count), load_carm("cios_fusion").camera.downsampled(1536 // side)
        for many in _COUNTS:
            poses = stored["poses"][:many]
            for task in (forward, gradient, jacobian):
                timing = measure(partial(task, volume, poses, camera, float(count)), "cpu", seconds)
                found[f"{side} {count} {many} {task.__name__}"] = 1e3 * timing.median / many
    return found


def in_tree(tree: Path, scene: Path, seconds: float) -> dict[str, float]:
    """`measure_tree` in a process of its own that imports the package of `tree`."""
    command = [sys.executable, str(Path(__file__).resolve()), "--tree", str(tree), "--scene", str(scene)]
    command += ["--seconds", str(seconds)]
    told = subprocess.run(command, env=os.environ | {"PYTHONPATH": str(tree)}, stdout=subprocess.PIPE, check=True)
    times: dict[str, float] = json.loads(told.stdout.decode().splitlines()[-1])
    return times


def take_configs_of(tree: Path) -> None:
    """Presets stand beside the package: an installed version's would be found in place of the tree's."""
    spec = importlib.util.spec_from_file_location("femoreg_torch.configs", tree / "configs" / "__init__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["femoreg_torch.configs"] = module
    spec.loader.exec_module(module)


def main() -> None:
    """Measure and write the section of RESULTS.md."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("versions", nargs="*", metavar="LABEL=TREE", help="two of them")
    parser.add_argument("--case", type=Path, help="case folder; default: the real pelvis, or a phantom")
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=1.0, help="for each kind of call in each turn")
    parser.add_argument("--tree", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--scene", type=Path, help=argparse.SUPPRESS)
    settings = parser.parse_args()
    if settings.tree is not None:
        take_configs_of(settings.tree)
        print(json.dumps(measure_tree(settings.scene, settings.seconds)))
        return
    trees = {label: Path(tree).resolve() for label, tree in (version.split("=", 1) for version in settings.versions)}
    if len(trees) != 2:
        parser.error(f"two versions as LABEL=TREE are needed, not {len(trees)}")

    import torch
    from measure import machine, table, write_section
    from scene import default_case, pelvis, poses

    volume, title = pelvis(settings.case or default_case())
    runs: dict[str, list[dict[str, float]]] = {label: [] for label in trees}
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.pt"
        held = {"data": volume.data, "lps_from_index": volume.lps_from_index, "poses": poses(volume, max(_COUNTS))}
        torch.save(held, scene)
        for _ in range(settings.turns):  # by turns, so that a slow minute hits both
            for label, tree in trees.items():
                runs[label].append(in_tree(tree, scene, settings.seconds))
    before, now = ({key: min(run[key] for run in of) for key in of[0]} for of in runs.values())
    rows = []
    for key in before:
        side, count, many, task = key.split()
        fine = before[f"{side} 1 {many} {task}"]
        ratios = (f"{before[key] / now[key]:.2f}", f"{fine / now[key]:.1f}")
        rows.append([f"{side}²", f"{count} mm", many, task, f"{before[key]:.2f}", f"{now[key]:.2f}", *ratios])
    names = list(trees)
    header = ["image", "voxels and step", "poses", "task", f"{names[0]}: ms per pose", f"{names[1]}: ms per pose"]
    header += ["faster", f"faster than {names[0]} with voxels of 1 mm"]
    text = (
        f"{machine('cpu', ())}\n\n{title}, 1 mm voxels or the means of 2³ and 4³ of them. Medians of the fastest of "
        f"{settings.turns} turns of {settings.seconds:g} s, the versions by turns. `gradient` is forward and backward "
        f"to the poses, `jacobian` the image and its six derivatives.\n\n{table(header, rows)}"
    )
    write_section("Small images, with voxels that fit them, by two versions", text)


if __name__ == "__main__":
    main()
