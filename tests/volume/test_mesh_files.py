"""CAD files: bodies by name, and mm whatever the unit of the file."""

from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
import trimesh

from femoreg_torch.errors import InputError
from femoreg_torch.volume import bounds_of, read_bodies, read_mesh

HANDLE = trimesh.creation.box((20, 10, 30))
SLEEVE = trimesh.creation.annulus(3, 5, 80)
PLACE = trimesh.transformations.translation_matrix([25, 0, 7])  # of the sleeve, by the file's scene


def scene() -> trimesh.Scene:
    made = trimesh.Scene()
    made.add_geometry(HANDLE, geom_name="handle", node_name="handle")
    made.add_geometry(SLEEVE, geom_name="sleeve", node_name="sleeve", transform=PLACE)
    return made


def write(path: Path, unit_mm: float = 1.0) -> Path:
    scene().scaled(1 / unit_mm).export(path)
    return path


def check_bodies(bodies: dict[str, trimesh.Trimesh]) -> None:
    assert list(bodies) == ["sleeve", "handle"]
    assert np.allclose(bodies["handle"].bounds, HANDLE.bounds, atol=1e-3)
    assert np.allclose(bodies["sleeve"].bounds, SLEEVE.copy().apply_transform(PLACE).bounds, atol=1e-3)
    assert bodies["sleeve"].volume == pytest.approx(SLEEVE.volume, rel=1e-4)


@pytest.mark.parametrize(("suffix", "unit_mm"), [("3mf", 1.0), ("obj", 1.0), ("glb", 1000.0)])
def test_bodies_come_by_name_in_mm(tmp_path: Path, suffix: str, unit_mm: float) -> None:
    path = write(tmp_path / f"device.{suffix}", unit_mm)
    check_bodies(read_bodies(path, ["sleeve", "handle"]))
    whole = read_mesh(path)
    assert whole.volume == pytest.approx(HANDLE.volume + SLEEVE.volume, rel=1e-4)
    assert np.allclose(whole.extents, [40, 10, 80], atol=1e-2)


def test_a_3mf_file_tells_its_unit(tmp_path: Path) -> None:
    written = write(tmp_path / "written.3mf", 25.4)
    with ZipFile(written) as old, ZipFile(tmp_path / "device.3mf", "w") as new:
        for name in old.namelist():  # trimesh writes mm
            new.writestr(name, old.read(name).replace(b'unit="millimeter"', b'unit="inch"'))
    check_bodies(read_bodies(tmp_path / "device.3mf", ["sleeve", "handle"]))


def test_models_of_a_3mf_file_that_number_their_objects_alike_are_refused(tmp_path: Path) -> None:
    """As the production extension may: each model has numbers of its own, and trimesh draws one body in two places."""
    with ZipFile(write(tmp_path / "written.3mf")) as old, ZipFile(tmp_path / "device.3mf", "w") as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
        new.writestr("3D/Objects/other.model", old.read("3D/3dmodel.model"))
    with pytest.raises(InputError, match="several of its 2 models have an object of the number"):
        read_mesh(tmp_path / "device.3mf")
    with ZipFile(tmp_path / "written.3mf") as old, ZipFile(tmp_path / "device.3mf", "w") as new:
        for name in old.namelist():
            new.writestr(name.replace("3dmodel", "part"), old.read(name))
    with pytest.raises(InputError, match=r"its model is called 3D/part\.model"):
        read_mesh(tmp_path / "device.3mf")


def test_an_obj_file_with_tabs_is_read(tmp_path: Path) -> None:
    path = write(tmp_path / "device.obj")
    path.write_text(path.read_text(encoding="utf-8").replace(" ", "\t"), encoding="utf-8")
    assert read_mesh(path).volume == pytest.approx(HANDLE.volume + SLEEVE.volume, rel=1e-4)


