"""Voxelised solids against their closed forms."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from femoreg_torch.errors import InputError
from femoreg_torch.volume import check_closed, read_mesh, voxelise_mesh

MU = 6000 * 2.6828e-5  # 5000 HU above air, 1/mm


def test_a_ball_keeps_its_volume_place_and_attenuation() -> None:
    ball = trimesh.creation.icosphere(5, 12.3)
    ball.apply_translation([3.1, -40.2, 7.7])
    volume = voxelise_mesh(ball, 0.5, 5000)
    assert volume.spacing_mm == (0.5, 0.5, 0.5)
    share = volume.data.double() / MU
    assert share.max() == pytest.approx(1, abs=1e-6)
    assert share.sum() * 0.5**3 == pytest.approx(4 / 3 * math.pi * 12.3**3, rel=3e-3)
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in share.shape), indexing="ij")
    points = torch.stack([x, y, z], -1) @ volume.lps_from_index[:3, :3].T + volume.lps_from_index[:3, 3]
    radius = (points - torch.tensor([3.1, -40.2, 7.7], dtype=torch.float64)).norm(dim=-1)
    half_diagonal = 0.5 * math.sqrt(3) / 2
    assert (share[radius < 12.2 - half_diagonal] > 1 - 1e-6).all()
    assert (share[radius > 12.3 + half_diagonal] == 0).all()
    edge = (radius - 12.3).abs() < 0.05
    assert share[edge].mean() == pytest.approx(0.5, abs=0.03)


def test_edges_of_a_box_hold_the_share_that_is_inside() -> None:
    box = trimesh.creation.box((10.0, 6.0, 4.4))
    volume = voxelise_mesh(box, 1.0, 5000)
    profile = volume.data[:, volume.data.shape[1] // 2, volume.data.shape[2] // 2] / MU
    assert profile.sum() == pytest.approx(4.4, abs=1e-5)  # exact along z
    assert (volume.data / MU).sum() == pytest.approx(10 * 6 * 4.4, rel=1e-6)


def test_overlapping_solids_are_one_solid() -> None:
    parts = trimesh.util.concatenate([trimesh.creation.box((10, 10, 10)), trimesh.creation.box((4, 4, 30))])
    volume = voxelise_mesh(parts, 0.5, 5000)
    assert (volume.data / MU).sum() * 0.125 == pytest.approx(1000 + 16 * 20, rel=1e-6)


def test_inward_normals_are_turned(tmp_path: Path) -> None:
    box = trimesh.creation.box((10, 6, 4))
    box.invert()
    box.export(tmp_path / "device.stl")
    assert read_mesh(tmp_path / "device.stl").volume == pytest.approx(240)


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "off"])
def test_mesh_formats(tmp_path: Path, suffix: str) -> None:
    trimesh.creation.icosphere(2, 5).export(tmp_path / f"device.{suffix}")
    mesh = read_mesh(tmp_path / f"device.{suffix}")
    assert np.allclose(mesh.extents, 10, atol=0.3)


def test_an_open_mesh_is_refused(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(2, 5)
    ball.update_faces(np.arange(len(ball.faces)) > 3)
    ball.export(tmp_path / "device.stl")
    with pytest.raises(InputError, match=r"device\.stl: the mesh is open"):
        read_mesh(tmp_path / "device.stl")
    with pytest.raises(InputError, match="open"):
        voxelise_mesh(ball, 0.5, 5000)


def test_bodies_of_an_assembly_may_touch_in_a_face_or_an_edge(tmp_path: Path) -> None:
    places = [(0, 0, 0), (10, 0, 0), (10, 10, 0), (20, 20, 0)]  # a wall between the first three, then only an edge
    boxes = [trimesh.creation.box((10, 10, 10), transform=np.eye(4)).apply_translation(place) for place in places]
    trimesh.util.concatenate(boxes).export(tmp_path / "device.stl")
    mesh = read_mesh(tmp_path / "device.stl")
    assert not mesh.is_watertight  # by trimesh, for whom an edge joins two faces
    volume = voxelise_mesh(mesh, 0.5, 5000)
    assert (volume.data / MU).sum() * 0.125 == pytest.approx(4000, rel=1e-6)
    assert (volume.data / MU).max() == pytest.approx(1)


def _block(size: float, at: tuple[float, float, float], *, inside_out: bool = False) -> trimesh.Trimesh:
    block = trimesh.creation.box((size, size, size)).apply_translation(at)
    if inside_out:
        block.invert()
    return block


@pytest.mark.parametrize("place", [(30, 0, 0), (5, 5, 10), (0, 0, 200)])  # apart, or with a corner in it, or far away
def test_a_body_that_is_inside_out_beside_others_is_turned(tmp_path: Path, place: tuple[float, float, float]) -> None:
    bodies = [_block(20, (0, 0, 0)), _block(9, place, inside_out=True), _block(3, (-40, 0, 0))]
    trimesh.util.concatenate(bodies).export(tmp_path / "device.stl")
    mesh = read_mesh(tmp_path / "device.stl")
    bodies[1].invert()
    rightly = trimesh.util.concatenate(bodies)
    assert mesh.volume == pytest.approx(rightly.volume)
    assert torch.equal(voxelise_mesh(mesh, 0.5, 5000).data, voxelise_mesh(rightly, 0.5, 5000).data)


def test_a_hollow_stays_one_and_what_floats_in_it_is_solid(tmp_path: Path) -> None:
    bodies = [_block(20, (0, 0, 0)), _block(10, (1, 1, 1), inside_out=True), _block(4, (1, 1, 1))]
    trimesh.util.concatenate(bodies).export(tmp_path / "device.stl")
    assert read_mesh(tmp_path / "device.stl").volume == pytest.approx(8000 - 1000 + 64)


def test_a_body_that_stands_twice_in_a_file_is_left_once(tmp_path: Path) -> None:
    bodies = [_block(20, (0, 0, 0)), _block(9, (30, 0, 0)), _block(9, (30, 0, 0))]
    trimesh.util.concatenate(bodies).export(tmp_path / "device.stl")
    assert read_mesh(tmp_path / "device.stl").volume == pytest.approx(8000 + 729)


@pytest.mark.parametrize("suffix", [".3mf", ".glb", ".stl"])
def test_a_body_that_stands_twice_under_two_names_is_left_once(tmp_path: Path, suffix: str) -> None:
    """Its triangles may come in another order, and begin with another corner. A third one lies elsewhere."""
    bodies = {"a": _block(20, (0, 0, 0)), "b": _block(20, (0, 0, 0)), "c": _block(20, (7, 0, 0))}
    bodies["b"].faces = np.roll(bodies["b"].faces[::-1], 1, 1)
    path = tmp_path / f"device{suffix}"
    if suffix == ".stl":
        texts = (trimesh.exchange.stl.export_stl_ascii(body) for body in bodies.values())
        path.write_text("\n".join(texts), encoding="utf-8")
    else:
        scene = trimesh.Scene()
        for name, body in bodies.items():
            body = body.copy().apply_scale(1e-3) if suffix == ".glb" else body
            scene.add_geometry(body, node_name=name, geom_name=name)
        scene.units = "m" if suffix == ".glb" else "mm"
        scene.export(path)
    assert read_mesh(path).volume == pytest.approx(2 * 8000, rel=1e-4)


def test_a_wall_that_two_nested_bodies_share_is_kept() -> None:
    outer, inner = _block(20, (0, 0, 0)), _block(20, (0, 0, 0))
    inner.vertices[inner.vertices[:, 0] > 0, 0] = 4.0  # five of its walls lie in the other's, one of them alike
    both = trimesh.util.concatenate([outer, inner])
    both.merge_vertices()
    volume = voxelise_mesh(check_closed(both, "model"), 0.5, 5000)
    assert (volume.data / MU).sum() * 0.125 == pytest.approx(8000, rel=1e-5)


def test_triangles_without_an_area_are_left_out(tmp_path: Path) -> None:
    box = trimesh.creation.box((10, 6, 4))
    corner, other = box.vertices[box.faces[0, :2]]
    sliver = trimesh.Trimesh([corner, corner + 1e-12, other], [[0, 1, 2]], process=False)
    trimesh.util.concatenate([box, sliver]).export(tmp_path / "device.stl")
    assert read_mesh(tmp_path / "device.stl").volume == pytest.approx(240)


def test_faces_that_disagree_are_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box((10, 6, 4))
    faces = box.faces.copy()
    faces[0] = faces[0, ::-1]
    trimesh.Trimesh(box.vertices, faces, process=False).export(tmp_path / "device.stl")
    with pytest.raises(InputError, match="disagree about which side is out"):
        read_mesh(tmp_path / "device.stl")


@pytest.mark.parametrize("content", [b"", b"solid nothing\nendsolid nothing\n", b"\x00\x01garbage" * 3])
def test_what_is_no_mesh_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "device.stl").write_bytes(content)
    with pytest.raises(InputError, match=r"device\.stl"):
        read_mesh(tmp_path / "device.stl")
    with pytest.raises(InputError, match="no such file"):
        read_mesh(tmp_path / "other.stl")


@pytest.mark.filterwarnings("error")
def test_a_flat_mesh_encloses_nothing_and_a_thin_wire_something() -> None:
    """A box without a width, closed as it is (fuzz, seed 177), and a wire of 0.1 mm and 300 mm."""
    flat = trimesh.creation.box((0.0, 10.0, 60.0))
    with pytest.raises(InputError, match=r"^model: the mesh is flat and encloses nothing\."):
        check_closed(flat, "model")
    wire = trimesh.creation.cylinder(radius=0.05, height=300.0)
    assert check_closed(wire, "model") is wire
