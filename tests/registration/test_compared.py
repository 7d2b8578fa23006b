"""The veil: what is compared where metal lets next to no light pass."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, alone, float64, make_scene, off, true_poses
from torch import Tensor

from femoreg_torch.geometry import pose_difference
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration.compared import veil_over
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.imaging import Imaging, draw, filled
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.objective import stage_objective
from femoreg_torch.registration.scene import Body, Scene, moved
from femoreg_torch.similarity import GradNcc

TRUTH = true_poses()
ALL = ("pelvis", "femur", "device")
LEVEL = Level(pixel_mm=3.0, step_mm=1.0)
CAMERA = LEVEL.camera(CARM.camera)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Images without scattered light, of which a shadow has told that there is next to none."""
    return replace(make_scene(TRUTH), scatter=1e-3)


def test_drawn_light_is_what_the_image_without_the_device_adds(scene: Scene) -> None:
    """On images that show just what is drawn, and a patient who takes nine tenths of all light besides."""
    behind = 2.3

    def shown(kind: str, view: int) -> Tensor:
        names = scene.shown(ALL, kind)  # type: ignore[arg-type]
        where = torch.stack([TRUTH.camera_from(name)[view] for name in names])[None]
        return draw([scene.objects[name] for name in names], where, CAMERA, LEVEL.step_mm)[0]

    exact = {kind: tuple(shown(kind, view) + behind for view in range(3)) for kind in scene.images}
    drawn = replace(scene, images=exact)
    for view in range(3):
        veil = veil_over(drawn, ALL, ("device", view), LEVEL, 0.3, 0.0, alone(scene, view, CAMERA))
        assert veil is not None
        assert veil.exposed is None
        torch.testing.assert_close(filled(shown("device", view), veil.light) + behind, veil.image)
        shadow = shown("device", view) - shown("anatomy", view)
        assert (veil.image - exact["anatomy"][view]).max() < -torch.tensor(0.3).log()  # no deeper than the share
        assert shadow.max() > 1.5


def test_only_images_with_a_device_beside_one_without_are_veiled(scene: Scene) -> None:
    def veil(kind: str, of: Scene, share: float = 0.3) -> object:
        return veil_over(of, ALL, (kind, 1), LEVEL, share, 0.0, alone(of, 1, CAMERA))  # type: ignore[arg-type]

    assert veil("device", scene) is not None
    assert veil("device", scene, share=0.0) is None
    assert veil("anatomy", scene) is None


def test_a_veil_is_exposed_where_both_images_are(scene: Scene) -> None:
    left, top = torch.ones(2, *CARM.camera.shape, dtype=torch.bool)
    left[:, 60:] = False
    top[60:] = False
    shaded = replace(scene, fields={"anatomy": (None, left, None), "device": (None, top, None)})
    veil = veil_over(shaded, ALL, ("device", 1), LEVEL, 0.3, 0.0, alone(shaded, 1, CAMERA))
    assert veil is not None
    assert veil.exposed is not None
    assert torch.equal(veil.exposed, left & top)


def test_shadows_that_are_all_noise_place_a_device_better_under_a_veil(scene: Scene) -> None:
    """Opaque metal behind which the detector counts noise alone; the mean of three draws of the noise."""
    dense = scene.objects["device"]
    metal = replace(dense, volume=dense.volume.with_data(6 * dense.volume.data))
    opaque = replace(scene, objects=scene.objects | {"device": metal})
    start = TRUTH.camera1_from["device"]
    body = Body(("device",), 0, start[:3, 3], float64(0.02, 0.02, 0.02, 1, 1, 4))
    begin = TRUTH.with_object("device", off(start, float64(0, 0, 0), (0.8, -0.6, 1), (1, 1, 3)))
    seen = [("device", view) for view in range(3)]

    def noisy(view: int, generator: torch.Generator) -> Tensor:
        where = torch.stack([TRUTH.camera_from(name)[view] for name in ALL])[None]
        light = (-draw([opaque.objects[name] for name in ALL], where, CARM.camera, 0.5)[0]).exp()
        return -(light + 0.03 * torch.randn(light.shape, generator=generator)).clamp_min(1e-4).log()

    def off_by(seed: int, guess: float) -> tuple[float, float]:
        generator = torch.Generator().manual_seed(seed)
        images = scene.images | {"device": tuple(noisy(view, generator) for view in range(3))}
        imaging = Imaging(scatter=guess)
        costs = image_costs(
            replace(opaque, images=images),
            begin,
            (body,),
            ALL,
            seen,
            LEVEL,
            GradNcc(),
            imaging=imaging,  # type: ignore[arg-type]
        )
        found = LevenbergMarquardt(max_iterations=30).minimise(stage_objective(costs, (body,), None), 6, 0)
        return pose_difference(
            moved(begin, (body,), found.delta).camera1_from["device"], start, REFERENCE_POINTS["device"]
        )

    # The guesses are the scattered light as it is, so that nothing is added, and that of the presets.
    bare, veiled = (torch.tensor([off_by(seed, guess) for seed in range(3)]).mean(0) for guess in (1e-3, 0.35))
    assert (veiled < 0.7 * bare).all(), (bare, veiled)
