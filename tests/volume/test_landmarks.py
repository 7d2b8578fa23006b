"""Landmark files in three formats, and all that may be wrong with them."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, axis_aligned, check_inside, read_landmarks, read_path_points, write_landmarks

HEAD, NOTCH = [97.3, -11.84, -78.18], [-78.68, 13.25, -23.23]  # FH-l is left (+x), GSN-r right, LPS
RAS_HEAD, RAS_NOTCH = [-97.3, 11.84, -78.18], [78.68, -13.25, -23.23]


def expected() -> dict[str, torch.Tensor]:
    return {name: torch.tensor(p, dtype=torch.float64) for name, p in (("FH-l", HEAD), ("GSN-r", NOTCH))}


def plain(**changes: Any) -> dict[str, Any]:
    return {"space": "LPS", "unit": "mm", "landmarks": {"GSN-r": NOTCH, "FH-l": HEAD}} | changes


def slicer(system: str, head: list[float], notch: list[float], **changes: Any) -> dict[str, Any]:
    points = [
        {"id": "1", "label": "GSN-r", "position": notch, "positionStatus": "defined"},
        {"id": "2", "label": "FH-l", "position": head},
        {"id": "3", "label": "FH-r", "position": [0, 0, 0], "positionStatus": "undefined"},
    ]
    return {"markups": [{"type": "Fiducial", "coordinateSystem": system, "controlPoints": points} | changes]}


def fcsv(system: str, head: list[float], notch: list[float]) -> str:
    lines = [
        "# Markups fiducial file version = 4.11",
        f"# CoordinateSystem = {system}",
        "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID",
    ]
    for name, point in (("GSN-r", notch), ("FH-l", head)):
        lines.append(f"vtkMRML_{name},{','.join(map(str, point))},0,0,0,1,1,1,0,{name},,")
    return "\n".join(lines) + "\n"


FILES = {
    "plain LPS.json": json.dumps(plain()),
    "plain RAS.json": json.dumps(plain(space="RAS", landmarks={"FH-l": RAS_HEAD, "GSN-r": RAS_NOTCH})),
    "slicer LPS.mrk.json": json.dumps(slicer("LPS", HEAD, NOTCH)),
    "slicer RAS.mrk.json": json.dumps(slicer("RAS", RAS_HEAD, RAS_NOTCH)),
    "LPS.fcsv": fcsv("LPS", HEAD, NOTCH),
    "RAS.fcsv": fcsv("RAS", RAS_HEAD, RAS_NOTCH),
    "old RAS.fcsv": fcsv("0", RAS_HEAD, RAS_NOTCH),
    "old LPS.fcsv": fcsv("1", HEAD, NOTCH),
    "small.fcsv": fcsv("lps", HEAD, NOTCH),
    "units.mrk.json": json.dumps(slicer("LPS", HEAD, NOTCH, coordinateUnits=["mm"] * 3)),
    "capitals.csv": f"Label,L,P,S\nGSN-r,{','.join(map(str, NOTCH))}\nFH-l,{','.join(map(str, HEAD))}\n",
}


@pytest.mark.parametrize("name", FILES)
def test_all_formats_give_the_same_lps_points_in_the_same_order(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(FILES[name], encoding="utf-8")
    found = read_landmarks(tmp_path / name)
    assert list(found) == ["FH-l", "GSN-r"]
    for key, point in expected().items():
        assert torch.equal(found[key], point)


def test_fcsv_without_a_header_is_ras_and_has_the_columns_of_slicer(tmp_path: Path) -> None:
    rows = [line for line in fcsv("RAS", RAS_HEAD, RAS_NOTCH).splitlines() if not line.startswith("#")]
    (tmp_path / "points.fcsv").write_text("\n".join(rows), encoding="utf-8")
    found = read_landmarks(tmp_path / "points.fcsv")
    for key, point in expected().items():
        assert torch.equal(found[key], point)


def test_several_lists_each_in_its_own_space_and_names_spelt_otherwise(tmp_path: Path) -> None:
    first = slicer("LPS", HEAD, NOTCH, controlPoints=[{"label": "fh_L", "position": HEAD}])
    second = slicer("RAS", HEAD, NOTCH, controlPoints=[{"label": "GSN R", "position": RAS_NOTCH}])
    content = {"markups": first["markups"] + second["markups"]}
    (tmp_path / "points.mrk.json").write_text(json.dumps(content), encoding="utf-8")
    found = read_landmarks(tmp_path / "points.mrk.json")
    assert list(found) == ["FH-l", "GSN-r"]
    for key, point in expected().items():
        assert torch.equal(found[key], point)


def path_file(folder: Path, names: list[str], **changes: Any) -> Path:
    points = [{"label": name, "position": [10.0 * n, 1, 2]} for n, name in enumerate(names, 1)]
    path = folder / "plan.mrk.json"
    path.write_text(json.dumps(slicer("LPS", HEAD, NOTCH, controlPoints=points, **changes)), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("names", "entry", "target"),
    [
        (["L-1", "L-2"], 10, 20),  # the ends of a line
        (["", ""], 10, 20),
        (["Target", "Entry point"], 20, 10),
        (["FH-l", "entry", "target"], 20, 30),
        (["F-1"], 10, None),
        (["entry", "F-2"], 10, 20),  # one end of a line was renamed
        (["F-1", "entry"], 20, 10),
        (["F-1", "target"], 10, 20),
        (["entry"], 10, None),
    ],
)
def test_the_ends_of_a_planned_path(tmp_path: Path, names: list[str], entry: float, target: float | None) -> None:
    found, end = read_path_points(path_file(tmp_path, names, type="Line"))
    assert found.tolist() == [entry, 1, 2]
    assert (None if end is None else end.tolist()) == (None if target is None else [target, 1, 2])


@pytest.mark.parametrize("names", [["a", "b", "c"], ["target"], ["entry", "entry 2"], []])
def test_points_that_are_no_path(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(InputError, match="a line, or points named `entry` and `target`, were expected"):
        read_path_points(path_file(tmp_path, names))


@pytest.mark.parametrize("name", ["points.json", "points.mrk.json"])
def test_written_landmarks_come_back(tmp_path: Path, name: str) -> None:
    values = torch.randn(14, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    points = dict(zip(HIP.landmark_names, values, strict=True))
    write_landmarks(tmp_path / name, points)
    again = read_landmarks(tmp_path / name)
    assert tuple(again) == HIP.landmark_names
    for key in points:
        torch.testing.assert_close(again[key], points[key], atol=1e-8, rtol=0)


BAD = {
    "unknown name": (json.dumps(plain(landmarks={"FH-x": HEAD})), "unknown landmark 'FH-x'"),
    "number for a name": (
        json.dumps(slicer("LPS", HEAD, NOTCH, controlPoints=[{"label": 5, "position": HEAD}])),
        "unknown landmark '5'",
    ),
    "centimetres": (json.dumps(plain(unit="cm")), "unit must be mm, found 'cm'"),
    "no unit": (json.dumps({"space": "LPS", "landmarks": {}}), "`unit` is missing"),
    "no landmarks": (json.dumps({"space": "LPS", "unit": "mm"}), "`landmarks` is missing"),
    "empty": (json.dumps(plain(landmarks={})), "holds no landmark"),
    "a list": (json.dumps(plain(landmarks=[HEAD])), "an object of names and points"),
    "space": (json.dumps(plain(space="LAS")), "LPS or RAS, found 'LAS'"),
    "nan": ('{"space": "LPS", "unit": "mm", "landmarks": {"FH-l": [NaN, 0, 0]}}', "FH-l: three finite numbers"),
    "two numbers": (json.dumps(plain(landmarks={"FH-l": [1, 2]})), "FH-l: three finite numbers"),
    "words": (json.dumps(plain(landmarks={"FH-l": ["a", 0, 0]})), "FH-l: three finite numbers"),
    "digits": (json.dumps(plain(landmarks={"FH-l": "123"})), "FH-l: three finite numbers"),
    "an object": (json.dumps(plain(landmarks={"FH-l": {"1": 1, "2": 2, "3": 3}})), "FH-l: three finite numbers"),
    "null": (json.dumps(plain(landmarks={"FH-l": None})), "FH-l: three finite numbers"),
    "no json": ("FH-l 1 2 3", "cannot be read as JSON"),
    "no object": ("[1, 2]", "a JSON object"),
    "slicer unit": (json.dumps(slicer("LPS", HEAD, NOTCH, coordinateUnits="cm")), "unit must be mm"),
    "slicer system": (json.dumps(slicer("IJK", HEAD, NOTCH)), "LPS or RAS, found 'IJK'"),
    "slicer points": (json.dumps(slicer("LPS", HEAD, NOTCH, controlPoints=None)), "controlPoints"),
    "slicer twice": (
        json.dumps(slicer("LPS", HEAD, NOTCH, controlPoints=[{"label": "FH-l", "position": HEAD}] * 2)),
        "FH-l stands there twice",
    ),
    "no markups": ('{"markups": []}', "markups"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_files(tmp_path: Path, kind: str) -> None:
    content, message = BAD[kind]
    (tmp_path / "points.json").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=message) as raised:
        read_landmarks(tmp_path / "points.json")
    assert "points.json" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("# CoordinateSystem = LPS", "# CoordinateSystem = 2"), "LPS or RAS, found '2'"),
        (("97.3", "left"), "FH-l: three finite numbers"),
        (("0,FH-l,,", "0,Head,,"), "unknown landmark 'Head'"),
    ],
)
def test_bad_fcsv(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    (tmp_path / "points.fcsv").write_text(fcsv("LPS", HEAD, NOTCH).replace(*change), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_landmarks(tmp_path / "points.fcsv")


def test_an_fcsv_that_is_another_table_names_the_line(tmp_path: Path) -> None:
    (tmp_path / "points.fcsv").write_text("# Markups fiducial file version = 4.11\n1,2,3\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 2: 3 values were found, but there are 14 columns"):
        read_landmarks(tmp_path / "points.fcsv")


def test_a_missing_file_and_bytes_that_are_no_text(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_landmarks(tmp_path / "points.json")
    for name in ("points.json", "points.fcsv"):
        (tmp_path / name).write_bytes(b"\xff\xfe\x00\x80")
        with pytest.raises(InputError, match="cannot be read"):
            read_landmarks(tmp_path / name)


def test_a_landmark_outside_the_ct_is_refused() -> None:
    volume = Volume(torch.zeros(10, 20, 30), axis_aligned((2.0, 1.0, 1.0), (5.0, 0.0, 0.0)))
    check_inside({"FH-l": torch.tensor([64.0, 19.4, 9.4], dtype=torch.float64)}, volume)
    for point in ([64.1, 10.0, 5.0], [3.9, 10.0, 5.0], [20.0, 10.0, -0.6]):
        with pytest.raises(InputError, match=r"FH-l .* outside the CT"):
            check_inside({"FH-l": torch.tensor(point, dtype=torch.float64)}, volume)


def test_a_name_that_nobody_would_write_is_not_repeated_whole(tmp_path: Path) -> None:
    """Found by the fuzz suite, seed 177: a line of 100,000 characters."""
    name = "x" * 100_000
    for point, times in (([1.0, 3.0], 1), ([1.0, 2.0, 3.0], 2)):
        markup = {"coordinateSystem": "LPS", "controlPoints": [{"label": name, "position": point}] * times}
        path = tmp_path / f"long{times}.mrk.json"
        path.write_text(json.dumps({"markups": [markup]}), encoding="utf-8")
        with pytest.raises(InputError) as told:
            read_landmarks(path, known=None)
        assert len(str(told.value)) < 300 + len(str(path))


def test_the_example_has_a_name_that_is_known(tmp_path: Path) -> None:
    path = tmp_path / "points.json"
    path.write_text(json.dumps({"tip": [0, 0, 1]}), encoding="utf-8")
    with pytest.raises(InputError, match=re.escape('"landmarks": {"tip": [x, y, z], …}')):
        read_landmarks(path, ("tip", "base"))
