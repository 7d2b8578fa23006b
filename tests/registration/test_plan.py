"""Presets as data: those that ship, and what a mistake in one says."""

from pathlib import Path

import pytest
import yaml
from femoreg_torch.configs import preset_names

from femoreg_torch.errors import InputError
from femoreg_torch.optimize import Bobyqa, CmaEs, LevenbergMarquardt
from femoreg_torch.registration import load_plan
from femoreg_torch.registration import plan as plan_module
from femoreg_torch.registration.plan import OrbitSearch, Stage, plan_from

STAGE = {
    "name": "a",
    "images": "first",
    "kinds": ["anatomy"],
    "render": ["pelvis"],
    "bodies": [{"move": ["pelvis"], "centre": "pelvis", "rotation_deg": [1, 1, 1], "translation_mm": [1, 1, 1]}],
    "level": {"downsample": 8, "step_mm": 1, "patch_radius": 5},
    "optimiser": {"population": 10},
}


@pytest.mark.parametrize("name", preset_names("registration"))
def test_every_preset_loads_and_registers_everything(name: str) -> None:
    steps = load_plan(name).steps
    moved = {what for step in steps if isinstance(step, Stage) for body in step.bodies for what in body.move}
    assert moved - {"views"} == {"pelvis", "femur", "device", "view"}
    assert any(isinstance(step, OrbitSearch) for step in steps)


def test_weights_of_pixels_are_a_stage_s_own_and_bones_need_segmentations() -> None:
    plain, clear, bones = (
        plan_from("mine", {"steps": [STAGE, STAGE | more]})
        for more in ({}, {"weights": ["clear"]}, {"weights": ["bones", "clear"]})
    )
    assert [stage.weights for stage in bones.steps if isinstance(stage, Stage)] == [[], ["bones", "clear"]]
    assert [plan.needs_segmentations for plan in (plain, clear, bones)] == [False, False, True]


def test_the_paper_preset_is_the_papers() -> None:
    steps = load_plan("paper").steps
    assert {step.level.downsample for step in steps} == {4}
    orbit = next(step for step in steps if isinstance(step, OrbitSearch))
    assert (orbit.half_range_deg, orbit.step_deg) == (45, 0.5)
    joint = [step for step in steps if isinstance(step, Stage) and len(step.bodies) > 1]
    assert all(isinstance(step.optimiser, Bobyqa) for step in joint)
    single = [step for step in steps if isinstance(step, Stage) and len(step.bodies) == 1]
    assert all(isinstance(step.optimiser, CmaEs) for step in single)


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
    *steps, last, finest = load_plan("device_fiducial").steps
    assert (last, finest) == load_plan("fast").steps[-2:]
    by_device = [step for step in steps if step.render == ["device"]]
    assert steps[: len(by_device)] == by_device
    assert [step.kind for step in steps if isinstance(step, OrbitSearch)] == ["device"]
    moving = [step for step in steps if isinstance(step, Stage) for b in step.bodies if b.move in (["view"], ["views"])]
    assert moving
    assert all(step in by_device and step.kinds == ["device"] for step in moving)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"images": "second"}, "step 1.*images"),
        ({"colour": "red"}, "step 1.*colour"),
        ({"weights": ["bone"]}, "step 1.*weights"),
        ({"bodies": [{**STAGE["bodies"][0], "rotation_deg": [1, 1]}]}, "need three numbers"),  # type: ignore[index,dict-item]
        ({"optimiser": {"popsize": 3}}, "step 1"),
    ],
)
def test_a_mistake_is_told_with_preset_and_step(
    change: dict[str, object], says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    text = yaml.safe_dump({"steps": [STAGE | change]})
    monkeypatch.setattr(plan_module, "load_preset", lambda *_: yaml.safe_load(text))
    with pytest.raises(InputError, match=says):
        load_plan("mine")


def test_an_unknown_preset_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"no registration preset 'slow'; there are: .*paper"):
        load_plan("slow")
