"""The tables: their numbers, the paper's beside them, and the same cells in Markdown, LaTeX and CSV."""

import io
import math
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from study_frames import made_up, refuse

from femoreg_torch.statistics.cause_tables import dependence_table
from femoreg_torch.statistics.course_tables import round_table
from femoreg_torch.statistics.error_tables import error_table, metric_table, pose_table
from femoreg_torch.statistics.formats import (
    Table,
    between,
    csv,
    for_terminal,
    html,
    latex,
    markdown,
    number,
    of_paper,
    plus_minus,
    write_tables,
)
from femoreg_torch.statistics.quantities import METRICS, PAPER_TRIALS, POSE_QUANTITIES
from femoreg_torch.statistics.tables import group_tables, overview_table
from femoreg_torch.statistics.trials import trial_table
from femoreg_torch.statistics.trust_tables import coverage_table, success_table, trust_table

ODD = Table(
    "odd",
    "5 % of a_b & c",
    "1 σ ≤ 2°",
    ("", "a|b", "±"),
    (("x_1 & y", "0.1 ± 0.2", "−3"), ("100 %", "∞", "{–}")),
    pd.DataFrame({"what": ["x_1 & y", "100 %"], "value": [1 / 3, math.inf]}),
)


def cells_of_markdown(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [
        [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        for line in (lines[0], *lines[2:])
    ]


def cells_of_latex(text: str) -> list[list[str]]:
    """What a reader of the printed table sees."""
    body = text.split(r"\toprule")[1].split(r"\bottomrule")[0]
    lines = [line.removesuffix(r" \\") for line in body.splitlines() if line.endswith(r" \\")]
    printed = {
        r"$\pm$": "±",
        r"$^\circ$": "°",
        r"$\leq$": "≤",
        r"$\infty$": "∞",
        r"$\sigma$": "σ",
        r"$\rho$": "ρ",
        "$^2$": "²",
        "--": "–",
        "$-$": "−",
    }
    rows = []
    for line in lines:
        cells = [cell.strip() for cell in re.split(r"(?<!\\)&", line)]
        for mark, sign in printed.items():
            cells = [cell.replace(mark, sign) for cell in cells]
        rows.append([re.sub(r"\\([&%$#_{}])", r"\1", cell) for cell in cells])
    return rows


@pytest.mark.parametrize("table", [ODD, *group_tables(refuse(made_up(100), [3, 4]), 0)], ids=lambda table: table.name)
def test_markdown_latex_and_csv_hold_what_the_table_holds(table: Table) -> None:
    cells = [list(table.columns), *map(list, table.rows)]
    assert cells_of_markdown(markdown(table)) == cells
    assert cells_of_latex(latex(table)) == cells
    back = pd.read_csv(io.StringIO(csv(table)))
    pd.testing.assert_frame_equal(back, table.data, check_dtype=False, rtol=1e-14)
    assert table.title.split()[0] in latex(table)
    assert latex(table).count("{") == latex(table).count("}")


def test_the_paper_agrees_with_its_text() -> None:
    """Means that the text tells, those of Table III from its trials; totals are near the length of their parts."""
    means = {c: (round(float(np.mean(v)), 2), round(float(np.std(v, ddof=1)), 2)) for c, v in PAPER_TRIALS.items()}
    assert means["relative_mm"] == (2.64, 1.10)
    assert means["path_deg"] == pytest.approx((1.36, 0.78), abs=0.011)
    assert means["guide_deg"] == pytest.approx((0.31, 0.26), abs=0.011)
    papers = {q.column: q.paper for q in METRICS}
    assert (papers["relative_mm"].mean, papers["relative_mm"].deviation) == (1.26, 0.74)
    assert (papers["entry_point_mm"].mean, papers["entry_point_mm"].median) == (1.70, 1.64)
    for units in POSE_QUANTITIES.values():
        for *parts, total in units.values():
            assert np.linalg.norm([q.paper.median for q in parts]) == pytest.approx(total.paper.median, rel=0.25)
            assert total.paper.median <= total.paper.mean + 0.01
            assert all(0 < q.paper.deviation < 3 * q.paper.mean for q in parts)
    femur = POSE_QUANTITIES["femur"]["deg"][-1].paper
    assert (femur.mean, femur.deviation, femur.median) == (0.73, 0.23, 0.71)


def test_table_1_tells_absolute_errors_of_each_axis_and_the_paper_below() -> None:
    rows = made_up(4)
    rows["femur_mm_is"] = [-1.0, 1.0, 3.0, -3.0]
    table = pose_table(rows)
    lines = {(first, what): cells for first, what, _, *cells in table.rows if first == "femur"}
    assert lines["femur", "mean ± SD"][0] == "2.00 ± 1.15"
    after = table.rows.index(next(row for row in table.rows if row[0] == "femur"))
    assert table.rows[after + 1][:4] == ("", "median", "", "2.00")
    assert table.rows[after + 2][:4] == ("", "paper, mean ± SD", "", "0.14 ± 0.15")
    assert table.rows[after + 3][-1] == "0.71"
    assert len(table.rows) == 5 * 4
    assert table.texts == 2
    assert table.columns[2] == "runs in mean"
    assert [of_paper(row) for row in table.rows] == [False, False, True, True] * 5


def test_a_refused_run_is_counted_where_a_number_can_hold_it() -> None:
    rows = refuse(made_up(9, scale=0.1), [0, 1, 2, 3], "refused")
    rows = refuse(rows, [4], "failed", "killed")
    metrics = {row[0]: row for row in metric_table(rows).rows}
    assert metrics["entry point to tip, mm"][1] == "4 of 9"
    assert metrics["entry point to tip, mm"][3] == "∞"
    assert math.isfinite(float(metrics["entry point to tip, mm"][2].split()[0]))
    assert "9 simulated runs: 4 done, 4 refused, 1 failed" in metric_table(rows).note
    success = {row[0]: row for row in success_table(rows).rows}
    assert success["entry point to tip ≤ 4 mm"][1:3] == ("4 of 9", "44.4 %")
    assert success["trusted"][1] == "4 of 9"
    trust = {row[0]: row for row in trust_table(rows).rows}
    assert trust["whole run"][1:5] == ("4", "0", "0", "5")
    overview = overview_table(rows).rows[0]
    assert overview[:4] == ("plain", "9", "4", "1")


def test_conditions_of_the_same_procedures_tell_no_more_than_one() -> None:
    rows = made_up(20, condition="plain")
    seven = pd.concat([rows.assign(condition=str(n)) for n in range(7)], ignore_index=True)
    one, many = (error_table(part, 0).data.set_index("error") for part in (rows, seven))
    assert many.loc["femur_mm", "mean_low"] == pytest.approx(one.loc["femur_mm", "mean_low"])
    assert "140 simulated runs of 20 procedures" in error_table(seven, 0).note
    assert success_table(seven).rows[0][1:4] == ("140 of 140", "100.0 %", "–")


def test_what_a_correction_leaves_is_told_where_the_runs_tell_it() -> None:
    rows = made_up(9)
    assert not any("correction" in row[0] for row in error_table(rows, 0).rows)
    table = error_table(rows.assign(miss_mm=np.arange(9.0), miss_deg=0.25), 0)
    rows_of = {row[0]: row for row in table.rows}
    assert rows_of["entry point after an exact correction, mm"][4:] == ("4.00", "4.00", "7.60", "8.00", "–", "–")
    assert table.data.set_index("error").loc["miss_deg", "mean"] == 0.25


def test_coverage_has_a_row_per_object_and_unit() -> None:
    table = coverage_table(made_up(500))
    assert [row[0] for row in table.rows] == [f"{o}, {u}" for o in ("pelvis", "femur", "device") for u in ("mm", "°")]
    assert all(60 < float(cell.removesuffix(" %")) < 76 for row in table.rows for cell in row[2:5])
    assert len(table.data) == 6 * 3 * 2


def test_what_errors_depend_on_is_found() -> None:
    rows = made_up(200)
    rows["femur_mm"] = 0.1 * rows["varied_turn_deg"]
    table = dependence_table(rows)
    assert [row[0] for row in table.rows] == ["turn, °"]
    rho = dict(zip(table.data["error"], table.data["rho"], strict=True))
    assert rho["femur_mm"] == pytest.approx(1)
    assert abs(rho["device_mm"]) < 0.25


def test_a_closed_loop_is_told_round_by_round() -> None:
    rows = pd.concat([made_up(20), made_up(20)], ignore_index=True)
    rows["round"] = np.repeat([1, 2], 20)
    rows["before_mm"], rows["left_mm"] = np.repeat([10.0, 1.0], 20), np.repeat([1.0, 0.2], 20)
    table = round_table(rows, 0)
    assert table.columns[2:4] == ("before mm, mean ± SD", "before mm, median")
    assert [row[:4] for row in table.rows] == [("1", "20", "10.00 ± 0.00", "10.00"), ("2", "20", "1.00 ± 0.00", "1.00")]
    assert round_table(made_up(3), 0).rows == ()


def test_trials_stand_side_by_side_with_the_papers_below() -> None:
    rows = pd.concat([made_up(1, seed=n, condition=f"T{n}") for n in range(3)], ignore_index=True)
    rows["relative_mm"] = [1.0, 2.0, 3.0]
    table = trial_table(refuse(rows, [2]))
    lines = {row[0]: row for row in table.rows}
    assert table.columns[2:5] == ("T0", "T1", "T2")
    assert lines["entry point to tip, mm"][1:6] == ("1.50 ± 0.71", "1.00", "2.00", "–", "")
    place = table.rows.index(lines["entry point to tip, mm"])
    assert table.rows[place + 1][1:] == ("2.64 ± 1.10", "1.98", "2.88", "3.44", "1.32", "1.94", "4.28")


def test_trials_tell_what_their_beads_leave_open() -> None:
    rows = pd.concat([made_up(1, seed=n, condition=f"T{n}") for n in range(2)], ignore_index=True)
    rows["beads_tip_mm"] = [3.0, 4.0]
    rows["trusted"] = [True, False]
    table = trial_table(rows)
    assert table.columns[2:5] == ("T0", "T1 *", "")
    place = [row[0] for row in table.rows].index("guide tip, mm")
    assert table.rows[place + 1][:4] == ("beads alone", "3.54 rms", "3.00", "4.00")
    assert sum(row[0] == "beads alone" for row in table.rows) == 1


def test_cells() -> None:
    assert [number(v, 2) for v in (math.nan, math.inf, -1.0)] == ["–", "∞", "−1.00"]
    assert number(1.0, 1, "+") == "+1.0"
    assert number(-0.001, 2) == "0.00"
    assert plus_minus(1, math.nan, 2) == "1.00"
    assert between((math.nan, math.nan), 2) == "–"


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize("scale", [0.1, 1000.0])
def test_numbers_are_whole_in_terminals_of_any_width(width: int, scale: float) -> None:
    """Rich cuts off what does not fit, without a sign of it."""
    console = Console(width=width, record=True, file=io.StringIO())
    tables = group_tables(refuse(made_up(100, scale=scale), [3, 4]), 0)
    for table in tables:
        console.print(for_terminal(table, console.width))
    text = console.export_text()
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= width
    words = text.split()
    for table in tables:
        told = " ".join((table.title, table.note, *table.columns, *(cell for row in table.rows for cell in row[1:])))
        assert set(told.split()) <= set(words)
    cells = [word for table in tables for row in table.rows for cell in row[table.texts :] for word in cell.split()]
    assert not Counter(cells) - Counter(words), "as often as the tables hold them"


def test_files_html_and_terminal(tmp_path: Path) -> None:
    write_tables([ODD], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["odd.csv", "odd.md", "odd.tex"]
    assert "5 % of a_b &amp; c" in html(ODD)
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(for_terminal(ODD, console.width))
    assert "x_1 & y" in console.export_text()
