"""Any rigid objects: words that stand for all of them, the preset that names none, and C-arm poses that are known."""

from dataclasses import replace

import pytest
import torch
from registration_scenes import REFERENCE_POINTS, error, float64, make_scene, off, quicker, true_poses

from femoreg_torch.case import Start
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import invert_rigid, rigid
from femoreg_torch.optimize import LevenbergMarquardt
from femoreg_torch.registration import BodyPlan, Level, OrbitSearch, Plan, Scene, Stage, load_plan, run_plan
from femoreg_torch.registration.costs import image_costs
from femoreg_torch.registration.doubts.carm import doubts_about_the_views
from femoreg_torch.registration.evidence.covariance import pose_covariance
from femoreg_torch.registration.imaging import Imaging
from femoreg_torch.registration.stage import run_stage
from femoreg_torch.similarity import GradNcc
from femoreg_torch.volume import Volume, axis_aligned

LEVEL = Level(pixel_mm=3.0, step_mm=2.0)
SIMILARITY = GradNcc(patch_radius=4)
BRIEF = LevenbergMarquardt(max_iterations=1)
TRUTH = true_poses((0, 2))


def stage(name: str, images: str, *bodies: BodyPlan, kinds: str = "all") -> Stage:
    return Stage(name, images, [kinds], ["all"], list(bodies), LEVEL, SIMILARITY, BRIEF)  # type: ignore[arg-type]


ORBIT = OrbitSearch("orbit", ["all"], ["all"], 20, 1, LEVEL, SIMILARITY)
EACH = BodyPlan(["each"], [1, 1, 1], [1, 1, 4])
ALL = BodyPlan(["all"], [1, 1, 1], [1, 1, 4])
VIEW, VIEWS = BodyPlan(["view"], [1, 1, 1], [1, 1, 4]), BodyPlan(["views"], [1, 1, 1], [1, 1, 4])

