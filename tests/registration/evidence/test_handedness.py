"""An object is told from its mirror image, and one that is its own mirror image is not doubted."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, VOLUMES, float64, make_scene, off, true_poses

from femoreg_torch.drr import project
from femoreg_torch.geometry import transform_points
from femoreg_torch.registration import Scene, evidence
from femoreg_torch.registration.doubts.device import doubts_about_the_models
from femoreg_torch.registration.doubts.shape import doubts_about_handedness
from femoreg_torch.registration.evidence.handedness import handedness, mirror_images
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.volume import Volume, axis_aligned

TRUTH = true_poses()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def with_volume(scene: Scene, name: str, volume: Volume) -> Scene:
    return replace(scene, objects=scene.objects | {name: replace(scene.objects[name], volume=volume)})


def line_integrals_of(scene: Scene, view: int) -> torch.Tensor:
    """The image of all objects of a scene in a view, at their true poses."""
    where = torch.stack([TRUTH.camera_from(name)[view] for name in scene.objects])[None]
    return project([thing.volume for thing in scene.objects.values()], where, CARM.camera, 1.0)[0]


def test_mirror_images_hold_the_same_values_at_mirrored_places() -> None:
    volume = VOLUMES["femur"]
    for mirrored in mirror_images(volume):
        assert float(torch.linalg.det(mirrored.lps_from_index[:3, :3])) > 0
        assert mirrored.spacing_mm == pytest.approx(volume.spacing_mm)
        ends = torch.cartesian_prod(*[float64(0, n - 1) for n in reversed(volume.data.shape)])
        turned_round = torch.stack([volume.data.shape[2] - 1 - ends[:, 0], ends[:, 1], ends[:, 2]], 1)
        places = transform_points(volume.lps_from_index, ends)
        images = transform_points(mirrored.lps_from_index, turned_round)
        normal = (images - places)[0] / (images - places)[0].norm()
        heights = (places @ normal) + (images @ normal)
        torch.testing.assert_close(heights, heights[:1].expand(8))  # all are halved by one plane
        along = [points - (points @ normal)[:, None] * normal for points in (places, images)]
        torch.testing.assert_close(along[0], along[1])


def test_objects_as_they_are_fit_better_than_their_mirror_images(scene: Scene) -> None:
    for name in REFERENCE_POINTS:
        fits = handedness(scene, TRUTH, name, PLAIN)
        assert fits.similarity > fits.mirrored + 0.02, name
    assert doubts_about_handedness(scene, scene, TRUTH, PLAIN) == ()


def test_a_mirrored_object_is_doubted_though_it_is_a_little_off(scene: Scene) -> None:
    wrong = with_volume(scene, "pelvis", mirror_images(VOLUMES["pelvis"])[2])
    here = off(TRUTH.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (1, -1, 1), (1, -1, 3))
    (doubt,) = doubts_about_handedness(wrong, wrong, TRUTH.with_object("pelvis", here), PLAIN)
    assert "the pelvis fits the images better mirrored" in doubt


def test_a_plane_that_changes_an_object_hardly_more_is_tried_as_well(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The right mirror image lies 9 mm away, where it fits a little worse at first than one that changes nothing."""
    told, true = mirror_images(VOLUMES["pelvis"])[2], VOLUMES["pelvis"]
    place = true.lps_from_index.clone()
    place[:3, 3] += float64(8.15, -4.075, 0)
    monkeypatch.setattr(evidence.handedness, "mirror_images", lambda _: [told, Volume(true.data, place)])
    fits = handedness(with_volume(scene, "pelvis", told), TRUTH, "pelvis", PLAIN)
    assert fits.mirrored > fits.similarity + 0.3


def test_what_is_its_own_mirror_image_is_not_doubted(scene: Scene) -> None:
    block = torch.zeros(20, 24, 30)
    block[4:-4, 4:-4, 4:-4] = 0.05
    box = Volume(block, axis_aligned((3.0, 3.0, 3.0), (-43.5, -34.5, -28.5)))
    boxed = with_volume(scene, "device", box)
    device = [line_integrals_of(boxed, view) for view in range(3)]
    seen = replace(boxed, images={**scene.images, "device": tuple(device)})
    fits = handedness(seen, TRUTH, "device", PLAIN)
    assert fits.similarity > 0.8
    assert fits.mirrored == pytest.approx(fits.similarity, abs=0.004)
    assert doubts_about_handedness(seen, seen, TRUTH, PLAIN) == ()


def test_a_model_is_asked_as_it_was_told_and_not_as_it_was_estimated(scene: Scene) -> None:
    """Of a mirrored model the estimate keeps what is its own mirror image, which says nothing."""
    body, fin = torch.zeros(20, 30, 40), torch.zeros(20, 30, 40)
    body[6:-6, 10:-10, 4:-4] = 0.06
    fin[8:-8, 3:10, 6:14] = 0.06  # at one end, on one side,
    fin[1:6, 13:-13, 28:36] = 0.06  # and at the other end a quarter of a turn from there
    place = axis_aligned((2.0, 2.0, 2.0), (-39.0, -29.0, -19.0))
    true, mirrored, estimated = (Volume(data, place) for data in (body + fin, body + fin.flip(1), body))
    there = with_volume(scene, "device", true)
    device = tuple(line_integrals_of(there, view) for view in range(3))
    seen = replace(there, images={**scene.images, "device": device})
    assert doubts_about_handedness(seen, with_volume(seen, "device", estimated), TRUTH, PLAIN) == ()
    told = with_volume(seen, "device", mirrored)
    (doubt,) = doubts_about_handedness(told, with_volume(seen, "device", estimated), TRUTH, PLAIN)
    assert "the device fits the images better mirrored" in doubt


