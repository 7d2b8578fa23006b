"""Whatever images there are: a view without a device image, no device images at all, one to four views, a biplane."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, error, float64, make_scene, off, quicker, true_poses

from femoreg_torch.case import Case, CaseObject, Model, View
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import Poses, rigid
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import BodyPlan, Level, OrbitSearch, Scene, Stage, load_plan, run_plan
from femoreg_torch.registration.evidence.covariance import pose_covariance
from femoreg_torch.registration.prepare.images import read_images
from femoreg_torch.registration.quality import Limits, assess
from femoreg_torch.registration.scene import Body
from femoreg_torch.similarity import GradNcc

LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
SIMILARITY = GradNcc(patch_radius=4)
BRIEF = LevenbergMarquardt(max_iterations=1)
TRUTH = true_poses()


def without_device(scene: Scene, views: Iterable[int]) -> Scene:
    """The scene without the device images of some views (from 0)."""
    left = tuple(None if view in set(views) else image for view, image in enumerate(scene.images["device"]))
    return replace(scene, images={**scene.images, "device": left})


def stage(images: str, kinds: list[str], *bodies: BodyPlan) -> Stage:
    return Stage("mine", images, kinds, ["all"], list(bodies), LEVEL, SIMILARITY, BRIEF)  # type: ignore[arg-type]


def moves(*names: str) -> BodyPlan:
    return BodyPlan(list(names), [1, 1, 1], [1, 1, 4])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def test_a_stage_sees_the_images_that_there_are(scene: Scene) -> None:
    one_less = without_device(scene, [1])
    assert one_less.there(["anatomy", "device", "other"], range(3)) == [
        ("anatomy", 0), ("anatomy", 1), ("anatomy", 2), ("device", 0), ("device", 2),
    ]  # fmt: skip
    with pytest.raises(InputError, match="view 2 has no device image"):
        one_less.image("device", 1)


def test_a_stage_moves_only_what_its_images_show(scene: Scene) -> None:
    first_less = without_device(scene, [0])
    joint = stage("first", ["anatomy", "device"], moves("pelvis"), moves("femur", "device"), moves("device"))
    assert [b.objects for b in joint.moving(scene, TRUTH, (0,))] == [("pelvis",), ("femur", "device"), ("device",)]
    assert [b.objects for b in joint.moving(first_less, TRUTH, (0,))] == [("pelvis",), ("femur", "device")]
    alone = stage("first", ["anatomy", "device"], moves("device"))
    assert alone.left_out(scene, TRUTH) is None
    assert alone.left_out(first_less, TRUTH) == "its images show nothing of what it moves"
    assert stage("first", ["device"], moves("device")).left_out(first_less, TRUTH) == (
        "there is no image of the kind “device” in view 1"
    )


def test_a_c_arm_stays_where_a_stage_has_no_image_of_its_view(scene: Scene) -> None:
    one_less = without_device(scene, [1])
    views = stage("all", ["device"], moves("views"))
    assert [body.view for body in views.moving(one_less, TRUTH, (0, 1, 2))] == [2]
    each = stage("each other", ["device"], moves("view"))
    assert [record.view for record in each.run(one_less, TRUTH, 0)] == [3]


def test_an_orbit_search_takes_the_images_that_a_view_has(scene: Scene) -> None:
    one_less = without_device(scene, [1])
    both = OrbitSearch("orbit", ["all"], ["all"], 20, 2, LEVEL, SIMILARITY)
    assert both.images(one_less, TRUTH, 1) == [("anatomy", 1)]
    assert [record.view for record in both.run(one_less, TRUTH, 0)] == [2, 3]
    with pytest.raises(InputError, match="kind “device” in view 2"):
        replace(both, kinds=["device"]).left_out(one_less, TRUTH)


def test_quality_and_covariance_ask_the_views_that_show_an_object(scene: Scene) -> None:
    one_less = without_device(scene, [1])
    found = assess(one_less, TRUTH, Limits())
    assert [view.view for view in found["device"].views] == [1, 3]
    assert [view.view for view in found["pelvis"].views] == [1, 2, 3]
    assert found["device"].reason == "all views that show it agree"
    assert found["pelvis"].reason == "all views agree"
    vague, sure = (pose_covariance(s, TRUTH, LEVEL, SIMILARITY).deviations("device")[1] for s in (one_less, scene))
    assert all(torch.isfinite(torch.tensor(vague)))
    assert sum(vague) > sum(sure)


def started(truth: Poses, with_device: bool, missing: tuple[int, ...] = (), known: bool = False) -> tuple[Scene, Poses]:
    device = off(truth.camera1_from["device"], REFERENCE_POINTS["device"], (2, 2, -2), (3, -3, 5))
    scene = make_scene(truth, with_device=with_device, camera1_from_device=device)
    if missing:
        scene = without_device(scene, missing)
    return replace(scene, camera_from_camera1=truth.camera_from_camera1 if known else None), truth


@pytest.mark.parametrize(
    ("preset", "views", "with_device", "missing", "known"),
    [
        ("fast", (0,), True, (), False),
        ("rigid", (0,), False, (), False),
        ("fast", (0, 2), True, (1,), False),
        ("rigid", (0, 1, 2, 3), True, (0, 2), False),
        ("fast", (0, 2), False, (), False),
        ("fast", (0, 2), False, (), True),
        ("rigid", (0, 2), True, (0,), True),
    ],
)
def test_presets_take_whatever_images_there_are(
    preset: str, views: tuple[int, ...], with_device: bool, missing: tuple[int, ...], known: bool
) -> None:
    scene, truth = started(true_poses(views), with_device, missing, known)
    start = off(truth.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (2, -2, 1), (2, -3, 8))
    outcome = run_plan(scene, quicker(load_plan(preset)), start, seed=0)
    assert list(outcome.poses.camera1_from) == ["pelvis", "femur", *(["device"] if with_device else [])]
    ran = [entry.name for entry in outcome.trace]
    assert "everything together" in ran
    by_device = preset == "fast" and with_device
    assert ran[-1] == ("device alone, finest" if by_device else "everything together, fine")
    for name, pose in outcome.poses.camera1_from.items():
        point = torch.cat([REFERENCE_POINTS[name], float64(1)])
        x, y, depth = ((pose - truth.camera1_from[name]) @ point)[:3].abs().tolist()
        assert max(x, y) < 1, name  # a device seen from the side alone errs in depth of that side
        assert depth < 4, name  # of one view
        assert error(pose, truth.camera1_from[name], REFERENCE_POINTS[name])[1] < 2, name
    told = " ".join(outcome.skipped)
    if preset == "fast" and not with_device:
        assert "stage “device in all views, coarse” was left out: there is no image of the kind “device”" in told
    assert "together" not in told
    quality = assess(scene, outcome.poses, Limits(), trace=outcome.trace)
    assert [len(q.views) for n, q in quality.items() if n == "device"] == [len(views) - len(missing)] * with_device


def test_a_case_without_a_device_takes_the_joint_stages_of_fast() -> None:
    """The preset names a device; neither the objects nor the images of this case have one."""
    scene = make_scene(true_poses((0,)), with_device=False)
    bare = replace(scene, objects={name: scene.objects[name] for name in ("pelvis", "femur")})
    plan = load_plan("fast")
    joint = next(step for step in plan.stages if step.name == "everything together")
    bones = bare.start(TRUTH.camera1_from["pelvis"])
    assert joint.left_out(bare, bones) is None
    moving = [body.objects for body in joint.moving(bare, bones, (0,)) if isinstance(body, Body)]
    assert moving == [("pelvis",), ("femur",)]


def case_with(folder: Path, has: list[tuple[str, ...]]) -> Case:
    """A case whose views have images of these kinds, 88 × 88 pixels of noise."""
    generator = torch.Generator().manual_seed(0)
    views = []
    for number, kinds in enumerate(has):
        paths = {kind: folder / f"{number}_{kind}.tif" for kind in kinds}
        for path in paths.values():
            write_image(path, torch.randint(2000, 30000, (88, 88), generator=generator).to(torch.uint16))
        views.append(View(paths))
    model = Model(folder / "nail.stl", 5000)
    objects = {"bone": CaseObject("bone"), "nail": CaseObject("nail", model=model, images=("device",))}
    return Case(folder, CARM, objects, tuple(views))


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    both, one = ("anatomy", "device"), ("anatomy",)
    images, fields, told = read_images(case_with(tmp_path, [both, one, both]))
    assert fields == {"anatomy": (None,) * 3, "device": (None,) * 3}
    assert [image is None for image in images["device"]] == [False, True, False]
    assert told == ("view 2 has no device image: the nail was found in views 1 and 3",)
    assert read_images(case_with(tmp_path, [one, one, both]))[2] == (
        "views 1 and 2 have no device image: the nail was found in view 3",
    )
    images, _, told = read_images(case_with(tmp_path, [one, one]))
    assert list(images) == ["anatomy"]
    assert told == ("there are no device images, so nothing shows the nail",)
    assert read_images(case_with(tmp_path, [both, both]))[2] == ()
    with pytest.raises(InputError, match=r"views\[1\]\.anatomy: missing"):
        read_images(case_with(tmp_path, [both, ("device",)]))


def test_rigid_motion_of_all_keeps_objects_together_where_one_is_not_shown(scene: Scene) -> None:
    first_less = without_device(scene, [0])
    away = rigid(translation=float64(2, -3, 0))
    start = replace(TRUTH, camera1_from={name: away @ pose for name, pose in TRUTH.camera1_from.items()})
    (record,) = stage("first", ["all"], moves("all")).run(first_less, start, 0)
    turned = [record.poses.camera1_from[n] @ start.camera1_from[n].inverse() for n in REFERENCE_POINTS]
    torch.testing.assert_close(turned[2], turned[0])
