"""`femoreg tables` and `femoreg report`, from a folder with runs to files."""

import re
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from study_frames import made_up, refuse

from femoreg_torch.commands.main import main
from femoreg_torch.statistics.figures import Picture
from femoreg_torch.statistics.report import report_page
from femoreg_torch.statistics.rows import read_rows, run_name, write_rows
from femoreg_torch.statistics.study import study_tables


class Page(HTMLParser):
    """Collects what a page refers to, and checks that its tags are balanced."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.tags: list[str] = []
        self.text = ""
        self.feed(text)
        assert self.tags == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data", "action")]
        if tag not in ("meta", "img"):
            self.tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.tags.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two conditions; a refused run, a failed one, and one that is wrong yet trusted."""
    rows = pd.concat([made_up(12), made_up(10, seed=1, condition="harder")], ignore_index=True)
    rows = rows.drop(columns=[c for c in rows if c.startswith(("varied_", "view", "pelvis")) or "_sigma_" in c])
    rows = refuse(rows, [2], reason="no <landmarks> & nothing else")
    rows = refuse(rows, [15], "failed", "its process was killed")
    rows.loc[5, "relative_mm"] = 7.5
    rows.loc[6, ["trusted", "reasons"]] = [False, "femur: pulled by 3.1 mm"]
    study = tmp_path / "study"
    study.mkdir()
    write_rows(rows, study / "runs.parquet")
    return study


def test_the_report_is_one_page_that_loads_nothing(folder: Path) -> None:
    rows = read_rows(folder / "runs.parquet")
    rows["condition"], rows["number"] = "plain", range(1, len(rows) + 1)
    write_rows(rows, folder / "runs.parquet")
    worst = rows.set_index("relative_mm").loc[7.5]
    (folder / "overlays").mkdir()
    cv2.imwrite(str(folder / "overlays" / f"{run_name(worst)}.jpg"), np.full((20, 30, 3), 90, np.uint8))
    assert main(["report", str(folder)]) == 0
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert page.references
    assert all(
        reference.startswith(("data:image/png;base64,", "data:image/jpeg;base64,")) for reference in page.references
    )
    assert sum(reference.startswith("data:image/jpeg") for reference in page.references) == 1  # of the worst run
    assert not re.search(r"https?:|url\(|@import|<script|<link", text)
    assert "default-src 'none'" in text
    assert 'name="viewport"' in text
    for told in (
        "Study made up",
        "no <landmarks> & nothing else",
        "its process was killed",
        "femur: pulled by 3.1 mm",
        "not a medical device",
        "simulated",
        "torch2.15.0",
    ):
        assert told in page.text
    assert "<landmarks>" not in text
    assert page.text.index("7.50") < page.text.index("Runs that are not trusted")
    figures = sorted(path.name for path in (folder / "figures" / "plain").iterdir())
    assert "histograms.png" in figures
    assert "histograms.svg" in figures
    assert len(page.references) == len(list((folder / "figures").glob("*/*.png"))) + 1  # and one overlay


def test_every_condition_has_its_tables_and_figures_on_the_page(folder: Path) -> None:
    rows = read_rows(folder / "runs.parquet")
    groups = ("all", "harder", "plain")
    pictures = {name: [Picture("histograms", f"drawn of {name}", "told below", b"png")] for name in groups}
    page = Page(report_page(rows, study_tables(rows, 0), [], pictures, folder))
    for name in groups:
        assert f"drawn of {name}" in page.text
    assert page.text.count("told below") == 3
    assert page.text.count("Errors that steer the drill") == 3
    assert page.text.index("Conditions") < page.text.index("drawn of harder") < page.text.index("Worst cases")
    assert "All 3 of 22 runs" in page.text


def test_tables_are_printed_and_written_and_old_ones_go(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "tables" / "gone").mkdir(parents=True)
    assert main(["tables", str(folder)]) == 0
    told = capsys.readouterr().out
    assert "Pose errors" in told
    assert "22 simulated runs of 12 procedures: 20 done, 1 refused, 1 failed" in " ".join(told.split())
    assert "the tables of 2 conditions are in the files" in " ".join(told.split())
    assert sorted(path.name for path in (folder / "tables").iterdir()) == [
        "all",
        "harder",
        "overview.csv",
        "overview.md",
        "overview.tex",
        "plain",
    ]
    errors = pd.read_csv(folder / "tables" / "plain" / "errors.csv").set_index("error")
    rows = read_rows(folder / "runs.parquet")
    plain = rows[rows["condition"].eq("plain")]
    assert errors.loc["femur_mm", "mean"] == pytest.approx(plain["femur_mm"].mean())
    assert errors.loc["femur_mm", "asked"] == 12
    before = (folder / "tables" / "all" / "errors.md").read_text(encoding="utf-8")
    assert main(["tables", str(folder)]) == 0
    assert (folder / "tables" / "all" / "errors.md").read_text(encoding="utf-8") == before


def test_two_studies_side_by_side(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other"
    other.mkdir()
    write_rows(made_up(12, scale=2), other / "runs.parquet")
    assert main(["tables", str(folder), "--beside", str(other)]) == 0
    assert (folder / "tables" / "beside_plain.md").is_file()
    assert "study beside other: plain" in capsys.readouterr().out
    assert main(["tables", str(folder), "--beside", str(folder)]) == 2
    assert "is the study itself" in capsys.readouterr().err


def test_trials_alone_make_table_3(tmp_path: Path) -> None:
    trials = pd.concat([made_up(1, seed=n, condition=name) for n, name in enumerate(("I", "II"))], ignore_index=True)
    write_rows(trials, tmp_path / "trials.parquet")
    assert main(["tables", str(tmp_path)]) == 0
    assert sorted(path.name for path in (tmp_path / "tables").iterdir()) == ["trials.csv", "trials.md", "trials.tex"]


@pytest.mark.parametrize("command", ["tables", "report"])
def test_a_folder_without_runs_is_refused_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, str(tmp_path)]) == 2
    assert "runs.parquet: no such file" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_study_leaves_no_empty_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path / "nope")]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