@pytest.mark.parametrize("before", ["", "o device\n"])
def test_groups_of_an_obj_file_are_bodies(tmp_path: Path, before: str) -> None:
    """Also where they stand within a single object, and where the materials of a renderer run across them."""
    write(tmp_path / "objects.obj")
    text = (tmp_path / "objects.obj").read_text(encoding="utf-8").replace("\no ", "\ng ")
    lines = [f"usemtl {line[2:]}\n{line}" if line.startswith("g ") else line for line in text.splitlines()]
    (tmp_path / "device.obj").write_text(before + "\n".join(lines), encoding="utf-8")
    check_bodies(read_bodies(tmp_path / "device.obj", ["sleeve", "handle"]))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["sleeve"], r"device\.3mf: handle has no material\. Name .*; the file has: handle, sleeve\.$"),
        (["sleeve", "handle", "knob"], r"device\.3mf: knob is not in the file\. .* the file has: handle, sleeve\.$"),
        (["sleeve", "grip"], r"device\.3mf: grip is not in the file and handle has no material"),
    ],
)
def test_all_bodies_are_named(tmp_path: Path, names: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_bodies(write(tmp_path / "device.3mf"), names)


def test_an_open_body_is_named(tmp_path: Path) -> None:
    made = scene()
    made.geometry["sleeve"].update_faces(np.arange(len(SLEEVE.faces)) > 0)
    made.export(tmp_path / "device.3mf")
    with pytest.raises(InputError, match=r"device\.3mf, body sleeve: the mesh is open"):
        read_bodies(tmp_path / "device.3mf", ["sleeve", "handle"])


@pytest.mark.parametrize("factor", [0.001, 0.0393, 1000])
def test_a_device_of_an_unlikely_size_is_refused(factor: float) -> None:
    with pytest.raises(InputError, match=r"device\.stl: its longest edge is .* mm, but .* is to be in mm"):
        bounds_of([HANDLE.copy().apply_scale(factor)], "device.stl")
    assert bounds_of([HANDLE], "device.stl").tolist() == HANDLE.bounds.tolist()


def test_a_corner_that_lacks_a_coordinate(tmp_path: Path) -> None:
    lines = HANDLE.export(file_type="obj").splitlines(keepends=True)
    second = [number for number, line in enumerate(lines) if line.startswith("v ")][1]
    lines[second] = " ".join(lines[second].split()[:3]) + "\n"
    (tmp_path / "device.obj").write_text("".join(lines), encoding="utf-8")
    with pytest.raises(InputError, match=r"device\.obj: a corner lacks a coordinate"):
        read_mesh(tmp_path / "device.obj")


@pytest.mark.parametrize("change", [-25, 7])
def test_a_binary_stl_that_is_cut_off_or_too_long_is_told(tmp_path: Path, change: int) -> None:
    trimesh.creation.box((10, 10, 60)).export(tmp_path / "device.stl")
    content = (tmp_path / "device.stl").read_bytes()
    (tmp_path / "device.stl").write_bytes(content[:change] if change < 0 else content + b"\0" * change)
    with pytest.raises(InputError, match=r"counts 12 triangles, which take 684 bytes, and has"):
        read_mesh(tmp_path / "device.stl")


def ascii_stl(*names: str) -> str:
    """A body of 20 mm for each name, one beside the other."""
    text = ""
    for n, name in enumerate(names):
        body = trimesh.creation.box((20, 20, 20), transform=trimesh.transformations.translation_matrix([30 * n, 0, 0]))
        text += f"solid {name}\n"
        for corners, normal in zip(body.triangles, body.face_normals, strict=True):
            text += f"facet normal {normal[0]} {normal[1]} {normal[2]}\nouter loop\n"
            text += "".join(f"vertex {x:.3f} {y:.3f} {z:.3f}\n" for x, y, z in corners) + "endloop\nendfacet\n"
        text += f"endsolid {name}\n"
    return text


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1"])
def test_text_of_any_program_is_read(tmp_path: Path, encoding: str, ends: str) -> None:
    path = tmp_path / "device.stl"
    path.write_bytes(ascii_stl("Gerät", "Hülse").replace("\n", ends).encode(encoding))
    assert read_mesh(path).volume == pytest.approx(2 * 20**3)


@pytest.mark.parametrize("kept", [0.4, 0.9])
def test_an_stl_of_text_that_is_cut_off_is_told(tmp_path: Path, kept: float) -> None:
    """trimesh leaves a body that does not end out, and says nothing: of two the device would have kept one."""
    text = ascii_stl("handle", "sleeve")
    (tmp_path / "device.stl").write_text(text[: int(kept * len(text))], encoding="utf-8")
    with pytest.raises(InputError, match=r"has . `solid` and . `endsolid`: it is cut off"):
        read_mesh(tmp_path / "device.stl")


def test_numbers_with_a_comma_and_bytes_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "device.stl").write_text(ascii_stl("a").replace(".", ","), encoding="utf-8")
    with pytest.raises(InputError, match="its numbers have a comma"):
        read_mesh(tmp_path / "device.stl")
    for name in ("noise.stl", "noise.obj"):
        (tmp_path / name).write_bytes(np.random.default_rng(0).integers(1, 255, 3000).astype(np.uint8).tobytes())
        with pytest.raises(InputError, match="the mesh holds no triangle"):
            read_mesh(tmp_path / name)
