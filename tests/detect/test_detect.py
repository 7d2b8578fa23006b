"""Planted heat maps: decoded to sub-pixel truth, mapped to the detector, and solved for the pose."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP
from femoreg_torch.detect import LandmarkNetwork, decode_heatmaps, detect, load_network, network_camera
from femoreg_torch.detect.decode import expected_error
from femoreg_torch.detect.network import _most_landmarks
from femoreg_torch.detect.tta import PLAIN
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, invert_rigid, load_carm, project_points, rotation_angle, transform_points
from femoreg_torch.pnp import solve_pnp
from models.protocols import Prediction
from models.unet import UNetSettings
from models.weights import Weights, save_weights

CAMERA = load_carm("cios_fusion").camera
LEFT_HALF = [[90.0, -10, -80], [75, 15, -25], [48, 10, -120], [30, -10, -112], [4, -45, -108], [4, -20, -120]]
POINTS = torch.tensor([[s * x, y, z] for x, y, z in [*LEFT_HALF, [85.0, -75, -45]] for s in (1, -1)]).double()
CAMERA_FROM_LPS = torch.tensor([[1.0, 0, 0, 20], [0, 0, -1, -60], [0, 1, 0, 760], [0, 0, 0, 1]], dtype=torch.float64)


LANDMARKS, CLASSES = len(HIP.landmarks), 1 + len(HIP.bones)
(FEMUR,) = HIP.classes(["femur_left"])


def peaks(pixels: Tensor, shape: tuple[int, int] = (96, 96), sigma_px: float = 1.5) -> Tensor:
    """Log-probabilities (L, H, W) of Gaussians about `pixels` (L, 2)."""
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in shape)
    squares = (columns - pixels[:, :1])[:, None, :] ** 2 + (rows - pixels[:, 1:])[:, :, None] ** 2
    return (-squares / (2 * sigma_px**2)).flatten(1).log_softmax(1).view(squares.shape).float()


def planted(pixels: Tensor, visible: Tensor) -> Prediction:
    """What a perfect network says about landmarks at `pixels` (L, 2) of the detector."""
    on_output = pixels / 16 - 7.5 / 16  # 16 detector pixels per output pixel, centre on centre
    segmentation = torch.zeros(1, CLASSES, 96, 96)
    segmentation[:, FEMUR, :48] = 9.0
    return Prediction(segmentation, peaks(on_output)[None], torch.where(visible, -25.0, 25.0)[None])


class Planted(nn.Module):
    """Answers with what was planted, bright bone or dark; with no landmark for the image turned by 180°."""

    def __init__(self, prediction: Prediction) -> None:
        super().__init__()
        self.prediction = prediction

    def forward(self, image: Tensor) -> Prediction:
        striped = image.diff(dim=2).abs()
        upright = bool(striped[0, 0, :96].mean() > striped[0, 0, 96:].mean())
        return self.prediction if upright else self.prediction._replace(absence=torch.full((1, LANDMARKS), 20.0))


def planting(pixels: Tensor, visible: Tensor) -> LandmarkNetwork:
    """A network that knows the image of `image()` the right way up."""
    return LandmarkNetwork(Planted(planted(pixels, visible)))


@pytest.fixture
def image() -> Tensor:
    """Brighter towards its top, whose half is striped."""
    rows = torch.arange(CAMERA.shape[0])
    stripes = 0.05 * (rows // 16 % 2) * (rows < CAMERA.shape[0] // 2)
    return (1 - rows / CAMERA.shape[0] + stripes)[:, None].expand(CAMERA.shape).contiguous()


def test_sub_pixel_positions_and_confidence() -> None:
    pixels = torch.tensor([[20.3, 30.6], [40.0, 40.5], [60.9, 10.1]])
    visible = torch.tensor([True, True, False])
    found, confidence = decode_heatmaps(peaks(pixels, (96, 90)), torch.where(visible, -25.0, 25.0))
    assert_close(found[:2].float(), pixels[:2], atol=0.04, rtol=0)
    assert confidence[:2].min() > 0.97
    assert confidence[2] < 0.01


def test_two_places_are_half_as_sure() -> None:
    both = peaks(torch.tensor([[20.0, 30.0], [70.0, 60.0]])).logsumexp(0, keepdim=True)
    _, confidence = decode_heatmaps(both, torch.tensor([-25.0]))
    assert_close(confidence, torch.tensor([0.5]).double(), atol=0.02, rtol=0)


def test_a_peak_wider_than_the_networks_own_is_less_certain() -> None:
    """The network's own peak of 1.25 pixels leaves the floor of 0.55; what is wider adds 0.4 of its variance."""
    pixels = torch.tensor([[40.0, 40.0]], dtype=torch.float64)
    own, wide = (expected_error(peaks(pixels, sigma_px=s), pixels, sigma_px=1.25).item() for s in (1.25, 2.0))
    assert own == pytest.approx(0.55, abs=1e-3)
    assert wide == pytest.approx((0.4 * (2.0**2 - 1.25**2) + 0.55**2) ** 0.5, abs=2e-3)
    assert expected_error(peaks(pixels, sigma_px=2.0), pixels, sigma_px=2.0).item() == pytest.approx(0.55, abs=5e-3)


