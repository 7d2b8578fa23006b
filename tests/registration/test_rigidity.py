"""An object that was bent since its model was made is told from a straight one."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import KINDS, KINK_DEG, REFERENCE_POINTS, images_of_broken, make_scene, off, true_poses

from femoreg_torch.registration import Scene, doubts
from femoreg_torch.registration.doubts import doubts_about_rigidity
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.registration.rigidity import CUTS, Bend, bend

TRUTH = true_poses()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def test_what_is_rigid_is_not_doubted(scene: Scene) -> None:
    for name in REFERENCE_POINTS:
        for share in CUTS:
            found = bend(scene, TRUTH, name, share, PLAIN)
            assert found is not None
            assert found.apart_mm < 0.4, (name, share)
    assert doubts_about_rigidity(scene, TRUTH, PLAIN) == ()


@pytest.mark.parametrize(("name", "axis"), [("device", 2), ("femur", 0)])
def test_a_broken_object_is_doubted_by_as_much_as_it_is_bent(scene: Scene, name: str, axis: int) -> None:
    broken = replace(scene, images=images_of_broken(name, axis, TRUTH, KINDS))
    found = bend(broken, TRUTH, name, 0.5, PLAIN)
    assert found is not None
    assert found.angle_deg == pytest.approx(float(torch.tensor(KINK_DEG).norm()), abs=2)
    assert found.sureness > 4
    (doubt,) = doubts_about_rigidity(broken, TRUTH, PLAIN)
    assert f"the images show the ends of the {name}" in doubt
    assert "bent or broken" in doubt


def test_a_break_that_is_small_and_yet_explains_the_images_is_doubted(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A neck that broke by 6° was 1.3 mm apart, less than what limits alone told, and gained eight times as much as
    unbroken ones."""
    motion = torch.tensor([4.0, 0, 0, 0.5, 0, 0], dtype=torch.float64)
    for apart, gain, told in ((1.3, 0.0012, 1), (1.3, 0.0003, 0), (0.5, 0.0012, 0)):
        ends = Bend(motion, motion.abs() / 3 + 1e-9, apart, 0.6, gain)
        monkeypatch.setattr(doubts, "bend", lambda *asked, ends=ends: ends if asked[2] == "femur" else None)
        assert len(doubts_about_rigidity(scene, TRUTH, PLAIN)) == told, (apart, gain)


def test_an_end_that_no_two_views_show_is_not_asked(scene: Scene) -> None:
    beside = TRUTH.with_object(
        "device", off(TRUTH.camera1_from["device"], REFERENCE_POINTS["device"], (0, 0, 0), (150, 0, 0))
    )
    assert all(bend(scene, beside, "device", share, PLAIN) is None for share in CUTS)


def test_an_end_that_shutters_hide_is_not_asked(scene: Scene) -> None:
    shut = torch.zeros(scene.carm.camera.shape, dtype=torch.bool)
    behind = replace(scene, fields={"device": (shut, shut, None)})
    assert bend(behind, TRUTH, "device", 0.5, PLAIN) is None
    assert bend(behind, TRUTH, "femur", 0.5, PLAIN) is not None  # the images without the device are exposed
