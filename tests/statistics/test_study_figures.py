"""Figures: their files, their sizes, and that something is drawn in every panel."""

from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pandas as pd
import pytest
from study_frames import made_up, refuse

from femoreg_torch.statistics.figures import Plot, all_figures, paper_figures, write_figures
from femoreg_torch.statistics.figures.distributions import distributions
from femoreg_torch.statistics.figures.origins import origins
from femoreg_torch.statistics.figures.style import DOUBLE_MM, SINGLE_MM, reach

KINDS = ["histograms", "correlations", "distributions", "deviations", "origins", "varied_turn_deg", "varied_bed"]


@pytest.fixture(scope="module")
def study() -> pd.DataFrame:
    rows = pd.concat([made_up(70), made_up(50, seed=1, condition="harder", scale=2)], ignore_index=True)
    return refuse(rows, [3, 90])


@pytest.fixture(scope="module")
def plots(study: pd.DataFrame) -> list[Plot]:
    return all_figures(study)


def test_every_figure_is_written_in_the_width_of_a_column_and_is_not_blank(plots: list[Plot], tmp_path: Path) -> None:
    assert [plot.name for plot in plots] == KINDS
    pictures = write_figures(plots, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(f"{n}.{s}" for n in KINDS for s in ("png", "svg"))
    for plot, picture in zip(plots, pictures, strict=True):
        image = cv2.imread(str(tmp_path / f"{plot.name}.png"))
        assert image is not None
        assert image.shape[1] / 200 * 25.4 == pytest.approx(SINGLE_MM if plot.name == "origins" else DOUBLE_MM, abs=0.3)
        assert (image < 200).any(-1).mean() > 0.01
        assert (tmp_path / f"{plot.name}.png").read_bytes() == picture.png
        assert picture.caption
        assert ElementTree.parse(tmp_path / f"{plot.name}.svg").getroot().tag.endswith("svg")
        for axes in plot.figure.axes:
            left, bottom, width, height = axes.get_position().bounds
            window = image[
                int((1 - bottom - height) * len(image)) : int((1 - bottom) * len(image)),
                int(left * image.shape[1]) : int((left + width) * image.shape[1]),
            ]
            assert np.ptp(window[6:-6, 6:-6]) > 60, f"a panel of {plot.name} is blank"


def test_a_figure_is_the_same_file_every_time(study: pd.DataFrame, tmp_path: Path) -> None:
    texts = []
    for _ in range(2):
        write_figures([plot for plot in [origins(study)] if plot is not None], tmp_path)
        texts.append((tmp_path / "origins.svg").read_bytes())
    assert texts[0] == texts[1]


def test_correlations_of_runs_that_share_procedures_say_so() -> None:
    alone = made_up(12)
    twice = pd.concat([alone, alone.assign(condition="other")], ignore_index=True)
    captions = [next(p for p in all_figures(rows) if p.name == "correlations").caption for rows in (alone, twice)]
    assert ["taken as independent" in caption for caption in captions] == [False, True]


def test_what_a_study_does_not_tell_is_not_drawn() -> None:
    rows = made_up(12)
    rows = rows.drop(columns=[c for c in rows if "_sigma_" in c or c.startswith("varied_")])
    assert [plot.name for plot in all_figures(rows)] == ["histograms", "correlations", "distributions"]
    assert all_figures(refuse(rows, list(range(12)))) == []


def test_the_histograms_hold_every_run_within_their_axes(plots: list[Plot]) -> None:
    figure = plots[0].figure
    shares = [sum(patch.get_height() for patch in axes.patches) for axes in figure.axes[5:10]]
    assert shares == pytest.approx([100] * 5, abs=3)  # but for those beyond the axes
    heat = sum(np.ma.filled(axes.collections[0].get_array(), 0).sum() for axes in figure.axes[:5])
    assert heat == pytest.approx(500, abs=15)


def test_the_paper_correlates_the_pelvis_at_the_femoral_head(study: pd.DataFrame) -> None:
    assert "does not tell it" in paper_figures(study)[1].caption
    plot = paper_figures(study.assign(pelvis_at_head_mm=2 * study["femur_mm"]))[1]
    assert "at the femoral head, as in the paper" in plot.caption
    assert any("r = 1.00" in text.get_text() for text in plot.figure.axes[0].texts)


def test_distributions_end_below_100_percent_where_runs_failed(study: pd.DataFrame) -> None:
    rows = refuse(study[study["condition"].eq("plain")], list(range(35)))
    plot = distributions(rows)
    assert plot is not None
    lines = plot.figure.axes[0].get_lines()
    assert max(lines[0].get_ydata()) == pytest.approx(100 * 35 / 70)


def test_an_axis_leaves_out_what_presses_the_others_into_a_corner() -> None:
    values = np.random.default_rng(0).uniform(0, 1, 100)
    assert reach(values) == pytest.approx(1.03 * values.max())
    assert reach(np.append(values, 400)) == pytest.approx(1.03 * values.max())
