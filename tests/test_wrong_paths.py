"""What a user meets who names a wrong path: at every door one line that says why, and how to mend it."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from femoreg_torch.case import read_case, read_result
from femoreg_torch.case.fields import Fields
from femoreg_torch.case.reading import case_folder
from femoreg_torch.case.start_files import read_pixels
from femoreg_torch.commands.main import main
from femoreg_torch.delimited import read_csv
from femoreg_torch.detect import load_network
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json
from femoreg_torch.fluoro import read_image
from femoreg_torch.geometry import load_carm, read_itk_transform
from femoreg_torch.intake import inspect_path
from femoreg_torch.navigation import read_robot
from femoreg_torch.paths import check_readable, why_unreadable
from femoreg_torch.tensors import read_tensors
from femoreg_torch.text import read_yaml
from femoreg_torch.volume import read_bodies, read_ct, read_label_map, read_landmarks, read_mesh, read_path_points

DOORS: dict[str, tuple[Callable[[Path], object], str]] = {  # a reader, and the name of a file that it takes
    "yaml": (read_yaml, "a.yaml"),
    "preset": (load_carm, "a.yaml"),
    "json": (read_json, "a.json"),
    "csv": (lambda path: read_csv(path, ("a",)), "a.csv"),
    "landmarks": (read_landmarks, "a.mrk.json"),
    "points of Slicer 4": (read_landmarks, "a.fcsv"),
    "path": (read_path_points, "a.mrk.json"),
    "pixels": (read_pixels, "a.csv"),
    "CT": (read_ct, "a.nii.gz"),
    "CT as NRRD": (read_ct, "a.nrrd"),
    "CT as DICOM": (read_ct, "a.dcm"),
    "labels": (read_label_map, "a.seg.nrrd"),
    "image": (read_image, "a.png"),
    "image as TIFF": (read_image, "a.tif"),
    "image as DICOM": (read_image, "a.dcm"),
    "image as NIfTI": (read_image, "a.nii"),
    "STL": (read_mesh, "a.stl"),
    "OBJ": (read_mesh, "a.obj"),
    "3MF": (lambda path: read_bodies(path, ("a",)), "a.3mf"),
    "transform": (read_itk_transform, "a.tfm"),
    "transform in HDF5": (read_itk_transform, "a.h5"),
    "robot": (lambda path: read_robot(path, "device"), "a.txt"),
    "tensors": (read_tensors, "a.safetensors"),
    "weights": (load_network, "a.safetensors"),
    "whatever": (inspect_path, "a.mha"),
}
OF_FOLDERS = {"CT", "CT as NRRD", "CT as DICOM", "labels", "whatever"}  # which may be folders


@pytest.fixture(params=DOORS)
def door(request: pytest.FixtureRequest) -> tuple[str, Callable[[Path], object], str]:
    return request.param, *DOORS[request.param]


def told(read: Callable[[Path], object], path: Path) -> str:
    """The one line of a refusal, after the path that it begins with."""
    with pytest.raises(InputError) as raised:
        read(path)
    line = str(raised.value)
    assert line.startswith(f"{path}: ")
    assert "\n" not in line
    return line.removeprefix(f"{path}: ")


def test_every_door_tells_a_missing_file_and_what_may_be_meant(
    door: tuple[str, Callable[[Path], object], str], tmp_path: Path
) -> None:
    _, read, name = door
    assert told(read, tmp_path / name).startswith("no such file")
    (tmp_path / f"{name.upper()}").write_bytes(b"x")
    assert f"Did you mean {name.upper()}?" in told(read, tmp_path / name)


def test_every_door_tells_an_empty_file(door: tuple[str, Callable[[Path], object], str], tmp_path: Path) -> None:
    _, read, name = door
    (tmp_path / name).touch()
    assert told(read, tmp_path / name) == "is empty (0 bytes). Copy or export it anew."


def test_every_door_tells_a_folder(door: tuple[str, Callable[[Path], object], str], tmp_path: Path) -> None:
    kind, read, name = door
    (tmp_path / name).mkdir()
    line = told(read, tmp_path / name)
    assert line.startswith("holds n") if kind in OF_FOLDERS else line.startswith("is a folder, a file was expected")


@pytest.fixture
def somebody_else() -> Iterator[None]:
    """The tests may run as root, who may read everything."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.fixture
def closed_place(tmp_path: Path) -> Iterator[Path]:
    """A folder that all may enter, for files that some may not read."""
    above = [tmp_path, *tmp_path.parents[:2]]
    before = [folder.stat().st_mode for folder in above]
    for folder in above:
        folder.chmod(0o755)
    yield tmp_path
    for folder, mode in zip(above, before, strict=True):
        folder.chmod(mode)


@pytest.mark.parametrize("shut", ["file", "folder"])
def test_what_one_may_not_read(shut: str, closed_place: Path, request: pytest.FixtureRequest) -> None:
    folder = closed_place / "mine"
    folder.mkdir()
    (folder / "a.yaml").write_text("a: 1", encoding="utf-8")
    (folder / "a.yaml" if shut == "file" else folder).chmod(0)
    request.getfixturevalue("somebody_else")
    line = told(read_yaml, folder / "a.yaml")
    assert line.startswith("you have no permission to read it. Give it to yourself (`chmod`)")


