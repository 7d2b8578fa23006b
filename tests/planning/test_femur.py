"""Calibration, laws, the femur's frame and its model, against numbers that are known otherwise; and bad input."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from femoreg_torch.errors import InputError
from femoreg_torch.planning.calibration import Calibration, calibrate
from femoreg_torch.planning.element import CORNERS
from femoreg_torch.planning.femur import Femur, Frame, cut_out
from femoreg_torch.planning.laws import Material, bone_material
from femoreg_torch.planning.loading import make_loading
from femoreg_torch.planning.mesh import blocks
from femoreg_torch.planning.model import make_bone, make_model, with_cement
from femoreg_torch.planning.settings import CalibrationSettings, Planning, load_planning
from femoreg_torch.volume import Volume

Solids = tuple[Volume, Volume, np.ndarray]
UNCALIBRATED = Calibration("uncalibrated", 0.000887, 0.0633, {})
RIGHT_KIND = {"rods": [], "mineral": "ha", "air_fat_muscle_mg_cc": (-840.0, -80.0, 30.0)}


def test_rods_on_a_line_give_that_line() -> None:
    rods = [(float(hu), 0.8 * hu - 12) for hu in (-50, 10, 200, 400)]
    found = calibrate(np.zeros((2, 2, 2), np.float32), CalibrationSettings("phantom", rods, "k2hpo4", (0.0, 0.0, 0.0)))
    np.testing.assert_allclose([found.slope, found.intercept], [1.06 * 0.0008, (1.06 * -12 + 38.9) / 1000])


def test_air_fat_and_muscle_are_found_by_their_peaks(solids: Solids) -> None:
    noisy = solids[0].data.numpy() + np.random.default_rng(0).normal(0, 8, solids[0].data.shape)
    found = calibrate(noisy.astype(np.float32), CalibrationSettings("internal", **RIGHT_KIND))
    hu = np.array([value for value, _ in found.references.values()])
    np.testing.assert_allclose(hu, [-1000, -95, 50], atol=3)
    slope, intercept = np.polyfit(hu, [-840, -80, 30], 1)
    np.testing.assert_allclose([found.slope, found.intercept], [0.000887 * slope, (0.887 * intercept + 63.3) / 1000])


def test_padding_is_no_air_where_there_is_other_air(solids: Solids) -> None:
    hu = (solids[0].data.numpy() + np.random.default_rng(0).normal(0, 8, solids[0].data.shape)).astype(np.float32)
    settings = CalibrationSettings("internal", **RIGHT_KIND)
    padded = hu.copy()
    padded[:, :, :3] = -1024  # more of it at one value than of air at any
    assert calibrate(padded, settings).references["air"][0] == pytest.approx(-1000, abs=3)
    padded[hu < -900] = -1024  # a simulated CT, whose air is all of one value
    assert calibrate(padded, settings).references["air"][0] == -1024


def test_laws_at_densities_worked_out_by_hand(planning: Planning) -> None:
    keyak = bone_material(np.array([0.5]), planning.bone)
    np.testing.assert_allclose(keyak.modulus, 14900 * 0.27547628)  # 0.5 ** 1.86
    np.testing.assert_allclose(keyak.tension, 102 * 0.28717459)  # 0.5 ** 1.8
    morgan = bone_material(np.array([0.3]), dataclasses.replace(planning.bone, law="morgan"))
    np.testing.assert_allclose(morgan.modulus, 6850 * 0.35601255, rtol=1e-6)  # (0.3 / 0.6) ** 1.49
    np.testing.assert_allclose(morgan.compression / morgan.tension, 85 / 61)


def test_the_frame_is_that_of_the_solids(femur: Femur) -> None:
    frame = femur.frame
    np.testing.assert_allclose(frame.proximal, [0, 0, 1], atol=0.01)
    np.testing.assert_allclose(frame.lateral, [1, 0, 0], atol=0.02)
    np.testing.assert_allclose(frame.posterior, [0, 1, 0], atol=0.02)
    np.testing.assert_allclose(frame.shaft, [65, 0, 130], atol=0.5)
    assert frame.head_radius == pytest.approx(22, abs=1.5)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.7, 0.7, 3.0), (2.0, 2.0, 2.0)])
def test_the_radius_of_the_head_is_that_of_its_sphere_wherever_its_centre_lies(
    spacing: tuple[float, float, float],
) -> None:
    """A voxel belongs to the bone where its middle lies in a sphere, a shaft, or the neck between them."""
    shape = [round(size / edge) for size, edge in zip((150, 110, 260), spacing, strict=True)]
    points = np.moveaxis(np.indices(shape), 0, -1) * np.array(spacing)
    head, below = np.array([110.3, 55.2, 210.4]), np.array([60.0, 55.0, 175.0])
    share = np.clip((points - head) @ (below - head) / ((below - head) ** 2).sum(), 0, 1)
    mask = np.linalg.norm(points - head - share[..., None] * (below - head), axis=-1) < 13
    mask |= (np.hypot(points[..., 0] - 60, points[..., 1] - 55) < 15) & (points[..., 2] < 190)
    mask |= np.linalg.norm(points - head, axis=-1) <= 24
    affine = torch.diag(torch.tensor([*spacing, 1.0], dtype=torch.float64))
    volume = Volume(torch.from_numpy(mask.transpose(2, 1, 0).astype(np.float32)), affine)
    found = cut_out(volume, volume, 1, head, "right", 95.0)
    assert found.frame.head_radius == pytest.approx(24, abs=0.1)


def test_blocks_average_every_voxel_alike(femur: Femur) -> None:
    whole = tuple(n // 3 * 3 for n in femur.mask.shape)
    cut = dataclasses.replace(femur, mask=femur.mask[: whole[0], : whole[1], : whole[2]])
    values = np.random.default_rng(1).random(whole)
    grid = blocks(cut, 6.0)
    expected = values.reshape(whole[0] // 3, 3, whole[1] // 3, 3, whole[2] // 3, 3).mean((1, 3, 5))
    np.testing.assert_allclose(grid.mean(values), expected)
    np.testing.assert_allclose(grid.mean(grid.spread(expected)), expected)
    np.testing.assert_allclose(grid.octants(values).mean(-1), expected)
    odd = blocks(femur, 5.0)
    np.testing.assert_allclose(odd.mean(np.flip(femur.mask, 0)), np.flip(odd.mean(femur.mask), 0))


def test_eighths_of_elements_stand_in_the_order_of_corners(femur: Femur) -> None:
    """Blocks of two voxels' edge: each eighth is one voxel."""
    even = tuple(n // 2 * 2 for n in femur.mask.shape)
    cut = dataclasses.replace(femur, mask=femur.mask[: even[0], : even[1], : even[2]])
    values = np.random.default_rng(1).random(even)
    grid = blocks(cut, 4.0)
    found = grid.octants(values)
    for n, (x, y, z) in enumerate(CORNERS):
        np.testing.assert_allclose(found[..., n], values[x::2, y::2, z::2])
    np.testing.assert_allclose(grid.spread_octants(found), values)


def test_the_mesh_has_the_volume_of_the_label(femur: Femur, planning: Planning) -> None:
    bone = make_bone(femur, UNCALIBRATED, planning)
    model = make_model(bone, planning, 4.0)
    kept = femur.mask.copy()
    z = np.arange(kept.shape[2]) * 2 + femur.lps_from_index[2, 3]
    kept[:, :, z < 130 - 95] = False
    assert model.fill.mean(1).sum() * 4**3 == pytest.approx(kept.sum() * 2**3, rel=0.02)
    np.testing.assert_array_equal(model.voxels, kept)


def test_what_is_shared_out_keeps_its_sum_and_its_middle(femur: Femur, planning: Planning) -> None:
    mesh = make_model(make_bone(femur, UNCALIBRATED, planning), planning, 6.0).mesh
    rng = np.random.default_rng(2)
    points = mesh.centres[rng.integers(0, len(mesh.cells), 200)] + rng.uniform(-3, 3, (200, 3))
    amounts = rng.random(200)
    shared = mesh.shared(points, amounts)
    assert shared.sum() == pytest.approx(amounts.sum())
    np.testing.assert_allclose(shared @ mesh.points, amounts @ points)
    beside = mesh.shared(mesh.points.max(0)[None] + 30, np.ones(1))
    assert beside.sum() == pytest.approx(1)
    assert beside.max() == pytest.approx(1)  # a corner of the nearest element


def test_pads_are_those_of_the_bone_on_every_mesh(femur: Femur, planning: Planning) -> None:
    """A sphere pressed on by a plane 6 mm beyond its top is met on a circle of π (r² − (r − 6)²)."""
    bone = make_bone(femur, UNCALIBRATED, planning)
    loadings = [make_loading(make_model(bone, planning, size), femur, planning.load) for size in (4.0, 5.0, 6.5)]
    pad = planning.load.pad_modulus_mpa / planning.load.pad_thickness_mm
    circle = np.pi * (22**2 - (22 - planning.load.pad_depth_mm) ** 2)
    for loading in loadings:
        assert loading.head.sum() / pad == pytest.approx(loadings[0].head.sum() / pad)
        assert loading.trochanter.sum() == pytest.approx(loadings[0].trochanter.sum())
        assert loading.span_mm == pytest.approx(loadings[0].span_mm)
    assert loadings[0].head.sum() / pad == pytest.approx(circle, rel=0.15)  # voxels of 2 mm


def test_cement_replaces_bone_voxel_by_voxel(femur: Femur, planning: Planning) -> None:
    bone = make_bone(femur, UNCALIBRATED, planning)
    model = make_model(bone, planning, 4.0)
    none = with_cement(model, bone, np.zeros(femur.mask.shape), planning.cement)
    np.testing.assert_allclose(none.modulus, model.material.modulus)
    full = with_cement(model, bone, np.ones(femur.mask.shape), planning.cement)
    deep = model.fill == 1
    np.testing.assert_allclose(full.modulus[deep], planning.cement.modulus_mpa)
    np.testing.assert_allclose(full.tension[deep], planning.cement.strength_mpa)


def test_an_eighth_of_two_kinds_of_bone_has_hills_average(femur: Femur, planning: Planning) -> None:
    """Layers of 30 and of 10 MPa, half and half: 20 MPa by Voigt, 15 MPa by Reuss; less bone bears as much less."""
    even = tuple(n // 4 * 4 for n in femur.mask.shape)
    cut = dataclasses.replace(femur, hu=femur.hu[: even[0], : even[1], : even[2]], mask=np.ones(even, bool))
    cut.mask[:, :, 1::4] = False  # half of the voxels of every second row of eighths
    layers = np.where(np.arange(even[0]) % 2 == 0, 30.0, 10.0)[:, None, None] * cut.mask
    bone = dataclasses.replace(make_bone(femur, UNCALIBRATED, planning), femur=cut, ash=layers)
    bone = dataclasses.replace(bone, material=Material(layers, 2 * layers, 3 * layers))
    uncut = dataclasses.replace(planning, mesh=dataclasses.replace(planning.mesh, shaft_mm=300.0))
    model = make_model(bone, uncut, 8.0)
    np.testing.assert_allclose(np.unique(model.fill.round(9)), [0.5, 1.0])
    for part, factor in ((model.material.modulus, 1), (model.material.tension, 2), (model.material.compression, 3)):
        np.testing.assert_allclose(part, factor * 17.5 * model.fill)


def test_cement_is_averaged_as_bone_is(femur: Femur, planning: Planning) -> None:
    """The same as a bone that has the mixed properties from the start, and untouched elements stay as they are."""
    bone = make_bone(femur, UNCALIBRATED, planning)
    model = make_model(bone, planning, 5.0)
    points = femur.points(np.argwhere(femur.mask))
    cement = np.zeros(femur.mask.shape)
    near = np.clip((16 - np.linalg.norm(points - (femur.frame.head + 20 * femur.frame.neck), axis=1)) / 4, 0, 1)
    cement[femur.mask] = near
    values = (planning.cement.modulus_mpa, planning.cement.strength_mpa, planning.cement.strength_mpa)
    parts = (bone.material.modulus, bone.material.tension, bone.material.compression)
    mixed = Material(*(old + cement * (new - old) * femur.mask for old, new in zip(parts, values, strict=True)))
    expected = make_model(dataclasses.replace(bone, material=mixed), planning, 5.0).material
    found = with_cement(model, bone, cement, planning.cement)
    untouched = (model.cement_share(cement) == 0).all(1)
    assert 50 < (~untouched).sum() < 0.5 * len(untouched)
    for name in ("modulus", "tension", "compression"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name))
        np.testing.assert_allclose(getattr(found, name)[untouched], getattr(model.material, name)[untouched])


def test_blocks_around_voxels_are_those_of_the_whole(femur: Femur) -> None:
    grid = blocks(femur, 5.0)
    there = np.zeros(femur.mask.shape, bool)
    there[10:15, 12, 20:33] = True
    part, first, box = grid.around(there)
    values = np.random.default_rng(4).random(femur.mask.shape)
    whole = grid.octants(values)
    cut = tuple(slice(a, a + n) for a, n in zip(first, part.shape, strict=True))
    np.testing.assert_allclose(part.octants(values[box]), whole[cut])
    touched = grid.mean(there) > 0
    assert touched[cut].sum() == touched.sum()
    index = np.argwhere(touched)
    np.testing.assert_allclose(part.centres(index - first), grid.centres(index))


def changed(labels: Volume, change: str) -> Volume:
    data = labels.data.clone()
    if change == "pieces":
        data[2:20, 2:8, 2:8] = 1
    elif change == "hollow":
        data[40:60, 17:23, 39:45] = 0
    elif change == "top":
        data = torch.cat([data[20:], data[:20]])[:56]
    elif change == "side":
        data = data.roll(12, dims=2)
        data[:, :, :6] = 0
    elif change == "short":
        data[:32] = 0
    elif change == "empty":
        data[:] = 0
    elif change == "shell":  # the cortex alone, with a gap of 2 mm in its medial wall
        data[torch.from_numpy(ndimage.binary_erosion(data.numpy(), iterations=2))] = 0
        data[:, 20, :42] = 0
    return Volume(data, labels.lps_from_index)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("pieces", "has 2 pieces, the second holds 648 voxels"),
        ("hollow", r"has holes of \d+ voxels"),
        ("top", "cut off by the CT at the top"),
        ("side", "cut off by the CT on the left"),
        ("short", "shows the left femur to 66 mm below"),
        ("empty", "no voxel of the left femur"),
        ("shell", r"has holes of \d+ voxels .* marrow belongs to the label"),
    ],
)
def test_a_bad_label_is_told_in_one_line(solids: Solids, change: str, message: str) -> None:
    ct, labels, head = solids
    bad = changed(labels, change)
    ct = Volume(ct.data[: len(bad.data)], ct.lps_from_index)
    with pytest.raises(InputError, match=message) as caught:
        cut_out(ct, bad, 1, head, "left", 95.0)
    assert "\n" not in str(caught.value)


