"""Trust: given at the truth, withheld where a pose is wrong or an object cannot be seen."""

import math
import re
from dataclasses import replace

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, float64, make_scene, off, true_poses
from torch import Tensor

from femoreg_torch.case import Start
from femoreg_torch.case.quality import ViewQuality
from femoreg_torch.case.trace import Restart, StageRecord
from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, Poses, project_points, transform_points
from femoreg_torch.registration.evidence.turns import losses_by_turning
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.registration.level import Level
from femoreg_torch.registration.quality import Limits, _Judged, _reason, _unsettled, _unturned, _vague, assess
from femoreg_torch.registration.run import _started_at
from femoreg_torch.registration.scene import RigidObject, Scene
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume, axis_aligned

TRUTH = true_poses()
LIMITS = Limits()


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


def test_displacement_is_told_from_the_nominal_pose_and_from_the_place_in_the_ct(scene: Scene) -> None:
    """The femur is turned about its head by about 11°, the device is nominal at the truth."""
    nominal = replace(scene.objects["device"], start=Start(TRUTH.camera1_from["device"]))
    known = replace(scene, objects={**scene.objects, "device": nominal})
    moved = off(TRUTH.camera1_from["device"], REFERENCE_POINTS["device"], (0, 0.5, 0), (0, 0, 1.0))
    found = assess(known, TRUTH.with_object("device", moved), LIMITS)
    assert found["pelvis"].displacement is None
    assert found["femur"].displacement == pytest.approx((11.2, 0), abs=0.1)
    assert found["device"].displacement == pytest.approx((0.5, 1.0), abs=1e-4)


def test_a_femur_out_of_its_joint_is_not_trusted(scene: Scene) -> None:
    """Even if every image agreed with it."""
    apart = off(TRUTH.camera1_from["femur"], REFERENCE_POINTS["femur"], (0, 0, 0), (0, 0, 9))
    far = 1e6
    blind = Limits(
        least_gain=-1,
        most_pull_mm=far,
        most_common_pull_mm=far,
        most_common_pull_deg=far,
        most_common_depth_pull_mm=far,
        most_deviation_mm=far,
        most_deviation_deg=far,
    )
    found = assess(scene, TRUTH.with_object("femur", apart), blind)
    assert found["pelvis"].trusted
    assert found["femur"].reason == "the femur lies 9.0 mm from its place beside the pelvis"


@pytest.mark.parametrize(
    ("cost", "apart_deg", "trusted"), [(0.001, 25.0, False), (0.05, 25.0, True), (0.001, 1.0, True)]
)
def test_a_rival_that_fits_as_well_is_a_doubt(scene: Scene, cost: float, apart_deg: float, trusted: bool) -> None:
    rival = Restart(cost, apart_deg, 3.0)
    step = StageRecord("femur in view 1", None, 0.4, 100, 1.0, "flat", TRUTH, (rival,), moving=("femur",))
    found = assess(scene, TRUTH, LIMITS, trace=(step,))
    assert found["pelvis"].trusted
    assert found["femur"].trusted is trusted
    assert trusted or "femur in view 1" in found["femur"].reason


@pytest.mark.parametrize(
    ("beside", "pull", "settled"),
    [
        (None, (0, 0, 0, 0.2, 0, 1.9), True),  # in depth, which matters least
        (None, (0, 0, 0, 0, 0, 2.1), False),
        (None, (0, 0, 0, 0.9, 0.6, 0), False),  # across
        (None, (0.8, 0.7, 0, 0, 0, 0), False),
        ("pelvis", (0.5, 0, 0, 0.3, 0, 0.9), True),
        ("pelvis", (0, 0, 0, 0, 0, 1.1), False),
        ("pelvis", (0, 1.1, 0, 0, 0, 0), False),
        ("pelvis", (0, 0, 0, math.nan, 0, 0), False),
    ],
)
def test_a_pull_is_asked_beside_the_anchor_and_of_the_anchor_mostly_across(
    beside: str | None, pull: tuple[float, ...], settled: bool
) -> None:
    judged = _Judged([0.0] * 3, [0.0] * 3, torch.tensor(pull, dtype=torch.float64), beside)
    told = _unsettled("femur", judged, Limits())
    assert (told is None) is settled
    assert told is None or ("beside the pelvis" in told) is (beside is not None)


@pytest.mark.parametrize("place", range(3))
def test_a_deviation_that_is_nan_counts_as_open(place: int) -> None:
    """Wherever it stands: the largest of (0.1, nan, 0.2) is 0.2 to Python."""
    good, bad = [0.1, 0.2, 0.1], [0.1, 0.2, 0.1]
    bad[place] = math.nan
    assert _vague("femur", good, good, Limits()) is None
    assert "femur" in (_vague("femur", good, bad, Limits()) or "")
    assert "femur" in (_vague("femur", bad, good, Limits()) or "")


def test_a_start_that_is_given_does_not_change_what_is_expected(scene: Scene) -> None:
    """A femur out of its joint is told too where the search starts at poses of an earlier result."""
    apart = off(TRUTH.camera1_from["femur"], REFERENCE_POINTS["femur"], (0, 0, 0), (0, 0, 9))
    given = _started_at(scene, {"femur": apart})
    assert torch.equal(given.start(TRUTH.camera1_from["pelvis"]).camera1_from["femur"], apart)
    before, after = (
        assess(each, TRUTH.with_object("femur", apart), LIMITS)["femur"].displacement for each in (scene, given)
    )
    assert before == after
    assert before is not None
    assert before[1] == pytest.approx(9.0, abs=1e-4)


