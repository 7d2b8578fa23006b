"""Labels of the training views against what the projector itself shows."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.detect import network_camera
from femoreg_torch.drr import project
from femoreg_torch.geometry import load_carm, transform_points
from femoreg_torch.volume import Volume, axis_aligned
from sim.labelled.attenuation_layers import Layers, deform, smooth_displacement, split_layers
from sim.labelled.class_images import class_image
from sim.labelled.training_views import render_view, write_views
from sim.labelled.view_poses import LabelledPose, ViewRanges, sample_pose

CAMERA = network_camera(load_carm("cios_fusion").camera)
SPACING, ORIGIN = 2.0, (-150.0, -90.0, -140.0)
IDS = {bone: ids[0] for bone, ids in label_table("femoreg").items()}
AP = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -40], [0, 1, 0, 750], [0, 0, 0, 1]], dtype=torch.float64)


def landmarks() -> dict[str, Tensor]:
    """A pelvis of about the right size, LPS mm; none of the points on a voxel centre."""
    left = [[90.3, -10, -80], [75, 15.5, -25], [48, 10, -120.2], [30, -10, -112], [8, -45, -90], [9, -20, -120.7]]
    points = [[s * x, y, z] for x, y, z in [*left, [119.0, -70.4, -25]] for s in (1, -1)]
    return dict(zip(HIP.landmark_names, torch.tensor(points, dtype=torch.float64), strict=True))


def patient() -> tuple[Volume, Volume]:
    """HU and labels: hip bones, sacrum and femora as boxes."""
    ct, labels = torch.full((100, 85, 150), -1000.0), torch.zeros((100, 85, 150), dtype=torch.uint8)
    ct[:, 4:-4, 4:-4] = 30.0
    boxes = {
        "hip_left": (80, 140, 40, 90),
        "hip_right": (10, 70, 40, 90),
        "sacrum": (66, 84, 60, 95),
        "femur_left": (105, 125, 5, 35),
        "femur_right": (25, 45, 5, 35),
    }
    for bone, (x0, x1, z0, z1) in boxes.items():
        ct[z0:z1, 30:50, x0:x1], labels[z0:z1, 30:50, x0:x1] = 600.0, IDS[bone]
    affine = axis_aligned((SPACING,) * 3, ORIGIN)
    return Volume(ct, affine), Volume(labels, affine)


@pytest.fixture(scope="module")
def layers() -> Layers:
    ct, labels = patient()
    return split_layers(ct, labels, landmarks(), spacing_mm=2.0)


def ball(centre: Tensor) -> Volume:
    """A Gaussian of 4 mm about a point in LPS mm, on a grid of its own."""
    origin = centre.round() - 16
    axes = [origin[n] + torch.arange(33, dtype=torch.float64) - centre[n] for n in (2, 1, 0)]
    squared = axes[0][:, None, None] ** 2 + axes[1][:, None] ** 2 + axes[2] ** 2
    x, y, z = origin.tolist()
    return Volume(torch.exp(-squared / 32).float(), axis_aligned((1.0, 1.0, 1.0), (x, y, z)))


@pytest.mark.parametrize("seed", range(6))
def test_landmarks_lie_where_a_bright_ball_is_seen(layers: Layers, seed: int) -> None:
    ranges = ViewRanges(shift_mm=5.0, one_hip_share=0.0, cranial_share=0.0, depth_mm=(800.0, 850.0))
    pose = sample_pose(ranges, layers.landmarks, np.random.default_rng(seed))
    view = render_view(layers, pose, CAMERA)
    axis = torch.arange(192, dtype=torch.float32)
    for n in (HIP.landmark_names.index("FH-l"), HIP.landmark_names.index("IOF-r"), HIP.landmark_names.index("SPS-l")):
        image = project([ball(layers.landmarks[n])], pose.camera_from_lps[None, None], CAMERA, 1.0)[0]
        image = image.flip(-1) if pose.mirrored else image
        seen = torch.stack([(image.sum(0) * axis).sum(), (image.sum(1) * axis).sum()]) / image.sum()
        assert_close(seen, view.landmarks[n], atol=0.06, rtol=0)


def test_cranial_views_move_the_heads_to_the_lower_edge(layers: Layers) -> None:
    heads = [HIP.landmark_names.index(name) for name in ("FH-l", "FH-r")]
    rows = []
    for share in (0.0, 1.0):
        ranges = ViewRanges(shift_mm=0.0, one_hip_share=0.0, cranial_share=share, cranial_mm=(80.0, 80.0))
        pose = sample_pose(ranges, layers.landmarks, np.random.default_rng(4))
        middle = transform_points(pose.camera_from_lps, layers.landmarks[heads]).mean(0)
        rows.append(float(middle[1]))
    assert abs(rows[0]) < 1e-6
    assert abs(rows[1] - 80.0) < 1e-6


def test_left_is_on_the_right_and_the_head_is_up(layers: Layers) -> None:
    stay = {"femur_left": AP, "femur_right": AP}
    behind = torch.tensor([[-1.0, 0, 0, 0], [0, 0, -1, -40], [0, -1, 0, 750], [0, 0, 0, 1]], dtype=torch.float64)
    poses = [LabelledPose(AP, stay, False), LabelledPose(behind, dict.fromkeys(stay, behind), True)]
    for pose in poses:
        view = render_view(layers, pose, CAMERA)
        for name, point in zip(HIP.landmark_names, view.landmarks, strict=True):
            assert (point[0] > 95.5) == name.endswith("-l"), name
        assert (
            view.landmarks[HIP.landmark_names.index("ASIS-l"), 1] < view.landmarks[HIP.landmark_names.index("FH-l"), 1]
        )
        for bone in ("hip", "femur"):
            left, right = (
                (view.labels == HIP.classes([f"{bone}_{side}"])[0]).nonzero()[:, 1].float().mean()
                for side in ("left", "right")
            )
            assert left > 47.5 > right


def test_labels_and_bones_lie_on_each_other(layers: Layers) -> None:
    view = render_view(layers, sample_pose(ViewRanges(), layers.landmarks, np.random.default_rng(8)), CAMERA)
    coarse = torch.nn.functional.avg_pool2d(view.bones.sum(0)[None], 2)[0]
    bone = coarse > 0.5 * coarse.max()
    assert bone.any()
    assert (view.labels[bone] > 0).all()
    assert view.labels[coarse == 0].max() == 0


def test_layers_add_up_to_the_ct(layers: Layers) -> None:
    ct, _ = patient()
    whole = Volume((ct.data + 1000) * 2.6828e-5, ct.lps_from_index)
    assert set(layers.bones) == set(HIP.bone_names) - {"vertebrae"}
    pose = AP[None, None]
    bones = list(layers.bones.values())
    bone_image = project(bones, pose.expand(1, len(bones), 4, 4), CAMERA, 2.0)[0]
    tissue_image = project([layers.tissue], pose, CAMERA, 2.0)[0]
    middle = (slice(60, 130), slice(40, 150))
    expected = project([whole], pose, CAMERA, 2.0)[0]
    difference = (tissue_image + bone_image - expected)[middle].abs()
    assert difference.median() < 0.01 * expected[middle].mean()


def test_overlaps_have_one_label() -> None:
    seen = [("hip_left", "hip_right"), ("hip_left", "sacrum", "femur_left"), ("vertebrae", "sacrum"), HIP.hides_outline]
    lengths = torch.zeros(len(HIP.bones), 1, len(seen) + 1)
    for column, bones in enumerate(seen):
        lengths[[n - 1 for n in HIP.classes(bones)], 0, column] = 10.0
    lengths[HIP.classes(["sacrum"])[0] - 1, 0, -1] = 1.0  # too little to be seen
    wins = ["hip_left", "femur_left", "vertebrae", "femur_left"]
    assert class_image(lengths, True)[0].tolist() == [*HIP.classes(wins), 0]
    assert class_image(lengths, False)[0, 0] == HIP.classes(["hip_right"])[0]


def test_femora_turn_about_their_heads(layers: Layers) -> None:
    pose = sample_pose(ViewRanges(), layers.landmarks, np.random.default_rng(3))
    for bone, name in (("femur_left", "FH-l"), ("femur_right", "FH-r")):
        head = layers.landmarks[[HIP.landmark_names.index(name)]]
        assert_close(transform_points(pose.camera_from(bone), head), transform_points(pose.camera_from_lps, head))
        assert not torch.allclose(pose.camera_from(bone), pose.camera_from_lps)
    assert pose.camera_from("hip_left") is pose.camera_from_lps


def test_deformation_moves_bone_and_landmark_alike() -> None:
    centre = torch.tensor([20.3, -10.0, 5.0], dtype=torch.float64)
    bright = ball(centre)
    layers = Layers(bright, {"sacrum": bright}, {"sacrum": bright}, centre.expand(14, 3))
    moved = deform(layers, smooth_displacement(np.random.default_rng(2), amplitude_mm=2.0))
    data = moved.bones["sacrum"].data.double()
    axes = [torch.arange(n, dtype=torch.float64) for n in data.shape]
    index = (
        torch.stack(
            [
                (data.sum((0, 1)) * axes[2]).sum(),
                (data.sum((0, 2)) * axes[1]).sum(),
                (data.sum((1, 2)) * axes[0]).sum(),
            ]
        )
        / data.sum()
    )
    seen = index + moved.bones["sacrum"].lps_from_index[:3, 3]
    assert (seen - centre).norm() > 1
    assert_close(seen, moved.landmarks[0], atol=0.15, rtol=0)


def test_files_are_reproducible(layers: Layers, tmp_path: Path) -> None:
    for name in ("a", "b"):
        rng = np.random.default_rng(6)
        write_views(tmp_path / name, layers, ViewRanges(), CAMERA, 2, rng, "boxes")
    first, second = (load_file(tmp_path / name) for name in ("a", "b"))
    assert first["bones"].shape == (2, 6, 192, 192)
    assert all(first[key].equal(second[key]) for key in first)