def test_a_whole_femur_is_taken_by_its_upper_end(solids: Solids, femur: Femur, planning: Planning) -> None:
    """Another 300 mm of shaft with condyles: the same frame, and elements down to the same level."""
    ct, labels, head = solids
    below = 150
    more = labels.data[:1].repeat(below, 1, 1)
    more[2:20, 6:34, 22:62] = 1  # condyles
    more[0] = 0
    lps = labels.lps_from_index.clone()
    lps[2, 3] -= 2.0 * below
    whole = Volume(torch.cat([more, labels.data]), lps)
    found = cut_out(Volume(torch.cat([ct.data[:1].repeat(below, 1, 1), ct.data]), lps), whole, 1, head, "left", 95.0)
    np.testing.assert_allclose(found.frame.proximal, femur.frame.proximal, atol=0.02)
    np.testing.assert_allclose(found.frame.shaft, femur.frame.shaft, atol=0.5)
    short, long = (make_model(make_bone(each, UNCALIBRATED, planning), planning, 4.0) for each in (femur, found))
    assert long.fill.sum() == pytest.approx(short.fill.sum(), rel=0.01)
    assert long.mesh.points[:, 2].min() == pytest.approx(short.mesh.points[:, 2].min(), abs=4)


def test_a_shaft_that_the_ct_cuts_askew_is_refused(solids: Solids) -> None:
    """A shaft leaning to the front: along it, the CT's end lies 107 mm below the head in front, 99 mm at the back."""
    ct, labels, head = solids
    data = labels.data.clone()
    depth = 15  # 30 mm above the end of the CT is 100 mm below the head's centre
    sheared = data[depth:].clone()
    for z in range(len(sheared)):
        sheared[z] = sheared[z].roll(-round(0.3 * max(0, 40 - z)), dims=0)  # rows are y
    lps = labels.lps_from_index.clone()
    lps[2, 3] += 2.0 * depth
    bent = Volume(sheared, lps)
    with pytest.raises(InputError, match="its last slice cuts the left femur askew") as caught:
        cut_out(Volume(ct.data[depth:], lps), bent, 1, head, "left", 102.0)
    assert "\n" not in str(caught.value)


