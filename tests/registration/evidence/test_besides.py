"""What came with a device into its images is seen, and another of its shape beside it is told as its rival."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, line_integrals, make_scene, off, true_poses
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.drr import project
from femoreg_torch.geometry import Poses, centred_camera
from femoreg_torch.registration import Scene
from femoreg_torch.registration.doubts.device import doubts_beside_devices
from femoreg_torch.registration.evidence.besides import _across, _share, besides, change_about, rival
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.volume import Volume, axis_aligned

TRUTH = true_poses()
ASIDE = off(TRUTH.camera1_from["device"], REFERENCE_POINTS["device"], (0, 0, 0), (-16, 12, 0))
ROD = Volume(F.pad(torch.full((26, 2, 2), 0.2), (1,) * 6), axis_aligned((3.0,) * 3, (-4.5, -4.5, -40.5)))
CEMENT = Volume(torch.full((10, 10, 10), 0.05), axis_aligned((3.0,) * 3, (-60.0, -40.0, -10.0)))  # beside the femur


def shadow(volume: Volume, poses: Poses, name: str, view: int) -> Tensor:
    fine = centred_camera(1020.0, (1.5, 1.5), (176, 176))
    image = project([volume], poses.camera_from(name)[view][None, None], fine, 0.3)
    return F.avg_pool2d(image[None], 2)[0, 0]


def with_rods(*places: Poses) -> Scene:
    """A rod for the device, and in its images one at each place."""
    scene = make_scene(TRUTH)
    images = tuple(
        scene.image("anatomy", view) + torch.stack([shadow(ROD, poses, "device", view) for poses in places]).sum(0)
        for view in range(3)
    )
    rod = replace(scene.objects["device"], volume=ROD)
    return replace(scene, images=scene.images | {"device": images}, objects=scene.objects | {"device": rod})


def with_cement(kind: str) -> Scene:
    scene = with_rods(TRUTH)
    images = tuple(scene.image(kind, view) + shadow(CEMENT, TRUTH, "femur", view) for view in range(3))
    return replace(scene, images=scene.images | {kind: images})


def test_nothing_is_seen_beside_a_device_alone() -> None:
    scene = make_scene(TRUTH)
    assert not any(found.more or found.less for found in besides(scene, TRUTH, "device", "device"))
    assert doubts_beside_devices(scene, TRUTH, PLAIN, in_doubt=True) == ()


def test_exposures_that_differ_are_nothing_beside_it() -> None:
    scene = make_scene(TRUTH)
    darker = tuple(scene.image("device", view) + 0.7 for view in range(3))
    scene = replace(scene, images=scene.images | {"device": darker})
    assert not any(found.more or found.less for found in besides(scene, TRUTH, "device", "device"))


def test_scattered_light_that_differs_is_nothing_beside_it() -> None:
    """Up to twice what is a shadow, without an edge."""
    scene = make_scene(TRUTH)
    row, column = torch.meshgrid(*[torch.arange(88.0) * 3 - 130] * 2, indexing="ij")
    veil = 0.3 * (-((row + 80) ** 2 + (column + 60) ** 2) / (2 * 45.0**2)).exp()
    veiled = tuple(scene.image("device", view) + veil for view in range(3))
    scene = replace(scene, images=scene.images | {"device": veiled})
    assert not any(found.more or found.less for found in besides(scene, TRUTH, "device", "device"))


@pytest.mark.parametrize("at", [TRUTH.camera1_from["device"], ASIDE])
def test_a_twin_is_told_from_either_of_the_two(at: Tensor) -> None:
    scene = with_rods(TRUTH, TRUTH.with_object("device", ASIDE))
    poses = TRUTH.with_object("device", at)
    found = rival(scene, poses, "device", "device", PLAIN)
    assert found is not None
    assert found.share > 0.65
    (told,) = doubts_beside_devices(scene, poses, PLAIN, in_doubt=False)
    assert "something else of the shape of the device" in told


def test_what_has_another_shape_is_no_rival_but_may_be_the_cause_of_doubts() -> None:
    scene = with_cement("device")
    assert all(found.more and not found.less for found in besides(scene, TRUTH, "device", "device"))
    assert doubts_beside_devices(scene, TRUTH, PLAIN, in_doubt=False) == ()
    (told,) = doubts_beside_devices(scene, TRUTH, PLAIN, in_doubt=True)
    assert "the device images of view 1 and 2 and 3 show something besides the device" in told


def test_what_only_the_images_without_the_device_show_is_told_as_that() -> None:
    (told,) = doubts_beside_devices(with_cement("anatomy"), TRUTH, PLAIN, in_doubt=True)
    assert "the images without the device of view 1 and 2 and 3 show something" in told


def test_a_bone_that_moved_is_not_taken_for_something_else() -> None:
    moved = Poses(TRUTH.camera_from_camera1, dict(TRUTH.camera1_from))
    pelvis = off(TRUTH.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (0, 0, 0), (6, 0, 0))
    images = tuple(
        line_integrals(moved.with_object("pelvis", pelvis), view, ("pelvis", "femur", "device")) for view in range(3)
    )
    scene = make_scene(TRUTH)
    scene = replace(scene, images=scene.images | {"device": images})
    assert doubts_beside_devices(scene, TRUTH, PLAIN, in_doubt=True) == ()


def test_what_equalising_brightens_about_a_device_is_told_and_no_shadow() -> None:
    scene = make_scene(TRUTH)
    assert change_about(scene, TRUTH, "device", "device", 0).abs().max() < 0.01
    row, column = torch.meshgrid(*[torch.arange(88.0) * 3 - 130] * 2, indexing="ij")
    halo = 0.3 * (-(row**2 + column**2) / (2 * 90.0**2)).exp()
    plain = scene.image("device", 0)
    for change in (-halo, halo):  # brighter, as of equalised images, and darker, as where scattered light came
        changed = replace(scene, images=scene.images | {"device": (plain + change, *scene.images["device"][1:])})
        found = change_about(changed, TRUTH, "device", "device", 0)
        assert found.shape == plain.shape
        torch.testing.assert_close(found, change.clip(max=0).to(found), atol=0.08, rtol=0)
    for exposure in (-0.2, 0.3):
        changed = replace(scene, images=scene.images | {"device": (plain + exposure, *scene.images["device"][1:])})
        found = change_about(changed, TRUTH, "device", "device", 0)
        torch.testing.assert_close(found, torch.full_like(found, exposure), atol=0.02, rtol=0)


def test_what_explains_one_view_alone_is_no_rival() -> None:
    """Moved along the beam of view 1 a device explains that view as well as where it is, and no other."""
    totals = torch.tensor([0.05, 0.04, 0.08])
    assert _share(torch.tensor([-0.01, 0.0, 0.08]), totals) < 0
    assert _share(0.8 * totals, totals) == pytest.approx(0.8)
    assert _share(totals[:1], totals[:1]) == pytest.approx(1)  # there is no other view to ask
    assert _share(torch.tensor([0.05, 0.01, 0.0]), torch.tensor([0.05, 0.0, 0.0])) == 0  # others show no device


@pytest.mark.parametrize("long", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.6, 0.0, 0.8), (1.0, 0.0, 0.0)])
def test_the_directions_across_a_device_are_square_to_it(long: tuple[float, float, float]) -> None:
    axis = torch.tensor(long, dtype=torch.float64)
    square = torch.cat([_across(axis), axis[:, None]], 1)
    torch.testing.assert_close(square.T @ square, torch.eye(3, dtype=torch.float64))
