"""Patients around closed surfaces: voxels against closed forms, landmarks against those of distance fields."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from skimage.measure import marching_cubes

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.segment.rules import find_surface_landmarks
from femoreg_torch.volume import read_ct, read_labels, read_landmarks
from sim.commands import around_surfaces
from sim.patient.around_surfaces import Options, read_surfaces
from sim.patient.around_surfaces.surfaces import BONES
from sim.patient.around_surfaces.voxels import block_mean, halved_voxels, inside_surface
from sim.patient.landmarks import find_landmarks
from sim.patient.parameters import draw_parameters
from sim.patient.procedural.bones import build_skeleton
from sim.patient.skeleton import Skeleton


@pytest.fixture(scope="module")
def skeleton() -> Skeleton:
    rng = np.random.default_rng(5)
    return build_skeleton(draw_parameters(rng), rng)


@pytest.fixture(scope="module")
def surfaces(skeleton: Skeleton) -> dict[str, trimesh.Trimesh]:
    """The bones' surfaces as triangles of about 3 mm."""
    meshes = {}
    for bone in BONES:
        field = skeleton.bones[bone]
        vertices, faces, _, _ = marching_cubes(np.pad(field.values, 1, constant_values=9.0), 0.0, step_size=2)
        meshes[bone] = trimesh.Trimesh((vertices - 1) * field.step + field.lo, faces)
        meshes[bone].fix_normals()
    return meshes


def _written(path: Path, meshes: dict[str, trimesh.Trimesh]) -> Path:
    arrays = {f"{bone}_vertices": mesh.vertices for bone, mesh in meshes.items()}
    np.savez(path, **arrays, **{f"{bone}_faces": mesh.faces for bone, mesh in meshes.items()}, licence="none")
    return path


def test_voxels_inside_a_box_are_those_whose_centres_are() -> None:
    box = trimesh.creation.box(bounds=[[-3.1, -2.2, 0.4], [4.3, 5.2, 6.6]])
    first, spacing = np.array([-5.0, -4.0, -1.0]), 0.5
    inside = inside_surface(box, first, (24, 22, 20), spacing)
    x, y, z = (first[k] + spacing * np.arange(n) for k, n in enumerate((24, 22, 20)))
    expected = ((x > -3.1) & (x < 4.3))[:, None, None] & ((y > -2.2) & (y < 5.2))[:, None] & ((z > 0.4) & (z < 6.6))
    assert np.array_equal(inside, expected)


def test_a_hollow_ball_has_its_volume() -> None:
    outer, inner = (trimesh.creation.icosphere(4, radius) for radius in (20.0, 12.0))
    inner.invert()
    shell = trimesh.util.concatenate([outer, inner])
    inside = inside_surface(shell, np.full(3, -22.0), (88, 88, 88), 0.5)
    assert set(np.unique(inside)) == {0, 1}
    assert inside.sum() * 0.125 == pytest.approx(shell.volume, rel=2e-3)
    assert block_mean(inside).sum() == pytest.approx(shell.volume, rel=2e-3)


def test_halved_voxels_keep_a_ramp_and_the_mean() -> None:
    ramp = np.arange(6, dtype=np.float32)[:, None, None] + np.zeros((6, 3, 2), np.float32)
    fine = halved_voxels(ramp)
    assert fine.shape == (12, 6, 4)
    assert fine[1:-1, 0, 0].tolist() == pytest.approx((np.arange(1, 11) / 2 - 0.25).tolist())
    assert np.allclose(block_mean(fine)[1:-1], ramp[1:-1])


def test_landmarks_are_those_of_the_distance_fields(skeleton: Skeleton, surfaces: dict[str, trimesh.Trimesh]) -> None:
    """The same rules by other means: vertices and silhouettes here, fields and shadows of them there."""
    found, expected = find_surface_landmarks(surfaces), find_landmarks(skeleton)
    assert tuple(found.points) == HIP.landmark_names
    off = {name: float(np.linalg.norm(point - expected[name])) for name, point in found.points.items()}
    assert max(off["FH-l"], off["FH-r"]) < 0.3
    assert np.median(list(off.values())) < 2, off
    assert max(off.values()) < 8, off
    for side in ("left", "right"):
        assert found.head_radius[side] == pytest.approx(skeleton.head_radius, abs=0.3)


def test_a_file_that_does_not_fit_is_named(surfaces: dict[str, trimesh.Trimesh], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        read_surfaces(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no archive", encoding="utf-8")
    with pytest.raises(InputError, match="NumPy archive"):
        read_surfaces(tmp_path / "text.npz")
    few = {bone: mesh for bone, mesh in surfaces.items() if bone != "sacrum"}
    with pytest.raises(InputError, match="sacrum_vertices"):
        read_surfaces(_written(tmp_path / "few.npz", few))
    hole = trimesh.Trimesh(surfaces["sacrum"].vertices, surfaces["sacrum"].faces[1:], process=False)
    with pytest.raises(InputError, match="sacrum: the mesh is open"):
        read_surfaces(_written(tmp_path / "open.npz", surfaces | {"sacrum": hole}))
    for factor in (0.001, 1000.0):
        scaled = trimesh.Trimesh(surfaces["femur_left"].vertices * factor, surfaces["femur_left"].faces, process=False)
        with pytest.raises(InputError, match=r"femur_left_vertices.*Are they in mm"):
            read_surfaces(_written(tmp_path / "scaled.npz", surfaces | {"femur_left": scaled}))
    swapped = surfaces | {"femur_left": surfaces["femur_right"], "femur_right": surfaces["femur_left"]}
    with pytest.raises(InputError, match="left femoral head"):
        find_surface_landmarks(swapped)
    whole = read_surfaces(_written(tmp_path / "whole.npz", surfaces))
    assert (whole.name, whole.licence, whole.role) == ("whole", "none", "unknown")


@pytest.mark.parametrize(
    ("option", "value"), [("seed", -1), ("spacing_mm", 0.75), ("osteoporotic", 0.0), ("below_mm", 50)]
)
def test_an_option_out_of_range_is_named(option: str, value: float) -> None:
    with pytest.raises(InputError, match=option.removesuffix("_mm")):
        Options(**{option: value})  # type: ignore[arg-type]


@pytest.mark.long
def test_the_patient_is_the_one_that_was_made_before(data_folder: Path, tmp_path: Path) -> None:
    """The volumes of `cases/bmf` were made by another program: VTK's stencils instead of counted crossings."""
    around_surfaces(data_folder / "meshes" / "bmf.npz", out=tmp_path / "bmf")
    known, made = data_folder / "cases" / "bmf", tmp_path / "bmf"
    ct = read_ct(known / "ct.nii.gz")
    again = read_ct(made / "ct.nii.gz")
    assert torch.equal(again.data, ct.data)
    assert torch.equal(again.lps_from_index, ct.lps_from_index)
    labels, landmarks = read_labels(known / "labels.nii.gz", ct), read_landmarks(known / "landmarks.json")
    assert torch.equal(read_labels(made / "labels.nii.gz", again).data, labels.data)
    assert all(torch.equal(point, landmarks[name]) for name, point in read_landmarks(made / "landmarks.json").items())
