"""The simulated acquisition: poses within their ranges, and a truth that hits what the images show."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
import trimesh
from scipy import ndimage
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case
from femoreg_torch.case.femoroplasty import Device, femoroplasty_objects, planned
from femoreg_torch.case.model import Model, Start
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import attenuation_image
from femoreg_torch.geometry import invert_rigid, load_carm, log_se3, project_points, rotation_angle, transform_points
from femoreg_torch.volume import Volume, axis_aligned
from sim.theatre.field_of_view import field_of_view
from sim.theatre.images import simulate_images
from sim.theatre.metal import metal_in_beam
from sim.theatre.nominal_poses import nominal_ap, nominal_device
from sim.theatre.preoperative_case import Preoperative
from sim.theatre.procedure import draw_procedure
from sim.theatre.settings import load_simulation

HIP_ID, FEMUR_ID = 11, 15  # any ids of a label map
HEAD = torch.tensor([90.0, 0.0, 0.0], dtype=torch.float64)
PELVIS_BALLS = HEAD + torch.tensor([[-70.0, 20, 40], [-20, -35, 60], [-75, -30, -35]], dtype=torch.float64)
FEMUR_BALLS = HEAD + torch.tensor([[0.0, 0, 0], [30, 10, -25], [38, 15, -70]], dtype=torch.float64)
BALL_MM = 4.0


@pytest.fixture(scope="module")
def settings():
    return load_simulation("paper")


@pytest.fixture(scope="module")
def mesh():
    handle = trimesh.creation.box((40, 10, 10), transform=trimesh.transformations.translation_matrix([22, 0, 30]))
    sleeve = trimesh.creation.cylinder(5, segment=[(0, 0, 0), (0, 0, 90)])
    return trimesh.boolean.union([sleeve, handle])


@pytest.fixture(scope="module")
def known(mesh, settings):
    """A left hip in memory, its C-arm with pixels of 8 × 8 of the real one."""
    carm = load_carm("cios_fusion")
    points = {
        name: torch.tensor([0.0, 0, z], dtype=torch.float64) for name, z in (("base", 0), ("center", 45), ("tip", 90))
    }
    entry = HEAD + torch.tensor([45.0, 20, -40], dtype=torch.float64)
    ap = nominal_ap(HEAD, "left", settings.acquisition)
    pose = nominal_device(mesh, points, ap[:3, :3] @ (HEAD - entry), settings.acquisition.device_depth_mm)
    device = Device(Model(Path("device.stl"), 5000.0), points, Start(camera1_from=pose))
    case = Case(
        folder=Path(),
        carm=replace(carm, camera=carm.camera.downsampled(8)),
        objects=femoroplasty_objects("left", HEAD, device),
        anatomy=HIP,
        landmarks=dict.fromkeys(HIP.landmark_names, HEAD),
        plan=planned(entry, HEAD, device),
        side="left",
    )
    return Preoperative(case, "left", HEAD, (FEMUR_ID,), Path("ct.nii.gz"), Path("labels.nii.gz"), device)


@pytest.fixture(scope="module")
def patient():
    """CT and labels at 2 mm: a body, a femur and a pelvis no denser than muscle, with dense balls in both."""
    affine = axis_aligned((2.0, 2.0, 2.0), (-80.0, -100.0, -150.0))
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (150, 100, 120)), indexing="ij")
    points = torch.stack([x, y, z], -1) * 2 + affine[:3, 3]
    hu = torch.full(points.shape[:3], 40.0)
    labels = torch.zeros_like(hu, dtype=torch.uint8)
    labels[points[..., 0] < HEAD[0] - 15] = HIP_ID
    for start, end in pairwise(FEMUR_BALLS):
        along = ((points - start) @ (end - start) / (end - start).norm() ** 2).clamp(0, 1)
        labels[(points - start - along[..., None] * (end - start)).norm(dim=-1) < 11] = FEMUR_ID
    for ball in torch.cat([PELVIS_BALLS, FEMUR_BALLS]):
        share = ((BALL_MM + 1 - (points - ball).norm(dim=-1)) / 2).clamp(0, 1)  # of the voxel inside the ball
        hu += (6000 * share).float()
    return Volume(hu, affine), Volume(labels, affine)


def blobs(image):
    """Centres (N, 2), column and row, of small bright spots of an image (H, W)."""
    relief = image.numpy() - ndimage.median_filter(image.numpy(), 15)
    labelled, count = ndimage.label(relief > 0.35 * relief.max())
    found = ndimage.center_of_mass(relief, labelled, range(1, count + 1))
    return torch.tensor([[column, row] for row, column in found], dtype=torch.float64)


def test_the_truth_hits_the_balls_in_all_views(known, mesh, settings, patient):
    acquisition, model = settings.acquisition, settings.xray
    generator = torch.Generator().manual_seed(4)
    procedure = draw_procedure(known, mesh, acquisition, generator)
    camera = known.case.carm.camera
    acquisition = replace(acquisition, step_mm=1.0)
    metal = metal_in_beam(mesh, 0, acquisition)
    args = (known.femur, HEAD, metal, procedure, camera, acquisition, model, generator)
    images = simulate_images(*patient, *args, report=lambda _: None)
    truth = procedure.truth
    assert len(images) == 3
    checked = 0
    for number, view in enumerate(images):
        found = blobs(attenuation_image(view.anatomy.float()))
        for name, balls in (("pelvis", PELVIS_BALLS), ("femur", FEMUR_BALLS)):
            pixels = project_points(camera, transform_points(truth.camera_from(name)[number], balls))
            seen = pixels[((pixels > 8) & (pixels < 183)).all(1)]
            assert (torch.cdist(seen, found).amin(1) < 0.5).all()
            checked += len(seen)
        shadow = attenuation_image(view.device.float()) - attenuation_image(view.anatomy.float()) > 0.5
        row, column = torch.nonzero(shadow, as_tuple=True)
        assert len(row) > 300
        assert row.min() > 0
        assert max(row.max(), column.max()) < 191
    assert checked >= 12  # of 18


def test_the_femur_has_really_turned(known, mesh, settings):
    procedure = draw_procedure(known, mesh, settings.acquisition, torch.Generator().manual_seed(4))
    apart = (
        transform_points(procedure.camera1_from_femur, FEMUR_BALLS)
        - transform_points(procedure.camera_from_pelvis[0], FEMUR_BALLS)
    ).norm(dim=1)
    assert apart[0] < 1e-9
    assert apart[2] > 5


def test_draws_stay_within_the_ranges_of_the_paper(known, mesh, settings):
    acquisition = settings.acquisition
    ap = nominal_ap(HEAD, "left", acquisition)
    generator = torch.Generator().manual_seed(0)
    orbits = []
    for _ in range(60):
        procedure = draw_procedure(known, mesh, acquisition, generator)
        first = procedure.camera_from_pelvis[0]
        assert math.degrees(rotation_angle((first @ invert_rigid(ap))[:3, :3])) <= 11
        assert (transform_points(first, HEAD[None]) - transform_points(ap, HEAD[None])).norm() < 30
        femur = invert_rigid(first) @ procedure.camera1_from_femur
        assert math.degrees(rotation_angle(femur[:3, :3])) <= 15
        device = invert_rigid(known.device.start.camera1_from) @ procedure.camera_from_device[0]
        assert math.degrees(rotation_angle(device[:3, :3])) <= 5
        relative = procedure.camera_from_pelvis[1:] @ invert_rigid(first)
        orbits.append(torch.rad2deg(log_se3(relative)[:, 1]))
    # a C-arm that turns by +θ about camera y lets the patient turn by −θ
    assert torch.stack(orbits).mean(0).tolist() == pytest.approx([-10, 15], abs=1.5)


def test_the_nominal_view_is_head_up_with_the_left_hip_on_the_right(settings):
    ap = nominal_ap(HEAD, "left", settings.acquisition)
    assert torch.linalg.det(ap[:3, :3]).item() == pytest.approx(1)
    head, above, left, behind = transform_points(
        ap, HEAD + torch.tensor([[0.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0]]).double()
    )
    assert head[2].item() == pytest.approx(settings.acquisition.head_depth_mm)
    assert above[1] < head[1]
    assert left[0] > head[0]
    assert behind[2] > head[2]


def test_the_guide_points_along_the_image_of_the_path(known, mesh, settings):
    ap = nominal_ap(HEAD, "left", settings.acquisition)
    path = ap[:3, :3] @ (known.case.plan.target - known.case.plan.entry_point)
    guide = known.device.start.camera1_from[:3, 2]
    assert guide[2].item() == pytest.approx(0, abs=1e-9)
    assert (guide[:2] / guide[:2].norm() @ (path[:2] / path[:2].norm())).item() == pytest.approx(1)


def test_the_same_seed_draws_the_same_procedure(known, mesh, settings):
    one, same, other = (
        draw_procedure(known, mesh, settings.acquisition, torch.Generator().manual_seed(s)) for s in (7, 7, 8)
    )
    assert torch.equal(one.camera_from_pelvis, same.camera_from_pelvis)
    assert torch.equal(one.camera_from_device, same.camera_from_device)
    assert not torch.equal(one.camera_from_pelvis, other.camera_from_pelvis)


def test_a_device_that_never_fits_is_refused(known, mesh, settings):
    with pytest.raises(InputError, match="device_depth_mm"):
        draw_procedure(
            known, mesh, replace(settings.acquisition, device_margin_mm=150), torch.Generator().manual_seed(0)
        )


def test_beyond_the_ct_the_last_slice_goes_on(settings):
    """A body that ends in the field of view is continued along z, and only there; its place does not change."""
    body = Volume(
        torch.arange(10.0)[:, None, None].expand(10, 30, 40).contiguous(),
        axis_aligned((5.0, 5.0, 5.0), (0.0, -75.0, -20.0)),
    )
    camera = load_carm("cios_fusion").camera
    seen = field_of_view(body, nominal_ap(HEAD, "left", settings.acquisition)[None], camera, 0)
    first = round((-20 - seen.lps_from_index[2, 3].item()) / 5)
    assert first > 0
    assert torch.equal(seen.data[first : first + 10, 0, 0], torch.arange(10.0))
    assert (seen.data[:first] == 0).all()
    assert (seen.data[first + 10 :] == 9).all()


def test_the_truth_of_the_case_is_that_of_the_images(known, mesh, settings):
    procedure = draw_procedure(known, mesh, settings.acquisition, torch.Generator().manual_seed(4))
    truth = procedure.truth
    assert_close(truth.camera_from("pelvis"), procedure.camera_from_pelvis)
    assert_close(truth.camera_from("device"), procedure.camera_from_device)
    assert torch.equal(truth.camera_from_camera1[0], torch.eye(4, dtype=torch.float64))