def test_other_things_that_are_no_files(tmp_path: Path) -> None:
    (tmp_path / "link.yaml").symlink_to("gone.yaml")
    (tmp_path / "loop.yaml").symlink_to("loop.yaml")
    (tmp_path / "file").write_text("x", encoding="utf-8")
    os.mkfifo(tmp_path / "pipe.yaml")
    assert told(read_yaml, tmp_path / "link.yaml") == "is a link to gone.yaml, which is not there."
    assert "cannot be read" in told(read_yaml, tmp_path / "loop.yaml")
    assert told(read_yaml, tmp_path / "pipe.yaml").startswith("is a device or a pipe, a file was expected")
    assert told(read_yaml, tmp_path / "file" / "a.yaml") == f"no such file: {tmp_path / 'file'} is a file, no folder."
    (tmp_path / "images").mkdir()
    line = told(read_yaml, tmp_path / "image" / "deep" / "a.yaml")
    assert line == f"no such file: there is no folder {tmp_path / 'image'}. Did you mean images?"


@pytest.mark.parametrize(
    ("meant", "there", "offered"),
    [
        ("ct.nii", ["ct.nii.gz", "labels.nii.gz", "view1.tif"], "Did you mean ct.nii.gz?"),
        ("ct.mha", ["ct.nii.gz", "ct.nrrd", "other"], "Did you mean ct.nii.gz or ct.nrrd?"),
        ("VIEW_1.tif", ["view1.tif"], "Did you mean view1.tif?"),
        ("landmark.json", ["landmarks.json"], "Did you mean landmarks.json?"),
        ("device.stl", ["ct.nii.gz", ".device.stl"], ""),
    ],
)
def test_similar_names_are_offered(meant: str, there: list[str], offered: str, tmp_path: Path) -> None:
    for name in there:
        (tmp_path / name).touch()
    assert why_unreadable(tmp_path / meant) == f"no such file. {offered}".rstrip()


def test_a_path_of_windows_is_told_as_ours(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "view1.tif").write_bytes(b"x")
    with pytest.raises(
        InputError, match=r"no such file\. Did you mean .*/images/view1\.tif\? Write / in place of \\\."
    ):
        Fields({"anatomy": "images\\view1.tif"}, "case.yaml").file_path("anatomy", tmp_path)


NAMES = st.text(st.characters(exclude_characters="/"), max_size=20)


@given(st.lists(NAMES, min_size=1, max_size=4))
def test_any_path_is_a_file_or_told_in_one_sentence(tmp_path_factory: pytest.TempPathFactory, steps: list[str]) -> None:
    path = tmp_path_factory.getbasetemp().joinpath(*steps)
    why = why_unreadable(path)
    if why is None:
        assert path.is_file()
    else:
        with pytest.raises(InputError) as raised:
            check_readable(path)
        assert str(raised.value).endswith(why)


# Case folders.


def test_a_case_is_its_folder_or_its_file(tmp_path: Path) -> None:
    (tmp_path / "case.yaml").write_text("version: 7\n", encoding="utf-8")
    assert case_folder(tmp_path) == case_folder(tmp_path / "case.yaml") == tmp_path
    for path in (tmp_path, tmp_path / "case.yaml"):
        with pytest.raises(InputError, match=r"case\.yaml, .*version: this FemoReg Torch reads versions 1 and 2"):
            read_case(path)


def test_what_is_no_case_is_told_what_may_be_one(tmp_path: Path) -> None:
    folder = tmp_path / "cases" / "one"
    folder.mkdir(parents=True)
    (folder / "case.yaml").write_text("version: 7\n", encoding="utf-8")
    (folder / "ct.nii.gz").write_bytes(b"x")
    (tmp_path / "note.txt").write_bytes(b"x")
    assert told(read_case, folder / "ct.nii.gz") == f"is a file, a folder was expected. Name the folder {folder}."
    assert told(read_case, tmp_path / "note.txt").endswith("Make a case with `femoreg new-case` or `femoreg simulate`.")
    assert "it holds no case.yaml. Its folders do: 'one'. Name one." in told(read_case, folder.parent)
    assert "no such folder. Did you mean one?" in told(read_case, folder.parent / "onr")
    assert "no such folder. Did you mean ct.nii.gz? Name the folder" in told(read_case, folder / "ct.nii")


def test_a_result_in_the_place_of_its_folder(tmp_path: Path) -> None:
    (tmp_path / "result.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match=r"result\.json: no such file: .*result\.json is a file, no folder"):
        read_result(tmp_path / "result.json")


def test_a_folder_without_a_result_is_told_how_one_is_made(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"result\.json: no such file\. .*`femoreg register CASE --out RUN`"):
        read_result(tmp_path)


@pytest.mark.parametrize(
    "words",
    [
        ["register", "CASE", "--out", "OUT"],
        ["check", "CASE", "--out", "OUT.png", "--fast"],
        ["plan", "CASE", "--out", "OUT"],
        ["simulate", "CASE", "--out", "OUT"],
        ["labelled-images", "CASE", "--out", "OUT.safetensors"],
        ["beads", "CASE", "--beads", "beads.yaml", "--out", "OUT"],
        ["inspect", "CASE", "--out", "OUT.png"],
        ["review", "CASE", "--out", "OUT"],
    ],
)
def test_commands_tell_it_in_one_line_and_write_nothing(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cases").mkdir()
    order = [word.replace("CASE", str(tmp_path / "case")).replace("OUT", str(tmp_path / "out")) for word in words]
    assert main(order) == 2
    line = capsys.readouterr().err
    assert line.startswith(f"femoreg: {tmp_path / 'case'}: no such f")
    assert "Did you mean cases?" in line
    assert line.count("\n") == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["cases"]
