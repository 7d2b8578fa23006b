"""Tables, overlay and report of a run, on a small case made here."""

import numpy as np
import pytest
import torch
import trimesh

from femoreg_torch.case import Case, Device, Truth, View, read_case, read_result, write_case, write_json
from femoreg_torch.commands.evaluate import evaluate
from femoreg_torch.errors import InputError
from femoreg_torch.evaluation import PAPER_METRICS, PAPER_POSES, draw_edges
from femoreg_torch.evaluation.table import error_tables, metric_rows, pose_rows
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import CArm, centred_camera, project_points, rigid, transform_points
from femoreg_torch.volume import Volume, axis_aligned, write_landmarks, write_volume

ROW = {"mm": 0.5, "deg": 0.2, "mm_xyz": [-0.3, 0.0, 0.4], "deg_xyz": [0.2, 0.0, -0.01]}
CAMERA = centred_camera(1000.0, (4.0, 4.0), (64, 64))
POSE = rigid(
    torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64), torch.tensor([0.0, 0, 700]).double()
)


def test_rows_are_absolute_and_have_the_papers_means_below():
    rows = list(pose_rows({"femur": ROW, "view2": ROW, "tip_mm": 1.0}))
    assert rows[0] == ["femur", "0.30", "0.00", "0.40", "0.50", "0.20", "0.00", "0.01", "0.20"]
    assert rows[1] == ["  paper", "0.14", "0.12", "0.77", "0.81", "0.65", "0.25", "0.11", "0.73"]
    assert rows[2][0] == "view 2"
    assert list(metric_rows({"relative_mm": 1.0, "femur": ROW})) == [["entry point to tip", "1.00 mm", "1.26 mm"]]


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


def test_edges_stand_where_the_structure_projects():
    """A box of 40 mm in the middle of the view: its outline, and nothing else, becomes green."""
    box = Volume(torch.full((20, 20, 20), 0.02), axis_aligned((2.0, 2.0, 2.0), (-19.0, -19.0, -19.0)))
    picture = np.zeros((*CAMERA.shape, 3), np.uint8)
    draw_edges(picture, [(box, POSE)], CAMERA)
    row, column = np.nonzero(picture[..., 1])
    corners = torch.tensor([[-20.0, -20, -20], [20, -20, 20]], dtype=torch.float64)  # of the face towards the source
    low, high = project_points(CAMERA, transform_points(POSE, corners)).sort(0).values.tolist()
    assert abs(column.min() - low[0]) < 2
    assert abs(column.max() - high[0]) < 2
    assert abs(row.min() - low[1]) < 2
    assert abs(row.max() - high[1]) < 2
    assert not picture[28:36, 28:36].any()


@pytest.fixture
def procedure(tmp_path):
    """A case folder with one pelvis block, one femur block, a device box and three noisy images; and a perfect run."""
    folder = tmp_path / "case"
    folder.mkdir()
    labels = torch.zeros(30, 30, 40, dtype=torch.uint8)
    labels[5:25, 10:20, 5:15], labels[5:25, 10:20, 25:35] = 1, 5
    affine = axis_aligned((3.0, 3.0, 3.0), (-58.5, -43.5, -43.5))
    hu = torch.where(labels > 0, 700.0, 40.0)
    hu[:, 0] = -1000
    write_volume(folder / "ct.nii.gz", Volume(hu, affine))
    write_volume(folder / "labels.nii.gz", Volume(labels, affine))
    head = torch.tensor([30.0, 0, 0], dtype=torch.float64)
    write_landmarks(folder / "landmarks.json", {"FH-l": head})
    trimesh.creation.box((10, 10, 60), transform=trimesh.transformations.translation_matrix([0, 0, 30])).export(
        folder / "device.stl"
    )
    points = {
        name: torch.tensor([0.0, 0, z], dtype=torch.float64) for name, z in (("base", 0), ("center", 30), ("tip", 60))
    }
    nominal = rigid(translation=torch.tensor([0.0, 0, 500], dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    views = []
    for number in (1, 2, 3):
        for name in (f"view{number}.tif", f"view{number}_device.tif"):
            noise = torch.randint(20_000, 40_000, CAMERA.shape, generator=generator)
            write_image(folder / name, noise.to(torch.uint16))
        views.append(View(folder / f"view{number}.tif", folder / f"view{number}_device.tif"))
    truth = Truth(POSE.expand(3, 4, 4).clone(), POSE.clone(), nominal)
    case = Case(
        folder=folder,
        side="left",
        ct_path=folder / "ct.nii.gz",
        labels_path=folder / "labels.nii.gz",
        structures={"pelvis": (1,), "femur_left": (5,)},
        landmarks={"FH-l": head},
        entry_point=head + torch.tensor([10.0, 0, -20], dtype=torch.float64),
        target=head,
        device=Device(folder / "device.stl", 5000.0, points, nominal),
        carm=CArm(CAMERA, (0.0, 0.0, 620.0), (0.0, 1.0, 0.0)),
        views=tuple(views),
        truth=truth,
    )
    write_case(folder, case)
    run = tmp_path / "run"
    run.mkdir()
    result = {
        "camera_from_pelvis": truth.camera_from_pelvis,
        "camera1_from_femur": truth.camera1_from_femur,
        "camera1_from_device": nominal,
        "points_camera1": {"entry_point": [1.0, 2.0, 3.0]},
        "directions_camera1": {"path": [0.0, 0.0, 1.0]},
        "quality": {"femur": {"trusted": False, "reason": "similarity <0.2", "similarity": [0.1, 0.2]}},
        "timings_s": {"pelvis": 1.5},
        "preset": "paper",
        "seed": 3,
        "versions": {"femoreg_torch": "0"},
    }
    write_json(run / "result.json", result)
    return folder, run


def test_evaluate_writes_errors_and_a_report_that_needs_no_other_file(procedure, capsys):
    folder, run = procedure
    evaluate(folder, run)
    assert "entry point to tip" in capsys.readouterr().out
    assert read_result(run)["seed"] == 3
    text = (run / "report.html").read_text(encoding="utf-8")
    assert "data:image/png;base64," in text
    assert 'src="data:' in text
    assert text.count("src=") == 1
    assert "href=" not in text
    assert "similarity &lt;0.2" in text
    assert "not a medical device" in text
    assert sorted(p.name for p in run.iterdir()) == ["errors.json", "overlay.png", "report.html", "result.json"]


def test_without_a_truth_there_is_a_report_but_no_error(procedure):
    folder, run = procedure
    case_yaml = folder / "case.yaml"
    case_yaml.write_text(case_yaml.read_text(encoding="utf-8").replace("truth: truth.json\n", ""), encoding="utf-8")
    evaluate(folder, run)
    assert read_case(folder).truth is None
    assert not (run / "errors.json").exists()
    assert "<h2>Errors</h2>" not in (run / "report.html").read_text(encoding="utf-8")


def test_a_folder_without_result_is_refused(procedure, tmp_path):
    with pytest.raises(InputError, match=r"result\.json"):
        evaluate(procedure[0], tmp_path)
