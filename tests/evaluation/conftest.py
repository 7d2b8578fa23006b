"""A small procedure, and a run of it whose poses are the truth."""

import json
from pathlib import Path

import pytest
import torch
import trimesh

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, Model, ObjectQuality, Result, Start, View, result_content, write_case, write_json
from femoreg_torch.case.femoroplasty import Device, femoroplasty_objects, planned
from femoreg_torch.case.result import path_in_camera1
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import Camera, CArm, centred_camera, poses_by_object, rigid
from femoreg_torch.volume import Volume, axis_aligned, write_landmarks, write_volume

CAMERA = centred_camera(1000.0, (4.0, 4.0), (64, 64))
POSE = rigid(
    torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64), torch.tensor([0.0, 0, 700]).double()
)


@pytest.fixture
def camera() -> Camera:
    """Of the procedure's images."""
    return CAMERA


@pytest.fixture
def pose() -> torch.Tensor:
    """Where the procedure's pelvis is in all views, (4, 4)."""
    return POSE.clone()


@pytest.fixture
def procedure(tmp_path: Path) -> tuple[Path, Path]:
    """A case folder with one pelvis block, one femur block, a device box and three noisy images; and a perfect run."""
    return make_procedure(tmp_path)


@pytest.fixture(scope="module")
def kept_procedure(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same for all tests of a module, which leave its files as they are."""
    return make_procedure(tmp_path_factory.mktemp("procedure"))


def make_procedure(tmp_path: Path) -> tuple[Path, Path]:
    folder = tmp_path / "case"
    folder.mkdir()
    labels = torch.zeros(30, 30, 40, dtype=torch.uint8)
    labels[5:25, 10:20, 5:15], labels[5:25, 10:20, 25:35] = 1, 5
    affine = axis_aligned((3.0, 3.0, 3.0), (-58.5, -43.5, -43.5))
    hu = torch.where(labels > 0, 700.0, 40.0)
    hu[:, 0] = -1000
    write_volume(folder / "ct.nii.gz", Volume(hu, affine))
    write_volume(folder / "labels.nii.gz", Volume(labels, affine))
    head = torch.tensor([30.0, 0, 0], dtype=torch.float64)
    write_landmarks(folder / "landmarks.json", {"FH-l": head})
    trimesh.creation.box((10, 10, 60), transform=trimesh.transformations.translation_matrix([0, 0, 30])).export(
        folder / "device.stl"
    )
    points = {
        name: torch.tensor([0.0, 0, z], dtype=torch.float64) for name, z in (("base", 0), ("center", 30), ("tip", 60))
    }
    nominal = rigid(translation=torch.tensor([0.0, 0, 500], dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    views = []
    for number in (1, 2, 3):
        for name in (f"view{number}.tif", f"view{number}_device.tif"):
            noise = torch.randint(20_000, 40_000, CAMERA.shape, generator=generator)
            write_image(folder / name, noise.to(torch.uint16))
        views.append(View({"anatomy": folder / f"view{number}.tif", "device": folder / f"view{number}_device.tif"}))
    truth = poses_by_object(POSE.expand(3, 4, 4).clone(), "pelvis", {"femur": POSE.clone(), "device": nominal})
    device = Device(Model(folder / "device.stl", 5000.0), points, Start(camera1_from=nominal))
    case = Case(
        folder=folder,
        carm=CArm(CAMERA, (0.0, 0.0, 620.0), (0.0, 1.0, 0.0)),
        objects=femoroplasty_objects("left", head, device),
        views=tuple(views),
        anatomy=HIP,
        ct_path=folder / "ct.nii.gz",
        labels_path=folder / "labels.nii.gz",
        bones={"pelvis": (1,), "femur_left": (5,)},
        landmarks={"FH-l": head},
        plan=planned(head + torch.tensor([10.0, 0, -20], dtype=torch.float64), head, device),
        truth=truth,
        template="femoroplasty",
        side="left",
    )
    write_case(folder, case)
    run = tmp_path / "run"
    run.mkdir()
    doubtful = ObjectQuality((), 0.1, (0.1, 0.1), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1), None, False, "similarity <0.2")
    points_told, directions_told = path_in_camera1(case, truth)
    result = Result(
        truth,
        quality=dict.fromkeys(case.objects, doubtful),
        path=("femur", "device"),
        points_camera1={"entry_point": points_told["entry_point"]},
        directions_camera1={"path": directions_told["path"]},
        timings_s={"registration": 1.5},
        skipped=("there are no lateral images",),
        preset="paper",
        seed=3,
        versions={"femoreg_torch": "0"},
    )
    write_json(run / "result.json", result_content(result))
    return folder, run


_LEVEL = {"pixel_mm": 16, "step_mm": 8}
_SIMILARITY = {"kind": "grad_ncc", "patch_radius": 3}
_SEEN = {"kinds": ["all"], "render": ["all"], "level": _LEVEL, "similarity": _SIMILARITY}
_OPTIMISER = {
    "kind": "levenberg_marquardt", "candidates": 20, "starts": 2, "max_iterations": 3, "tol_x": 0.01, "tol_f": 0.000003
}  # fmt: skip
_BODIES = [{"move": ["each"], "rotation_deg": [5, 5, 5], "translation_mm": [6, 6, 30]}]
_STEPS = [
    {"name": "all", "kind": "stage", "images": "first", "bodies": _BODIES, "optimiser": _OPTIMISER, **_SEEN},
    {"name": "orbit search", "kind": "orbit_search", "half_range_deg": 10, "step_deg": 5, **_SEEN},
]


@pytest.fixture
def small_registration(procedure: tuple[Path, Path], tmp_path: Path) -> list[str]:
    """The command line, but for `--out`, of a registration of the procedure that takes a moment."""
    case, run = procedure
    (tmp_path / "small.yaml").write_text(json.dumps({"steps": _STEPS}), encoding="utf-8")
    told = json.loads((run / "result.json").read_text(encoding="utf-8"))
    poses = {"camera1_from_pelvis": told["camera_from_pelvis"][0]}
    poses |= {name: told[name] for name in ("camera1_from_femur", "camera1_from_device")}
    (tmp_path / "start.json").write_text(json.dumps(poses), encoding="utf-8")
    return [
        "register", str(case), "--preset", str(tmp_path / "small.yaml"), "--start", str(tmp_path / "start.json")
    ]  # fmt: skip
