"""An object that was bent since its model was made is told from a straight one."""

import math
from dataclasses import replace
from typing import get_args

import pytest
import torch
from registration_scenes import KINDS, KINK_DEG, REFERENCE_POINTS, images_of_broken, make_scene, off, true_poses

from femoreg_torch.case import Start
from femoreg_torch.drr import project
from femoreg_torch.geometry import Poses, exp_so3, load_carm, rigid
from femoreg_torch.optimize import levenberg
from femoreg_torch.registration import Scene
from femoreg_torch.registration.doubts import shape
from femoreg_torch.registration.doubts.shape import doubts_about_rigidity
from femoreg_torch.registration.evidence.rigidity import CUTS, Bend, Turns, bend, gain_as_one, images_of
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.registration.scene import RigidObject
from femoreg_torch.volume import Volume, axis_aligned

TRUTH = true_poses()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def bent(scene: Scene, poses: Poses, name: str, share: float, turns: Turns = "all") -> Bend | None:
    return bend(scene, poses, name, share, images_of(scene, poses, name, PLAIN), turns)


def test_what_is_rigid_is_not_doubted(scene: Scene) -> None:
    for name in REFERENCE_POINTS:
        for share in CUTS:
            found = bent(scene, TRUTH, name, share)
            assert found is not None
            assert found.apart_mm < 0.4, (name, share)
    assert doubts_about_rigidity(scene, TRUTH, PLAIN) == ()


@pytest.mark.parametrize(("name", "axis"), [("device", 2), ("femur", 0)])
def test_a_broken_object_is_doubted_by_as_much_as_it_is_bent(scene: Scene, name: str, axis: int) -> None:
    broken = replace(scene, images=images_of_broken(name, axis, TRUTH, KINDS))
    found = bent(broken, TRUTH, name, 0.5)
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
        monkeypatch.setattr(shape, "bend", lambda *asked, ends=ends: ends if asked[2] == "femur" else None)
        assert len(doubts_about_rigidity(scene, TRUTH, PLAIN)) == told, (apart, gain)


@pytest.mark.parametrize(("gain", "apart_without", "told"), [(0.0013, 0.6, 0), (0.0013, 1.0, 1), (0.0021, 0.6, 1)])
def test_a_turn_of_an_end_about_its_long_axis_must_explain_more(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, gain: float, apart_without: float, told: int
) -> None:
    """Right femora that had turned in the hip seemed to be twisted by 3 to 5°, and gained up to 0.0013 by it."""
    motion = torch.tensor([4.0, 0, 0, 0.5, 0, 0], dtype=torch.float64)
    free = Bend(motion, motion.abs() / 6 + 1e-9, 1.1, 0.4, gain)
    without = replace(free, apart_mm=apart_without)
    of = {"all": free, "told": free, "none": without}
    monkeypatch.setattr(shape, "bend", lambda *asked: of[asked[-1]] if asked[2] == "femur" else None)
    assert len(doubts_about_rigidity(scene, TRUTH, PLAIN)) == told


@pytest.mark.parametrize(
    ("known", "apart", "sigmas", "told"),
    [(True, 0.7, 8, 1), (False, 0.7, 8, 0), (True, 0.4, 8, 0), (True, 0.7, 4.5, 0)],
)
def test_a_model_of_known_materials_is_doubted_sooner(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, known: bool, apart: float, sigmas: float, told: int
) -> None:
    """Where materials are estimated, what is wrong with them may look like ends that lie apart."""
    motion = torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64)
    ends = Bend(motion, motion.abs() / sigmas + 1e-9, apart, 0.3, 0.0003)
    monkeypatch.setattr(shape, "bend", lambda *asked: ends if asked[2] == "device" else None)
    device = scene.objects["device"]
    device = replace(device, parts=(device.volume,), materials_known=known)
    asked = replace(scene, objects=scene.objects | {"device": device})
    assert len(doubts_about_rigidity(asked, TRUTH, PLAIN)) == told


