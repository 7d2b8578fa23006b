"""Trust: given at the truth, withheld where a pose is wrong or an object cannot be seen."""

import pytest
from registration_scenes import REFERENCE_POINTS, float64, make_scene, off, true_poses

from femoreg_torch.registration import Scene, quality
from femoreg_torch.registration.objective import Level
from femoreg_torch.registration.quality import Limits, assess

TRUTH = true_poses()
LIMITS = Limits()


@pytest.fixture(autouse=True)
def whole_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quality, "_LEVEL", Level(downsample=1, step_mm=2.0, patch_radius=4))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def test_the_truth_is_trusted(scene: Scene) -> None:
    for name, found in assess(scene, TRUTH, LIMITS).items():
        assert found.trusted, (name, found)
        assert found.in_plane_uncertainty_mm < 0.3
        assert len(found.views) == 3


@pytest.mark.parametrize("name", ["pelvis", "femur", "device"])
def test_a_shifted_object_is_not(scene: Scene, name: str) -> None:
    wrong = off(TRUTH.camera1_from[name], REFERENCE_POINTS[name], (0, 0, 0), (6, 3, 0))
    found = assess(scene, TRUTH.with_object(name, wrong), LIMITS)[name]
    assert not found.trusted
    assert name in found.reason


def test_an_object_outside_the_image_is_not(scene: Scene) -> None:
    away = TRUTH.camera1_from["femur"].clone()
    away[:3, 3] = float64(900, 0, 740)
    found = assess(scene, TRUTH.with_object("femur", away), LIMITS)["femur"]
    assert not found.trusted
    assert found.reason.startswith("view 1")


def test_a_wrong_view_is_noticed(scene: Scene) -> None:
    wrong = off(TRUTH.camera_from_camera1[1], float64(0, 0, 740), (0, 2, 0), (5, 0, 0))
    assert not assess(scene, TRUTH.with_view(1, wrong), LIMITS)["pelvis"].trusted
