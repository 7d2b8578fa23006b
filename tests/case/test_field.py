"""The `field:` of a view: what shutters leave of its images, read, checked and written back."""

from pathlib import Path
from typing import Any

import pytest

from femoreg_torch.case.fields import Fields
from femoreg_torch.case.parts import read_view
from femoreg_torch.case.writing import _view
from femoreg_torch.errors import InputError
from femoreg_torch.files import plain
from femoreg_torch.fluoro import Circle, Polygon


def view(folder: Path, field: Any) -> Fields:
    for name in ("a.tif", "mask.png"):
        (folder / name).write_bytes(b"some")
    return Fields({"image": "a.tif", "field": field}, "case.yaml", "views[0]")


@pytest.mark.parametrize(
    ("told", "meant"),
    [
        ({"circle": {"centre": [767.5, 760], "radius": 700}}, Circle((767.5, 760.0), 700.0)),
        ({"polygon": [[1, 2], [30, 2], [30, 40.5]]}, Polygon(((1.0, 2.0), (30.0, 2.0), (30.0, 40.5)))),
        ("mask.png", "mask.png"),
        (None, None),
    ],
)
def test_a_field_is_read_and_written(told: Any, meant: Any, tmp_path: Path) -> None:
    found = read_view(view(tmp_path, told), tmp_path)
    assert found.field == (tmp_path / meant if isinstance(meant, str) else meant)
    again = read_view(Fields(plain(_view(found, tmp_path.resolve(), False)), "case.yaml", "views[0]"), tmp_path)
    assert again.field == found.field


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ({}, r"views\[0\]\.field: `circle`, `polygon` or the file"),
        ({"square": 3}, r"views\[0\]\.field\.square: unknown key"),
        ({"circle": {"centre": [1, 2], "radius": 0}}, r"circle\.radius: a positive number"),
        ({"circle": {"centre": [1, 2]}}, r"circle\.radius: is missing"),
        ({"polygon": [[1, 2], [3, 4]]}, r"field\.polygon: at least three corners"),
        ({"polygon": [[1, 2], [3, 4], [5]]}, r"field\.polygon\[2\]: 2 numbers"),
        ("no.png", r"views\[0\]\.field: .*no such file"),
    ],
)
def test_what_is_wrong_with_a_field_is_named(told: Any, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=says):
        read_view(view(tmp_path, told), tmp_path)


def test_a_polygon_may_be_concave() -> None:
    arrow = Polygon(((0, 0), (10, 0), (5, 5), (10, 10), (0, 10))).exposed((11, 11))
    assert not arrow[5, 8]
    assert arrow[2, 2]
    assert arrow[8, 2]
