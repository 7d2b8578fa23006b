"""Planted heat maps: decoded to sub-pixel truth, mapped to the detector, and solved for the pose."""

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from femoreg_torch.detect import decode_heatmaps, detect, load_network, network_camera
from femoreg_torch.detect.looks import PLAIN
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, invert_rigid, load_carm, project_points, rotation_angle, transform_points
from femoreg_torch.pnp import solve_pnp
from models.losses import landmark_target
from models.unet import Prediction

CAMERA = load_carm("cios_fusion").camera
LEFT_HALF = [[90.0, -10, -80], [75, 15, -25], [48, 10, -120], [30, -10, -112], [4, -45, -108], [4, -20, -120]]
POINTS = torch.tensor([[s * x, y, z] for x, y, z in [*LEFT_HALF, [85.0, -75, -45]] for s in (1, -1)]).double()
CAMERA_FROM_LPS = torch.tensor([[1.0, 0, 0, 20], [0, 0, -1, -60], [0, 1, 0, 760], [0, 0, 0, 1]], dtype=torch.float64)


def planted(pixels: Tensor, visible: Tensor) -> Prediction:
    """What a perfect network says about landmarks at `pixels` (14, 2) of the detector."""
    on_output = (pixels / 16 - 7.5 / 16).float()  # 16 detector pixels per output pixel, centre on centre
    target = landmark_target(on_output[None], visible[None], (96, 96), 1.5).clamp_min(1e-12).log()
    segmentation = torch.zeros(1, 7, 96, 96)
    segmentation[:, 5, :48] = 9.0
    return Prediction(segmentation, target[..., :-1].view(1, 14, 96, 96), target[..., -1])


class Planted(nn.Module):
    """Answers with what was planted, whatever it is shown; for the image turned by 180°, with a shrug."""

    def __init__(self, prediction: Prediction, top_is_bright: bool) -> None:
        super().__init__()
        self.prediction, self.top_is_bright = prediction, top_is_bright

    def forward(self, image: Tensor) -> Prediction:
        upright = bool(image[0, 0, :96].mean() > 0) == self.top_is_bright
        return self.prediction if upright else self.prediction._replace(absence=torch.full((1, 14), 20.0))


@pytest.fixture
def image() -> Tensor:
    return torch.linspace(1, 0, CAMERA.shape[0])[:, None].expand(CAMERA.shape).contiguous()


def test_sub_pixel_positions_and_confidence() -> None:
    pixels = torch.tensor([[20.3, 30.6], [40.0, 40.5], [60.9, 10.1]])
    visible = torch.tensor([True, True, False])
    target = landmark_target(pixels[None], visible[None], (96, 90), 1.5)[0].clamp_min(1e-12).log()
    found, confidence = decode_heatmaps(target[:, :-1].view(3, 96, 90), target[:, -1])
    assert_close(found[:2].float(), pixels[:2], atol=0.04, rtol=0)
    assert confidence[:2].min() > 0.97
    assert confidence[2] < 0.01


def test_two_places_are_half_as_sure() -> None:
    twice = landmark_target(torch.tensor([[[20.0, 30.0], [70.0, 60.0]]]), torch.ones(1, 2).bool(), (96, 96), 1.5)[0]
    both = (0.5 * twice.sum(0)).clamp_min(1e-12).log()
    _, confidence = decode_heatmaps(both[:-1].view(1, 96, 96), both[-1:])
    assert_close(confidence, torch.tensor([0.5]).double(), atol=0.02, rtol=0)


def test_planted_landmarks_give_the_pose(image: Tensor) -> None:
    truth = project_points(CAMERA, transform_points(CAMERA_FROM_LPS, POINTS))
    visible = ((truth > 0) & (truth < 1535)).all(1)
    assert 8 <= visible.sum() < 14
    detection = detect(Planted(planted(truth, visible), True), image, CAMERA, PLAIN)
    assert not detection.turned
    assert detection.visible.equal(visible)
    assert_close(detection.pixels[visible], truth[visible], atol=0.7, rtol=0)  # 0.04 pixels of the heat map
    seen = detection.visible
    pose = solve_pnp(POINTS[seen], detection.pixels[seen], CAMERA, detection.confidence[seen]).camera_from_object
    moved = invert_rigid(CAMERA_FROM_LPS) @ pose
    assert torch.rad2deg(rotation_angle(moved[:3, :3])) < 0.15
    assert (transform_points(moved, POINTS) - POINTS).norm(dim=1).max() < 3


def test_an_image_on_its_head_is_read_turned(image: Tensor) -> None:
    truth = project_points(CAMERA, transform_points(CAMERA_FROM_LPS, POINTS))
    visible = ((truth > 0) & (truth < 1535)).all(1)
    detection = detect(Planted(planted(truth, visible), True), image.rot90(2), CAMERA, PLAIN)
    assert detection.turned
    assert_close(detection.pixels[visible], 1535 - truth[visible], atol=0.7, rtol=0)
    assert detection.segmentation[:, 90].argmax(0).eq(5).all()
    assert detection.segmentation[:, 5].argmax(0).eq(0).all()


def test_the_segmentations_camera(image: Tensor) -> None:
    detection = detect(Planted(planted(torch.full((14, 2), 700.0), torch.ones(14).bool()), True), image, CAMERA, PLAIN)
    assert detection.segmentation.shape == (7, *detection.network_camera.shape)
    assert detection.network_camera == network_camera(CAMERA).downsampled(2)
    assert_close(detection.segmentation.sum(0), torch.ones(96, 96))


def test_bad_images(image: Tensor) -> None:
    network = Planted(planted(torch.zeros(14, 2), torch.zeros(14).bool()), True)
    with pytest.raises(InputError, match="every pixel of the image is 1"):
        detect(network, torch.ones(CAMERA.shape), CAMERA)
    with pytest.raises(InputError, match="its camera has"):
        detect(network, image[:100], CAMERA)
    with pytest.raises(InputError, match="not finite"):
        detect(network, image * torch.nan, CAMERA)


def test_bad_weights(tmp_path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match="no such file"):
        load_network(tmp_path / "missing.safetensors")
    (tmp_path / "text.safetensors").write_text("not weights")
    with pytest.raises(InputError, match="cannot be read as safetensors"):
        load_network(tmp_path / "text.safetensors")


def test_a_camera_of_other_pixels(image: Tensor) -> None:
    camera = Camera(1020.0, (0.388, 0.388), (768, 768), (383.5, 383.5))
    truth = project_points(CAMERA, transform_points(CAMERA_FROM_LPS, POINTS))
    visible = ((truth > 0) & (truth < 1535)).all(1)
    detection = detect(Planted(planted(truth, visible), True), image[::2, ::2].contiguous(), camera, PLAIN)
    assert_close(detection.pixels[visible], (truth[visible] + 0.5) / 2 - 0.5, atol=0.4, rtol=0)
