"""Outlines correct a start pose, and contradict a wrong patient."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import Detection, network_camera
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import (
    about_point,
    centred_camera,
    exp_se3,
    project_points,
    rigid,
    rotation_angle,
    transform_points,
)
from femoreg_torch.registration.prepare.outline import outline_of
from femoreg_torch.registration.scene import Outline, Segmentation
from femoreg_torch.registration.start.find import LEAST_OVERLAP, find_start
from femoreg_torch.registration.start.silhouette import refine_by_silhouette
from femoreg_torch.volume import BoneLabels, Volume, axis_aligned

CAMERA = centred_camera(1020.0, (0.776, 0.776), (384, 384))
AP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
TRUTH = rigid(AP, torch.tensor([4.0, -6.0, 740.0], dtype=torch.float64))
CENTRE = torch.tensor([4.0, -6.0, 740.0], dtype=torch.float64)


def labels(spacing: float, scale: float = 1.0) -> Volume:
    """Two leaning rings (left 1, right 2) with a wing behind each; `scale` stretches the patient from side to side."""
    axis = torch.arange(-120, 120, spacing, dtype=torch.float64)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    volume = torch.zeros(x.shape, dtype=torch.uint8)
    for label, sign in ((1, 1.0), (2, -1.0)):
        u, v, w = sign * x / scale - 55, y + 0.3 * z, z + 30 + 0.2 * sign * x / scale
        ring = ((u**2 / 1.2 + w**2).sqrt() - 28) ** 2 + v**2 < 11**2
        wing = ((sign * x / scale - 70) / 38) ** 2 + ((y - 30) / 9) ** 2 + ((z - 45) / 45) ** 2 < 1
        volume[ring | wing] = label
    return Volume(volume, axis_aligned((spacing,) * 3, (-120.0,) * 3))


def outline(spacing: float, scale: float = 1.0) -> Outline:
    found = outline_of(BoneLabels(labels(spacing, scale), {"hip_left": 1, "hip_right": 2}), HIP)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def seen() -> Tensor:
    """Probabilities (7, 96, 96) of a network that sees the fine patient: a ray through 1.5 mm of bone is labelled."""
    fine = labels(1.5)
    grid = network_camera(CAMERA).downsampled(2)
    probabilities = torch.zeros(7, *grid.shape)
    for label in (1, 2):
        mask = fine.with_data((fine.data == label).float())
        probabilities[label] = (project([mask], TRUTH[None, None], grid, 0.7)[0] > 1.5).float()
    probabilities[2] *= 1 - probabilities[1]
    probabilities[0] = 1 - probabilities[1:].sum(0)
    return probabilities


def off_by(rotation_deg: float, depth_mm: float) -> Tensor:
    twist = torch.tensor([0.6, -0.7, 0.39, 0, 0, 0], dtype=torch.float64) * torch.pi / 180 * rotation_deg
    twist[5] = depth_mm
    return about_point(exp_se3(twist[None])[0], CENTRE) @ TRUTH


def errors(pose: Tensor) -> tuple[float, float]:
    """Degrees and mm in depth."""
    turned = torch.rad2deg(rotation_angle(pose[:3, :3] @ TRUTH[:3, :3].mT)).item()
    return turned, abs((pose[:3, 3] - TRUTH[:3, 3])[2].item())


@pytest.mark.parametrize("shutter", [0, 150])
def test_a_start_far_off_is_brought_near(seen: Tensor, shutter: int) -> None:
    """Also where a shutter hides the left of the image, of which the network says nothing."""
    image = torch.rand(CAMERA.shape, generator=torch.Generator().manual_seed(1))
    image[:, :shutter] = 2.0
    probabilities = seen.clone()
    probabilities[:, :, : shutter // 4] = 0
    covariance = torch.diag(torch.tensor([0.08, 0.08, 0.04, 3, 3, 20], dtype=torch.float64) ** 2)
    start = off_by(7.0, 25.0)
    bones = Segmentation(probabilities, network_camera(CAMERA).downsampled(2))
    fit = refine_by_silhouette(outline(2.0), HIP, start, CENTRE, covariance, bones, image, CAMERA)
    assert errors(start) == pytest.approx((7.0, 25.0), rel=0.02)
    turned, depth = errors(fit.camera_from_ct)
    assert turned < 2.5  # 0.3 mm of the outline, a tenth of a pixel
    assert depth < 8.0
    assert fit.overlap is not None
    assert fit.overlap > 0.94
    assert (fit.covariance.diagonal() < covariance.diagonal()).all()


def test_what_the_image_shows_beyond_a_short_ct_is_not_compared(seen: Tensor) -> None:
    whole = labels(2.0)
    short = Volume(whole.data[:65], whole.lps_from_index)  # up to 9 mm: the wings go on to 90
    cut = outline_of(BoneLabels(short, {"hip_left": 1, "hip_right": 2}), HIP)
    assert cut is not None
    covariance = torch.diag(torch.tensor([0.08, 0.08, 0.04, 3, 3, 20], dtype=torch.float64) ** 2)
    bones = Segmentation(seen, network_camera(CAMERA).downsampled(2))
    image = torch.rand(CAMERA.shape, generator=torch.Generator().manual_seed(1))
    fit = refine_by_silhouette(cut, HIP, off_by(5.0, 15.0), CENTRE, covariance, bones, image, CAMERA)
    assert fit.overlap is not None
    assert fit.overlap > 0.94
    assert errors(fit.camera_from_ct)[0] < 3.5
    narrow = Volume(labels(2.0, 0.7).data[:65], whole.lps_from_index)
    stretched = outline_of(BoneLabels(narrow, {"hip_left": 1, "hip_right": 2}), HIP)
    assert stretched is not None
    other = refine_by_silhouette(stretched, HIP, TRUTH, CENTRE, covariance, bones, image, CAMERA)
    assert other.overlap is not None
    assert other.overlap < LEAST_OVERLAP  # which is asked for of bones that a CT cuts
    assert fit.beyond > 0.3
    whole_fit = refine_by_silhouette(outline(2.0), HIP, TRUTH, CENTRE, covariance, bones, image, CAMERA)
    assert whole_fit.beyond == 0


def test_a_ct_that_is_cut_in_front_leaves_most_to_compare(seen: Tensor) -> None:
    """All of the picture lies beyond that face, but the bones are cut at a few places there."""
    whole = labels(2.0)
    behind = axis_aligned((2.0,) * 3, (-120.0, 0.0, -120.0))
    cut = outline_of(BoneLabels(Volume(whole.data[:, 60:], behind), {"hip_left": 1, "hip_right": 2}), HIP)
    assert cut is not None
    covariance = torch.diag(torch.tensor([0.08, 0.08, 0.04, 3, 3, 20], dtype=torch.float64) ** 2)
    bones = Segmentation(seen, network_camera(CAMERA).downsampled(2))
    image = torch.rand(CAMERA.shape, generator=torch.Generator().manual_seed(1))
    fit = refine_by_silhouette(cut, HIP, off_by(5.0, 15.0), CENTRE, covariance, bones, image, CAMERA)
    assert 0.1 < fit.beyond < 0.8
    assert fit.overlap is not None
    assert fit.overlap > 0.94
    assert errors(fit.camera_from_ct)[0] < 3.5


def detection(seen: Tensor, points: Tensor) -> Detection:
    ones = torch.ones(len(points), dtype=torch.float64)
    pixels = project_points(CAMERA, transform_points(TRUTH, points))
    return Detection(pixels, ones, ones, ones > 0, seen, network_camera(CAMERA).downsampled(2), False)


def test_another_patient_is_refused(seen: Tensor) -> None:
    points = torch.randn(14, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 40
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    image = torch.rand(CAMERA.shape)
    found = find_start(landmarks, detection(seen, points), image, CAMERA, outline(2.0), HIP)
    assert errors(found.camera_from_ct)[0] < 0.5
    assert found.overlap is not None
    with pytest.raises(InputError, match=r"agree by \d+ % only .*same patient.*--landmarks"):
        find_start(landmarks, detection(seen, points), image, CAMERA, outline(2.0, 0.7), HIP)
    blind = replace(detection(seen, points), segmentation=torch.zeros_like(seen))
    with pytest.raises(InputError, match="agree by 0 % only"):
        find_start(landmarks, blind, image, CAMERA, outline(2.0), HIP)


def test_where_nothing_can_be_compared_landmarks_start_it_alone(seen: Tensor) -> None:
    """Of an image that a shutter covers nearly, as it seems; few landmarks are not enough then."""
    points = torch.randn(14, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 40
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    covered = torch.full(CAMERA.shape, 0.5)
    found = find_start(landmarks, detection(seen, points), covered, CAMERA, outline(2.0), HIP)
    assert found.overlap is None
    assert errors(found.camera_from_ct)[0] < 0.5
    few = replace(detection(seen, points), visible=torch.arange(14) < 3)
    with pytest.raises(InputError, match="3 usable landmarks found"):
        find_start(landmarks, few, covered, CAMERA, outline(2.0), HIP, among_views=True)


@pytest.mark.parametrize("count", [1, 3])
def test_few_landmarks_and_outlines_tell_a_start(seen: Tensor, count: int) -> None:
    """Which they do not without outlines, or where those do not agree."""
    points = torch.randn(14, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 40
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    few = replace(detection(seen, points), visible=torch.arange(14) < count)
    image = torch.rand(CAMERA.shape)
    found = find_start(landmarks, few, image, CAMERA, outline(2.0), HIP)
    turned, apart = errors(found.camera_from_ct)
    assert turned < 3
    assert apart < 12
    assert found.few
    assert found.used == list(HIP.landmark_names[:count])
    refused = f"{count} usable landmarks found, at least 4 are needed"
    with pytest.raises(InputError, match=refused):
        find_start(landmarks, few, image, CAMERA, None, HIP)
    with pytest.raises(InputError, match=refused):
        find_start(landmarks, few, image, CAMERA, outline(2.0, 0.7), HIP)
    with pytest.raises(InputError, match=refused):
        find_start(landmarks, few, image, CAMERA, outline(2.0), HIP, None, (1.0, 0.0, 0.0))
    shaved = outline(2.0, 0.85)
    with pytest.raises(InputError, match=refused):
        find_start(landmarks, few, image, CAMERA, shaved, HIP)
    doubtful = find_start(landmarks, few, image, CAMERA, shaved, HIP, among_views=True)
    assert doubtful.overlap is not None
    assert doubtful.overlap < LEAST_OVERLAP  # which the other views are to make up for
    with pytest.raises(InputError, match=refused):
        find_start(landmarks, few, image, CAMERA, outline(2.0, 0.7), HIP, among_views=True)
    with pytest.raises(InputError, match="0 usable landmarks found"):
        find_start(landmarks, replace(few, visible=few.visible & False), image, CAMERA, outline(2.0), HIP)


def test_landmarks_that_contradict_each_other_leave_it_to_the_outlines(seen: Tensor) -> None:
    points = torch.randn(14, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 40
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    right = detection(seen, points)
    astray = right.pixels + torch.tensor([[0.0, 0], [0, 0], [25, 0], [0, -30], *[[0, 0]] * 10]).double()
    found = find_start(
        landmarks,
        replace(right, pixels=astray, visible=torch.arange(14) < 4),
        torch.rand(CAMERA.shape),
        CAMERA,
        outline(2.0),
        HIP,
    )
    assert found.few
    assert errors(found.camera_from_ct)[0] < 3


def test_one_half_of_a_pelvis_is_compared_by_itself(seen: Tensor) -> None:
    """The CT holds the left hip bone alone, while the image shows both."""
    half = outline_of(BoneLabels(labels(2.0), {"hip_left": 1}), HIP)
    assert half is not None
    points = torch.randn(14, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 40
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    found = find_start(landmarks, detection(seen, points), torch.rand(CAMERA.shape), CAMERA, half, HIP)
    assert errors(found.camera_from_ct)[0] < 0.5
    assert found.overlap is not None


def test_a_pelvis_in_one_label_is_not_compared(seen: Tensor) -> None:
    assert outline_of(BoneLabels(labels(4.0), {"pelvis": 1}), HIP) is None
    assert outline_of(BoneLabels(labels(4.0), {"hip_left": 1}), None) is None
    points = torch.randn(14, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 40
    landmarks = dict(zip(HIP.landmark_names, points, strict=True))
    found = find_start(landmarks, detection(seen, points), torch.rand(CAMERA.shape), CAMERA, None, HIP)
    assert found.overlap is None
    assert errors(found.camera_from_ct)[0] < 0.5
