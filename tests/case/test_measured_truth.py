"""A truth that does not know the first object: told by another one, in all views or in the first."""

from pathlib import Path

import pytest
import torch
import yaml

from femoreg_torch.case import read_case, write_case
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json, write_json
from femoreg_torch.fluoro import write_image
from femoreg_torch.geometry import rigid

NEAR = rigid(translation=torch.tensor([0.0, 0, 700], dtype=torch.float64))
ASIDE = rigid(translation=torch.tensor([5.0, 0, 690], dtype=torch.float64))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three objects at nominal poses and two views."""
    for number in (1, 2):
        image = torch.arange(64 * 64).reshape(64, 64) + number
        write_image(tmp_path / f"v{number}.tif", image.to(torch.uint16))
    (tmp_path / "box.stl").write_text("solid\nendsolid\n", encoding="utf-8")
    start = {"camera1_from": NEAR.tolist()}
    thing = {"model": "box.stl", "hu": 1000, "start": start}
    content = {
        "version": 2,
        "objects": {"one": thing, "two": thing, "three": thing},
        "carm": {"sdd_mm": 1000, "pixel_mm": [4, 4], "shape": [64, 64]},
        "views": [{"image": "v1.tif"}, {"image": "v2.tif"}],
        "truth": "truth.json",
    }
    (tmp_path / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return tmp_path


def test_another_object_may_tell_the_cameras(folder: Path) -> None:
    write_json(folder / "truth.json", {"camera_from_two": [NEAR, ASIDE], "camera1_from_three": ASIDE})
    case = read_case(folder)
    assert case.truth is not None
    assert set(case.truth.camera1_from) == {"two", "three"}
    torch.testing.assert_close(case.truth.camera_from("two")[1], ASIDE)
    write_case(folder, case)
    assert set(read_json(folder / "truth.json")) == {"camera_from_two", "camera1_from_three"}


def test_the_first_view_alone_may_be_told(folder: Path) -> None:
    write_json(folder / "truth.json", {"camera_from_two": [NEAR]})
    truth = read_case(folder).truth
    assert truth is not None
    assert len(truth.camera_from_camera1) == 1


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({"camera_from_two": [NEAR, ASIDE], "camera1_from_one": NEAR}, "camera1_from_one: unknown key"),
        ({"camera_from_two": [NEAR, ASIDE, NEAR]}, "3 poses, but the case has 2 views"),
        ({"camera_from_one": [NEAR]}, "camera1_from_three: is missing"),
        ({"camera1_from_three": NEAR}, "camera_from_one: is missing"),
    ],
)
def test_what_cannot_be_a_truth_is_told(folder: Path, content: dict[str, object], told: str) -> None:
    write_json(folder / "truth.json", content)
    with pytest.raises(InputError, match=told):
        read_case(folder)
