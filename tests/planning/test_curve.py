"""Yield curves of a femur of simple solids: balance of forces, symmetries, rules of the yield load."""

import dataclasses

import numpy as np
import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.planning.calibration import Calibration
from femoreg_torch.planning.curve import Curve, Press
from femoreg_torch.planning.femur import Frame, cut_out
from femoreg_torch.planning.loading import force_direction, make_loading
from femoreg_torch.planning.model import Model, make_bone, make_model
from femoreg_torch.planning.settings import Planning
from femoreg_torch.volume import Volume

Solids = tuple[Volume, Volume, np.ndarray]
SIZE_MM = 6.0
UNCALIBRATED = Calibration("uncalibrated", 0.000887, 0.0633, {})


def pressed(solids: Solids, planning: Planning, side: str = "left") -> tuple[Model, Press]:
    ct, labels, head = solids
    femur = cut_out(ct, labels, 1, head, side, planning.mesh.shaft_mm)  # type: ignore[arg-type]
    model = make_model(make_bone(femur, UNCALIBRATED, planning), planning, SIZE_MM)
    loading = make_loading(model, femur, planning.load)
    return model, Press(model.mesh, loading, planning.bone.poisson)


@pytest.fixture(scope="module")
def press(solids: Solids, planning: Planning) -> tuple[Model, Press]:
    return pressed(solids, planning)


@pytest.fixture(scope="module")
def curve(press: tuple[Model, Press], planning: Planning) -> Curve:
    model, machine = press
    return machine.curve(model.material, planning.curve)


def test_the_head_is_pressed_as_hard_as_the_bone_is_held(press: tuple[Model, Press], curve: Curve) -> None:
    loading = press[1].loading
    _, held = loading.reactions(curve.last.u)
    np.testing.assert_allclose(
        held,
        -curve.last.load_n * loading.direction,
        atol=1e-3 * np.linalg.norm(loading.push(curve.last.displacement_mm)),
    )
    trochanter, _ = loading.reactions(curve.last.u)
    assert -trochanter @ loading.direction == pytest.approx(curve.last.load_n, rel=0.02)  # the cut gives way along it


def test_the_curve_starts_with_the_elastic_stiffness_and_ends_soft(curve: Curve, planning: Planning) -> None:
    assert curve.load_n[0] == 0
    slopes = np.diff(curve.load_n) / np.diff(curve.displacement_mm)
    assert slopes[0] <= curve.stiffness_n_mm * 1.0001
    assert slopes[-1] < planning.curve.stop_stiffness * curve.stiffness_n_mm * 1.05
    shifted = curve.stiffness_n_mm * (curve.yield_mm - planning.curve.offset_mm)
    assert curve.yield_load_n == pytest.approx(shifted)
    assert np.interp(curve.yield_mm, curve.displacement_mm, curve.load_n) == pytest.approx(shifted, rel=1e-3)
    assert 0 < curve.yield_energy_nmm < curve.yield_load_n * curve.yield_mm


def test_half_the_step_gives_the_same_yield_load(press: tuple[Model, Press], curve: Curve, planning: Planning) -> None:
    finer = press[1].curve(press[0].material, dataclasses.replace(planning.curve, step_mm=0.125))
    assert finer.yield_load_n == pytest.approx(curve.yield_load_n, rel=0.005)


def test_stronger_and_stiffer_bone_scales_the_curve(
    press: tuple[Model, Press], planning: Planning, curve: Curve
) -> None:
    """Strength alone twice as large: the same stiffness, and a load of nearly twice as much at twice the offset."""
    model, machine = press
    stronger = dataclasses.replace(
        model.material, tension=2 * model.material.tension, compression=2 * model.material.compression
    )
    found = machine.curve(stronger, dataclasses.replace(planning.curve, offset_mm=0.4, step_mm=0.5))
    assert found.stiffness_n_mm == pytest.approx(curve.stiffness_n_mm)
    assert found.yield_load_n == pytest.approx(2 * curve.yield_load_n, rel=1e-3)


def test_a_turned_patient_yields_at_the_same_load(solids: Solids, planning: Planning, curve: Curve) -> None:
    ct, labels, head = solids
    angle = 0.4
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.tensor(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]], dtype=torch.float64
    )
    turn[:3, 3] = torch.tensor([5.0, -30, 12])
    affine = turn @ ct.lps_from_index
    turned = (Volume(ct.data, affine), Volume(labels.data, affine), (turn[:3, :3].numpy() @ head) + turn[:3, 3].numpy())
    model, machine = pressed(turned, planning)
    assert machine.curve(model.material, planning.curve).yield_load_n == pytest.approx(curve.yield_load_n, rel=1e-4)


def test_a_mirrored_patient_yields_at_the_same_load(solids: Solids, planning: Planning, curve: Curve) -> None:
    ct, labels, head = solids
    affine = ct.lps_from_index.clone()
    affine[0, 3] = -(affine[0, 3] + 2.0 * (ct.data.shape[2] - 1))
    mirrored = tuple(Volume(v.data.flip(2).contiguous(), affine) for v in (ct, labels))
    model, machine = pressed((*mirrored, head * [-1, 1, 1]), planning, "right")
    found = machine.curve(model.material, planning.curve)
    assert found.yield_load_n == pytest.approx(curve.yield_load_n, rel=1e-4)


def test_a_finer_mesh_carries_a_similar_load(solids: Solids, planning: Planning, curve: Curve) -> None:
    ct, labels, head = solids
    femur = cut_out(ct, labels, 1, head, "left", planning.mesh.shaft_mm)
    model = make_model(make_bone(femur, UNCALIBRATED, planning), planning, 4.8)
    machine = Press(model.mesh, make_loading(model, femur, planning.load), planning.bone.poisson)
    found = machine.curve(model.material, planning.curve)
    assert found.yield_load_n == pytest.approx(curve.yield_load_n, rel=0.1)


