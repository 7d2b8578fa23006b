"""Femoral heads of a label map: that their size is an adult's, and that a picture goes through them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hip_scenes import HEAD, RADIUS_MM, answering, hip_scene, shares_of

from femoreg_torch.commands.main import main
from femoreg_torch.intake.planes import planes_through_joints
from femoreg_torch.segment.heads import Head, doubted_slices, fitted_heads
from femoreg_torch.segment.rules import femoral_head
from femoreg_torch.segment.sphere import most_supported_sphere, stretch_along
from femoreg_torch.volume import Volume, axis_aligned, write_volume

SPACING = 1.5
RED, BLUE = (255, 0, 0), (0, 0, 255)


def scaled(scale: float) -> tuple[Volume, Volume, np.ndarray]:
    """CT, label map and labels of a hip whose header makes it larger or smaller by `scale`."""
    ct, truth = hip_scene((SPACING,) * 3)
    affine = ct.lps_from_index.clone()
    affine[:3] *= scale
    return Volume(ct.data, affine), Volume(torch.from_numpy(truth), affine), truth


@pytest.mark.parametrize(("scale", "doubted"), [(0.7, True), (0.8, False), (1.0, False), (1.3, False), (1.5, True)])
def test_a_head_that_no_adult_has_is_a_warning(
    scale: float, doubted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ct, labels, truth = scaled(scale)
    write_volume(tmp_path / "ct.nii.gz", ct)
    write_volume(tmp_path / "known.nii.gz", labels)
    network = answering(shares_of(truth, (SPACING * scale,) * 3))
    monkeypatch.setattr("femoreg_torch.segment.load_bone_network", lambda path: network)
    assert main(["segment", str(tmp_path / "ct.nii.gz"), "--out", str(tmp_path / "labels.nii.gz")]) == 0
    told = json.loads((tmp_path / "labels.json").read_text(encoding="utf-8"))
    assert told["head_radius_mm"]["left"] == pytest.approx(RADIUS_MM * scale, abs=0.5)
    words = "the left femoral head has a radius of"
    assert any(words in warning for warning in told["warnings"]) == doubted
    assert (words in capsys.readouterr().out) == doubted
    ct_path, known = str(tmp_path / "ct.nii.gz"), str(tmp_path / "known.nii.gz")
    points = tmp_path / "points.json"
    assert main(["landmarks", ct_path, known, "--out", str(points)]) == 0
    assert (words in capsys.readouterr().out) == doubted
    points.write_text("corrected by hand", encoding="utf-8")
    assert main(["landmarks", ct_path, known, "--out", str(points)]) == 2
    assert "points.json: is there already" in capsys.readouterr().err
    assert points.read_text(encoding="utf-8") == "corrected by hand"


def test_a_head_without_its_socket_is_not_looked_for() -> None:
    _, labels, _ = scaled(1.0)
    assert fitted_heads(labels, {"femur_left": 5}) == {}
    (head,) = fitted_heads(labels, {"femur_left": 5, "hip_left": 1}).values()
    np.testing.assert_allclose(head.centre, HEAD, atol=0.5)


def test_a_head_is_found_where_the_femur_comes_near_the_ischium_too() -> None:
    """The lesser trochanter, 60 mm below the head, lies nearer to the hip bone than the head does."""
    head, socket = (trimesh.creation.icosphere(4, radius) for radius in (22.0, 26.0))
    socket.update_faces(socket.triangles_center[:, 2] > 5)
    socket.remove_unreferenced_vertices()
    shaft = trimesh.creation.cylinder(14.0, 90.0, transform=trimesh.transformations.translation_matrix([30, 0, -70]))
    shaft = shaft.subdivide_to_size(4.0)
    ischium = trimesh.creation.icosphere(3, 12.0).apply_translation([5, 0, -70])  # 1 mm from the shaft
    femur = trimesh.util.concatenate([head, shaft])
    sphere, residual = femoral_head(femur, trimesh.util.concatenate([socket, ischium]))
    np.testing.assert_allclose(sphere, [0, 0, 0, 22], atol=0.2)
    assert residual < 0.5


def test_the_known_sphere_stays_where_no_other_holds_more_points() -> None:
    generator = np.random.default_rng(3)
    ball = generator.normal(size=(500, 3))
    ball *= 23 / np.linalg.norm(ball, axis=1, keepdims=True)
    known = np.array([0.01, 0.0, 0.0, 23.0])
    np.testing.assert_allclose(most_supported_sphere(ball, np.ones(500, bool), (15, 35), known), known, atol=0.02)
    flat = np.c_[generator.uniform(-20, 20, (200, 2)), np.zeros(200)]  # no sphere goes through a plane
    assert most_supported_sphere(flat, np.ones(200, bool), (15, 35), known) is known


@pytest.mark.parametrize("stretch", [0.85, 1.0, 1.12])
def test_a_spheroid_is_found_from_its_upper_half_with_a_neck_on_it(stretch: float) -> None:
    generator = np.random.default_rng(1)
    axis = np.array([0.36, -0.48, 0.8])
    ball = generator.normal(size=(4000, 3))
    ball *= 23 / np.linalg.norm(ball, axis=1, keepdims=True)
    ball = ball[ball @ [1, 2, 2] > -10]
    neck = generator.uniform(0, 20, (500, 3)) - [0, 40, 40]
    points = ball + np.outer(ball @ axis, axis) * (stretch - 1)
    found = stretch_along(np.concatenate([points, neck]) + HEAD, np.r_[HEAD + 0.5, 23.0], axis)
    assert found == pytest.approx(stretch, abs=1e-6)


def test_what_fits_no_spheroid_says_nothing() -> None:
    far = np.random.default_rng(1).normal(size=(100, 3)) + 500
    assert math.isnan(stretch_along(far, np.r_[HEAD, 23.0], np.array([0, 0, 1.0])))
    nothing = Head(torch.zeros(3), 23.0, 1.0, math.nan)
    assert doubted_slices([nothing], (1.0, 1.0, 1.0)) == doubted_slices([], (1.0, 1.0, 1.0)) == []


@pytest.mark.parametrize(
    ("stretches", "thick_mm", "told"),
    [
        ((1.03, 1.03), 1.0, 0),
        ((1.05, 1.05), 1.0, 1),
        ((1.10, 1.00), 1.0, 0),  # one is deformed
        ((1.05,), 1.0, 0),
        ((1.07,), 1.0, 1),
        ((1.07, 1.07), 3.0, 0),  # labels may be a slice too long
        ((1.10, 1.10), 3.0, 1),
    ],
)
def test_what_anatomy_and_thick_slices_explain_is_not_told(
    stretches: tuple[float, ...], thick_mm: float, told: int
) -> None:
    heads = [Head(torch.zeros(3), 23.0, 0.5, stretch) for stretch in stretches]
    assert len(doubted_slices(heads, (1.0, 1.0, thick_mm))) == told


def test_the_planes_go_through_the_heads_and_show_each_joint_large() -> None:
    """Two balls low in a volume, with much bone above them, which draws the middle of all bone away."""
    affine = axis_aligned((2.0, 2.0, 2.0), (-120.0, -80.0, -200.0))
    z, y, x = np.meshgrid(np.arange(150), np.arange(80), np.arange(120), indexing="ij")
    place = np.stack([x, y, z], -1) * 2.0 + [-120.0, -80.0, -200.0]
    heads = {"left": np.array([70.0, 10.0, -120.0]), "right": np.array([-70.0, 10.0, -120.0])}
    labels = np.zeros(x.shape, np.uint8)
    labels[z > 90] = 3
    for number, centre in enumerate(heads.values(), 1):
        labels[np.linalg.norm(place - centre, axis=-1) < 24] = number
    ct, bones = (Volume(torch.from_numpy(data), affine) for data in (np.zeros(x.shape, np.float32), labels))
    points = {side: torch.from_numpy(centre) for side, centre in heads.items()}
    picture = planes_through_joints(ct, bones, {1: RED, 2: BLUE}, points)
    red, blue = ((picture[..., channel] > 60) & (picture[..., 1] < 10) for channel in (2, 0))
    joint = picture.shape[0] - 2 * (426 + 6)  # rows of the picture of all
    above = math.pi * 24**2 / (300 / 420) ** 2  # pixels of a ball's largest disc where 300 mm are 420 pixels
    large = math.pi * 24**2 / (114 / 420) ** 2  # and where some 114 mm are: 55 mm to each side, and voxels of 2 mm
    assert red[:joint].sum() == pytest.approx(2 * above, rel=0.05)  # the axial and the coronal plane of all
    assert blue[:joint].sum() == pytest.approx(2 * above, rel=0.05)
    assert red[joint : joint + 430].sum() == pytest.approx(3 * large, rel=0.05)
    assert blue[joint + 430 :].sum() == pytest.approx(3 * large, rel=0.05)