def test_planted_landmarks_give_the_pose(image: Tensor) -> None:
    truth = project_points(CAMERA, transform_points(CAMERA_FROM_LPS, POINTS))
    visible = ((truth > 0) & (truth < 1535)).all(1)
    assert 8 <= visible.sum() < LANDMARKS
    detection = detect(planting(truth, visible), image, CAMERA, PLAIN)
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
    detection = detect(planting(truth, visible), image.rot90(2), CAMERA, PLAIN)
    assert detection.turned
    assert_close(detection.pixels[visible], 1535 - truth[visible], atol=0.7, rtol=0)
    assert detection.segmentation[:, 90].argmax(0).eq(FEMUR).all()
    assert detection.segmentation[:, 5].argmax(0).eq(0).all()


@pytest.mark.parametrize(("shown", "turned"), [(3, False), (4, True)])
def test_a_few_landmarks_do_not_stand_an_image_on_its_head(shown: int, turned: bool, image: Tensor) -> None:
    truth = project_points(CAMERA, transform_points(CAMERA_FROM_LPS, POINTS))
    visible = torch.arange(LANDMARKS) < shown
    assert detect(planting(truth, visible), image, CAMERA, PLAIN).visible.sum() > 0
    assert detect(planting(truth, visible), image.rot90(2), CAMERA, PLAIN).turned == turned


def test_one_reading_that_is_turned_and_inverted_does_not_stand_an_image_on_its_head() -> None:
    """As of an ordinary hip: both upright readings expected 3.5 landmarks, and turned and inverted at once 4.3."""
    expected = {(False, False): 3.5, (False, True): 3.5, (True, False): 0.9, (True, True): 4.3}
    assert _most_landmarks(expected) == (False, False)
    turned = {(not turned, inverted): most for (turned, inverted), most in expected.items()}
    assert _most_landmarks(turned) == (True, False)


def test_the_segmentations_camera(image: Tensor) -> None:
    detection = detect(planting(torch.full((LANDMARKS, 2), 700.0), torch.ones(LANDMARKS).bool()), image, CAMERA, PLAIN)
    assert detection.segmentation.shape == (CLASSES, *detection.network_camera.shape)
    assert detection.network_camera == network_camera(CAMERA).downsampled(2)
    assert_close(detection.segmentation.sum(0), torch.ones(96, 96))


def test_bad_images(image: Tensor) -> None:
    network = planting(torch.zeros(LANDMARKS, 2), torch.zeros(LANDMARKS).bool())
    with pytest.raises(InputError, match="every pixel of the image is 1"):
        detect(network, torch.ones(CAMERA.shape), CAMERA)
    with pytest.raises(InputError, match="its camera has"):
        detect(network, image[:100], CAMERA)
    with pytest.raises(InputError, match="not finite"):
        detect(network, image * torch.nan, CAMERA)


def test_bad_weights(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_network(tmp_path / "missing.safetensors")
    (tmp_path / "text.safetensors").write_text("not weights", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read as safetensors"):
        load_network(tmp_path / "text.safetensors")


def test_the_shipped_weights() -> None:
    network = load_network()
    assert network.anatomy == HIP
    assert not network.module.training
    with torch.inference_mode():
        prediction = network.module(torch.zeros(1, 1, 192, 192))
    assert prediction.segmentation.shape == (1, CLASSES, 96, 96)
    assert prediction.heatmaps.shape == (1, LANDMARKS, 96, 96)


SETTINGS = {"classes": CLASSES, "landmarks": LANDMARKS, "channels": [8, 12, 16], "convolutions": [1, 1, 1]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "vision_transformer"}, "vision_transformer"),
        ({"anatomy": "knee"}, "no anatomy preset 'knee'"),
        ({"settings": {**SETTINGS, "depth": 3}}, "unknown key 'depth'"),
        ({"settings": {**SETTINGS, "channels": [8, 12, 24]}}, "do not fit"),
        ({"settings": {**SETTINGS, "landmarks": 3}}, "3 landmarks, but the anatomy hip has"),
    ],
)
def test_weights_that_do_not_fit_what_they_say(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    state = UNetSettings(CLASSES, LANDMARKS, channels=(8, 12, 16), convolutions=(1, 1, 1)).build().state_dict()
    good = Weights("multitask_unet", SETTINGS, "hip", 1.5, state)
    path = tmp_path / "tiny.safetensors"
    save_weights(path, good, {})
    assert load_network(path).sigma_px == 1.5
    save_weights(path, replace(good, **change), {})
    with pytest.raises(InputError, match=message) as raised:
        load_network(path)
    assert str(raised.value).startswith(str(path))


def test_a_camera_of_other_pixels(image: Tensor) -> None:
    camera = Camera(1020.0, (0.388, 0.388), (768, 768), (383.5, 383.5))
    truth = project_points(CAMERA, transform_points(CAMERA_FROM_LPS, POINTS))
    visible = ((truth > 0) & (truth < 1535)).all(1)
    detection = detect(planting(truth, visible), image[::2, ::2].contiguous(), camera, PLAIN)
    assert_close(detection.pixels[visible], (truth[visible] + 0.5) / 2 - 0.5, atol=0.4, rtol=0)
