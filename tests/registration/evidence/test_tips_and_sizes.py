"""A device whose model has another length or size than the one in the images is told from one that is right."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from registration_scenes import VOLUMES, float64, true_poses
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.case import Case, CaseObject, Model, Start
from femoreg_torch.drr import project
from femoreg_torch.geometry import Camera, CArm, centred_camera, project_points, transform_points
from femoreg_torch.registration.doubts.device import (
    _ends_elsewhere,
    _is_borne_out,
    _is_off,
    doubts_about_size,
    doubts_about_told_tips,
    doubts_about_units,
    notes_on_unseen_tips,
)
from femoreg_torch.registration.evidence.bones import Amount
from femoreg_torch.registration.evidence.sizes import FURTHEST, Size, _best, device_size
from femoreg_torch.registration.evidence.tips import TipLength, _near_the_tip, _parted, _stretched, tip_length
from femoreg_torch.registration.imaging import PLAIN, Imaging
from femoreg_torch.registration.scene import RigidObject, Scene
from femoreg_torch.volume import Volume, axis_aligned

TRUTH = true_poses()
CARM = CArm(centred_camera(1020.0, (1.5, 1.5), (176, 176)), (0.0, 0.0, 632.0), (0.0, 1.0, 0.0))
BASE, TIP = float64(0, 0, -20), float64(0, 0, 40)
CASE = Case(Path(), CARM, {"device": CaseObject("device", points={"base": BASE, "tip": TIP})})


def tool(length_mm: float = 60.0, voxel_mm: float = 1.0) -> Volume:
    """A rod of 6 mm from −20 mm to its tip, on a block with a bar to one side; its voxels are means of eight."""
    half = voxel_mm / 2
    size = [round(mm / half) for mm in (96, 48, 64)]
    start = (-24.0, -24.0, -32.0)
    z, y, x = (
        (torch.arange(n) + 0.5) * half + first for n, first in zip(size, (start[2], start[1], start[0]), strict=True)
    )
    z, y, x = z[:, None, None], y[:, None], x
    rod = (x**2 + y**2 < 9) & (z > -20) & (z < -20 + length_mm)
    block = (x.abs() < 8) & (y.abs() < 10) & (z > -26) & (z < -12)
    bar = (x > 0) & (x < 36) & (y.abs() < 4) & (z > -22) & (z < -15)
    filled = 0.1 * (rod | block | bar).float()
    first = tuple(mm + half for mm in start)
    return Volume(F.avg_pool3d(filled[None], 2)[0], axis_aligned((voxel_mm,) * 3, (first[0], first[1], first[2])))


def line_integrals(view: int, names: tuple[str, ...]) -> Tensor:
    """Of the bones and of a finely drawn tool, on a grid twice as fine and averaged."""
    volumes = VOLUMES | {"device": tool(voxel_mm=0.5)}
    where = torch.stack([TRUTH.camera_from(name)[view] for name in names])[None]
    fine = centred_camera(1020.0, (0.75, 0.75), (352, 352))
    return F.avg_pool2d(project([volumes[name] for name in names], where, fine, 0.25), 2)[0]


@pytest.fixture(scope="module")
def scene() -> Scene:
    bones = ("pelvis", "femur")
    noise = torch.Generator().manual_seed(5)

    def image(view: int, names: tuple[str, ...]) -> Tensor:
        exact = line_integrals(view, names)
        return exact + 0.003 * torch.randn(exact.shape, generator=noise)

    images = {
        "anatomy": tuple(image(view, bones) for view in range(3)),
        "device": tuple(image(view, (*bones, "device")) for view in range(3)),
    }
    origin = float64(0, 0, 0)
    objects = {name: RigidObject(VOLUMES[name], origin, ("anatomy", "device")) for name in bones}
    device = RigidObject(tool(), origin, ("device",), Start(TRUTH.camera1_from["device"]), sharp=True)
    return Scene(CARM, objects | {"device": device}, images)


def with_model(scene: Scene, volume: Volume) -> Scene:
    return replace(scene, objects=scene.objects | {"device": replace(scene.objects["device"], volume=volume)})


def larger(volume: Volume, factor: float) -> Volume:
    affine = volume.lps_from_index.clone()
    affine[:3] *= factor
    return Volume(volume.data, affine)


@pytest.mark.parametrize("how", ["not exposed", "saturated"])
def test_it_is_said_where_no_image_shows_the_end_of_a_guide(scene: Scene, how: str) -> None:
    """One view that shows it is enough."""
    hidden = []
    for view in range(3):
        camera = scene.camera(TRUTH, view)
        tip = transform_points(TRUTH.camera_from("device")[view], TIP[None])
        column, row = project_points(camera, tip)[0].round().long().tolist()
        mask = torch.zeros(camera.shape, dtype=torch.bool)
        mask[row - 4 : row + 5, column - 4 : column + 5] = True
        hidden.append(mask)

    def behind(masks: list[Tensor]) -> Scene:
        if how == "saturated":
            return replace(scene, saturated={"device": tuple(masks)})
        return replace(scene, fields={"device": tuple(~mask for mask in masks)})

    assert not notes_on_unseen_tips(CASE, scene, TRUTH)
    assert not notes_on_unseen_tips(CASE, behind([*hidden[:2], torch.zeros_like(hidden[2])]), TRUTH)
    (note,) = notes_on_unseen_tips(CASE, behind(hidden), TRUTH)
    assert note.startswith("no image shows where the guide of the device ends")


def test_a_device_as_its_model_has_it_is_not_doubted(scene: Scene) -> None:
    tip = tip_length(scene, TRUTH, "device", "device", (BASE, TIP), PLAIN)
    assert tip is not None
    assert abs(tip.longer_mm) < 0.3
    assert tip.gain < 0.005
    shown = device_size(scene, TRUTH, "device", "device", PLAIN)
    assert shown is not None
    assert shown.factor == pytest.approx(1, abs=0.004)
    assert doubts_about_size(CASE, scene, scene, TRUTH, PLAIN) == ()


@pytest.mark.parametrize("mm", [-3.0, 2.0])
def test_a_tip_of_another_length_is_told_by_as_much(scene: Scene, mm: float) -> None:
    wrong = with_model(scene, tool(60 + mm))
    tip = TIP + float64(0, 0, mm)
    found = tip_length(wrong, TRUTH, "device", "device", (BASE, tip), PLAIN)
    assert found is not None
    assert found.longer_mm == pytest.approx(-mm, abs=0.6)
    case = replace(CASE, objects={"device": CaseObject("device", points={"base": BASE, "tip": tip})})
    (doubt,) = doubts_about_size(case, wrong, wrong, TRUTH, PLAIN)
    assert ("before the tip of its model" if mm > 0 else "beyond the tip of its model") in doubt


@pytest.mark.parametrize("longer_mm", [0, 2])
def test_a_device_that_all_images_show_is_asked_too(scene: Scene, longer_mm: int) -> None:
    """Of a biplane, say, that is used while a drill is in."""
    model = tool(60.0 - longer_mm)
    pelvis, femur, device = (scene.objects[name] for name in ("pelvis", "femur", "device"))
    there = replace(
        scene,
        images={"image": scene.images["device"]},
        objects={
            "pelvis": replace(pelvis, shown_in=("image",)),
            "femur": replace(femur, shown_in=("image",)),
            "device": replace(device, shown_in=("image",), volume=model, parts=(model,)),
        },
    )
    case = replace(
        CASE, objects={"device": CaseObject("device", points={"base": BASE, "tip": TIP - float64(0, 0, longer_mm)})}
    )
    told = doubts_about_size(case, there, there, TRUTH, PLAIN)
    assert len(told) == (longer_mm > 0)
    assert all("the guide of the device end" in doubt for doubt in told)


@pytest.mark.parametrize("given", [False, True])
def test_soft_tissue_lies_about_the_bones_while_a_tip_is_asked(
    scene: Scene, given: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not about the parts of the device, whether landmarks or poses that were given place the bones."""
    drawn_at: list[Tensor] = []

    def tissue_integrals(tissue: Volume, pose: Tensor, camera: Camera) -> Tensor:
        drawn_at.append(pose)
        return torch.zeros(camera.shape)

    monkeypatch.setattr("femoreg_torch.registration.target.tissue_integrals", tissue_integrals)
    start = Start(TRUTH.camera1_from["pelvis"]) if given else Start()
    pelvis = replace(scene.objects["pelvis"], start=start)
    femur = replace(scene.objects["femur"], start=Start(beside="pelvis"))
    placed = replace(scene, objects=scene.objects | {"pelvis": pelvis, "femur": femur}, tissue=VOLUMES["pelvis"])
    assert tip_length(placed, TRUTH, "device", "device", (BASE, TIP), Imaging(tissue=0.75)) is not None
    torch.testing.assert_close(torch.stack(drawn_at), TRUTH.camera_from("pelvis"))