def test_a_head_outside_the_label_is_refused(solids: Solids) -> None:
    with pytest.raises(InputError, match="does not lie in the label"):
        cut_out(solids[0], solids[1], 1, HEAD_OUTSIDE, "left", 95.0)


HEAD_OUTSIDE = np.array([20.0, 30.0, 130.0])


def test_no_calibration_is_told_in_one_line(solids: Solids) -> None:
    bone_only = np.full((20, 20, 20), 300.0, np.float32)
    with pytest.raises(InputError, match="no peak of air"):
        calibrate(bone_only, CalibrationSettings("internal", **RIGHT_KIND))
    with pytest.raises(InputError, match="at least two rods"):
        CalibrationSettings("phantom", [(0.0, 0.0)], "ha", (0.0, 0.0, 0.0))
    falling = CalibrationSettings("phantom", [(0.0, 100.0), (100.0, 0.0)], "ha", (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="density falls"):
        calibrate(bone_only, falling)


def test_uncalibrated_says_so(solids: Solids) -> None:
    found = calibrate(solids[0].data.numpy(), CalibrationSettings("uncalibrated", **RIGHT_KIND))
    assert found.kind == "uncalibrated"
    assert found.references == {}


def test_presets_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("extends: default\nmesh: {size_mm: 4}\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"mesh\.search_mm: at least mesh\.size_mm, 4, was expected, found 3"):
        load_planning(path)
    path.write_text("extends: default\nmesh: {size_mm: -3}\n", encoding="utf-8")
    with pytest.raises(InputError, match="size_mm"):
        load_planning(path)
    path.write_text("extends: default\npath: {polish: -1}\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"path\.polish: 0 or more was expected, found -1"):
        load_planning(path)
    path.write_text("extends: default\nmesh: {sise_mm: 3}\n", encoding="utf-8")
    with pytest.raises(InputError, match="sise_mm"):
        load_planning(path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("curve: {pistoia_share: 2}", r"curve\.pistoia_share: below 1 was expected"),
        ("load: {adduction_deg: 400}", r"load\.adduction_deg: −90 to 90 was expected, found 400"),
        ("load: {cap_mm: -1}", r"load\.cap_mm: 0 or more"),
        ("path: {angle_deg: 120}", r"path\.angle_deg: −90 to 90"),
        ("path: {target_mm: -3}", r"path\.target_mm: 0 or more"),
        ("distribution: {clearance_mm: -1}", r"distribution\.clearance_mm: 0 or more"),
        ("offsets: {distance_mm: 0}", r"offsets\.distance_mm: a number above 0"),
        ("diffusion: {voxel_mm: 20}", r"diffusion\.voxel_mm: at most 10 was expected, found 20"),
    ],
)
def test_settings_that_cannot_be_are_refused(tmp_path: Path, change: str, told: str) -> None:
    (tmp_path / "mine.yaml").write_text(f"extends: default\n{change}\n", encoding="utf-8")
    with pytest.raises(InputError, match=told):
        load_planning(tmp_path / "mine.yaml")


@pytest.mark.parametrize("slice_mm", [0.7, 2.0, 3.0])
def test_depth_is_counted_from_half_way_between_voxels_along_thick_slices_too(slice_mm: float) -> None:
    """A block whose faces lie half-way between voxels: on its middle line all depths are known."""
    spacing = np.array([0.7, 0.7, slice_mm])
    block = np.zeros((41, 41, 21), bool)
    block[5:-5, 5:-5, 5:-5] = True
    frame = Frame(np.zeros(3), 24.0, *(np.zeros(3),) * 4)
    depth = Femur("left", np.zeros(block.shape, np.float32), block, np.diag([*spacing, 1.0]), (0, 0, 0), frame).depth()
    for axis, size in enumerate(block.shape):
        turned = np.moveaxis(depth, axis, 0)
        line = turned[:, turned.shape[1] // 2, turned.shape[2] // 2]
        below = (np.arange(size // 2 + 1) - 4.5) * spacing[axis]
        near = below < 5 * 0.7  # nearer to this face than to any other
        np.testing.assert_allclose(line[: size // 2 + 1][near], below[near], atol=1e-6)