STEPS = (
    ORBIT,
    stage("C-arm", "each other", VIEW),
    stage("C-arms", "all", VIEWS),
    stage("joint", "all", EACH, VIEWS),
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(TRUTH)


def known(scene: Scene) -> Scene:
    return replace(scene, camera_from_camera1=TRUTH.camera_from_camera1)


def test_all_is_one_body_and_each_is_one_for_every_object_that_the_images_show(scene: Scene) -> None:
    (one,) = ALL.bodies(scene, TRUTH, ["anatomy"], (0,))
    assert one.objects == ("pelvis", "femur", "device")
    torch.testing.assert_close(one.centre, TRUTH.camera1_from["pelvis"][:3, 3])  # the anchor's origin
    bodies = EACH.bodies(scene, TRUTH, ["anatomy"], (0,))
    assert [body.objects for body in bodies] == [("pelvis",), ("femur",)]
    assert [body.objects for body in EACH.bodies(scene, TRUTH, ["device"], (0,))][2] == ("device",)
    head = torch.cat([REFERENCE_POINTS["femur"], torch.ones(1).double()])
    torch.testing.assert_close(bodies[1].centre, (TRUTH.camera1_from["femur"] @ head)[:3])


def device_first(scene: Scene) -> Scene:
    """The scene with a model before the bones, where every object starts from a pose that was told."""
    device, pelvis = scene.objects["device"], scene.objects["pelvis"]
    objects = {
        "device": replace(device, parts=(device.volume,)),
        "pelvis": replace(pelvis, start=Start(TRUTH.camera1_from["pelvis"])),
        "femur": scene.objects["femur"],
    }
    return replace(scene, objects=objects)


def test_a_bone_is_the_anchor_although_a_model_stands_first(scene: Scene) -> None:
    """Soft tissue and landmarks lie in its space, and not in that of the model."""
    assert device_first(scene).anchor == "pelvis"
    model = device_first(scene).objects["device"]
    assert replace(scene, objects={"one": model, "other": model}).anchor == "one"
    body = torch.zeros(30, 30, 30)
    body[6:24, 6:24, 6:24] = 0.02
    tissue = Volume(body, axis_aligned((6.0, 6.0, 6.0), (-90.0, -90.0, -90.0)))
    drawn, expected = (
        image_costs(
            replace(each, tissue=tissue), TRUTH, (), list(TRUTH.camera1_from), [("anatomy", 0)], LEVEL, SIMILARITY,
            imaging=Imaging(tissue=0.75),
        ).targets[0].tissue
        for each in (device_first(scene), scene)
    )  # fmt: skip
    assert drawn is not None
    torch.testing.assert_close(drawn, expected)


def test_a_model_that_stands_first_needs_no_image() -> None:
    bones = device_first(make_scene(TRUTH, with_device=False))
    outcome = run_plan(bones, Plan("mine", STEPS), None, 0)
    assert list(outcome.poses.camera1_from) == ["pelvis", "femur"]


def test_one_body_for_all_keeps_them_together(scene: Scene) -> None:
    away = rigid(translation=float64(2, -3, 0))
    start = replace(TRUTH, camera1_from={name: away @ pose for name, pose in TRUTH.camera1_from.items()})
    after = run_stage(scene, start, stage("all", "first", ALL), (0,), seed=0).poses
    motions = torch.stack([after.camera1_from[n] @ invert_rigid(start.camera1_from[n]) for n in REFERENCE_POINTS])
    torch.testing.assert_close(motions, motions[:1].expand(3, 4, 4))
    assert not torch.allclose(motions[0], rigid(), atol=0.1)


def test_known_c_arm_poses_stay_and_what_would_find_them_is_left_out_and_told(scene: Scene) -> None:
    found = run_plan(known(scene), Plan("mine", STEPS), TRUTH.camera1_from["pelvis"], 0)
    assert [record.name for record in found.trace] == ["joint"]
    assert found.skipped == tuple(
        f"stage “{name}” was left out: the C-arm's poses are given" for name in ("orbit", "C-arm", "C-arms")
    )
    assert torch.equal(found.poses.camera_from_camera1, TRUTH.camera_from_camera1)
    assert pose_covariance(known(scene), found.poses, LEVEL, SIMILARITY).bodies == tuple(REFERENCE_POINTS)


def test_of_one_view_the_c_arm_stays_and_it_is_told() -> None:
    alone = make_scene(true_poses((0,)))
    found = run_plan(alone, Plan("mine", STEPS), TRUTH.camera1_from["pelvis"], 0)
    assert [record.name for record in found.trace] == ["joint"]
    assert found.skipped == tuple(
        f"stage “{name}” was left out: this case has one view only" for name in ("orbit", "C-arm", "C-arms")
    )


def test_a_search_for_the_views_without_its_images_is_refused() -> None:
    scene = make_scene(TRUTH, with_device=False)
    search = replace(ORBIT, kinds=["device"])
    says = r"preset mine, step “orbit”: it finds the C-arm .* kind “device” in view 2. Choose another preset."
    with pytest.raises(InputError, match=says):
        run_plan(scene, Plan("mine", (search,)), TRUTH.camera1_from["pelvis"], 0)
    plan = Plan("mine", (search, stage("joint", "all", EACH)))
    assert len(run_plan(known(scene), plan, TRUTH.camera1_from["pelvis"], 0).skipped) == 1


@pytest.mark.parametrize("given", [True, False])
def test_the_rigid_preset_finds_every_object_from_a_start_pose(given: bool) -> None:
    """No object starts from landmarks here: one from a nominal pose, another beside it."""
    scene = make_scene(TRUTH)
    point = REFERENCE_POINTS["pelvis"]
    nominal = off(TRUTH.camera1_from["pelvis"], point, (3, -2, 2), (4, -4, 15))
    device = off(TRUTH.camera1_from["device"], REFERENCE_POINTS["device"], (2, 2, -2), (3, -3, 8))
    objects = {name: scene.objects[name] for name in ("pelvis", "femur", "device")}
    objects["pelvis"] = replace(objects["pelvis"], start=Start(nominal))
    objects["device"] = replace(objects["device"], start=Start(device))
    poses = TRUTH.camera_from_camera1 if given else None
    scene = replace(scene, objects=objects, camera_from_camera1=poses)
    found = run_plan(scene, quicker(load_plan("rigid")), None, seed=0)
    for name, true in TRUTH.camera1_from.items():
        mm, deg = error(found.poses.camera1_from[name], true, REFERENCE_POINTS[name])
        assert mm < (0.6 if given else 2.5), name
        assert deg < 1.0, name
    assert len(found.skipped) == (2 if given else 0)


def test_views_are_found_by_a_tool_that_the_first_kind_of_images_lacks(scene: Scene) -> None:
    """Images without the tool come first, and show nothing that is registered."""
    alone = replace(scene, objects={"device": scene.objects["device"]})
    poses = replace(TRUTH, camera1_from={"device": TRUTH.camera1_from["device"]})
    assert doubts_about_the_views(alone, poses) == ()
