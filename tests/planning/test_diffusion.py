"""Cement in a block of spongy bone: spheres, ellipsoids, conserved volume."""

import dataclasses

import numpy as np
import pytest

from femoreg_torch.errors import InputError
from femoreg_torch.planning.calibration import Calibration
from femoreg_torch.planning.diffusion import Injection, _pour, diffuse
from femoreg_torch.planning.femur import Femur
from femoreg_torch.planning.laws import Material
from femoreg_torch.planning.model import Bone
from femoreg_torch.planning.settings import DiffusionSettings, Planning

COUNT = 41
MIDDLE = np.full(3, (COUNT - 1) / 2)


def spongy(femur: Femur, pores: np.ndarray) -> Bone:
    """A cube of 41 mm of spongy bone with these pores (X, Y, Z)."""
    mask = np.ones(pores.shape, bool)
    cube = dataclasses.replace(femur, mask=mask, hu=np.zeros(pores.shape, np.float32), lps_from_index=np.eye(4))
    none = np.zeros(pores.shape)
    calibration = Calibration("uncalibrated", 1.0, 0.0, {})
    return Bone(cube, calibration, none, Material(none, none, none), none, pores > 0, pores)


def settings(planning: Planning, voxel_mm: float = 1.0, across: float = 1.0) -> DiffusionSettings:
    return dataclasses.replace(planning.diffusion, voxel_mm=voxel_mm, across=across)


def semi_axes(cement: np.ndarray) -> np.ndarray:
    """Of the ellipsoid with the same second moments: of a full one they are a² / 5 along each axis."""
    index = np.argwhere(np.ones(cement.shape)) - MIDDLE
    weight = cement.ravel() / cement.sum()
    return np.sqrt(5 * (weight[:, None] * index**2).sum(0))


def test_even_bone_gives_a_sphere_of_the_injected_volume(femur: Femur, planning: Planning) -> None:
    bone = spongy(femur, np.full((COUNT,) * 3, 0.8))
    cement = diffuse(bone, [Injection(MIDDLE, 4.0)], settings(planning))
    assert bone.cement_ml(cement) == pytest.approx(4.0, rel=1e-9)
    radius = (3 * 4000 / 0.8 / (4 * np.pi)) ** (1 / 3)
    np.testing.assert_allclose(semi_axes(cement), radius, rtol=0.02)
    distance = np.linalg.norm(np.argwhere(np.ones(cement.shape)) - MIDDLE, axis=1).reshape(cement.shape)
    assert (cement[distance < radius - 1.5] > 0.999).all()
    assert (cement[distance > radius + 1.5] == 0).all()


def test_easier_flow_upwards_gives_an_ellipsoid(femur: Femur, planning: Planning) -> None:
    """Around a point, isobars of Darcy's law are ellipsoids with axes as the roots of the permeabilities."""
    bone = spongy(femur, np.full((COUNT,) * 3, 0.8))
    cement = diffuse(bone, [Injection(MIDDLE, 4.0)], settings(planning, across=0.4))
    x, y, z = semi_axes(cement)
    assert x == pytest.approx(y, rel=0.01)
    assert x / z == pytest.approx(np.sqrt(0.4), rel=0.05)
    assert bone.cement_ml(cement) == pytest.approx(4.0, rel=1e-9)


def test_cement_prefers_the_looser_half_and_stays_out_of_cortex(femur: Femur, planning: Planning) -> None:
    pores = np.full((COUNT,) * 3, 0.6)
    pores[21:] = 0.9
    pores[:, :, 28:] = 0
    bone = spongy(femur, pores)
    cement = diffuse(bone, [Injection(MIDDLE, 3.0)], settings(planning))
    ml = bone.pores * cement
    assert ml[21:].sum() > 2 * ml[:20].sum()
    assert (cement[:, :, 28:] == 0).all()
    assert bone.cement_ml(cement) == pytest.approx(3.0, rel=1e-9)


def test_one_place_in_two_amounts_is_one_amount(femur: Femur, planning: Planning) -> None:
    bone = spongy(femur, np.full((COUNT,) * 3, 0.8))
    at_once = diffuse(bone, [Injection(MIDDLE, 2.0)], settings(planning))
    in_turn = diffuse(bone, [Injection(MIDDLE, 0.7), Injection(MIDDLE, 1.3)], settings(planning))
    assert np.abs(at_once - in_turn).sum() < 0.02 * at_once.sum()


def test_cement_follows_a_place_that_moves_by_less_than_a_block(femur: Femur, planning: Planning) -> None:
    bone = spongy(femur, np.full((COUNT,) * 3, 0.8))
    centres = []
    for x in (0.0, 0.1, 0.5, 1.0, 1.3):
        cement = diffuse(bone, [Injection(MIDDLE + np.array([x, 0, 0]), 2.0)], settings(planning, voxel_mm=2.0))
        assert bone.cement_ml(cement) == pytest.approx(2.0, rel=1e-9)
        centres.append((np.arange(COUNT)[:, None, None] * cement).sum() / cement.sum())
    np.testing.assert_allclose(np.array(centres) - centres[0], [0, 0.1, 0.5, 1.0, 1.3], atol=0.12)


def test_coarser_blocks_give_nearly_the_same_cement(femur: Femur, planning: Planning) -> None:
    bone = spongy(femur, np.full((COUNT,) * 3, 0.8))
    fine, coarse = (diffuse(bone, [Injection(MIDDLE, 6.0)], settings(planning, voxel_mm=h)) for h in (1.0, 2.0))
    overlap = 2 * np.minimum(fine, coarse).sum() / (fine.sum() + coarse.sum())
    assert overlap > 0.93


def test_cement_in_turns_in_a_narrow_canal_stays_finite_and_whole(femur: Femur, planning: Planning) -> None:
    """The far end of a canal gets no flow that counts; what does not fit near the source waits for the next front."""
    pores = np.zeros((COUNT,) * 3)
    pores[18:23, 18:23, :] = 0.7
    pores[10:31, 10:31, 30:] = 0.9
    bone = spongy(femur, pores)
    places = [np.array([20.0, 20.0, z]) for z in (36.0, 8.0, 20.0)]
    cement = diffuse(bone, [Injection(p, v) for p, v in zip(places, (2.0, 0.2, 0.6), strict=True)], settings(planning))
    assert np.isfinite(cement).all()
    assert bone.cement_ml(cement) == pytest.approx(2.8, rel=1e-9)


def test_what_the_flow_reaches_takes_no_more_than_its_room() -> None:
    full, room = np.array([0.5, 0.0]), np.array([1.0, 1.0])
    assert _pour(full, room, np.array([0, 1]), np.array([1.0, 0.0]), 0.8) == pytest.approx(0.3)
    np.testing.assert_array_equal(full, [1.0, 0.0])


def test_more_than_fits_and_places_outside_are_refused(femur: Femur, planning: Planning) -> None:
    bone = spongy(femur, np.full((COUNT,) * 3, 0.8))
    with pytest.raises(InputError, match=r"volume_ml: 60 ml of cement, but the marrow space .* takes up to 55\.1 ml"):
        diffuse(bone, [Injection(MIDDLE, 60.0)], settings(planning))
    with pytest.raises(InputError, match="the path leaves the bone"):
        diffuse(bone, [Injection(MIDDLE + np.array([40, 0, 0]), 1.0)], settings(planning))
    pores = np.full((COUNT,) * 3, 0.8)
    pores[26:30] = 0  # two parts
    with pytest.raises(InputError, match="find no room"):
        diffuse(spongy(femur, pores), [Injection(MIDDLE + np.array([15, 0, 0]), 25.0)], settings(planning, 2.0))
