"""Errors beside their bounds, on rows that are made up."""

import math
from pathlib import Path

import pandas as pd
import pytest
from study_frames import made_up

from femoreg_torch.errors import InputError
from femoreg_torch.statistics.figures import all_figures
from femoreg_torch.statistics.limit_tables import (
    ALL_IMAGES,
    BOUND,
    BOUNDS_NAME,
    INFORMATION,
    NOISE,
    POSES_ALONE,
    REGISTERED,
    USUAL,
    limit_tables,
    read_bounds,
    without_name,
)
from femoreg_torch.statistics.quantities import POSES, QUANTITIES
from femoreg_torch.statistics.study import study_tables
from sim.study.limits_page import write_limits

SETTINGS = made_up(1)["settings"].iloc[0]


def made_up_bounds(condition: str = "plain") -> pd.DataFrame:
    """Of procedures 1 and 2, the errors of which are some mm: all bounds 0.01 and 0.07, twice as much without one."""
    rows = []
    for number, value in ((1, 0.01), (2, 0.07)):
        head = {"condition": condition, "number": number, "settings": SETTINGS}
        for unknown, factor in ((POSES_ALONE, 0.5), (USUAL, 1.0)):
            every = {q.column: factor * value for q in QUANTITIES}
            rows.append(head | {"what": BOUND, "unknown": unknown, "images": ALL_IMAGES} | every)
        fewer = {q.column: 2 * value for q in QUANTITIES} | {"device_mm": math.inf}
        rows.append(head | {"what": BOUND, "unknown": USUAL, "images": without_name("device 1")} | fewer)
        for image, share in (("anatomy 1", 0.25), ("device 1", 0.75)):
            rows.append(head | {"what": NOISE, "unknown": USUAL, "images": image, "relative_mm": share})
            about = {f"{key}_mm": share for key in POSES}
            rows.append(head | {"what": INFORMATION, "unknown": POSES_ALONE, "images": image} | about)
    return pd.DataFrame(rows)


def test_the_ratio_is_that_of_root_mean_squares_over_the_same_procedures() -> None:
    rows = made_up(3)
    rows["number"] = [1, 2, 3]
    rows["relative_mm"] = [0.3, 0.4, 90.0]  # the third has no bound
    bounds = made_up_bounds()
    place = {"condition": "plain", "number": 1, "settings": SETTINGS, "unknown": USUAL, "images": ALL_IMAGES}
    bounds.loc[len(bounds)] = place | {"what": REGISTERED, "relative_mm": -0.06}
    limit, worth, shares = limit_tables(rows, bounds)
    line = next(row for row in limit.rows if row[0] == "entry point to tip, mm")
    # √((0.09 + 0.16) / 2), then √((0.0001 + 0.0049) / 2) = 0.05 and half of it
    assert line == ("entry point to tip, mm", "2", "0.354", "0.060", "0.025", "0.050", "7.1")
    assert limit.columns == ("", "runs", "error", "noise alone", f"bound, {POSES_ALONE}", f"bound, {USUAL}", "ratio")
    cells = dict(zip(worth.columns, worth.rows[1], strict=True))
    assert (cells["images"], cells["pelvis"], cells["device"]) == ("without device 1", "× 2.00", "× ∞")
    assert shares.rows[1] == ("device 1", *["75.0 %"] * 6)


def test_a_run_without_an_error_has_no_part_in_the_bounds_beside() -> None:
    rows = made_up(2)
    rows["number"] = [1, 2]
    rows["relative_mm"] = [0.3, float("nan")]
    line = next(row for row in limit_tables(rows, made_up_bounds())[0].rows if row[0] == "entry point to tip, mm")
    assert line[1:3] == ("1", "0.300")
    assert line[5] == "0.010"  # of the first alone: √0.0001


@pytest.mark.parametrize("column", ["number", "relative_mm"])
def test_text_in_place_of_numbers_is_told(tmp_path: Path, column: str) -> None:
    made_up_bounds().assign(**{column: "one"}).to_parquet(tmp_path / BOUNDS_NAME)
    with pytest.raises(InputError, match=f"column {column}: numbers were expected"):
        read_bounds(tmp_path)


def test_bounds_of_another_condition_say_nothing() -> None:
    rows = made_up(3)
    rows["number"] = [1, 2, 3]
    assert limit_tables(rows, made_up_bounds("other")) == []
    assert limit_tables(rows.assign(settings="others"), made_up_bounds()) == []
    two = pd.concat([rows, made_up(3, condition="other").assign(number=[1, 2, 3])], ignore_index=True)
    tables = study_tables(two, 0, made_up_bounds("other"))
    names = {group: {table.name for table in own} for group, own in tables.items()}
    assert {"limits", "worth", "shares"} <= names["other"]
    assert not {"limits", "worth", "shares"} & (names["plain"] | names["all"])


def test_a_figure_holds_every_error() -> None:
    rows = made_up(3)
    rows["number"] = [1, 2, 3]
    plot = next(plot for plot in all_figures(rows, made_up_bounds()) if plot.name == "limits")
    labels = [len(axes.get_yticks()) for axes in plot.figure.axes]
    assert sum(labels) == len(QUANTITIES)
    assert "limits" not in {plot.name for plot in all_figures(rows)}


def test_a_file_that_holds_no_bounds_is_refused(tmp_path: Path) -> None:
    assert read_bounds(tmp_path) is None
    (tmp_path / BOUNDS_NAME).write_text("no parquet", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        read_bounds(tmp_path)
    pd.DataFrame({"number": [1]}).to_parquet(tmp_path / BOUNDS_NAME)
    with pytest.raises(InputError, match="has no column condition, settings"):
        read_bounds(tmp_path)


def test_the_page_holds_the_tables_and_the_figure(tmp_path: Path) -> None:
    (tmp_path / "limits.md").write_text(
        "# Limits\n\nA head.\n\n## Measured\n\nold\n\n## Tests\n\nkept\n", encoding="utf-8"
    )
    text = write_limits(made_up(2), made_up_bounds(), "the command", tmp_path, tmp_path)
    page = (tmp_path / "limits.md").read_text(encoding="utf-8")
    assert text in page
    assert "old" not in page
    assert page.index("## Measured") < page.index("## Tests\n\nkept")
    for table in limit_tables(made_up(2), made_up_bounds()):
        assert f"### {table.title}" in text
        assert all(table.rows[0][column] in text for column in range(len(table.columns)))
    assert (tmp_path / "limits.png").stat().st_size > 5000
    other = made_up_bounds(condition="another")
    with pytest.raises(InputError, match="no bounds of these runs"):
        write_limits(made_up(2), other, "the command", tmp_path, tmp_path)
