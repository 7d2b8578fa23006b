"""Tables, overlay and report of a run, on a small case made here."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from femoreg_torch.case import read_case, read_result, write_json
from femoreg_torch.case.inputs import case_digest
from femoreg_torch.commands.evaluate import evaluate
from femoreg_torch.commands.main import main
from femoreg_torch.drr import project
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import PAPER_METRICS, PAPER_POSES
from femoreg_torch.evaluation.overlay import paint_edges
from femoreg_torch.evaluation.table import error_tables, metric_rows, pose_rows
from femoreg_torch.files import read_json
from femoreg_torch.geometry import project_points, transform_points
from femoreg_torch.volume import Volume, axis_aligned

ROW = {"mm": 0.5, "deg": 0.2, "mm_xyz": [-0.3, 0.0, 0.4], "deg_xyz": [0.2, 0.0, -0.01]}


def test_rows_are_absolute_and_have_the_papers_means_below():
    rows = list(pose_rows({"femur": ROW, "view2": ROW, "tip_mm": 1.0}))
    assert rows[0] == ["femur", "0.30", "0.00", "0.40", "0.50", "0.20", "0.00", "0.01", "0.20"]
    assert rows[1] == ["  paper", "0.14", "0.12", "0.77", "0.81", "0.65", "0.25", "0.11", "0.73"]
    assert rows[2][0] == "view 2"
    assert list(metric_rows({"relative_mm": 1.0, "femur": ROW})) == [["entry point to tip", "1.00 mm", "1.26 mm"]]
    assert list(metric_rows({"miss_mm": 0.6})) == [["entry point, after an exact correction", "0.60 mm", "–"]]


def test_the_papers_totals_are_near_the_length_of_their_parts():
    """Means of lengths are at least the length of mean components: catches a mistyped column."""
    for millimetres, degrees in PAPER_POSES.values():
        for values in (millimetres, degrees):
            assert np.linalg.norm(values[:3]) * 0.95 < values[3] < sum(values[:3])
    assert PAPER_METRICS["relative_mm"] == 1.26


def test_the_tables_fit_a_terminal_of_80_columns():
    from rich.console import Console

    console = Console(width=80)
    for table in error_tables(dict.fromkeys(PAPER_POSES, ROW)):
        assert console.measure(table).maximum <= 80


def test_edges_stand_where_the_structure_projects(camera, pose):
    """A box of 40 mm in the middle of the view: its outline, and nothing else, takes the colour."""
    box = Volume(torch.full((20, 20, 20), 0.02), axis_aligned((2.0, 2.0, 2.0), (-19.0, -19.0, -19.0)))
    picture = np.zeros((*camera.shape, 3), np.uint8)
    paint_edges(picture, project(box, pose[None], camera)[0], (0, 158, 115))
    assert np.unique(picture[picture.any(2)], axis=0).tolist() == [[115, 158, 0]]  # blue, green, red
    row, column = np.nonzero(picture[..., 1])
    corners = torch.tensor([[-20.0, -20, -20], [20, -20, 20]], dtype=torch.float64)  # of the face towards the source
    low, high = project_points(camera, transform_points(pose, corners)).sort(0).values.tolist()
    assert abs(column.min() - low[0]) < 2
    assert abs(column.max() - high[0]) < 2
    assert abs(row.min() - low[1]) < 2
    assert abs(row.max() - high[1]) < 2
    assert not picture[28:36, 28:36].any()


def test_evaluate_writes_errors_and_a_report_that_needs_no_other_file(procedure, capsys):
    folder, run = procedure
    evaluate(folder, run)
    assert "entry point to tip" in capsys.readouterr().out
    assert read_result(run).seed == 3
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "imilarity &lt;0.2" in text
    assert "not a medical device" in text
    assert sorted(p.name for p in run.iterdir()) == ["errors.json", "overlay.png", "report.html", "result.json"]


def test_without_a_truth_there_is_a_report_but_no_error(procedure):
    folder, run = procedure
    case_yaml = folder / "case.yaml"
    case_yaml.write_text(case_yaml.read_text(encoding="utf-8").replace("truth: truth.json\n", ""), encoding="utf-8")
    evaluate(folder, run)
    assert read_case(folder).truth is None
    assert not (run / "errors.json").exists()
    assert "Errors against the truth" not in (run / "report.html").read_text(encoding="utf-8")


def test_a_folder_without_result_is_refused(procedure, tmp_path):
    with pytest.raises(InputError, match=r"result\.json"):
        evaluate(procedure[0], tmp_path)


def test_case_and_run_in_the_wrong_order_are_told(procedure):
    folder, run = procedure
    with pytest.raises(InputError, match=r"is a run, and .* is a case\. Is the order `femoreg evaluate CASE RUN`\?"):
        evaluate(run, folder)


def test_the_verdict_stands_in_the_report_and_in_the_terminal(procedure, capsys):
    folder, run = procedure
    evaluate(folder, run)
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "Pelvis: similarity &lt;0.2." in text
    assert "There are no lateral images." in text
    told = capsys.readouterr().out
    assert "Do not trust this registration" in told
    assert "there are no lateral images" in told


def change_result(run, change):
    content = read_json(run / "result.json")
    change(content)
    write_json(run / "result.json", content)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: c.pop("quality"), "does not say how good it is"),
        (lambda c: c.update(version=99), "version 99"),
    ],
)
def test_a_result_that_is_not_understood_is_reported_as_not_trusted(procedure, capsys, change, says):
    folder, run = procedure
    change_result(run, lambda c: [q.update(trusted=True) for q in c["quality"].values()])
    change_result(run, lambda c: c.update(trusted=True))
    evaluate(folder, run)
    assert "<title>Trusted" in (run / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    change_result(run, change)
    evaluate(folder, run)
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "<title>Not trusted" in text
    assert says[1:] in text
    assert says in " ".join(capsys.readouterr().out.split())


def test_a_result_of_another_case_is_refused(procedure):
    folder, run = procedure
    change_result(run, lambda c: c.update(camera1_from_tibia=c["camera1_from_femur"]))
    with pytest.raises(InputError, match=r"an object 'tibia', but .* has pelvis, femur, device"):
        evaluate(folder, run)


def test_a_case_whose_files_are_not_those_of_the_result_is_refused(procedure):
    """Exchanged images, say, that change nothing that a result tells."""
    folder, run = procedure
    change_result(run, lambda c: c.update(case_files=case_digest(read_case(folder))))
    evaluate(folder, run)
    file = folder / "case.yaml"
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    content["views"][0], content["views"][-1] = content["views"][-1], content["views"][0]
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(InputError, match="was made of another case"):
        evaluate(folder, run)


def test_a_case_whose_plan_was_changed_since_is_refused(
    procedure: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, run = procedure
    content = yaml.safe_load((folder / "case.yaml").read_text(encoding="utf-8"))
    content["plan"]["entry_point"][0] += 3
    (folder / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    assert main(["evaluate", str(folder), str(run)]) == 2
    assert "its entry point is another one than the result tells" in capsys.readouterr().err
    assert not (run / "report.html").exists()
    change_result(run, lambda c: c.update(case=os.path.relpath(folder, run)))
    assert main(["navigate", str(run)]) == 2
    assert "its entry point is another one than the result tells" in capsys.readouterr().err
    assert not (run / "navigation.json").exists()


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("simulation", "are simulated, and so is the truth"),
        ("beads", "by beads"),
        (None, "does not say how it was found"),
    ],
)
def test_the_report_says_where_the_truth_comes_from(
    procedure: tuple[Path, Path], source: str | None, says: str
) -> None:
    folder, run = procedure
    content = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    told = {} if source is None else {"source": source}
    (folder / "truth.json").write_text(json.dumps(told | content), encoding="utf-8")
    assert main(["evaluate", str(folder), str(run)]) == 0
    page = (run / "report.html").read_text(encoding="utf-8")
    assert says in page
    assert ("simulated images" in page) == (source == "simulation")
