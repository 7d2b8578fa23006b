"""Two studies side by side."""

import numpy as np
import pandas as pd
import pytest
from study_frames import made_up, refuse

from femoreg_torch.statistics.beside import beside_tables, difference, matched
from femoreg_torch.statistics.outcome import told


def shifted(rows: pd.DataFrame, by: float, **columns: object) -> pd.DataFrame:
    rows = rows.assign(**columns)
    rows["relative_mm"] += by + np.random.default_rng(9).normal(0, 0.01, len(rows))
    return rows


def alone(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(count), np.arange(count)


def test_runs_of_one_procedure_do_not_make_a_difference_clearer() -> None:
    """Twenty differences told seven times are twenty differences."""
    one, other = (pd.Series(np.random.default_rng(seed).normal(size=20)) for seed in (0, 1))
    pairs = pd.DataFrame({"first": range(20), "second": range(20)})
    told_once = difference(one, other, pairs, alone(20), 0)
    many = [pd.concat([values] * 7, ignore_index=True) for values in (one, other)]
    clusters = np.tile(np.arange(20), 7)
    pairs = pd.DataFrame({"first": range(140), "second": range(140)})
    repeated = difference(*many, pairs, (clusters, clusters), 0)
    assert repeated.interval == pytest.approx(told_once.interval)
    assert np.isnan(difference(*many, None, (clusters, clusters), 0).interval[0])


def test_the_same_procedures_are_paired_and_a_small_difference_is_clear() -> None:
    """0.05 mm is a tenth of the spread between procedures: clear only where each is held against itself."""
    first = made_up(60)
    second = shifted(first, 0.05, condition="other", study="other").sample(frac=1, random_state=1)
    pairs = matched(second, first)
    assert pairs is not None
    found = difference(told(second, "relative_mm"), told(first, "relative_mm"), pairs, alone(60), 0)
    assert (found.counts, found.paired, found.clear) == ((60, 60), True, True)
    assert found.interval[0] < 0.05 < found.interval[1]
    assert found.interval[1] - found.interval[0] < 0.01
    unpaired = difference(told(second, "relative_mm"), told(first, "relative_mm"), None, alone(60), 0)
    assert not unpaired.clear
    assert unpaired.value == pytest.approx(found.value)


def test_a_part_of_a_study_is_paired_with_the_whole_and_other_procedures_are_not() -> None:
    first = made_up(30)
    pairs = matched(first.iloc[5:20], first)
    assert pairs is not None
    assert pairs["second"].tolist() == list(range(5, 20))
    assert matched(first, first.assign(seed=first["seed"] + 1)) is None
    assert matched(first, made_up(30).assign(patient="another")) is None
    assert matched(first, pd.concat([first, first], ignore_index=True)) is None  # twice the same


def test_a_run_that_one_of_them_refused_is_in_neither_mean_but_in_the_share_of_good_ones() -> None:
    first = made_up(40, scale=0.1)
    second = refuse(shifted(first, 1.0), [0, 1])
    (table,) = beside_tables(first, second, ("a", "b"), 0)
    data = table.data.set_index("error")
    assert data.loc["relative_mm", "runs_first"] == 38
    assert data.loc["relative_mm", "difference"] == pytest.approx(-1, abs=0.01)
    assert data.loc["success", "runs_first"] == 40
    assert data.loc["success", "difference"] == pytest.approx(2 / 40)
    assert "Paired" in table.note
    rows = {row[0]: row for row in table.rows}
    assert rows["entry point to tip ≤ 4 mm"][2:5] == ("100.0 %", "95.0 %", "+5.0 %")
    assert rows["entry point to tip, mm"][-1] == "yes"
    assert rows["femur, mm"][-1] == "no"  # not a bit of difference


def test_conditions_that_both_have_are_compared() -> None:
    a, b, c = (made_up(20, seed=n, condition=name) for n, name in enumerate("abc"))
    ab, bc = pd.concat([a, b], ignore_index=True), pd.concat([b, c], ignore_index=True)
    names = ("one", "two")
    assert [t.name for t in beside_tables(ab, bc, names, 0)] == ["beside_b"]
    assert [t.name for t in beside_tables(ab, ab, names, 0)] == ["beside_all", "beside_a", "beside_b"]
    assert [t.name for t in beside_tables(a, c, names, 0)] == ["beside_all"]
    assert [t.name for t in beside_tables(a, a, names, 0)] == ["beside_a"]