def shown(scene: Scene) -> Scene:
    """The same with images of the device as it is drawn."""
    return replace(scene, images={**scene.images, "device": tuple(line_integrals_of(scene, v) for v in range(3))})


def test_a_model_of_which_a_part_casts_no_shadow_is_doubted(scene: Scene) -> None:
    assert doubts_about_the_models(scene, scene, TRUTH) == ()
    data = VOLUMES["device"].data.clone()
    data[:, :, 15:] = 0.001
    estimated = with_volume(scene, "device", VOLUMES["device"].with_data(data))
    (doubt,) = doubts_about_the_models(scene, shown(estimated), TRUTH)
    assert "of the device's volume casts no shadow" in doubt


def test_a_light_part_of_a_named_material_that_is_not_there_is_missing(scene: Scene) -> None:
    """Of the one model of two materials, not of the one of steel alone, whatever the exposure of the images."""
    steel, plastic, none = (VOLUMES["device"].data.clone() for _ in range(3))
    steel[:, :, 15:], none[:, :, 15:] = 0, 0
    plastic[:, :, :15], plastic[:, :, 15:] = 0, 0.1 * plastic[:, :, 15:]
    parts = tuple(VOLUMES["device"].with_data(data) for data in (steel, plastic))
    told = with_volume(scene, "device", VOLUMES["device"].with_data(steel + plastic))
    told = replace(told, objects=told.objects | {"device": replace(told.objects["device"], parts=parts)})
    estimated = shown(with_volume(told, "device", VOLUMES["device"].with_data(none)))
    for exposure in (0.0, 0.3, -0.2):
        device = tuple(estimated.image("device", view) + exposure for view in range(3))
        exposed = replace(estimated, images={**estimated.images, "device": device})
        (doubt,) = doubts_about_the_models(told, exposed, TRUTH)
        assert "of the device's volume casts no shadow" in doubt
    assert doubts_about_the_models(told, shown(told), TRUTH) == ()


def test_a_part_in_whose_place_all_images_show_a_shadow_is_not_missing(scene: Scene) -> None:
    """Metal that lets scattered light through alone looks the same with and without what is in it."""
    data = VOLUMES["device"].data.clone()
    data[:, :, 15:] = 0.001
    estimated = with_volume(scene, "device", VOLUMES["device"].with_data(data))
    assert doubts_about_the_models(scene, replace(estimated, images=shown(scene).images), TRUTH) == ()


def test_a_faint_part_in_noise_is_not_missing(scene: Scene) -> None:
    """A handle of light plastic, two thirds of whose contrast are lost in images for display, and much noise.

    What is estimated of it may be as good as nothing.
    """
    faint, estimated = VOLUMES["device"].data.clone(), VOLUMES["device"].data.clone()
    faint[:, :, 15:], estimated[:, :, 15:] = 0.006, 0.001
    images = shown(with_volume(scene, "device", VOLUMES["device"].with_data(faint))).images
    random = torch.Generator().manual_seed(0)
    noisy = [image + 0.1 * torch.randn(image.shape, generator=random) for image in images["device"]]
    there = replace(with_volume(scene, "device", VOLUMES["device"].with_data(estimated)), images=images)
    assert doubts_about_the_models(scene, replace(there, images={**images, "device": tuple(noisy)}), TRUTH) == ()


def test_a_drill_in_its_sleeve_need_cast_no_shadow_of_its_own(scene: Scene) -> None:
    """The images tell the two together; of one that stands out of its sleeve, or of a handle, they tell each part."""
    y, x = torch.meshgrid(torch.arange(40) - 19.5, torch.arange(40) - 19.5, indexing="ij")
    radius = torch.hypot(y, x)
    told = torch.zeros(60, 40, 40)
    told[10:50] = 0.1 * (radius < 9).float()

    def estimated(hollow: torch.Tensor) -> Scene:
        data = told.clone()
        data[10:50, hollow] = 0.0
        return with_volume(scene, "device", Volume(data, place))

    place = axis_aligned((0.5, 0.5, 0.5), (-10.0, -10.0, -15.0))
    whole = with_volume(scene, "device", Volume(told, place))
    assert doubts_about_the_models(whole, shown(estimated(radius < 4)), TRUTH) == ()
    (doubt,) = doubts_about_the_models(whole, shown(estimated(radius > 6)), TRUTH)
    assert "of the device's volume casts no shadow" in doubt
    away = TRUTH.camera1_from["device"].clone()
    away[0, 3] += 300  # beside the detector: nothing is known of what no image shows
    assert doubts_about_the_models(whole, estimated(radius > 6), TRUTH.with_object("device", away)) == ()
