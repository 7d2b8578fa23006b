"""Runs in Parquet: what is read is what was written, and what cannot be a study is told in one line."""

from pathlib import Path

import pandas as pd
import pytest
from study_frames import made_up, refuse

from femoreg_torch.errors import InputError
from femoreg_torch.statistics.rows import (
    checked_rows,
    folder_name,
    groups,
    plain_name,
    read_rows,
    run_name,
    source,
    varied,
    write_rows,
)


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    rows = refuse(made_up(5), [2])
    write_rows(rows, tmp_path / "runs.parquet")
    found = read_rows(tmp_path / "runs.parquet")
    pd.testing.assert_frame_equal(found, rows, check_dtype=False)
    assert [path.name for path in tmp_path.iterdir()] == ["runs.parquet"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rows: rows.drop(columns=["patient", "reasons"]), "no column patient, reasons"),
        (lambda rows: rows.iloc[:0], "holds no run"),
        (lambda rows: rows.assign(status="odd"), "status 'odd' is unknown"),
        (lambda rows: rows.assign(femur_mm="far"), "column femur_mm: numbers"),
        (lambda rows: rows[[c for c in rows if not c.endswith(("_mm", "_deg"))]], "no error in any column"),
    ],
)
def test_what_cannot_be_a_study_is_refused_in_one_line(change, says, tmp_path: Path) -> None:
    rows = change(made_up(4))
    rows.to_parquet(tmp_path / "runs.parquet")
    with pytest.raises(InputError, match=says) as told:
        read_rows(tmp_path / "runs.parquet")
    assert "\n" not in str(told.value)
    with pytest.raises(InputError, match=says):
        write_rows(rows, tmp_path / "other.parquet")
    assert not (tmp_path / "other.parquet").exists()


def test_a_missing_file_and_one_that_is_no_parquet_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_rows(tmp_path / "runs.parquet")
    (tmp_path / "runs.parquet").write_text("number,patient\n1,2\n", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        read_rows(tmp_path / "runs.parquet")


def test_what_is_not_known_to_be_trusted_is_not() -> None:
    rows = made_up(4)
    rows["trusted"] = [True, None, False, True]
    rows["femur_trusted"] = [True, None, True, False]
    rows.loc[3, "status"] = "failed"  # though it says that it can be trusted
    found = checked_rows(rows, "here")
    assert found["trusted"].tolist() == [True, False, False, False]
    assert found["femur_trusted"].tolist() == [True, False, True, False]


@pytest.mark.parametrize(
    ("column", "value", "says"),
    [
        ("status", [1, 2], "status '\\[1,? 2\\]' is unknown"),
        ("number", [1, 2], "column number: whole numbers"),
        ("number", 1.5, "column number: whole numbers"),
        ("number", None, "column number: whole numbers"),
        ("femur_mm", [1, 2], "column femur_mm: numbers were expected"),
        ("femur_mm", "far", "column femur_mm: numbers were expected"),
        ("femur_mm", 1e300, "column femur_mm: numbers were expected, and run 1 has 1e\\+300"),
        ("trusted", "yes", "column trusted: true or false was expected, found 'yes'"),
        ("femur_mm", -1.0, "column femur_mm: an error or a deviation cannot be below 0"),
        ("femur_mm", float("inf"), "column femur_mm: numbers were expected, and run 1 has an infinite number"),
    ],
)
def test_columns_of_other_things(column: str, value: object, says: str, tmp_path: Path) -> None:
    rows = made_up(4)
    rows[column] = pd.Series([value] * 4)
    rows.to_parquet(tmp_path / "runs.parquet")
    with pytest.raises(InputError, match=says) as raised:
        read_rows(tmp_path / "runs.parquet")
    assert "\n" not in str(raised.value)


def test_a_run_that_stands_there_twice_is_told() -> None:
    rows = made_up(4)
    with pytest.raises(InputError, match="run 2 of condition 'plain' stands there twice"):
        checked_rows(pd.concat([rows, rows[rows["number"].eq(2)]]), "here")


@pytest.mark.parametrize("column", ["pelvis_trusted", "trusted", "reasons", "varied_bed", "host", "version_torch"])
def test_lists_where_one_value_was_expected_are_text_or_not_trusted(column: str, tmp_path: Path) -> None:
    rows = made_up(4)
    rows[column] = pd.Series([["a", "b"]] * 4)
    rows.to_parquet(tmp_path / "runs.parquet")
    found = read_rows(tmp_path / "runs.parquet")[column].tolist()
    assert found == [False] * 4 if column.endswith("trusted") else found == ["a; b"] * 4


def test_groups_are_the_conditions_and_all_together() -> None:
    rows = pd.concat([made_up(3, condition="b"), made_up(2, condition="a b")], ignore_index=True)
    assert {name: len(part) for name, part in groups(rows).items()} == {"all": 5, "a b": 2, "b": 3}
    assert list(groups(made_up(3))) == ["plain"]
    assert folder_name("a b/c°") == "a_b_c_"
    for name in ("a_b", "all"):
        with pytest.raises(InputError, match="share a folder"):
            groups(pd.concat([rows, made_up(1, condition=name)], ignore_index=True))


def test_what_was_varied_is_compared_with_the_conditions_that_vary_nothing() -> None:
    rows = pd.concat([made_up(3, condition=name) for name in ("plain", "binned", "blurred")], ignore_index=True)
    rows = rows.drop(columns=["varied_bed"])  # the turn is drawn for every run
    rows["varied_binned"] = rows["condition"].map({"binned": 2.0})
    rows["varied_blur_mm"] = rows["condition"].map({"blurred": 1.0})
    rows["varied_never"] = None
    found = {key: sorted(set(part["condition"])) for key, part in varied(rows).items()}
    assert found.pop("varied_turn_deg") == ["binned", "blurred", "plain"]
    assert found == {"varied_binned": ["binned", "plain"], "varied_blur_mm": ["blurred", "plain"]}


def test_names() -> None:
    assert plain_name("varied_device_turn_deg") == "device turn, °"
    assert plain_name("varied_bed") == "bed"
    assert run_name(made_up(1).iloc[0]) == "plain-00001-01234567"
    rows = made_up(2)
    assert source(rows) == "simulated"
    assert source(rows.assign(kind=["recorded", "real"])) == "simulated and recorded"
    assert source(rows.assign(kind="recorded")) == "recorded"
