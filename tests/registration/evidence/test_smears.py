"""An image that was smeared while it was taken is told; what differs otherwise between two images is not a smear."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from registration_scenes import REFERENCE_POINTS, line_integrals, make_scene, off, true_poses
from scipy import ndimage
from torch import Tensor

from femoreg_torch.fluoro import natural
from femoreg_torch.registration import Scene
from femoreg_torch.registration.doubts.images import doubts_about_smears
from femoreg_torch.registration.evidence.smears import smears

TRUTH = true_poses()


def smeared(image: Tensor, rows: float, columns: float) -> Tensor:
    """An attenuation image (H, W), its intensities averaged along a way of so many pixels."""
    steps = np.linspace(-0.5, 0.5, 9)
    light = np.exp(-image.numpy())
    every = [ndimage.shift(light, (rows * t, columns * t), order=1, mode="nearest") for t in steps]
    return torch.from_numpy(-np.log(np.mean(every, 0))).to(image)


def with_image(scene: Scene, kind: str, view: int, image: Tensor) -> Scene:
    images = list(scene.images[kind])
    images[view] = image
    return replace(scene, images={**scene.images, kind: tuple(images)})


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def test_sharp_images_are_not_smeared(scene: Scene) -> None:
    found = smears(scene, TRUTH)
    assert [(each.kind, each.view) for each in found] == [("device", view) for view in range(3)]
    assert all(each.kept > 0.98 for each in found)
    assert doubts_about_smears(scene, TRUTH) == ()


@pytest.mark.parametrize("kind", ["device", "anatomy"])
@pytest.mark.parametrize("way", [(3.0, 0.0), (0.0, 3.0), (-2.0, 2.0)])
def test_a_smear_is_told_of_its_view(scene: Scene, kind: str, way: tuple[float, float]) -> None:
    there = with_image(scene, kind, 1, smeared(scene.image(kind, 1), *way))
    (told,) = doubts_about_smears(there, TRUTH)
    assert told.startswith("of view 2, the anatomy and the device image differ in sharpness along one direction")


def test_a_smear_is_told_of_grey_values_too(scene: Scene) -> None:
    """Where nothing is known of how strong a shadow is."""

    def grey(image: Tensor) -> Tensor:
        return 1000 * image + 10 * torch.arange(image.shape[1])

    there = scene
    for kind in scene.images:
        for view in range(3):
            there = with_image(there, kind, view, grey(scene.image(kind, view)))
    assert not any(natural(there.image("device", view)) for view in range(3))
    assert doubts_about_smears(there, TRUTH) == ()
    smear = grey(smeared(scene.image("device", 0), 0.0, 3.0))
    assert len(doubts_about_smears(with_image(there, "device", 0, smear), TRUTH)) == 1


def test_exposure_noise_and_a_blur_of_1_2_mm_along_all_directions_are_no_smear(scene: Scene) -> None:
    image = scene.image("device", 1)
    noise = 0.02 * torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    soft = torch.from_numpy(ndimage.gaussian_filter(image.numpy(), 0.4)).to(image)
    assert doubts_about_smears(with_image(scene, "device", 1, 0.9 * soft + noise + 0.6), TRUTH) == ()


def test_what_came_with_the_device_is_no_smear(scene: Scene) -> None:
    image = scene.image("device", 1).clone()
    image[20:70, 60:64] += 0.9  # a rod beside it
    assert doubts_about_smears(with_image(scene, "device", 1, image), TRUTH) == ()


def test_a_bone_that_moved_is_no_smear(scene: Scene) -> None:
    pelvis = off(TRUTH.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (0, 0, 0), (3, 1, 0))
    image = line_integrals(TRUTH.with_object("pelvis", pelvis), 1, ("pelvis", "femur", "device"))
    assert doubts_about_smears(with_image(scene, "device", 1, image), TRUTH) == ()


def test_views_that_lack_an_image_or_show_nothing_are_left_out(scene: Scene) -> None:
    lacking = replace(scene, images={**scene.images, "device": (*scene.images["device"][:2], None)})
    assert [each.view for each in smears(lacking, TRUTH)] == [0, 1]
    empty = torch.zeros_like(scene.image("device", 0))
    for kinds in (("anatomy", "device"), ("anatomy",), ("device",)):
        blank = scene
        for kind in kinds:
            blank = with_image(blank, kind, 0, empty)
        assert [each.view for each in smears(blank, TRUTH)] == [1, 2]


def test_shutters_that_differ_are_no_smear(scene: Scene) -> None:
    exposed = torch.zeros(scene.carm.camera.shape, dtype=torch.bool)
    exposed[:, 20:80] = True
    image = scene.image("device", 1).where(exposed, scene.image("device", 1).new_tensor(6.0))
    fields = {**scene.fields, "device": (None, exposed, None)}
    fields.setdefault("anatomy", (None, None, None))
    there = replace(with_image(scene, "device", 1, image), fields=fields)
    assert doubts_about_smears(there, TRUTH) == ()
