"""Statistics of a group of runs: nothing that went wrong is forgotten."""

import math

import numpy as np
import pandas as pd
import pytest
from study_frames import made_up, refuse

from femoreg_torch.statistics.outcome import asked, run_is_wrong
from femoreg_torch.statistics.quantities import AXES
from femoreg_torch.statistics.summary import confusion, coverage, right_runs, statistics, trusted_runs, within


def of_values(*values: float | None) -> pd.DataFrame:
    """Runs with these relative errors; None was refused."""
    rows = made_up(len(values), scale=0.1)
    rows["relative_mm"] = [math.nan if value is None else value for value in values]
    return refuse(rows, [n for n, value in enumerate(values) if value is None])


def test_refused_runs_count_as_infinitely_far_off_where_a_number_can_hold_that() -> None:
    found = statistics(of_values(1, 2, 3, None, None), "relative_mm")
    assert (found.asked, found.count, found.mean, found.deviation) == (5, 3, 2, 1)
    assert found.median == 3
    assert math.isinf(found.maximum)
    assert math.isinf(found.percentile_95)
    assert math.isinf(statistics(of_values(1, None), "relative_mm").median)
    assert statistics(of_values(1, 2, 3, 4), "relative_mm").median == np.median([1, 2, 3, 4])


def test_quantiles_are_those_of_numpy_where_all_is_finite() -> None:
    values = np.random.default_rng(0).exponential(1, 57)
    assert statistics(of_values(*values), "relative_mm").percentile_95 == pytest.approx(np.quantile(values, 0.95))


def test_rates_count_refused_and_failed_runs_as_not_met() -> None:
    rows = refuse(of_values(0.5, 3.9, 4.1, None, 1), [4], "failed")
    assert (within(rows, "relative_mm", 4).met, within(rows, "relative_mm", 4).of) == (2, 5)
    assert (trusted_runs(rows).met, trusted_runs(rows).of) == (3, 5)
    assert right_runs(rows).met == 2


def test_trust_is_told_against_what_is_right() -> None:
    rows = of_values(1, 1, 9, 9, None)
    rows.loc[[1, 3], "trusted"] = False
    found = confusion(rows)
    assert found is not None
    assert (found.right_trusted, found.right_flagged, found.wrong_trusted, found.wrong_flagged) == (1, 1, 1, 2)
    assert (found.harm.met, found.harm.of) == (1, 2)
    rows.loc[0, "femur_deg"] = 2.1  # beyond 2°
    femur = confusion(rows, "femur")
    assert femur is not None
    assert (femur.right_trusted, femur.right_flagged, femur.wrong_trusted, femur.wrong_flagged) == (3, 0, 1, 1)
    assert confusion(rows.drop(columns="femur_trusted"), "femur") is None


def test_no_device_is_asked_of_a_condition_without_device_images() -> None:
    rows = pd.concat([made_up(4, scale=0.1), made_up(4, condition="bare", scale=0.1)], ignore_index=True)
    bare = rows["condition"].eq("bare")
    rows.loc[bare, ["device_mm", "device_deg", "relative_mm", "tip_mm", "guide_deg"]] = math.nan
    assert asked(rows, "device_mm").tolist() == [True] * 4 + [False] * 4
    assert not run_is_wrong(rows).any()
    assert statistics(rows, "relative_mm").asked == 4
    rows = refuse(rows, [4])  # a refused run of it still has no femur
    assert run_is_wrong(rows).tolist() == [False] * 4 + [True] + [False] * 3


def test_an_object_that_the_images_show_and_no_run_finds_is_wrong() -> None:
    rows = made_up(3, scale=0.1)
    rows[["device_mm", "device_deg"]] = math.nan
    assert not asked(rows, "device_mm").any()
    rows["asked"] = "pelvis femur device"
    assert asked(rows, "device_mm").all()
    assert run_is_wrong(rows).all()


def test_what_was_not_measured_makes_no_run_wrong() -> None:
    """Of runs of others, say, whose table has errors in mm alone."""
    rows = made_up(3, scale=0.1).drop(columns=["pelvis_deg", "femur_deg", "device_deg"])
    assert not run_is_wrong(rows).any()
    rows.loc[1, "pelvis_mm"] = 4.1
    assert run_is_wrong(rows).tolist() == [False, True, False]


def test_where_no_run_gives_a_result_all_is_wrong() -> None:
    rows = refuse(made_up(3), [0, 1, 2])
    assert (right_runs(rows).met, right_runs(rows).of) == (0, 3)
    assert (within(rows, "relative_mm", 4).met, within(rows, "relative_mm", 4).of) == (0, 3)
    assert math.isinf(statistics(rows, "relative_mm").median)
    assert math.isnan(statistics(rows, "relative_mm").mean)


def test_deviations_that_are_right_cover_what_they_should() -> None:
    """Of normal errors 68.3 % lie within one and 95.4 % within two; stated twice as small, 38.3 % and 68.3 %."""
    rows = made_up(4000)
    for found in coverage(rows):
        assert [rate.share for rate in found.within_1] == pytest.approx([0.683] * 3, abs=0.025)
        assert [rate.share for rate in found.within_2] == pytest.approx([0.954] * 3, abs=0.012)
    sure = [c for c in rows if "_sigma_" in c]
    halved = coverage(rows.assign(**{c: rows[c] / 2 for c in sure}))
    assert [rate.share for rate in halved[0].within_1] == pytest.approx([0.383] * 3, abs=0.025)
    assert len(halved) == 6


def test_each_deviation_is_held_against_the_error_of_its_own_axis() -> None:
    rows = made_up(50)
    for axis, factor in zip(AXES, (0.5, 1.5, 3), strict=True):
        rows[f"femur_mm_{axis}"] = factor * rows[f"femur_sigma_mm_{axis}"]
    femur = next(found for found in coverage(rows) if (found.object, found.unit) == ("femur", "mm"))
    assert [rate.share for rate in femur.within_1] == [1, 0, 0]
    assert [rate.share for rate in femur.within_2] == [1, 1, 0]
