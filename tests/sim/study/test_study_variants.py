"""Starts off the truth by the stated offset, success rates, and variants of a plan."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import rotation_angle, transform_points
from femoreg_torch.registration import OrbitSearch, Stage, load_plan
from femoreg_torch.statistics.intervals import rate_interval
from femoreg_torch.statistics.summary import Rate
from sim.study.ablation import Variant, plan_of, read_variants
from sim.study.capture import AXIS_LABELS, LEVELS, first_stages, offset, success_rates
from sim.study.capture_figure import capture_figure
from sim.study.starts import displaced

POSE = torch.tensor([[1, 0, 0, 5], [0, 0, -1, -8], [0, 1, 0, 760], [0, 0, 0, 1]], dtype=torch.float64)
CENTRE = torch.tensor([10.0, -30, 60], dtype=torch.float64)


def moved_by(sweep: str, share: float, seed: int) -> tuple[float, float, float]:
    """Rotation in degrees, depth and shift in the image plane in mm, of the middle of the pelvis."""
    start = displaced(POSE, CENTRE, offset(sweep, share), torch.Generator().manual_seed(seed))
    shift = (transform_points(start, CENTRE[None]) - transform_points(POSE, CENTRE[None]))[0]
    angle = torch.rad2deg(rotation_angle(start[:3, :3] @ POSE[:3, :3].T)).item()
    return angle, shift[2].item(), shift[:2].norm().item()


@pytest.mark.parametrize(
    ("sweep", "rotation", "depth", "lateral", "ways"),
    [
        ("rotation", 15, 0, 0, {0}),
        ("depth", 0, 50, 0, {-1, 1}),
        ("lateral", 0, 0, 20, {0}),
        ("jointly", 15, 50, 20, {-1, 1}),
    ],
)
def test_a_start_is_off_by_what_its_sweep_says(
    sweep: str, rotation: float, depth: float, lateral: float, ways: set[int]
) -> None:
    found = [moved_by(sweep, 0.5, seed) for seed in range(20)]
    for angle, along, across in found:
        assert (angle, abs(along), across) == pytest.approx((rotation, depth, lateral), abs=1e-4)
    assert {round(along / 50) for _, along, _ in found} == ways  # towards the source and away from it


def capture_rows(starts: list[tuple[str, str, float, float, float]], numbers: list[int]) -> pd.DataFrame:
    """Rows of starts (status, sweep, share, mm, degrees), each on the procedure of a number."""
    rows = pd.DataFrame(starts, columns=["status", "varied_sweep", "varied_share", "pelvis_mm", "pelvis_deg"])
    return rows.assign(number=numbers, patient="a", side="left", seed=0)


def test_success_needs_both_place_and_rotation() -> None:
    starts = [
        ("done", "rotation", 0.0, 1, 0.1),
        ("done", "rotation", 0.2, 9.9, 1.9),
        ("done", "rotation", 0.2, 10.1, 0.1),
        ("done", "depth", 0.2, 0.1, 2.1),
        ("failed", "depth", 0.2, np.nan, np.nan),
        ("refused", "depth", 0.2, np.nan, np.nan),
    ]
    rates = success_rates(capture_rows(starts, [1, 1, 2, 1, 2, 3]))
    assert rates["rotation"] == [(0.0, Rate(1, 1)), (pytest.approx(6.0), Rate(1, 2))]
    assert rates["depth"] == [(0.0, Rate(1, 1)), (pytest.approx(20.0), Rate(0, 2))]
    assert rates["jointly"] == [(0.0, Rate(1, 1))]
    assert max(LEVELS) == 1


@pytest.mark.parametrize(("numbers", "shaded"), [([1, 2, 3, 4], True), ([1, 1, 2, 2], False)])
def test_starts_that_share_procedures_have_no_interval(numbers: list[int], shaded: bool) -> None:
    """Four starts at the truth and four off it, on four procedures or twice on two."""
    starts = [("done", "rotation", share, mm, 0.1) for share in (0.0, 0.2) for mm in (1.0, 2.0, 3.0, 40.0)]
    rates = success_rates(capture_rows(starts, numbers * 2))
    assert [rate.independent for _, rate in rates["rotation"]] == [shaded, shaded]
    plot = capture_figure(rates, AXIS_LABELS, "capture", "title")
    assert [bool(axes.collections) for axes in plot.figure.axes] == [shaded] * len(AXIS_LABELS)
    assert ("Shaded" in plot.caption) is shaded


def test_interval_of_a_rate() -> None:
    assert rate_interval(5, 10) == pytest.approx(
        (0.2366, 0.7634), abs=1e-4
    )  # Brown, Cai, DasGupta, Stat Sci 16 (2001) 101
    assert rate_interval(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)


@pytest.mark.parametrize("preset", ["derivative_free", "paper"])
def test_first_stages_end_before_another_view_is_looked_at(preset: str) -> None:
    plan = load_plan(preset)
    steps = first_stages(plan).steps
    assert steps == plan.steps[: len(steps)]
    assert all(isinstance(step, Stage) and step.images == "first" for step in steps)
    assert isinstance(plan.steps[len(steps)], OrbitSearch)


def test_variants_leave_out_and_change_steps() -> None:
    whole = load_plan("derivative_free")
    assert plan_of(Variant("same", "derivative_free")) == whole
    names = [step.name for step in whole.steps]
    without = plan_of(Variant("less", "derivative_free", without=[names[-1]]))
    assert without.steps == whole.steps[:-1]
    changed = plan_of(Variant("no prior", "derivative_free", change={"*": {"prior": None}}))
    assert [step.name for step in changed.steps] == names
    assert all(step.prior is None for step in changed.steps if isinstance(step, Stage))
    other = plan_of(
        Variant("other", "derivative_free", change={names[0]: {"optimiser": {"kind": "bobyqa", "first_step": 0.1}}})
    )
    assert isinstance(other.steps[0], Stage)
    assert other.steps[0].optimiser != whole.steps[0].optimiser  # type: ignore[union-attr]
    assert other.steps[1:] == whole.steps[1:]


def test_unknown_steps_and_keys_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no step “pelvis in view 9”"):
        plan_of(Variant("wrong", "derivative_free", without=["pelvis in view 9"]))
    path = tmp_path / "variants.yaml"
    path.write_text("preset: demo\nvariants: [{name: a, minus: [b]}]\n", encoding="utf-8")
    with pytest.raises(InputError, match="minus"):
        read_variants(path)


def test_the_variants_that_ship_are_plans() -> None:
    for variant in read_variants("ablation"):
        assert plan_of(variant).steps
