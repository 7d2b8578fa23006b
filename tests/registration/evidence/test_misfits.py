"""Images that do not show what is drawn for them: mirrored, turned, exchanged, of something else."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from registration_scenes import CARM, float64, make_scene, true_poses

from femoreg_torch.geometry import exp_se3
from femoreg_torch.registration.doubts.images import doubts_about_exchanged_kinds, doubts_about_the_images
from femoreg_torch.registration.evidence.misfits import misfits
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.registration.scene import Kind, Scene

TRUTH = true_poses()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def with_image(scene: Scene, kind: Kind, view: int, image: torch.Tensor) -> Scene:
    images = list(scene.images[kind])
    images[view] = image
    return replace(scene, images=scene.images | {kind: tuple(images)})


def test_right_images_fit(scene: Scene) -> None:
    assert misfits(scene, TRUTH, PLAIN) == ()


@pytest.mark.parametrize(
    ("dims", "turns", "told"), [((1,), 0, "mirrored"), ((), 2, "turned by 180°"), ((), 1, "turned by 270°")]
)
def test_an_image_that_was_stored_otherwise(scene: Scene, dims: tuple[int, ...], turns: int, told: str) -> None:
    """Its C-arm ended where the search along the orbit put it, which is nowhere."""
    other = scene.image("anatomy", 1).flip(dims).rot90(turns)
    strange = with_image(scene, "anatomy", 1, other)
    astray = TRUTH.with_view(1, exp_se3(float64(0.05, 0.3, -0.1, 20, -10, 30)) @ TRUTH.camera_from_camera1[1])
    (found,) = misfits(strange, astray, PLAIN)  # not the device image of a view that was not placed as well
    assert (found.kind, found.view, found.as_stored) == ("anatomy", 1, told)
    (doubt,) = doubts_about_the_images(strange, [found])
    assert "view 2" in doubt
    assert f"{told} it does" in doubt


def test_an_image_that_was_inverted(scene: Scene) -> None:
    inverted = 5 - scene.image("anatomy", 1)
    fields: tuple[torch.Tensor | None, ...] = (None, torch.ones_like(inverted).bool(), None)
    strange = replace(with_image(scene, "anatomy", 1, inverted), fields={"anatomy": fields})
    (found,) = misfits(strange, TRUTH, PLAIN)
    assert (found.kind, found.view, found.as_stored) == ("anatomy", 1, "with bright and dark exchanged")
    assert "check `display` and `intensity`" in doubts_about_the_images(strange, [found])[0]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda image: 5 - image, "with bright and dark exchanged"),
        (lambda image: image.flip(1), "mirrored"),
        (lambda image: image.rot90(1), "turned by 270°"),
    ],
)
def test_a_device_image_that_was_stored_otherwise_than_the_other_of_its_view(
    scene: Scene, change: Callable[[torch.Tensor], torch.Tensor], told: str
) -> None:
    strange = with_image(scene, "device", 2, change(scene.image("device", 2)))
    (found,) = misfits(strange, TRUTH, PLAIN)
    assert (found.kind, found.view, found.as_view, found.as_stored) == ("device", 2, None, told)
    (doubt,) = doubts_about_the_images(strange, [found])
    assert doubt.startswith("the device image of view 3 does not fit as the case tells it")
    assert f"{told} it does" in doubt


def test_device_images_that_were_exchanged(scene: Scene) -> None:
    exchanged = with_image(scene, "device", 1, scene.image("device", 2))
    exchanged = with_image(exchanged, "device", 2, scene.image("device", 1))
    found = misfits(exchanged, TRUTH, PLAIN)
    assert [(each.kind, each.view, each.as_view) for each in found] == [("device", 1, 2), ("device", 2, 1)]
    assert "shows what the other images of view 3 show" in doubts_about_the_images(exchanged, found)[0]


def test_images_of_something_else(scene: Scene) -> None:
    noise = torch.rand(scene.image("anatomy", 1).shape, generator=torch.Generator().manual_seed(3))
    for kind, says in (("anatomy", "or register without that view"), ("device", "no images are exchanged")):
        strange = with_image(scene, kind, 1, noise)
        (found,) = misfits(strange, TRUTH, PLAIN)
        assert (found.kind, found.view, found.as_view, found.as_stored) == (kind, 1, None, None)
        assert found.similarity < 0.2 < found.in_view_1
        assert says in doubts_about_the_images(strange, [found])[0]


def test_a_view_1_that_shows_nothing_of_the_bones_is_told_as_that(scene: Scene) -> None:
    """All else would be compared with it, and so it is told alone."""
    noise = torch.rand(scene.image("anatomy", 0).shape, generator=torch.Generator().manual_seed(3))
    for strange in (noise, 5 - scene.image("anatomy", 0)):
        (found,) = misfits(with_image(scene, "anatomy", 0, strange), TRUTH, PLAIN)
        assert (found.kind, found.view) == ("anatomy", 0)
        (doubt,) = doubts_about_the_images(scene, [found])
        assert doubt.startswith("the anatomy image of view 1 does not show the bones where they were found")


def test_a_view_that_was_not_looked_for_so_far_is_told_with_its_angle(scene: Scene) -> None:
    """A preset's search may end before it."""
    astray = TRUTH.with_view(2, TRUTH.camera_from_camera1[2] @ exp_se3(float64(0, 0.9, 0, 0, 0, 0)))
    (found,) = misfits(scene, astray, PLAIN)
    assert found.found_deg == pytest.approx(15, abs=3)
    (doubt,) = doubts_about_the_images(scene, [found])
    assert f"but {found.found_deg:.0f}° from view 1 it does: the search for it ended elsewhere" in doubt


def test_poses_that_the_case_gives_are_named_where_an_image_does_not_fit(scene: Scene) -> None:
    noise = torch.rand(scene.image("anatomy", 1).shape, generator=torch.Generator().manual_seed(3))
    given = replace(with_image(scene, "anatomy", 1, noise), camera_from_camera1=TRUTH.camera_from_camera1)
    told = doubts_about_the_images(given, misfits(given, TRUTH, PLAIN))[0]
    assert "does not fit at the pose that the case gives" in told
    assert "not the inverse" in told


def test_the_only_device_image_may_be_of_something_else() -> None:
    """There is no other view that it could have been taken in."""
    truth = true_poses((0,))
    noise = torch.rand(CARM.camera.shape, generator=torch.Generator().manual_seed(3))
    strange = with_image(make_scene(truth), "device", 0, noise)
    (found,) = misfits(strange, truth, PLAIN)
    assert (found.kind, found.view, found.as_view, found.as_stored) == ("device", 0, None, None)
    assert "no images are exchanged" in doubts_about_the_images(strange, [found])[0]


def test_images_with_and_without_the_device_that_are_exchanged_are_told_with_the_view(scene: Scene) -> None:
    assert doubts_about_exchanged_kinds(scene) == ()
    without, with_it = scene.image("anatomy", 1), scene.image("device", 1)
    exchanged = with_image(with_image(scene, "anatomy", 1, with_it + 0.3), "device", 1, without)
    (doubt,) = doubts_about_exchanged_kinds(exchanged)
    assert doubt.startswith("the anatomy image of view 2 shows something dense that the device image lacks")
    everywhere = replace(scene, images={"anatomy": scene.images["device"], "device": scene.images["anatomy"]})
    assert "of view 1 and 2 and 3" in doubts_about_exchanged_kinds(everywhere)[0]
