"""A CT that is stretched or sheared is told from one that has the patient's shape."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from registration_scenes import make_scene, true_poses
from torch import Tensor

from femoreg_torch.case import Case, CaseObject, Model
from femoreg_torch.geometry import Poses, exp_so3
from femoreg_torch.registration import Scene
from femoreg_torch.registration.doubts.ct import doubts_about_the_ct
from femoreg_torch.registration.evidence.ct_shape import ct_shape
from femoreg_torch.registration.imaging import PLAIN
from femoreg_torch.volume import Volume

TRUTH = true_poses((0, 1, 3))
BONES = ("pelvis", "femur")
CASE = Case(
    Path(),
    make_scene(TRUTH).carm,
    {name: CaseObject(name) for name in BONES} | {"device": CaseObject("device", model=Model("device", ()))},
)
NORMAL, COLUMNS, ROWS = 2, 1, 0
OF_AXIS = {NORMAL: "stretch", COLUMNS: "tilt", ROWS: "slide"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def as_the_ct_has_it(scene: Scene, linear: Tensor) -> Scene:
    """The scene with all bones deformed about the origin, as a CT that is not of the patient's shape has them."""
    deformation = torch.eye(4, dtype=torch.float64)
    deformation[:3, :3] = linear
    objects = dict(scene.objects)
    for name in BONES:
        volume = objects[name].volume
        objects[name] = replace(objects[name], volume=Volume(volume.data, deformation @ volume.lps_from_index))
    return replace(scene, objects=objects)


def ct_of(way: int, amount: float) -> Tensor:
    """What makes a CT of the patient's bones that lacks this much of one way to deform it, (3, 3)."""
    true = torch.eye(3, dtype=torch.float64)
    true[way, NORMAL] += amount
    return torch.linalg.inv(true)


def amounts(scene: Scene, poses: Poses = TRUTH) -> dict[str, float]:
    return {found.way: found.amount.value for found in ct_shape(scene, poses, BONES, PLAIN)}


def test_a_ct_of_the_right_shape_is_not_doubted(scene: Scene) -> None:
    assert amounts(scene) == {}
    assert doubts_about_the_ct(CASE, scene, TRUTH, PLAIN) == ()


@pytest.mark.parametrize(
    ("way", "amount", "words"),
    [
        (NORMAL, 0.02, "longer across the slices"),
        (NORMAL, -0.02, "shorter across the slices"),
        (COLUMNS, 0.05, "from front to back against the CT"),
        (ROWS, -0.05, "from side to side against the CT"),
    ],
)
def test_it_is_told_by_how_much_and_in_which_way(scene: Scene, way: int, amount: float, words: str) -> None:
    wrong = as_the_ct_has_it(scene, ct_of(way, amount))
    assert amounts(wrong)[OF_AXIS[way]] == pytest.approx(amount, rel=0.25)
    told = doubts_about_the_ct(CASE, wrong, TRUTH, PLAIN)
    assert words in told[0] if way == NORMAL else any(words in doubt for doubt in told)


def test_slices_of_an_oblique_ct_count_and_not_the_patients_axes(scene: Scene) -> None:
    """The whole patient lies turned in the CT: its bones, and where they are."""
    turn = exp_so3(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64))
    whole = torch.eye(4, dtype=torch.float64)
    whole[:3, :3] = turn
    wrong = as_the_ct_has_it(scene, turn @ ct_of(NORMAL, 0.02))
    objects = {
        name: replace(thing, reference_point=turn @ thing.reference_point) if name in BONES else thing
        for name, thing in wrong.objects.items()
    }
    poses = TRUTH
    for name in BONES:
        poses = poses.with_object(name, TRUTH.camera1_from[name] @ torch.linalg.inv(whole))
    assert amounts(replace(wrong, objects=objects), poses)["stretch"] == pytest.approx(0.02, rel=0.25)


def test_one_view_tells_no_shape(scene: Scene) -> None:
    of_one = {kind: (images[0], None, None) for kind, images in scene.images.items()}
    assert ct_shape(replace(scene, images=of_one), TRUTH, BONES, PLAIN) == ()


def test_where_no_bone_of_a_ct_is_the_anchor_nothing_is_asked(scene: Scene) -> None:
    models = {name: replace(thing, model=Model(name, ())) for name, thing in CASE.objects.items()}
    wrong = as_the_ct_has_it(scene, ct_of(NORMAL, 0.02))
    assert doubts_about_the_ct(replace(CASE, objects=models), wrong, TRUTH, PLAIN) == ()
