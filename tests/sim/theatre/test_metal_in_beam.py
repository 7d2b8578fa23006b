"""Devices of several materials: their parts fill the device, and are imaged at their own densities."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import centred_camera, rigid
from femoreg_torch.volume.materials import DENSITIES
from sim.physics.line_integrals import areal_solids, device_density, solid_of, together
from sim.physics.materials import metal_density
from sim.theatre.device import PARTS, make_device, make_device_parts
from sim.theatre.metal import draw_materials, metal_in_beam, table_solids, united
from sim.theatre.settings import load_simulation

CAMERA = centred_camera(1000.0, (3.0, 3.0), (96, 96))
POSE = rigid(translation=torch.tensor([0.0, 0.0, 600.0], dtype=torch.float64))


@pytest.fixture(scope="module")
def acquisition():
    return load_simulation("paper").acquisition


@pytest.mark.parametrize("seed", [0, 1, 301, 1002])
def test_parts_are_closed_disjoint_and_fill_the_device(seed: int) -> None:
    device, parts = make_device(seed)[0], make_device_parts(seed)
    assert set(parts) == set(PARTS)
    assert all(part.is_volume for part in parts.values())
    volume = sum(part.volume for part in parts.values())
    assert volume == pytest.approx(device.volume, rel=0.005)
    whole = trimesh.boolean.union(list(parts.values()))
    assert whole.volume == pytest.approx(volume, rel=1e-6)  # so no two of them overlap
    assert trimesh.boolean.union([whole, device]).volume == pytest.approx(volume, rel=1e-6)  # nor does one stand out
    assert np.allclose(whole.bounds, device.bounds)


def test_the_sleeve_has_its_flange_and_the_arm_its_knob() -> None:
    parts = make_device_parts(1)
    points = make_device(1)[1]
    assert parts["sleeve"].bounds[1, 2] == pytest.approx(points["tip"][2].item())
    assert parts["sleeve"].extents[0] > 13  # wider than any tube: the flange
    assert parts["arm"].bounds[1, 1] == pytest.approx(22, abs=1)  # where the knob ends


def test_materials_belong_to_the_seed_and_differ() -> None:
    assert draw_materials(3) == draw_materials(3)
    drawn = [draw_materials(seed) for seed in range(200)]
    assert {materials["sleeve"] for materials in drawn} == {"steel", "titanium", "cobalt chromium"}
    others = [{material for name, material in materials.items() if name != "sleeve"} for materials in drawn]
    assert set.union(*others) == {"steel", "titanium", "aluminium", "pmma", "peek"}
    assert min(map(len, others)) == 2


def test_parts_of_one_material_weigh_what_the_device_weighs() -> None:
    """All parts of steel are the whole device of steel."""
    device, parts = make_device(1)[0], make_device_parts(1)
    apart = areal_solids([solid_of(part, "steel") for part in parts.values()], POSE, CAMERA)
    whole = areal_solids([solid_of(device, "steel")], POSE, CAMERA)
    assert set(apart) == {"steel"}
    assert whole["steel"].max() > 8
    torch.testing.assert_close(apart["steel"], whole["steel"], atol=1e-3, rtol=0)


def test_a_block_has_the_density_of_its_material() -> None:
    block = trimesh.creation.box((40, 40, 20))
    areal = areal_solids([solid_of(block, "aluminium")], POSE, CAMERA)["aluminium"]
    assert areal[47:49, 47:49].mean().item() == pytest.approx(2.0 * DENSITIES["aluminium"], rel=1e-4)


def test_as_the_presets_say_the_device_is_titanium_alone(acquisition) -> None:
    mesh, _ = make_device(2)
    metal = metal_in_beam(mesh, 2, acquisition)
    assert metal.table == []
    (solid,) = metal.device
    assert solid.material == "titanium"
    assert solid.mesh.volume == pytest.approx(mesh.volume)
    assert solid.density == metal_density(5000)
    torch.testing.assert_close(solid.voxels(2.0).data, device_density(mesh, 2.0, 5000).data)


def test_bodies_that_overlap_are_one_and_hollows_stay() -> None:
    pin, block = trimesh.creation.cylinder(3, 40), trimesh.creation.box((20, 20, 20))
    both = united(trimesh.util.concatenate([pin, block]))
    areal = areal_solids([solid_of(both, "steel")], POSE, CAMERA)["steel"]
    assert areal[47:49, 47:49].mean().item() == pytest.approx(4.0 * DENSITIES["steel"], rel=1e-4)
    beside = trimesh.creation.box((20, 20, 20), transform=trimesh.transformations.translation_matrix((0, 0, 20)))
    touching = trimesh.util.concatenate([block, beside])
    touching.merge_vertices()
    areal = areal_solids([solid_of(united(touching), "steel")], POSE, CAMERA)["steel"]
    assert areal[47:49, 47:49].mean().item() == pytest.approx(4.0 * DENSITIES["steel"], rel=1e-4)
    hollow = trimesh.creation.box((10, 10, 10))
    hollow.invert()
    shell = trimesh.util.concatenate([block, hollow])
    areal = areal_solids([solid_of(united(shell), "steel")], POSE, CAMERA)["steel"]
    assert areal[47:49, 47:49].mean().item() == pytest.approx(1.0 * DENSITIES["steel"], rel=1e-4)


def test_a_body_inside_out_beside_others_has_no_shadow() -> None:
    block, other = trimesh.creation.box((20, 20, 20)), trimesh.creation.box((5, 5, 5))
    other.invert()
    other.apply_translation((40, 0, 0))
    areal = areal_solids([solid_of(united(trimesh.util.concatenate([block, other])), "steel")], POSE, CAMERA)["steel"]
    alone = areal_solids([solid_of(block, "steel")], POSE, CAMERA)["steel"]
    assert torch.equal(areal, alone)


def test_a_mixed_device_is_that_of_its_seed(acquisition) -> None:
    mesh, _ = make_device(2)
    mixed = replace(acquisition, device_materials="mixed")
    metal = metal_in_beam(mesh, 2, mixed)
    assert [solid.material for solid in metal.device] == list(draw_materials(2).values())
    for solid in metal.device:
        assert solid.density == DENSITIES[solid.material]
        assert solid.voxels(1.0).data.max().item() == pytest.approx(DENSITIES[solid.material], rel=1e-5)
    with pytest.raises(InputError, match="seed 3"):
        metal_in_beam(mesh, 3, mixed)


def test_parts_of_the_table_are_seen_in_the_first_view(acquisition) -> None:
    camera = centred_camera(1020.0, (298 / 384, 298 / 384), (384, 384))  # a wire is as wide as a pixel and more
    here = torch.eye(4, dtype=torch.float64)
    for seed in range(3):
        areal = areal_solids(table_solids(seed), here, camera)
        assert set(areal) == {"steel", "aluminium"}
        assert (areal["steel"] > 0).any(1).all()  # the wire crosses every row
        assert (areal["aluminium"] > 1).sum() > 320


def test_what_is_together_adds_up_by_material() -> None:
    one, two = torch.rand(2, 4, 4)
    found = together({"water": one}, {"steel": two}, {"steel": one})
    assert list(found) == ["water", "steel"]
    assert torch.equal(found["water"], one)
    assert torch.equal(found["steel"], two + one)
