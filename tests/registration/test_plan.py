"""Presets as data: those that ship, and what a mistake in one says."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from femoreg_torch.configs import preset_names

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import load_carm
from femoreg_torch.optimize import Bobyqa, CmaEs, LevenbergMarquardt
from femoreg_torch.registration import BodyPlan, OrbitSearch, Stage, load_plan, plan_from
from femoreg_torch.registration.level import Level, binning
from femoreg_torch.registration.materials.calibration import Calibration
from femoreg_torch.similarity import GradNcc, Ncc

STAGE = {
    "name": "a",
    "kind": "stage",
    "images": "first",
    "kinds": ["anatomy"],
    "render": ["pelvis"],
    "bodies": [{"move": ["pelvis"], "centre": "pelvis", "rotation_deg": [1, 1, 1], "translation_mm": [1, 1, 1]}],
    "level": {"pixel_mm": 1.55, "step_mm": 1},
    "similarity": {"kind": "ncc"},
    "optimiser": {"kind": "cma_es", "population": 10},
}
OF_THE_HIP = sorted(set(preset_names("registration")) - {"rigid"})


@pytest.mark.parametrize("name", OF_THE_HIP)
def test_every_preset_loads_and_registers_everything(name: str) -> None:
    plan = load_plan(name)
    moved = {what for stage in plan.stages for body in stage.bodies for what in body.move}
    assert moved - {"views", "intrinsics"} == {"pelvis", "femur", "device", "view"}
    assert any(isinstance(step, OrbitSearch) for step in plan.steps)


def test_the_preset_for_any_objects_names_none() -> None:
    for step in load_plan("rigid").steps:
        assert isinstance(step, Stage | OrbitSearch)
        assert (step.kinds, step.render) == (["all"], ["all"])
    stages = load_plan("rigid").stages
    assert {what for stage in stages for body in stage.bodies for what in body.move} == {"all", "each", "view", "views"}


def test_a_stage_is_what_its_keys_say() -> None:
    (stage,) = plan_from("mine", {"steps": [STAGE]}).steps
    body = BodyPlan(["pelvis"], [1, 1, 1], [1, 1, 1], "pelvis")
    assert stage == Stage("a", "first", ["anatomy"], ["pelvis"], [body], Level(1.55, 1), Ncc(), CmaEs(population=10))


def test_levels_of_the_presets_are_whole_pixels_of_the_c_arm_binned_or_not() -> None:
    """32, 16, 8, 4 and 2 pixels of 0.194 mm."""
    camera = load_carm("cios_fusion").camera
    levels = (6.2, 3.1, 1.55, 0.78, 0.39)
    steps = [step for name in OF_THE_HIP for step in load_plan(name).steps]
    used = {step.level.pixel_mm for step in steps if isinstance(step, Stage | OrbitSearch)}
    assert used == set(levels)
    for factor, pixels in ((1, [32, 16, 8, 4, 2]), (2, [16, 8, 4, 2, 1]), (4, [8, 4, 2, 1, 1])):
        assert [binning(level, camera.downsampled(factor)) for level in levels] == pixels


def test_weights_of_pixels_are_a_stage_s_own_and_bones_need_segmentations() -> None:
    plain, clear, bones = (
        plan_from("mine", {"steps": [STAGE, STAGE | more]})
        for more in ({}, {"weights": ["clear"]}, {"weights": ["bones", "clear"]})
    )
    assert [stage.weights for stage in bones.stages] == [[], ["bones", "clear"]]
    assert [plan.needs_segmentations for plan in (plain, clear, bones)] == [False, False, True]


def test_the_paper_preset_is_the_papers() -> None:
    plan = load_plan("paper")
    (orbit,) = (step for step in plan.steps if isinstance(step, OrbitSearch))
    assert (orbit.half_range_deg, orbit.step_deg) == (45, 0.5)
    *stages, last = plan.stages
    for step in (*stages, orbit):
        assert step.level.pixel_mm == 0.78
        assert step.similarity == GradNcc(patch_radius=10)
    assert last.level.pixel_mm == 0.78
    assert last.similarity == GradNcc(patch_radius=5)  # smaller, as the preset's comment tells
    (materials,) = (step for step in plan.steps if isinstance(step, Calibration))  # the one that is not
    assert plan.steps.index(materials) == len(plan.steps) - 2
    assert all(isinstance(stage.optimiser, Bobyqa) for stage in plan.stages if len(stage.bodies) > 1)
    assert all(isinstance(stage.optimiser, CmaEs) for stage in plan.stages if len(stage.bodies) == 1)


def test_the_preset_of_a_carm_as_told_is_fast_without_refined_intrinsics() -> None:
    fast, told = load_plan("fast").steps, load_plan("fast_carm_as_told").steps
    assert [step.name for step in told] == [step.name for step in fast]
    for one, other in zip(fast, told, strict=True):
        if isinstance(one, Stage):
            assert isinstance(other, Stage)
            kept = [body for body in one.bodies if body.move != ["intrinsics"]]
            assert other == replace(one, bodies=kept)
        else:
            assert other == one
    assert not any("intrinsics" in body.move for step in told if isinstance(step, Stage) for body in step.bodies)


def test_the_wide_preset_is_fast_with_two_more_searches_for_the_device() -> None:
    fast, wide = load_plan("fast").steps, load_plan("fast_wide_device").steps
    more = [step for step in wide if step not in fast]
    assert [step for step in wide if step in fast] == list(fast)
    assert len(more) == 2
    for step in more:
        assert isinstance(step, Stage)
        assert [body.move for body in step.bodies] == [["device"]]
        assert isinstance(step.optimiser, LevenbergMarquardt)
        assert step.optimiser.candidates >= 500
    assert wide[wide.index(more[-1]) + 1].name == "device in all views, coarse"


def test_the_fiducial_preset_finds_the_views_by_the_device_alone() -> None:
    *steps, last, fine, finest = load_plan("device_fiducial").steps
    assert (last, fine, finest) == load_plan("fast").steps[-3:]
    by_device = [step for step in steps if isinstance(step, Stage | OrbitSearch) and step.render == ["device"]]
    assert steps[: len(by_device)] == by_device
    assert [step.kinds for step in steps if isinstance(step, OrbitSearch)] == [["device"]]
    moving = [step for step in steps if isinstance(step, Stage) for b in step.bodies if b.move in (["view"], ["views"])]
    assert moving
    assert all(step in by_device and step.kinds == ["device"] for step in moving)


def test_a_file_may_change_a_preset(tmp_path: Path) -> None:
    change = {"name": "orbit search", "half_range_deg": 20}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"extends": "fast", "steps": [change]}), encoding="utf-8")
    fast, mine = load_plan("fast"), load_plan(tmp_path / "mine.yaml")
    assert [step.name for step in mine.steps] == [step.name for step in fast.steps]
    (orbit,) = (step for step in mine.steps if step not in fast.steps)
    assert isinstance(orbit, OrbitSearch)
    assert orbit.half_range_deg == 20


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"images": "second"}, "step 1.*images"),
        ({"colour": "red"}, "step 1.*colour"),
        ({"kind": "stag"}, "step 1 \\('a'\\): unknown kind 'stag'. Known kinds: stage, orbit_search"),
        ({"kind": None}, "step 1 \\('a'\\): a mapping with the key `kind`"),
        ({"weights": ["bone"]}, "step 1.*weights"),
        ({"bodies": [{**STAGE["bodies"][0], "rotation_deg": [1, 1]}]}, "step 1.*need three numbers"),  # type: ignore[index,dict-item]
        ({"bodies": [{**STAGE["bodies"][0], "move": ["views"]}]}, "step 1.*needs `images: all`"),  # type: ignore[index,dict-item]
        ({"level": {"pixel_mm": 0, "step_mm": 1}}, "step 1 \\('a'\\): pixel_mm: 0.01 to 100"),
        ({"similarity": {"kind": "mi"}}, "step 1 \\('a'\\), similarity: unknown kind 'mi'. Known kinds: grad_ncc, ncc"),
        ({"similarity": {"kind": "ncc", "radius": 3}}, "step 1 \\('a'\\), similarity, ncc: unknown key 'radius'"),
        ({"optimiser": {"population": 3}}, "step 1 \\('a'\\), optimiser: a mapping with the key `kind`"),
        ({"optimiser": {"kind": "cma_es", "population": "many"}}, "step 1 \\('a'\\), optimiser, cma_es: .*population"),
    ],
)
def test_a_mistake_is_told_with_preset_and_step(change: dict[str, object], says: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({"steps": [STAGE | change]}), encoding="utf-8")
    with pytest.raises(InputError, match=f"mine.yaml, {says}"):
        load_plan(tmp_path / "mine.yaml")


@pytest.mark.parametrize("key", ["similarity", "optimiser", "level"])
def test_a_missing_key_is_named(key: str) -> None:
    with pytest.raises(InputError, match=f"preset mine, step 1 \\('a'\\): .*{key}"):
        plan_from("mine", {"steps": [{name: value for name, value in STAGE.items() if name != key}]})


def test_an_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"no registration preset 'slow'; there are: .*paper"):
        load_plan("slow")


def test_a_preset_holds_steps_and_nothing_else() -> None:
    with pytest.raises(InputError, match="registration preset mine: unknown key 'stages'"):
        plan_from("mine", {"stages": []})


@pytest.mark.parametrize("text", ["steps: []\n", "extends: fast\nsteps: []\n"])
def test_a_preset_without_steps_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"mine\.yaml, steps: none is left"):
        load_plan(tmp_path / "mine.yaml")