@pytest.mark.parametrize(("lost", "told"), [(0.2, True), (0.001, False), (-0.01, False), (math.nan, False)])
def test_a_turn_that_costs_nothing_is_not_told(lost: float, told: bool) -> None:
    assert (_unturned("device", (lost, math.inf), Limits()) is None) is told
    assert (_unturned("device", (math.inf, lost / 16), Limits()) is None) is told


@pytest.mark.parametrize(
    ("lost", "words"),
    [(0.0003, "nearly as well (similarity 0.0003 lower);"), (-2e-5, "as well;"), (math.nan, "as well;")],
)
def test_a_turn_that_costs_nothing_is_told_in_words(lost: float, words: str) -> None:
    told = _unturned("device", (lost, math.inf), Limits())
    assert told is not None
    assert f"of it fits {words}" in told


def test_a_device_is_turned_about_what_is_in_view(scene: Scene) -> None:
    """A round guide with a handle: turning it costs much, but next to nothing where a shutter hides the handle."""
    z, y, x = torch.meshgrid(*[torch.arange(n).double() for n in (120, 61, 61)], indexing="ij")
    x, y, z = x - 30, y - 30, z - 20
    guide = (x.hypot(y) < 5) & (z.abs() < 20)
    handle = (x.abs() < 6) & (y.abs() < 28) & (z > 60) & (z < 95)
    volume = Volume((0.2 * (guide | handle)).float(), axis_aligned((1.0, 1.0, 1.0), (-30, -30, -20)))
    pose = TRUTH.camera1_from["device"]
    poses = Poses(TRUTH.camera_from_camera1, {"probe": pose})
    cameras = [scene.camera(poses, view) for view in range(scene.views)]
    places = [poses.camera_from("probe")[view] for view in range(scene.views)]
    images = tuple(project(volume, place[None], camera, 0.5)[0] for place, camera in zip(places, cameras, strict=True))
    probe = RigidObject(volume, float64(0, 0, 0), ("device",), Start(pose), parts=(volume,), sharp=True)
    whole = replace(scene, objects={"probe": probe}, images={"device": images}, tissue=None, outline=None)

    def shown(place: Tensor, camera: Camera) -> Tensor:
        """The pixels that look at no voxel of the handle, nor near it."""
        points = transform_points(volume.lps_from_index, (volume.data * handle).nonzero().flip(1).double())
        pixels = project_points(camera, transform_points(place, points)).round().long()
        field = torch.ones(camera.shape, dtype=torch.bool)
        low, high = pixels.amin(0) - 4, pixels.amax(0) + 5
        field[max(0, int(low[1])) : max(0, int(high[1])), max(0, int(low[0])) : max(0, int(high[0]))] = False
        return field

    fields = tuple(shown(place, camera) for place, camera in zip(places, cameras, strict=True))
    hidden = replace(whole, fields={"device": fields})
    found, blind = (
        losses_by_turning(each, poses, "probe", Level(3.0, 1.0), GradNcc(4), PLAIN)[0] for each in (whole, hidden)
    )
    assert found > 0.05
    assert blind < 0.01


def test_a_device_is_turned_about_its_guide_as_well(scene: Scene) -> None:
    """A round guide with a round plate, half of which a shutter hides: the long axis of the rest leans to one side."""
    z, y, x = torch.meshgrid(*[torch.arange(n).double() for n in (120, 71, 71)], indexing="ij")
    x, y, z = x - 35, y - 35, z - 20
    data = 0.2 * ((x.hypot(y) < 5) & (z.abs() < 20) | (x.hypot(y) < 30) & (z > 60) & (z < 70))
    volume = Volume(data.float(), axis_aligned((1.0, 1.0, 1.0), (-35, -35, -20)))
    pose = TRUTH.camera1_from["device"]
    poses = Poses(TRUTH.camera_from_camera1, {"probe": pose})
    base, tip = float64(0, 0, 20), float64(0, 0, -20)
    images, fields = [], []
    for view in range(scene.views):
        camera, place = scene.camera(poses, view), poses.camera_from("probe")[view]
        images.append(project(volume, place[None], camera, 0.5)[0])
        middle = project_points(camera, transform_points(place, float64(0, 0, 65)[None]))[0]
        fields.append((torch.arange(camera.shape[1]) < middle[0] + 3).expand(camera.shape).clone())
    probe = RigidObject(volume, float64(0, 0, 0), ("device",), Start(pose), parts=(volume,), sharp=True)
    shown = replace(
        scene, images={"device": tuple(images)}, fields={"device": tuple(fields)}, tissue=None, outline=None
    )
    objects = {"probe": replace(probe, guide=(base, tip))}
    there = replace(shown, objects=objects)
    long, guide = losses_by_turning(there, poses, "probe", Level(3.0, 1.0), GradNcc(4), PLAIN)
    assert guide < Limits().least_loss_by_turning < long


@pytest.mark.parametrize(
    ("pull_mm", "says"),
    [
        ((3.0, -4.0), r"view 2 would move the femur by \(3.0, -4.0\) mm"),
        ((-23.6, -5171.8), "view 2 does not hold the femur"),
        ((math.nan, 0.0), "view 2 does not hold the femur"),
        ((0.1, 0.1), None),
    ],
)
def test_a_step_that_no_peak_nearby_explains_is_not_told_as_a_distance(
    pull_mm: tuple[float, float], says: str | None
) -> None:
    views = (ViewQuality(1, 0.7, 0.1, (0.0, 0.0)), ViewQuality(2, 0.7, 0.1, pull_mm))
    reason = _reason("femur", views, LIMITS)
    assert (reason is None) if says is None else re.match(says, reason or "")