def test_the_load_hardly_hangs_on_where_elements_fall(solids: Solids, planning: Planning, curve: Curve) -> None:
    """A box with two voxels less at its right and front moves all elements by 2 of their 6 mm to the left and back."""
    ct, labels, head = solids
    femur = cut_out(ct, labels, 1, head, "left", planning.mesh.shaft_mm)
    affine = femur.lps_from_index.copy()
    affine[:3, 3] += affine[:3, :3] @ [2.0, 2.0, 0.0]
    moved = dataclasses.replace(femur, hu=femur.hu[2:, 2:], mask=femur.mask[2:, 2:], lps_from_index=affine)
    assert moved.mask.sum() == femur.mask.sum()
    model = make_model(make_bone(moved, UNCALIBRATED, planning), planning, SIZE_MM)
    machine = Press(model.mesh, make_loading(model, moved, planning.load), planning.bone.poisson)
    found = machine.curve(model.material, planning.curve)
    assert found.yield_load_n == pytest.approx(curve.yield_load_n, rel=0.03)


@pytest.mark.parametrize("rule", ["displacement", "pistoia"])
def test_other_rules_of_the_yield_load(press: tuple[Model, Press], planning: Planning, curve: Curve, rule: str) -> None:
    model, machine = press
    found = machine.curve(model.material, dataclasses.replace(planning.curve, rule=rule, step_mm=0.5))
    if rule == "displacement":
        assert found.yield_mm == pytest.approx(0.04 * machine.loading.span_mm)
        assert found.yield_load_n > curve.yield_load_n
    else:
        u, stiffness, _ = machine.elastic(model.material)
        modulus = machine.hardened(model.material).modulus.mean(1)
        density = machine.energy(model.material, u * found.yield_load_n / stiffness).sum(1) / SIZE_MM**3
        beyond = np.sqrt(2 * density / modulus)[~machine.loading.caps.any(1)] > planning.curve.pistoia_strain
        assert beyond.mean() == pytest.approx(planning.curve.pistoia_share, abs=0.002)


def test_tension_and_compression_of_their_own_converge(solids: Solids, planning: Planning) -> None:
    morgan = dataclasses.replace(
        planning,
        bone=dataclasses.replace(planning.bone, law="morgan"),
        curve=dataclasses.replace(planning.curve, step_mm=0.5),
    )
    model, machine = pressed(solids, morgan)
    found = machine.curve(model.material, morgan.curve)
    weak, strong = (
        dataclasses.replace(model.material, tension=part, compression=part)
        for part in (model.material.tension, model.material.compression)
    )
    low, high = (machine.curve(part, morgan.curve).yield_load_n for part in (weak, strong))
    assert low < found.yield_load_n < high


def test_stance_needs_no_trochanter(solids: Solids, planning: Planning) -> None:
    stance = dataclasses.replace(planning, load=dataclasses.replace(planning.load, kind="stance"))
    model, machine = pressed(solids, stance)
    assert (machine.loading.trochanter == 0).all()
    u, stiffness, _ = machine.elastic(model.material)
    assert stiffness > 0
    _, held = machine.loading.reactions(u)
    np.testing.assert_allclose(held, -stiffness * machine.loading.direction, atol=1e-4 * stiffness)


def test_the_force_leans_as_its_angles_say(planning: Planning) -> None:
    frame = Frame(np.zeros(3), 22.0, np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.ones(3))
    straight = dataclasses.replace(planning.load, adduction_deg=0.0, internal_rotation_deg=0.0)
    np.testing.assert_allclose(force_direction(frame, straight), [1, 0, 0])
    turned = force_direction(frame, dataclasses.replace(straight, internal_rotation_deg=90.0))
    np.testing.assert_allclose(turned, [0, 1, 0], atol=1e-12)  # the head goes to the back
    np.testing.assert_allclose(
        force_direction(frame, dataclasses.replace(straight, adduction_deg=90.0)), [0, 0, 1], atol=1e-12
    )
    stance = force_direction(frame, dataclasses.replace(straight, kind="stance", stance_deg=0.0))
    np.testing.assert_allclose(stance, [0, 0, -1])


def test_a_pad_that_hardly_gives_way_changes_the_load_by_little(
    solids: Solids, planning: Planning, curve: Curve
) -> None:
    stiff = dataclasses.replace(planning, load=dataclasses.replace(planning.load, pad_thickness_mm=0.001))
    model, machine = pressed(solids, stiff)
    assert machine.curve(model.material, planning.curve).yield_load_n == pytest.approx(curve.yield_load_n, rel=0.1)


def test_what_does_not_converge_is_told_in_one_line(press: tuple[Model, Press], planning: Planning) -> None:
    model, machine = press
    with pytest.raises(InputError, match="does not come to rest"):
        machine.curve(model.material, dataclasses.replace(planning.curve, newton_steps=1))
    with pytest.raises(InputError, match=r"has not yielded at 0\.5 mm"):
        machine.curve(model.material, dataclasses.replace(planning.curve, longest_mm=0.5))


def test_a_mesh_beyond_memory_is_refused(solids: Solids, planning: Planning) -> None:
    ct, labels, head = solids
    bone = make_bone(cut_out(ct, labels, 1, head, "left", 95.0), UNCALIBRATED, planning)
    with pytest.raises(InputError, match=r"mesh.size_mm: 2 makes \d+ elements, more than 1000"):
        make_model(
            bone, dataclasses.replace(planning, mesh=dataclasses.replace(planning.mesh, most_elements=1000)), 2.0
        )
