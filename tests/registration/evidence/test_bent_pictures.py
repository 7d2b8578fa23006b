"""Pictures that are stretched or twisted towards their rim, or put together of halves, are told from straight ones."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from registration_scenes import CARM, make_scene, true_poses

from femoreg_torch.case import Case, CaseObject, Model
from femoreg_torch.geometry import CameraChange
from femoreg_torch.registration import Scene
from femoreg_torch.registration.doubts.bends import doubts_about_bends
from femoreg_torch.registration.evidence.bent_pictures import Bend, _ways, bent_pictures, half, towards_the_rim, twisted
from femoreg_torch.registration.evidence.bones import Amount, costs_of_bones
from femoreg_torch.registration.imaging import PLAIN

TRUTH = true_poses((0, 1, 3))
BONES = ("pelvis", "femur")
CASE = Case(
    Path(),
    CARM,
    {name: CaseObject(name) for name in BONES} | {"device": CaseObject("device", model=Model("device", ()))},
)
PX_MM, SIDE = 3.0, 88
RADIUS_MM = PX_MM * SIDE / 2

Array = NDArray[np.float64]
Shift = Callable[[Array, Array], tuple[Array, Array]]  # of places x, y in mm from the middle, mm


def pincushion(mm: float) -> Shift:
    return lambda x, y: (mm * x * (x**2 + y**2) / RADIUS_MM**3, mm * y * (x**2 + y**2) / RADIUS_MM**3)


def s_distortion(mm: float) -> Shift:
    return lambda x, y: (-mm * y * (x**2 + y**2) / RADIUS_MM**3, mm * x * (x**2 + y**2) / RADIUS_MM**3)


def lower_right_half(mm: float) -> Shift:
    return lambda x, y: (0 * x, mm * (x > 0))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def bent(scene: Scene, shifts: Sequence[Shift | None]) -> Scene:
    """The scene with first images whose content was moved, by view."""
    along = (np.arange(SIDE) - (SIDE - 1) / 2) * PX_MM
    x, y = np.meshgrid(along, along)
    images = list(scene.images["anatomy"])
    for view, shift in enumerate(shifts):
        image = images[view]
        if shift is None or image is None:
            continue
        across, down = shift(x, y)
        maps = [(np.indices(x.shape)[axis] - off / PX_MM).astype(np.float32) for axis, off in enumerate((down, across))]
        moved = cv2.remap(image.numpy(), maps[1], maps[0], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        images[view] = torch.from_numpy(moved)
    return replace(scene, images=scene.images | {"anatomy": tuple(images)})


def found(scene: Scene) -> dict[str, list[float]]:
    bends = bent_pictures(scene, TRUTH, BONES, PLAIN)
    return {bend.way.name: [each.value for each in bend.amounts] for bend in bends}


def test_straight_pictures_are_not_doubted(scene: Scene) -> None:
    assert found(scene) == {}
    assert doubts_about_bends(CASE, scene, TRUTH, PLAIN) == ()


@pytest.mark.parametrize(
    ("shift", "way", "mm"),
    [(pincushion, "rim", (6.0, 6.0, 6.0)), (s_distortion, "twist", (5.0, -4.0, 5.0))],
)
def test_bends_of_an_image_intensifier_are_measured_view_by_view(
    scene: Scene, shift: Callable[[float], Shift], way: str, mm: tuple[float, ...]
) -> None:
    """But for view 1, where the bones lie in the middle."""
    amounts = found(bent(scene, [shift(each) for each in mm]))[way]
    assert amounts[1:] == pytest.approx(mm[1:], abs=1.0)
    assert 0 < amounts[0] < mm[0]


def test_what_is_sure_and_explains_much_is_told(scene: Scene) -> None:
    (told,) = doubts_about_bends(CASE, bent(scene, [s_distortion(mm) for mm in (5, -4, 5)]), TRUTH, PLAIN)
    assert told.startswith("the pictures seem to be twisted at their rim, by ")
    assert "mm in view 3 (straightened so, they fit" in told
    assert "`grid` of the views" in told


def test_halves_that_were_put_together_wrongly_are_told(scene: Scene) -> None:
    wrong = bent(scene, [lower_right_half(4.0)] * 3)
    assert found(wrong)["columns"] == pytest.approx([0.0, 4.0], abs=1.0)
    (told,) = doubts_about_bends(CASE, wrong, TRUTH, PLAIN)
    assert re.match(
        r"the left and the right half of the pictures, set upright, seem to lie 0\.\d mm aside and [34]\.\d mm", told
    )
    assert "are halves of the detector put together wrongly" in told


RIM, TWIST, COLUMNS, ROWS = _ways((0, 2))


@pytest.mark.parametrize(
    ("bends", "says"),
    [
        ([], None),
        ([Bend(RIM, (Amount(0.3, 0.1), Amount(6.0, 0.8)), 0.008)], "towards their rim, by 6.0 mm in view 3 ("),
        (
            [Bend(RIM, (Amount(-3.2, 0.4), Amount(4.3, 0.8)), 0.1)],
            "stretched towards their rim, by 4.3 mm in view 3, and drawn in at their rim, by 3.2 mm in view 1 (",
        ),
        ([Bend(RIM, (Amount(-4.2, 1.8), Amount(0.3, 1.9)), 0.017)], None),  # not sure
        ([Bend(RIM, (Amount(-2.6, 0.7), Amount(-4.2, 1.9)), -0.06)], None),  # explains nothing
        ([Bend(RIM, (Amount(7.0, 1.0), Amount(12.0, 2.0)), 0.033)], None),  # no detector bends pictures so far
        ([Bend(TWIST, (Amount(1.8, 0.3), Amount(2.0, 0.3)), 0.008)], None),
        ([Bend(ROWS, (Amount(2.0, 0.2), Amount(-0.5, 0.1)), 0.028)], "upper and the lower half"),
        ([Bend(COLUMNS, (Amount(0.1, 0.02), Amount(-0.3, 0.02)), 0.028)], None),  # sure, but little
        (
            [Bend(ROWS, (Amount(2.0, 0.2), Amount(0, 0.1)), 0.02), Bend(TWIST, (Amount(4, 1), Amount(3, 1)), 0.05)],
            "twisted at their rim, by 4.0 mm in view 1 and 3.0 mm in view 3 (straightened so, they fit 5 % better)",
        ),
    ],
)
def test_the_likeliest_of_the_sure_ones_is_told(
    bends: list[Bend], says: str | None, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("femoreg_torch.registration.doubts.bends.bent_pictures", lambda *_: tuple(bends))
    told = doubts_about_bends(CASE, scene, TRUTH, PLAIN)
    assert told == () if says is None else says in told[0]
    assert len(told) <= 1


def test_a_bend_of_one_ends_where_the_wider_side_of_the_picture_does() -> None:
    camera = replace(CARM.camera, shape=(60, 100), pixel_mm=(2.0, 1.5), principal_point_px=(10.0, 7.0))
    edge = 99 / 100  # the middle of the last column, by half the width
    for field, expected in ((towards_the_rim, (edge**3, 0.0)), (twisted, (0.0, edge**3))):
        between = field(camera)[:, 29:31, -1].mean(1)  # of the two middle rows
        assert between.tolist() == pytest.approx(expected, abs=1e-3)
    moved = half(1, 0)(camera)
    assert moved.sum(-1).tolist() == [[0.0] * 30 + [100.0] * 30, [0.0] * 60]


def test_a_bend_that_moves_everything_alike_is_a_shift_of_the_camera(scene: Scene) -> None:
    """Its slope is that of the costs between cameras whose principal points lie elsewhere, here away from the truth."""
    costs = costs_of_bones(scene, TRUTH, BONES, PLAIN)
    assert costs is not None
    away = costs.still.clone()
    away[3:5] = 2.0  # mm
    for axis in (0, 1):
        rates = {target.view: torch.zeros(2, *target.camera.shape) for target in costs.targets}
        for rate in rates.values():
            rate[axis] = 1.0
        slope = sum(float(model.gradient[-1]) for model in costs.quadratics(away, bends=[rates]))
        values = []
        for px in (0.1, -0.1):
            elsewhere = [
                replace(each, camera=each.camera.changed(CameraChange(principal_point_shift_mm=shift)))
                for each in costs.targets
                for shift in [(PX_MM * px, 0.0) if axis == 0 else (0.0, PX_MM * px)]
            ]
            values.append(float(replace(costs, targets=tuple(elsewhere))(away[None]).sum()))
        assert slope == pytest.approx((values[0] - values[1]) / 0.2, rel=0.1)


def test_one_view_tells_nothing_of_bends(scene: Scene) -> None:
    of_one = {kind: (images[0], None, None) for kind, images in scene.images.items()}
    assert bent_pictures(replace(scene, images=of_one), TRUTH, BONES, PLAIN) == ()


def test_where_no_bone_of_a_ct_is_the_anchor_nothing_is_asked(scene: Scene) -> None:
    models = {name: replace(thing, model=Model(name, ())) for name, thing in CASE.objects.items()}
    wrong = bent(scene, [lower_right_half(2.0)] * 3)
    assert doubts_about_bends(replace(CASE, objects=models), wrong, TRUTH, PLAIN) == ()
