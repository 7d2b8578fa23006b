"""Files that start a registration by hand."""

import json
from pathlib import Path

import pytest

from femoreg_torch.case.start_files import read_pixels, read_start_poses
from femoreg_torch.errors import InputError

HEADER = "image,landmark,column_px,row_px,confidence,visible\n"
ROWS = "view1.tif,FH-l,10.5,20.25,0.9,1\nview1.tif,FH-r,-3,7,0.2,0\nview1.tif,mine,1,2,1,1\n"
EYE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 600], [0, 0, 0, 1]]


def test_a_table_as_detect_writes_it_without_what_is_not_visible(tmp_path: Path) -> None:
    (tmp_path / "landmarks.csv").write_text(HEADER + ROWS, encoding="utf-8")
    found = read_pixels(tmp_path / "landmarks.csv")
    assert {name: pixel.tolist() for name, pixel in found.items()} == {"FH-l": [10.5, 20.25], "mine": [1, 2]}


def test_markups_of_the_image_plane(tmp_path: Path) -> None:
    points = [{"label": "FH-l", "position": [10.5, 20.25, 0], "positionStatus": "defined"}]
    markup = {"coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    (tmp_path / "view1.mrk.json").write_text(json.dumps({"markups": [markup]}), encoding="utf-8")
    assert read_pixels(tmp_path / "view1.mrk.json")["FH-l"].tolist() == [10.5, 20.25]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", r"is empty \(0 bytes\)"),
        ("landmark,x,y\nFH-l,1,2\n", "a header with landmark, column_px, row_px"),
        (HEADER + ROWS + "view2.tif,FH-l,1,2,1,1\n", "landmarks of 2 images"),
        (HEADER + ROWS + "view1.tif,FH-l,1,2,1,1\n", "line 5: the name of a landmark was expected, each once"),
        (HEADER + "view1.tif,FH-l,one,2,1,1\n", "line 2: two finite numbers"),
        (HEADER + "view1.tif,FH-l,nan,2,1,1\n", "line 2: two finite numbers"),
        (HEADER + "view1.tif,FH-l,1,2,1,0\n", "no row is visible"),
        (HEADER + "view1.tif,FH-l,1,2,1,FALSE\nview1.tif,FH-r,1,2,1,no\n", "no row is visible"),
        (HEADER + "view1.tif,FH-l,1,2,1,perhaps\n", "line 2: visible: 1 or 0 was expected, found 'perhaps'"),
    ],
)
def test_bad_tables(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "landmarks.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=says) as raised:
        read_pixels(tmp_path / "landmarks.csv")
    assert "\n" not in str(raised.value)


def test_start_poses_of_any_objects_and_of_an_earlier_result(tmp_path: Path) -> None:
    (tmp_path / "start.json").write_text(
        json.dumps({"camera1_from_tibia": EYE, "camera_from_shank": [EYE, EYE]}), encoding="utf-8"
    )
    found = read_start_poses(tmp_path / "start.json")
    assert {name: pose.tolist() for name, pose in found.items()} == {"shank": EYE, "tibia": EYE}


def test_a_file_without_poses_is_refused(tmp_path: Path) -> None:
    (tmp_path / "start.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="holds no start pose"):
        read_start_poses(tmp_path / "start.json")
