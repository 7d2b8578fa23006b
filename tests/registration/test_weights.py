"""Pixel weights: what they keep and leave out, and that what they leave out does not matter."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import (
    CARM,
    REFERENCE_POINTS,
    alone,
    float64,
    line_integrals,
    make_scene,
    segmentations,
    true_poses,
)
from torch import Tensor

from femoreg_torch.detect import Detection
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, pose_difference
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body, Scene, Segmentation, moved
from femoreg_torch.registration.start.find import with_segmentations
from femoreg_torch.registration.weights import Weighting, believed, pixel_weights
from femoreg_torch.similarity import GradNcc

TRUTH = true_poses()
ANATOMY = ("pelvis", "femur")
ALL = (*ANATOMY, "device")
LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
SMALL = GradNcc(patch_radius=1)
REACH = 2 + 3  # pixels: a patch that weighs a little at one end, and the kernel of the derivatives


@pytest.fixture(scope="module")
def scene() -> Scene:
    return replace(make_scene(TRUTH), segmentations=segmentations(TRUTH))


def looked_at(
    scene: Scene, render: tuple[str, ...], kind: str, weights: list[Weighting], moving: tuple[str, ...] = ()
) -> Tensor:
    found = pixel_weights(scene, TRUTH, render, moving, (kind, 1), CARM.camera, 2.0, weights)  # type: ignore[arg-type]
    assert found is not None
    return found


def distance(mask: Tensor) -> Tensor:
    """Of every pixel (H, W) from the nearest one of a mask along rows or columns, whichever is longer, in mm."""
    places = mask.nonzero()
    pixels = torch.ones_like(mask).nonzero()
    apart = torch.cdist(pixels.double(), places.double(), p=float("inf")).amin(1)
    return apart.view(mask.shape) * CARM.camera.pixel_mm[0]


def covered(names: tuple[str, ...]) -> Tensor:
    return line_integrals(TRUTH, 1, names) > 0.01


def test_without_weights_all_pixels_count(scene: Scene) -> None:
    assert pixel_weights(scene, TRUTH, ANATOMY, (), ("anatomy", 0), CARM.camera, 2.0, []) is None


def test_bones_are_what_the_stage_draws_with_a_margin(scene: Scene) -> None:
    for render in (ANATOMY, ("femur",)):
        kept, away = looked_at(scene, render, "anatomy", ["bones"]), distance(covered(render))
        seen = covered(render) & ~(covered(("femur",)) if "femur" not in render else torch.zeros_like(covered(render)))
        assert kept[seen].all()
        assert kept[away <= 6].all()
        assert not kept[away > 22].any()  # the margin of 10 mm, and two pixels of the segmentation and the image
        assert 0.1 < kept.mean() < 0.9


def test_an_instrument_counts_where_it_is_drawn_in_the_images_that_hold_it(scene: Scene) -> None:
    anatomy = looked_at(scene, ALL, "anatomy", ["bones"])
    device = looked_at(scene, ALL, "device", ["bones"])
    assert torch.equal(anatomy, looked_at(scene, ANATOMY, "anatomy", ["bones"]))
    assert device[covered(("device",))].all()
    assert torch.equal(device.bool(), anatomy.bool() | looked_at(scene, ("device",), "device", ["bones"]).bool())


def test_clear_leaves_out_what_is_behind_an_instrument_that_stands_still(scene: Scene) -> None:
    kept, away = looked_at(scene, ANATOMY, "device", ["clear"]), distance(covered(("device",)))
    assert not kept[covered(("device",))].any()
    assert kept[away > 7].all()  # the margin of 3 mm, and a pixel
    assert looked_at(scene, ANATOMY, "anatomy", ["clear"]).all()
    assert looked_at(scene, ALL, "device", ["clear"], moving=("device",)).all()
    both = looked_at(scene, ANATOMY, "device", ["bones", "clear"])
    assert torch.equal(both, kept * looked_at(scene, ANATOMY, "device", ["bones"]))


def test_a_segmentation_lands_where_its_own_camera_has_it(scene: Scene) -> None:
    """One marked pixel of a window of another pixel size; its place on the detector is known."""
    camera = Camera(1020.0, (4.0, 4.0), (30, 40), (10.0, 5.0))
    probabilities = torch.zeros(4, 30, 40)
    probabilities[3, 12, 25] = 1  # 60 mm right of the central ray, 28 mm below it
    marked = replace(scene, segmentations=(Segmentation(probabilities, camera),) * 3)
    rows, columns = looked_at(marked, ("femur",), "anatomy", ["bones"]).nonzero().double().T
    middle = (CARM.camera.shape[0] - 1) / 2
    assert float(columns.mean() - middle) * 3 == pytest.approx(60, abs=2)
    assert float(rows.mean() - middle) * 3 == pytest.approx(28, abs=2)


@pytest.mark.parametrize("kind", ["anatomy", "device"])
def test_what_happens_where_no_pixel_counts_does_not_matter(scene: Scene, kind: str) -> None:
    render, weights = (ANATOMY, ["bones"]) if kind == "anatomy" else (ANATOMY, ["clear"])
    away = distance(looked_at(scene, render, kind, weights) > 0) / CARM.camera.pixel_mm[0]  # type: ignore[arg-type]
    assert (away > REACH).any()
    images = list(scene.images[kind])  # type: ignore[index]
    images[1] = torch.where(
        away > REACH, torch.rand(images[1].shape, generator=torch.Generator().manual_seed(1)), images[1]
    )
    disturbed = replace(scene, images=scene.images | {kind: tuple(images)})
    body = Body(("pelvis",), 0, float64(0, 0, 740), float64(0.02, 0.02, 0.02, 2, 2, 12))
    deltas = torch.eye(6, dtype=torch.float64)

    def costs(of: Scene, by: list[Weighting]) -> Tensor:
        return image_costs(of, TRUTH, (body,), render, [(kind, 1)], LEVEL, SMALL, by)(deltas)  # type: ignore[list-item]

    torch.testing.assert_close(costs(scene, weights), costs(disturbed, weights), rtol=0, atol=1e-9)  # type: ignore[arg-type]
    assert (costs(scene, []) - costs(disturbed, [])).abs().max() > 1e-4


def test_an_image_of_which_nothing_is_left_is_named(scene: Scene) -> None:
    background = torch.zeros(4, 44, 44)
    background[0] = 1
    nothing = Segmentation(background, CARM.camera.downsampled(2))
    blind = replace(scene, segmentations=(*scene.segmentations[:2], nothing))
    body = Body(("pelvis",), 0, float64(0, 0, 740), float64(0.02, 0.02, 0.02, 2, 2, 12))
    images = [("anatomy", view) for view in range(3)]
    with pytest.raises(
        InputError, match=r"^view 3, anatomy image: weights \[bones\] leave no pixel .*pelvis, femur.*$"
    ):
        image_costs(blind, TRUTH, (body,), ANATOMY, images, LEVEL, SMALL, ["bones"])  # type: ignore[arg-type]
    with pytest.raises(InputError, match="has no segmentations"):
        image_costs(make_scene(TRUTH), TRUTH, (body,), ANATOMY, images, LEVEL, SMALL, ["bones"])  # type: ignore[arg-type]


def test_the_network_looks_once_at_every_view(scene: Scene) -> None:
    looks: list[Tensor] = []

    def find(image: Tensor, camera: Camera) -> Detection:
        looks.append(image)
        return detection(float(len(looks)))

    def detection(value: float) -> Detection:
        none = torch.zeros(14)
        return Detection(torch.zeros(14, 2), none, none, none.bool(), torch.full((7, 4, 4), value), CARM.camera, False)

    seen = with_segmentations(scene, detection(0.0), find).segmentations
    assert [float(found.probabilities.mean()) for found in seen] == [0, 1, 2]
    assert all(image is other for image, other in zip(looks, scene.images["anatomy"][1:], strict=True))


def with_a_mistake(scene: Scene, unsure: bool) -> Scene:
    """A block of the device drawn thrice as dense as it is, which is known as a possible mistake, or not."""
    device = scene.objects["device"]
    block = torch.zeros_like(device.volume.data)
    block[:, :, 16:22] = 2 * device.volume.data[:, :, 16:22]
    mistaken = replace(device, volume=device.volume.with_data(device.volume.data + block))
    difference = (device.volume.with_data(block),) if unsure else ()
    return replace(scene, objects=scene.objects | {"device": replace(mistaken, unsure=difference)})


def test_what_may_be_drawn_wrong_counts_less_and_all_else_as_before(scene: Scene) -> None:
    """Little where a false block is drawn, and all where no patch reaches it."""
    assert believed(scene, TRUTH, ALL, ("device", 1), CARM.camera, 1.0, None, alone(scene, 1, CARM.camera)) is None
    unsure = with_a_mistake(scene, unsure=True)
    assert believed(unsure, TRUTH, ALL, ("anatomy", 1), CARM.camera, 1.0, None, alone(unsure, 1, CARM.camera)) is None
    weights = believed(unsure, TRUTH, ALL, ("device", 1), CARM.camera, 1.0, None, alone(unsure, 1, CARM.camera))
    assert weights is not None
    assert weights.min() >= 0
    assert weights.max() <= 1
    block = unsure.objects["device"].unsure[0]
    pose = TRUTH.camera_from("device")[1]
    false = project([block], pose[None, None], CARM.camera, 1.0)[0]
    assert weights[false > 0.05].median() < 0.25
    beside = distance(false > 1e-4) > 8 * CARM.camera.pixel_mm[0]  # a patch and the derivative's taps
    assert weights[beside].min() > 0.999


def test_a_device_with_a_part_drawn_wrong_is_placed_better_where_that_is_known(scene: Scene) -> None:
    body = Body(("device",), 0, TRUTH.camera1_from["device"][:3, 3], float64(0.02, 0.02, 0.02, 1, 1, 4))
    images = [("device", view) for view in range(3)]
    ends = []
    for unsure in (False, True):
        drawn = with_a_mistake(scene, unsure)
        costs = image_costs(drawn, TRUTH, (body,), ALL, images, Level(3.0, 1.0), GradNcc())
        found = LevenbergMarquardt(max_iterations=20).minimise(stage_objective(costs, (body,), None), 6, 0)
        ends.append(
            pose_difference(
                moved(TRUTH, (body,), found.delta).camera1_from["device"],
                TRUTH.camera1_from["device"],
                REFERENCE_POINTS["device"],
            )
        )
    (blind_deg, blind_mm), (deg, mm) = ends
    assert blind_deg > 0.3  # the mistake matters
    assert deg < 0.7 * blind_deg
    assert mm < blind_mm