@pytest.mark.parametrize(
    ("gain", "sigmas", "apart", "told"),
    [
        (0.0014, 8.5, 1.2, 1),
        (0.0052, 8.8, 0.9, 1),
        (0.0025, 6.2, 1.8, 0),
        (0.0003, 8.5, 1.2, 0),
        (0.0014, 8.5, 0.6, 0),
        (0.0039, 12.0, 0.5, 1),
        (0.0039, 8.0, 0.5, 0),
        (0.0020, 12.0, 0.5, 0),
        (0.0039, 12.0, 0.35, 0),
    ],
)
def test_a_model_of_unknown_materials_is_bent_only_where_that_is_sure_and_explains_much(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, gain: float, sigmas: float, apart: float, told: int
) -> None:
    """A plastic hub whose turn hardly any view told lay 1.8 mm off, and gained as much as bent ones."""
    motion = torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64)
    ends = Bend(motion, motion.abs() / sigmas + 1e-9, apart, 0.3, gain)
    freely = replace(ends, deviation=motion.abs())  # an end that may turn as it likes is told less surely
    of = {"all": freely, "told": ends}
    monkeypatch.setattr(shape, "bend", lambda *asked: of[asked[-1]] if asked[2] == "device" else None)
    device = scene.objects["device"]
    asked = replace(scene, objects=scene.objects | {"device": replace(device, parts=(device.volume,))})
    assert len(doubts_about_rigidity(asked, TRUTH, PLAIN)) == told


def test_what_lies_elsewhere_as_a_whole_gains_by_that_alone(scene: Scene) -> None:
    by = rigid(translation=torch.tensor([0.4, 0.4, 0.0], dtype=torch.float64))
    aside = TRUTH.with_object("device", by @ TRUTH.camera1_from["device"])
    found = bent(scene, aside, "device", 0.5)
    assert found is not None
    assert found.gain > 0.001
    as_one = gain_as_one(scene, aside, "device", 0.5, images_of(scene, aside, "device", PLAIN))
    assert as_one == pytest.approx(found.gain, rel=0.05)


