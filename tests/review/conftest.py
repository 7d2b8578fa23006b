"""A small procedure whose images were drawn, and what a review of it needs."""

from pathlib import Path

import pytest
import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, ObjectQuality, Result, View, read_case, result_content, write_case, write_json
from femoreg_torch.case.femoroplasty import femoroplasty_objects, planned
from femoreg_torch.drr import project
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import CArm, centred_camera, first_view_only, rigid
from femoreg_torch.registration import Scene, prepare_scene
from femoreg_torch.review import Order
from femoreg_torch.volume import Volume, axis_aligned, write_landmarks, write_volume

SIZE = 96
CAMERA = centred_camera(1000.0, (3.0, 3.0), (SIZE, SIZE))
POSE = rigid(
    torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64), torch.tensor([4.0, 3, 690]).double()
)
PLAN = """
steps:
  - name: pelvis and femur
    kind: stage
    images: all
    kinds: [all]
    render: [pelvis, femur]
    bodies: [{move: [pelvis, femur], rotation_deg: [2, 2, 2], translation_mm: [3, 3, 10]}]
    level: {pixel_mm: 3, step_mm: 3}
    similarity: {kind: grad_ncc, patch_radius: 3}
    optimiser: {kind: levenberg_marquardt, max_iterations: 8, tol_x: 0.01, tol_f: 0.00001}
"""
# Where landmarks are, as the cuboids' corners: enough of them, and not in one plane.
PLACES = {
    "FH-l": (30, 0, 0), "GSN-l": (-45, -15, 30), "IOF-l": (-15, -15, -28), "MOF-l": (-45, 15, -28),
    "SPS-l": (-15, 15, 30), "IPS-l": (45, 15, -28), "ASIS-l": (15, -15, 28),
}  # fmt: skip


@pytest.fixture(scope="session")
def drawn_case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A case folder: one block of pelvis, one of femur, and one image of them, drawn at `POSE`; `plan.yaml` beside."""
    folder = tmp_path_factory.mktemp("drawn") / "case"
    folder.mkdir()
    labels = torch.zeros(30, 30, 40, dtype=torch.uint8)
    labels[5:25, 10:20, 5:15], labels[5:23, 11:20, 25:35] = 1, 5
    affine = axis_aligned((3.0, 3.0, 3.0), (-58.5, -43.5, -43.5))
    hu = torch.where(labels > 0, 900.0, 40.0)
    hu[:, 0] = -1000
    write_volume(folder / "ct.nii.gz", Volume(hu, affine))
    write_volume(folder / "labels.nii.gz", Volume(labels, affine))
    places = {name: torch.tensor(place, dtype=torch.float64) for name, place in PLACES.items()}
    write_landmarks(folder / "landmarks.json", places)
    bone = Volume(0.03 * (labels > 0), affine)
    integrals = project(bone, POSE[None], CAMERA, 0.5)[0]
    write_image(folder / "view1.tif", (40_000 * torch.exp(-integrals)).to(torch.uint16))
    head = places["FH-l"]
    case = Case(
        folder=folder,
        carm=CArm(CAMERA, (0.0, 0.0, 700.0), (0.0, 1.0, 0.0)),
        objects=femoroplasty_objects("left", head, None),
        views=(View({"anatomy": folder / "view1.tif"}),),
        anatomy=HIP,
        ct_path=folder / "ct.nii.gz",
        labels_path=folder / "labels.nii.gz",
        bones={"pelvis": (1,), "femur_left": (5,)},
        landmarks=places,
        plan=planned(head + torch.tensor([10.0, 0, -20], dtype=torch.float64), head, None),
        template="femoroplasty",
        side="left",
    )
    write_case(folder, case)
    (folder.parent / "plan.yaml").write_text(PLAN, encoding="utf-8")
    return folder


@pytest.fixture(scope="session")
def drawn_scene(drawn_case: Path) -> tuple[Case, Scene]:
    """The case, read, and its scene."""
    case = read_case(drawn_case)
    return case, prepare_scene(case)


@pytest.fixture
def order(drawn_case: Path, tmp_path: Path) -> Order:
    """Registers the case by the small plan into a run that is not there yet."""
    return Order(drawn_case, tmp_path / "out" / "run", str(drawn_case.parent / "plan.yaml"), 0, "cpu")


@pytest.fixture
def run(order: Order) -> Path:
    """The run of the order, with a trusted result."""
    good = ObjectQuality((), 0.1, (0.1, 0.1), (0.1, 0.1, 0.1), (0.1, 0.1, 0.1), None, True, "all views agree")
    poses = first_view_only({"pelvis": POSE, "femur": POSE}, 1)
    order.out.mkdir(parents=True)
    result = Result(poses, {"pelvis": good, "femur": good}, path=("femur", None))
    write_json(order.out / "result.json", result_content(result))
    return order.out


@pytest.fixture
def true_pose() -> torch.Tensor:
    """Where both bones are, (4, 4)."""
    return POSE.clone()