@pytest.mark.parametrize("left_mm", [60, 34])
def test_a_tip_that_was_estimated_to_be_empty_is_asked_as_it_was_told(scene: Scene, left_mm: float) -> None:
    """Where nothing at all is left near the tip, too."""
    tip = TIP + float64(0, 0, 3)
    estimated = with_model(scene, tool(left_mm))
    assert (tip_length(estimated, TRUTH, "device", "device", (BASE, tip), PLAIN) is None) == (left_mm < 60)
    case = replace(CASE, objects={"device": CaseObject("device", points={"base": BASE, "tip": tip})})
    (doubt,) = doubts_about_size(case, with_model(scene, tool(63)), estimated, TRUTH, PLAIN)
    assert "before the tip of its model" in doubt


def test_costs_that_fall_ever_faster_are_of_a_size_that_is_far_off() -> None:
    assert _best(0.60, 0.58, 0.52) == FURTHEST
    assert _best(0.52, 0.58, 0.60) == -FURTHEST
    assert _best(0.60, 0.58, 0.60) == _best(0.5, 0.5, 0.5) == 0
    assert _best(0.60, 0.58, 0.58) == pytest.approx(0.01)


def test_one_view_tells_no_size(scene: Scene) -> None:
    one = replace(scene, images={kind: (images[0], None, None) for kind, images in scene.images.items()})
    assert device_size(one, TRUTH, "device", "device", PLAIN) is None


