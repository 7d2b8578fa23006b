"""The replay: its frames follow the trace, and the edges stand where the structures were at that moment."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from fuzz_faults import full_after
from numpy.typing import NDArray
from PIL import Image

from femoreg_torch.case import read_case, read_result, write_json
from femoreg_torch.commands.main import main
from femoreg_torch.evaluation.replay import frames_of, write_film
from femoreg_torch.geometry import centred_camera, project_points, rigid, transform_points
from femoreg_torch.registration import prepare_scene

CAMERA = centred_camera(1000.0, (4.0, 4.0), (64, 64))  # as those of the procedure
POSE = rigid(
    torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64), torch.tensor([0.0, 0, 700]).double()
)
SHIFTS = (-60.0, -25.0, 0.0)  # mm along the columns: the pelvis, as it comes to its place
EYE = torch.eye(4, dtype=torch.float64)


def shifted(x: float) -> torch.Tensor:
    return rigid(translation=torch.tensor([x, 0, 0], dtype=torch.float64)) @ POSE


def stage(name: str, moments: list[dict[str, Any]], view: int | None = None, **placed: torch.Tensor) -> dict[str, Any]:
    return {
        "name": name,
        "view": view,
        "cost": 0.25,
        "evaluations": 100,
        "camera_from_camera1": EYE.expand(3, 4, 4),
        "camera1_from": {"pelvis": POSE, "femur": POSE} | placed,
        "moments": moments,
    }


@pytest.fixture
def run(procedure: tuple[Path, Path]) -> Path:
    """A run in which the pelvis comes from the side, then the C-arm of view 2 is found, then the device."""
    folder, run = procedure
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    nominal = read_case(folder).objects["device"].start.camera1_from
    assert nominal is not None
    start = {"pelvis": shifted(SHIFTS[0]), "femur": shifted(SHIFTS[0])}
    coming = [{"evaluations": n, "cost": 0.5 - n / 100, "camera1_from": {"pelvis": shifted(x)}} for n, x in
              enumerate(SHIFTS, 1)]  # fmt: skip
    device = rigid(translation=torch.tensor([0.0, 0, 5], dtype=torch.float64)) @ nominal
    result |= {
        "case": "../case",
        "start": {"camera1_from_pelvis": start["pelvis"]},
        "trusted": False,
        "stages": [
            stage("pelvis in view 1", coming, device=nominal),
            stage("orbit search", [], view=2, device=nominal),
            stage("device", [{"evaluations": 1, "cost": 0.3, "camera1_from": {"device": nominal}}], device=device),
        ],
    }
    write_json(run / "result.json", result)
    return run


def pictures(path: Path) -> list[NDArray[np.uint8]]:
    with Image.open(path) as film:
        found = []
        for number in range(film.n_frames):  # type: ignore[attr-defined]
            film.seek(number)
            found.append(np.array(film.convert("RGB")))
    return found


COLOURS = ((86, 180, 233), (0, 158, 115))  # Okabe and Ito's sky blue and bluish green: first object, third object


def edges(picture: NDArray[np.uint8], row: int, view: int) -> NDArray[np.bool_]:
    """Pixels of an edge in one panel: row 0 is anatomy, with the pelvis, 1 device."""
    rows, columns = CAMERA.shape
    panel = picture[22 + row * rows :, view * columns :][:rows, :columns].astype(int)
    return np.abs(panel - COLOURS[row]).max(-1) < 12


def test_frames_follow_the_trace(run: Path) -> None:
    case = read_case(run.parent / "case")
    frames = list(frames_of(read_result(run), prepare_scene(case)))
    assert [frame.stage.partition(",")[0] for frame in frames] == [
        "start: landmarks of the network",
        *["1/3 pelvis in view 1"] * 4,
        "2/3 orbit search",
        *["3/3 device"] * 2,
    ]
    places = [float((frame.poses.camera1_from["pelvis"] - POSE)[0, 3]) for frame in frames[:5]]
    assert places == pytest.approx([-60, *SHIFTS, 0])
    assert [sorted(frame.views) for frame in frames] == [[0]] * 5 + [[0, 1]] * 3
    assert ["device" in frame.objects for frame in frames] == [False] * 6 + [True] * 2
    assert frames[2].detail == "2 evaluations, cost 0.4800"


def test_edges_stand_where_the_pelvis_was_and_in_views_that_have_their_place(run: Path) -> None:
    assert main(["replay", str(run)]) == 0
    film = pictures(run / "replay.gif")
    bar, (rows, columns) = 22, CAMERA.shape
    assert film[0].shape == (2 * rows + 2 * bar, 3 * columns, 3)
    start = edges(film[0], 0, 0)[: rows - bar]  # the last rows hold text
    corner = torch.tensor([[-45.0, 0, 0]], dtype=torch.float64)  # the face of the pelvis block towards the right
    for frame, shift in ((film[0], SHIFTS[0]), (film[-1], SHIFTS[-1])):
        left = project_points(CAMERA, transform_points(shifted(shift), corner))[0, 0].item()
        found = np.nonzero(edges(frame, 0, 0)[: rows - bar].any(0))[0].min()
        assert abs(found - left) < 2 or (left < 0 and found < 2)
    assert start.any()
    assert not edges(film[0], 0, 1).any()  # view 2 has no place yet
    assert edges(film[-1], 0, 1).any()
    assert not edges(film[-1], 0, 2).any()  # and view 3 never gets one here
    assert not edges(film[0], 1, 0).any()
    assert edges(film[-1], 1, 0).any()


def test_the_end_says_that_the_result_is_not_trusted(run: Path) -> None:
    assert main(["replay", str(run), "--out", str(run / "other.gif")]) == 0
    film = pictures(run / "other.gif")
    red = [(p[-22:, :, 0].astype(int) - p[-22:, :, 1] > 100).any() for p in film]
    assert red[-1]
    assert not any(red[:-1])


def without_moments(run: Path) -> None:
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    for entry in result["stages"]:
        del entry["moments"]
    write_json(run / "result.json", result)


def two_views(run: Path) -> None:
    result = json.loads((run / "result.json").read_text(encoding="utf-8"))
    result["camera_from_pelvis"].pop()
    write_json(run / "result.json", result)


def case_moved(run: Path) -> None:
    shutil.move(run.parent / "case", run.parent / "archive")


@pytest.mark.parametrize(
    ("spoil", "arguments", "says"),
    [
        (without_moments, [], "Register again"),
        (two_views, [], "2 views were expected"),
        (case_moved, [], "Name the case folder with --case"),
        (lambda run: None, ["--out", "replay.avi"], "ends in .gif, .mp4, .webm"),
    ],
)
def test_what_cannot_be_replayed_is_one_line(
    spoil: Callable[[Path], None], arguments: list[str], says: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil(run)
    assert main(["replay", str(run), *arguments]) == 2
    told = capsys.readouterr().err
    assert says in told
    assert told.count("\n") == 1
    assert not (run / "replay.gif").exists()


def test_a_case_that_was_moved_can_be_named(run: Path) -> None:
    case_moved(run)
    assert main(["replay", str(run), "--case", str(run.parent / "archive")]) == 0
    assert (run / "replay.gif").is_file()


def film_frames(path: Path) -> tuple[list[NDArray[np.uint8]], float]:
    """Frames (H, W, 3), RGB, of a film as OpenCV reads it, and how many it shows in a second."""
    film = cv2.VideoCapture(str(path))
    shown = []
    while (read := film.read())[0]:
        shown.append(read[1][..., ::-1])
    rate = film.get(cv2.CAP_PROP_FPS)
    film.release()
    return shown, rate


def test_a_film_shows_what_the_gif_shows(run: Path) -> None:
    assert main(["replay", str(run)]) == 0
    assert main(["replay", str(run), "--out", str(run / "replay.mp4")]) == 0
    still = pictures(run / "replay.gif")[-1].astype(float)
    with Image.open(run / "replay.gif") as gif:
        seconds = 0.0
        for number in range(gif.n_frames):  # type: ignore[attr-defined]
            gif.seek(number)
            seconds += gif.info["duration"] / 1000
    shown, rate = film_frames(run / "replay.mp4")
    assert len(shown) / rate == pytest.approx(seconds, abs=0.5)
    assert shown[-1].shape == still.shape
    assert np.abs(shown[-1] - still).mean() < 12


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_film_shows_every_picture_for_as_long_as_it_is_told(suffix: str, tmp_path: Path) -> None:
    """Black for 0.4 s, then white for 0.8 s, of an odd number of pixels."""
    black = np.zeros((63, 95, 3), np.uint8)
    write_film(tmp_path / f"film{suffix}", iter([black, black + 255]), [400, 800])
    shown, rate = film_frames(tmp_path / f"film{suffix}")
    bright = [bool(picture.mean() > 128) for picture in shown]
    assert bright == sorted(bright)
    assert bright.count(False) / rate == pytest.approx(0.4, abs=0.05)
    assert bright.count(True) / rate == pytest.approx(0.8, abs=0.05)
    assert shown[0].shape == (64, 96, 3)


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_film_that_a_full_disk_cuts_off_is_told(suffix: str, tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (4, 64, 96, 3), dtype=np.uint8)
    path = tmp_path / f"film{suffix}"
    write_film(path, iter(noise), [400] * 4)
    size = path.stat().st_size
    for most in (200, size // 2):
        with full_after(most), pytest.raises(OSError, match="Is the disk full"):
            write_film(path, iter(noise), [400] * 4)


def test_a_film_needs_the_extra(run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["replay", str(run), "--out", str(run / "replay.mp4")]) == 2
    assert "femoreg-torch[video]" in capsys.readouterr().err
    assert not (run / "replay.mp4").exists()