def test_a_model_of_unknown_materials_must_gain_by_its_ends(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Coarse images of two right devices gained 0.033 by another pose of the whole, and 0.0008 by their ends."""
    motion = torch.tensor([2.0, 0, 0, 0, 0, 0], dtype=torch.float64)
    device = scene.objects["device"]
    asked = replace(scene, objects=scene.objects | {"device": replace(device, parts=(device.volume,))})
    for gain, as_one, told in ((0.033, 0.0322, 0), (0.033, 0.0318, 1), (0.0025, 0.0018, 1)):
        ends = Bend(motion, motion.abs() / 9 + 1e-9, 1.2, 0.3, gain)
        monkeypatch.setattr(shape, "bend", lambda *asked, ends=ends: ends if asked[2] == "device" else None)
        monkeypatch.setattr(shape, "gain_as_one", lambda *_, as_one=as_one: as_one)
        assert len(doubts_about_rigidity(asked, TRUTH, PLAIN)) == told, (gain, as_one)


def test_an_end_that_no_two_views_show_is_not_asked(scene: Scene) -> None:
    beside = TRUTH.with_object(
        "device", off(TRUTH.camera1_from["device"], REFERENCE_POINTS["device"], (0, 0, 0), (150, 0, 0))
    )
    assert all(bent(scene, beside, "device", share) is None for share in CUTS)


def test_an_end_that_shutters_hide_is_not_asked(scene: Scene) -> None:
    shut = torch.zeros(scene.carm.camera.shape, dtype=torch.bool)
    behind = replace(scene, fields={"device": (shut, shut, None)})
    assert bent(behind, TRUTH, "device", 0.5) is None
    assert bent(behind, TRUTH, "femur", 0.5) is not None  # the images without the device are exposed


@pytest.mark.parametrize("shorter", [1 - 1e-9, levenberg._SHORTER])
def test_a_turn_that_no_image_tells_is_no_break(shorter: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The shaft of a tibia is round. A pin that its model lacks crosses the cut, and asks the lower end to turn.

    A search whose steps hardly shorten goes along that turn; the one of now stops before.
    """
    monkeypatch.setattr(levenberg, "_SHORTER", shorter)
    scene, poses, name = _tibia(broken_deg=0.0)
    free, told, none = (bent(scene, poses, name, 0.5, turns) for turns in get_args(Turns))
    assert free is not None
    assert told is not None
    assert none is not None
    assert none.apart_mm < 0.6
    if shorter > 0.9:
        assert free.apart_mm > 0.8  # with a gain of 0.003, both of which are those of broken necks
    assert told.apart_mm < 0.6
    assert doubts_about_rigidity(scene, poses, PLAIN) == ()


def test_a_round_shaft_that_broke_is_doubted() -> None:
    assert len(doubts_about_rigidity(*_tibia(broken_deg=6.0)[:2], PLAIN)) == 1


def _tibia(broken_deg: float) -> tuple[Scene, Poses, str]:
    """A round shaft with a crossbar on it, its upper end turned across its axis, in two views with a pin before it."""
    spacing = 1.5
    ticks = [torch.arange(-half, half + 0.1, spacing) for half in (60.0, 30.0, 36.0)]
    z, y, x = torch.meshgrid(*ticks, indexing="ij")
    places = torch.stack([x, y, z], -1)

    def rod(start: tuple[float, ...], end: tuple[float, ...], radius: float) -> torch.Tensor:
        first, along = torch.tensor(start), torch.tensor(end) - torch.tensor(start)
        share = ((places - first) @ along / (along @ along)).clamp(0, 1)
        return ((radius - (places - first - share[..., None] * along).norm(dim=-1)) / spacing + 0.5).clamp(0, 1)

    bar = rod((-10.0, 0.0, 42.0), (12.0, 4.0, 44.0), 12.0)
    tibia = 0.045 * torch.maximum(rod((0.0, 0.0, -55.0), (-4.0, 4.0, 30.0), 9.0), bar)
    grid = axis_aligned((spacing,) * 3, (-36.0, -30.0, -60.0))
    upper = z > 0
    parts = [torch.where(upper, 0.0, tibia), torch.where(upper, tibia, 0.0)]
    parts.append(0.25 * rod((-30.0, -20.0, -10.0), (30.0, -20.0, 20.0), 2.5))
    parts.append(0.045 * rod((24.0, 12.0, -55.0), (22.0, 10.0, 32.0), 4.5))  # the fibula
    carm = load_carm("cios_fusion")
    camera = carm.camera.downsampled(12)
    cameras = carm.orbit(torch.deg2rad(torch.tensor([0.0, 50.0], dtype=torch.float64)))
    pose = torch.tensor([[1.0, 0, 0, 6], [0, 0, -1, 4], [0, 1, 0, 640], [0, 0, 0, 1]], dtype=torch.float64)
    kink = pose @ rigid(exp_so3(torch.tensor([math.radians(broken_deg), 0, 0], dtype=torch.float64)))
    places_of = torch.stack([cameras @ each for each in (pose, kink, pose, pose)], 1)
    paths = project([Volume(part, grid) for part in parts], places_of, camera, 0.5)
    counts = torch.poisson(20_000 * (-paths).exp(), generator=torch.Generator().manual_seed(1))
    images = -(counts.clamp_min(1) / 20_000).log()
    bone = Volume(torch.where(tibia > 0.0225, 0.021 + 0.4 * tibia, 0.0), grid)  # as a CT shows it, in soft tissue
    shaft = RigidObject(bone, torch.zeros(3, dtype=torch.float64), ("image",), Start(camera1_from=pose))
    scene = Scene(replace(carm, camera=camera), {"tibia": shaft}, {"image": tuple(images)}, camera_from_camera1=cameras)
    return scene, scene.start(), "tibia"