def test_sizes_that_contradict_each_other_are_not_told(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    for sign, told in ((1, 1), (-1, 0)):
        size = Size(1.03, 0.01, Amount(0.03 * sign, 0.005))
        monkeypatch.setattr("femoreg_torch.registration.doubts.device.device_size", lambda *_, size=size: size)
        assert len(doubts_about_size(CASE, scene, scene, TRUTH, PLAIN)) == told


@pytest.mark.parametrize(("factor", "words"), [(1.03, "smaller"), (0.97, "larger")])
def test_a_model_of_another_size_is_told(scene: Scene, factor: float, words: str) -> None:
    wrong = with_model(scene, larger(tool(), factor))
    shown = device_size(wrong, TRUTH, "device", "device", PLAIN)
    assert shown is not None
    assert shown.factor == pytest.approx(1 / factor, abs=0.012)
    assert shown.step.value == pytest.approx(1 / factor - 1, rel=0.5)
    (doubt,) = doubts_about_size(CASE, wrong, wrong, TRUTH, PLAIN)
    assert words in doubt
    assert "than its model, beside the pelvis" in doubt


@pytest.mark.parametrize(
    ("found", "off"),
    [
        (Size(0.96, 0.0005, Amount(-0.004, 0.0016)), False),  # a right needle, whose size nothing tells
        (Size(1.016, 0.0007, Amount(0.0085, 0.0059)), False),  # a right tube before saturated air
        (Size(0.984, 0.0006, Amount(-0.011, 0.0048)), True),  # a model told 2 % too large
    ],
)
def test_a_size_is_told_where_the_images_are_sure(found: Size, off: bool) -> None:
    assert _is_off(found) == off


@pytest.mark.parametrize(
    ("base", "tip", "words"),
    [
        (BASE, TIP, None),
        (BASE / 25.4, TIP / 25.4, "its guide is 2.36 mm long"),  # all of it in inches
        (BASE * 25.4, TIP * 25.4, "its point base lies far outside its model"),
    ],
)
def test_models_and_points_in_other_units_are_told(scene: Scene, base: Tensor, tip: Tensor, words: str | None) -> None:
    device = CaseObject("device", model=Model(Path("device.stl"), 5000.0), points={"base": base, "tip": tip})
    doubts = doubts_about_units(replace(CASE, objects={"device": device}), scene, True)
    assert len(doubts) == (words is not None)
    assert words is None or words in doubts[0]


def test_a_tip_that_stands_far_out_of_its_model_is_no_doubt_by_itself(scene: Scene) -> None:
    device = CaseObject("device", model=Model(Path("device.stl"), 5000.0), points={"base": BASE, "tip": 3 * TIP})
    assert doubts_about_units(replace(CASE, objects={"device": device}), scene, False) == ()
    assert len(doubts_about_units(replace(CASE, objects={"device": device}), scene, True)) == 1


@pytest.mark.parametrize(("aside_mm", "told"), [(0, False), (1.5, False), (2.5, True), (5, True)])
def test_a_guide_that_passes_beside_its_model_is_doubted(scene: Scene, aside_mm: float, told: bool) -> None:
    """Beside a rod of 3 mm: points of another origin than that of the model."""
    away = float64(0, aside_mm, 0)
    device = CaseObject(
        "device", model=Model(Path("device.stl"), 5000.0), points={"base": BASE + away, "tip": TIP + away}
    )
    doubts = doubts_about_told_tips(replace(CASE, objects={"device": device}), scene)
    assert len(doubts) == told
    assert all("beside the middle of its model's end" in doubt for doubt in doubts)


@pytest.mark.parametrize(("deg", "told"), [(0, False), (1, False), (3, True)])
def test_a_guide_that_leans_against_its_model_is_doubted(scene: Scene, deg: float, told: bool) -> None:
    away = float64(0, float((BASE - TIP).norm()) * math.tan(math.radians(deg)), 0)
    device = CaseObject("device", model=Model(Path("device.stl"), 5000.0), points={"base": BASE + away, "tip": TIP})
    doubts = doubts_about_told_tips(replace(CASE, objects={"device": device}), scene)
    assert len(doubts) == told
    assert all("leans by 3° against the axis" in doubt for doubt in doubts)


def test_an_image_that_is_saturated_as_a_whole_is_no_error(scene: Scene) -> None:
    whole = torch.ones(CARM.camera.shape, dtype=torch.bool)
    clear = replace(scene, saturated={"device": (None, whole, None)}).where_unsaturated()
    assert device_size(clear, TRUTH, "device", "device", PLAIN) is None
    assert doubts_about_size(CASE, scene, clear, TRUTH, PLAIN) == ()


def test_a_tip_that_no_image_shows_is_not_asked(scene: Scene) -> None:
    pose = TRUTH.camera1_from["device"].clone()
    pose[0, 3] += 200
    assert tip_length(scene, TRUTH.with_object("device", pose), "device", "device", (BASE, TIP), PLAIN) is None


def test_a_tip_is_looked_at_through_a_window_of_the_same_detector(scene: Scene) -> None:
    window = _near_the_tip(scene, TRUTH, "device", "device", 1, TIP, float64(0, 0, 1))
    assert window is not None
    assert window.there(["anatomy", "device"], range(3)) == [("anatomy", 1), ("device", 1)]
    whole, part = scene.image("device", 1), window.image("device", 1)
    assert max(part.shape) < 70
    tip = transform_points(TRUTH.camera_from("device")[1], TIP[None])
    (u, v), (column, row) = (project_points(of.carm.camera, tip)[0].round().long() for of in (scene, window))
    torch.testing.assert_close(part[row - 5 : row + 5, column - 5 : column + 5], whole[v - 5 : v + 5, u - 5 : u + 5])
    near = window.field("device", 1)
    assert near is not None
    assert near[row, column]
    assert not near[0].any()
    drawn = project(tool(), TRUTH.camera_from("device")[1][None], window.carm.camera)[0]
    exact = project(tool(), TRUTH.camera_from("device")[1][None], CARM.camera)[0]
    assert torch.equal(drawn[row - 5 : row + 5, column - 5 : column + 5], exact[v - 5 : v + 5, u - 5 : u + 5])


def test_a_tip_beside_its_model_is_not_asked(scene: Scene) -> None:
    for tip in (float64(0, 0, 400), float64(0, -300, 40)):
        assert tip_length(scene, TRUTH, "device", "device", (BASE, tip), PLAIN) is None


@pytest.mark.parametrize("mm", [-4, -1, 0, 3])
def test_an_end_is_drawn_out_by_so_much_and_all_else_stays(mm: int) -> None:
    whole, axis = tool(), float64(0, 0, 1)
    parted = _parted(whole, TIP, axis)
    assert parted is not None
    rest, end = parted
    drawn_out = _stretched(end, TIP, axis, mm)
    shift = ((end.lps_from_index[:3, 3] - whole.lps_from_index[:3, 3]) / 1.0).round().int().tolist()
    column = drawn_out.data[:, 24 - shift[1], 24 - shift[0]]
    top = end.lps_from_index[2, 3] + 0.5 * (column > 0.05).nonzero().max() * 2
    assert float(top) == pytest.approx(39.5 + mm, abs=0.01)
    if mm == 0:
        torch.testing.assert_close(drawn_out.data, end.data, atol=1e-5, rtol=0)
    z = range(end.data.shape[0])
    assert float(rest.data.sum() + end.data.sum()) == pytest.approx(float(whole.data.sum()), rel=1e-5)
    assert float(drawn_out.data[min(z)].sum()) == pytest.approx(float(end.data[min(z)].sum()), abs=1e-5)


def length(longer_mm: float, gain: float, cost: float) -> TipLength:
    """As all views show it alike."""
    return TipLength(longer_mm, gain, cost, gain)


@pytest.mark.parametrize(
    ("estimated", "as_told", "counts"),
    [
        (length(2.31, 0.31, 0.063), length(2.42, 0.31, 0.070), True),  # 2.5 mm longer than its model
        (length(1.96, 0.084, 0.270), length(2.04, 0.113, 0.119), True),  # the same, its end estimated badly
        (length(0.89, 0.012, 0.350), length(-0.05, 0.0, 0.149), False),  # right, its end estimated badly
        (length(-1.45, 0.060, 0.241), length(0.65, 0.005, 0.197), False),  # right, on equalised images
        (length(1.2, 0.03, 0.1), length(0.1, 0.0, 0.2), True),  # a model as told that fits badly knows nothing
    ],
)
def test_an_estimated_end_counts_unless_the_model_as_told_fits_better_without(
    estimated: TipLength, as_told: TipLength, counts: bool
) -> None:
    assert _is_borne_out(estimated, as_told) is counts


@pytest.mark.parametrize(
    ("found", "elsewhere"),
    [
        (TipLength(2.08, 0.125, 0.072, 0.101), True),  # a wire that slid by 2 mm
        (TipLength(1.08, 0.017, 0.303, -0.016), False),  # right: one of three noisy views shows it so much shorter
        (TipLength(0.81, 0.016, 0.066, 0.009), False),  # right, by a little
        (TipLength(1.08, 0.077, 0.018, 0.049), True),
        (TipLength(-2.6, 0.153, 0.098, 0.139), True),
    ],
)
def test_a_length_counts_that_explains_enough_and_that_no_view_contradicts(found: TipLength, elsewhere: bool) -> None:
    assert _ends_elsewhere(found) is elsewhere
