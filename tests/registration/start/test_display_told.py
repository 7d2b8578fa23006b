"""A view 1 that was taken from behind, and not told so, is named; one that is told right is not."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from registration_scenes import CARM, REFERENCE_POINTS, make_scene, off, quicker, true_poses
from torch import Tensor

from femoreg_torch.case import Case, StageRecord, View
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.pnp import PnpResult
from femoreg_torch.registration import Stage, load_plan
from femoreg_torch.registration.start import display_told
from femoreg_torch.registration.start.display_told import doubts_about_head_up, doubts_about_the_display
from femoreg_torch.registration.start.find import Start

TRUTH = true_poses()
LAST_OF_VIEW_1 = "pelvis and femur in view 1"


def doubts_of(
    monkeypatch: pytest.MonkeyPatch,
    stored_as: Display,
    told_as: Display,
    cost: float,
    start: bool = True,
    kinds: str = "anatomy",
) -> tuple[str, ...]:
    """Doubts where view 1 is stored one way and told another, and the bones fitted with this cost as it was told.

    Nothing but the right picture, as the source saw it from its side, gives a start, which is a little off.
    """
    true = make_scene(TRUTH)
    seen = true.image("anatomy", 0)
    image = told_as.to_camera(stored_as.to_stored(seen))
    scene = replace(true, images={"anatomy": (image, *true.images["anatomy"][1:])})

    def find_start(_: object, __: object, shown: Tensor, *others: object, among_views: bool) -> Start:
        beam = others[-1]
        if not (start and among_views and torch.equal(shown, seen) and beam == stored_as.beam):
            raise InputError("no landmarks")
        pose = off(TRUTH.camera1_from["pelvis"], REFERENCE_POINTS["pelvis"], (1, -1, 1), (1, -1, 5))
        found = PnpResult(pose, torch.ones(6, dtype=torch.bool), 1.0, torch.eye(6, dtype=torch.float64))
        return Start(pose, found, [], 0.95)

    monkeypatch.setattr(display_told, "find_start", find_start)
    monkeypatch.setattr(display_told, "look_at", lambda *_: None)
    case = Case(Path("case"), CARM, {}, views=(View({"anatomy": Path("view1.tif")}, display=told_as),) * 3)
    trace = [StageRecord(LAST_OF_VIEW_1, 1, cost, 1, 0.0, "", TRUTH)]
    plan = quicker(load_plan("fast"))
    steps = tuple(replace(step, kinds=[kinds]) if isinstance(step, Stage) else step for step in plan.steps)
    plan = replace(plan, steps=steps)
    return doubts_about_the_display(case, scene, plan, lambda *_: None, trace, seed=0)  # type: ignore[arg-type,return-value]


@pytest.mark.parametrize(
    ("stored_as", "told_as", "says"),
    [
        (Display("posterior"), Display(), "source stands behind the patient (similarity"),
        (Display(), Display("posterior"), "source stands in front of the patient (similarity"),
        (Display(mirrored=True), Display(), "in front of the patient, its picture mirrored, (similarity"),
    ],
)
def test_a_display_that_fits_better_is_named(
    monkeypatch: pytest.MonkeyPatch, stored_as: Display, told_as: Display, says: str
) -> None:
    (doubt,) = doubts_of(monkeypatch, stored_as, told_as, cost=0.9)
    assert says in doubt
    assert "check `display` of the views" in doubt


def test_a_display_that_fits_no_better_is_not_named(monkeypatch: pytest.MonkeyPatch) -> None:
    behind = Display("posterior"), Display()
    assert doubts_of(monkeypatch, *behind, cost=0.0) == ()  # nothing can fit better
    assert doubts_of(monkeypatch, *behind, cost=0.9, start=False) == ()
    assert doubts_of(monkeypatch, Display("posterior"), Display("left"), cost=0.9) == ()
    assert doubts_of(monkeypatch, *behind, cost=0.9, kinds="device") == ()  # stages that do not look at the bones


@pytest.mark.parametrize(("turned", "right"), [(0, 180), (90, 270), (270, 90)])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_picture_told_the_wrong_way_up_is_named_with_its_turn(turned: int, right: int, mirrored: bool) -> None:
    """The pose is the one that a true picture gives after it was set upright as it was told."""
    true = Display(mirrored=mirrored, turned_deg=right)
    told = replace(true, turned_deg=turned)
    stored = true.to_stored(make_scene(TRUTH).image("anatomy", 0))
    shown = told.to_camera(stored)
    assert torch.equal(shown, true.to_camera(stored).flip(0, 1)), "half a turn of what the source saw"
    pose = torch.tensor([[1.0, 0, 0, 10], [0, 0, -1, 20], [0, 1, 0, 700], [0, 0, 0, 1]], dtype=torch.float64)
    assert doubts_about_head_up(true, pose) == ()
    pose[:2] *= -1
    (doubt,) = doubts_about_head_up(told, pose)
    assert f"is its picture turned by {right}°, and not by {turned}°" in doubt
