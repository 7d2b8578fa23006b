"""Tables of text as spreadsheets of any language save them: what can only mean one thing is read, the rest is told."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from femoreg_torch.case.start_files import read_pixels
from femoreg_torch.delimited import decimal, read_csv
from femoreg_torch.errors import InputError
from femoreg_torch.volume import read_landmarks

POINTS = {"FH-l": [97.3, -11.84, -78.18], "GSN-r": [-78.68, 13.25, -23.0]}  # LPS
FCSV = (
    "# Markups fiducial file version = 4.11\n# CoordinateSystem = LPS\n"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    + "".join(f"v{n},{x},{y},{z},0,0,0,1,1,1,0,{name},,\n" for n, (name, (x, y, z)) in enumerate(POINTS.items()))
)
TABLE = "label,l,p,s,defined\n" + "".join(f"{name},{x},{y},{z},1\n" for name, (x, y, z) in POINTS.items())
PIXELS = "image,landmark,column_px,row_px\nview1.tif,FH-l,10.5,20.25\nview1.tif,Fovea 1,-3.0,7.125\n"


def points(path: Path) -> dict[str, list[float]]:
    return {name: point.tolist() for name, point in read_landmarks(path, None).items()}


def pixels(path: Path) -> dict[str, list[float]]:
    return {name: pixel.tolist() for name, pixel in read_pixels(path).items()}


def as_saved(text: str, separator: str, comma: bool) -> str:
    """A table as another spreadsheet saves it."""
    lines = [line if line.startswith("#") else line.replace(",", separator) for line in text.split("\n")]
    return "\n".join(line if line.startswith("#") or not comma else line.replace(".", ",") for line in lines)


@given(
    st.sampled_from([("a.fcsv", FCSV), ("a.csv", TABLE), ("a.csv", PIXELS)]),
    st.sampled_from(",;\t"),
    st.booleans(),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["", "\ufeff"]),
    st.lists(st.sampled_from(["", " ", ";;;", ",,"]), max_size=3),
    st.integers(0, 4),
)
def test_every_way_to_save_a_table_gives_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    table: tuple[str, str],
    separator: str,
    comma: bool,
    end: str,
    mark: str,
    blank: list[str],
    at: int,
) -> None:
    name, text = table
    comma = comma and separator != ","
    image = "view1,tif" if comma else "view1.tif"
    lines = as_saved(text, separator, comma).split("\n")
    lines[at:at] = blank
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes((mark + end.join(lines)).encode())
    if text is PIXELS:
        assert image in path.read_text(encoding="utf-8")
        assert pixels(path) == {"FH-l": [10.5, 20.25], "Fovea 1": [-3.0, 7.125]}
    else:
        assert points(path) == POINTS


def test_what_a_spreadsheet_makes_of_remarks(tmp_path: Path) -> None:
    text = as_saved(FCSV, ";", comma=True).replace("= LPS", "= LPS;;;;").replace("# columns = ", '"# columns = ')
    (tmp_path / "a.fcsv").write_text(text.replace("NodeID\n", 'NodeID";;;\n'), encoding="utf-8")
    assert points(tmp_path / "a.fcsv") == POINTS


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sep=;\nlandmark;column_px;row_px\nFH-l;1;2\n", {"FH-l": [1, 2]}),
        (" Landmark , COLUMN_PX,row_px ,\n FH-l , 1 , 2 ,\n", {"FH-l": [1, 2]}),
        ('landmark,column_px,row_px\n"FH, left","1,5","2,5"\n', {"FH, left": [1.5, 2.5]}),
        ("landmark\tcolumn_px\trow_px\nFovea capitis 1\t1e1\t2\n", {"Fovea capitis 1": [10, 2]}),
    ],
)
def test_other_tables_of_one_meaning(text: str, expected: dict[str, list[float]], tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert pixels(tmp_path / "a.csv") == expected


def test_letters_of_latin_1_are_read_where_no_other_set_has_other_ones(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("landmark;column_px;row_px\nHüfte;1,5;2\n".encode("latin-1"))
    assert pixels(tmp_path / "a.csv") == {"Hüfte": [1.5, 2]}
    (tmp_path / "a.csv").write_bytes("landmark;column_px;row_px\n\nH–l;1,5;2\n".encode("cp1252"))
    with pytest.raises(InputError, match=r"a\.csv, line 3: cannot be read as CSV: the byte 0x96 is none of UTF-8"):
        read_pixels(tmp_path / "a.csv")


def test_tables_of_slicer_in_ras_and_points_that_are_not_placed(tmp_path: Path) -> None:
    text = "label,r,a,s,defined,selected\nFH-l,-97.3,11.84,-78.18,1,1\nGSN-r,0,0,0,0,1\n"
    (tmp_path / "a.tsv").write_text(text.replace(",", "\t"), encoding="utf-8")
    assert points(tmp_path / "a.tsv") == {"FH-l": POINTS["FH-l"]}


HEADER = "landmark,column_px,row_px\n"


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.csv", HEADER + "FH-l,10,5,20,25\n", "line 2: 5 values were found, but there are 3 .* Is there a comma"),
        ("a.csv", HEADER + "\nFH-l,10\n", "line 3: 2 values were found, but there are 3 columns .* Complete it"),
        ("a.csv", HEADER + "FH-l,1,2\n\nFH-r,1,one\n", "line 4: two finite numbers, column_px and row_px"),
        ("a.csv", HEADER.replace(",", ";") + "FH-l;1,5;2\nFH-r;1.234;2\n", "line 2 has a decimal comma, and line 3 a"),
        ("a.csv", HEADER + '"FH-l,1,2\nFH-r,1,2\n', "line 2: cannot be read as CSV"),
        ("a.csv", "FH-l,1,2\nFH-r,1,2\n", "line 1: a header with landmark, column_px, row_px, .* found 'FH-l,1,2'"),
        ("a.csv", HEADER, "and rows below it, were expected, found no row"),
        ("a.csv", "landmark,row_px,column_px,row_px\nFH-l,1,2,3\n", "line 1: column 'row_px' stands there twice"),
        ("a.csv", HEADER + "FH\x07l,1,2\n", r"line 2: cannot be read as CSV: the letter U\+0007 is no text"),
        ("a.csv", HEADER + "FH\x00l,1,2\n", "cannot be read as CSV: it holds bytes of 0"),
    ],
)  # fmt: skip
def test_tables_of_pixels_that_may_mean_something_else(name: str, text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=told) as raised:
        read_pixels(tmp_path / name)
    assert str(raised.value).startswith(str(tmp_path / name))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("a.fcsv", FCSV.replace("97.3", "97,3"), "line 4: 15 values were found, but there are 14 columns"),
        ("a.fcsv", FCSV.replace("97.3", "97,3").replace("-78.18", "-78"), "line 4: 15 values were found"),
        ("a.fcsv", FCSV.replace("97.3", "left"), "line 4, FH-l: three finite numbers .* found .*left"),
        ("a.fcsv", as_saved(FCSV, ";", comma=False).replace("97.3", "97,3"), "line 4 has a decimal comma, and li"),
        ("a.csv", TABLE.replace("label,l,p,s", "label,x,y,z"), "Other names do not say which way x, y and z run"),
        ("a.csv", TABLE.replace("label,l,p,s,defined\n", ""), "line 1: a header with label"),
        ("a.csv", TABLE.replace("97.3", ""), r"line 2, FH-l: three finite numbers"),
        ("a.json", json.dumps({"space": "LPS", "unit": "mm", "landmarks": {"FH-l": [97, 3, -11, 84, -78, 18]}}),
         "FH-l: three finite numbers .* Are these decimal commas?"),
    ],
)  # fmt: skip
def test_tables_of_points_that_may_mean_something_else(name: str, text: str, told: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=told) as raised:
        read_landmarks(tmp_path / name, None)
    assert "\n" not in str(raised.value)


def test_markups_that_are_not_utf_8_are_told_with_their_line(tmp_path: Path) -> None:
    (tmp_path / "a.mrk.json").write_bytes('{"markups": [\n{"name": "Hüfte"}]}'.encode("latin-1"))
    with pytest.raises(
        InputError, match=r"a\.mrk\.json, line 2: cannot be read as JSON: the byte 0xFC is none of UTF-8"
    ):
        read_landmarks(tmp_path / "a.mrk.json")


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_any_number_is_read_with_either_mark(value: float) -> None:
    assert decimal(str(value)) == decimal(str(value).replace(".", ",")) == value


@given(st.binary(max_size=80) | st.text("a,;\t\n\"'#.1", max_size=40).map(str.encode))
def test_any_bytes_are_a_table_or_told_in_one_line(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    for text in (content, b"a,b\n" + content):
        path.write_bytes(text)
        line = ""
        try:
            read_csv(path, ("a", "b"))
        except InputError as error:
            line = str(error)
        assert "\n" not in line
