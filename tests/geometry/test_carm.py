"""The C-arm's orbit by literal cases and laws, and the errors of its settings."""

import math
from dataclasses import replace

import pytest
import torch
from femoreg_torch.configs import preset_names
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Uncertainty, carm_from_dict, invert_rigid, load_carm, orbit_angles, transform_points

GOOD = {"sdd_mm": 1000, "pixel_mm": [0.3, 0.2], "shape": [100, 200]}
CARM = load_carm("cios_fusion")
OBLIQUE = carm_from_dict(GOOD | {"isocentre_mm": [5, -3, 600], "orbit_axis": [1, 2, -2]}, "oblique")
ORIGIN = torch.zeros(1, 3, dtype=torch.float64)
angles = st.floats(-math.pi, math.pi).map(lambda a: torch.tensor(a, dtype=torch.float64))


def test_the_preset_is_the_detector_of_the_paper():
    assert CARM.camera.shape == (1536, 1536)
    assert CARM.camera.pixel_mm == (0.194, 0.194)
    assert CARM.camera.sdd_mm == 1020
    assert CARM.camera.principal_point_px == (767.5, 767.5)


def test_plus_90_degrees_about_y_takes_the_source_to_minus_x():
    """The source stands 631.8 mm before the isocentre, at −z of it: a right-hand turn about +y takes it to −x."""
    moved_from_camera = CARM.orbit(torch.tensor(math.pi / 2, dtype=torch.float64))
    source = transform_points(invert_rigid(moved_from_camera), ORIGIN)
    assert_close(source, torch.tensor([[-631.8, 0.0, 631.8]], dtype=torch.float64), atol=1e-12, rtol=0)


def test_a_small_positive_angle_moves_what_lies_beyond_the_isocentre_to_lower_columns():
    """Seen from the camera, the room turns the other way: +z of the isocentre moves to −x."""
    beyond = torch.tensor([[0.0, 0.0, 731.8]], dtype=torch.float64)
    seen = transform_points(CARM.orbit(torch.tensor(math.radians(10), dtype=torch.float64)), beyond)
    expected = torch.tensor(
        [[-100 * math.sin(math.radians(10)), 0.0, 631.8 + 100 * math.cos(math.radians(10))]], dtype=torch.float64
    )
    assert_close(seen, expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("carm", [CARM, OBLIQUE])
@given(a=angles, b=angles)
def test_orbits_add_and_hold_the_axis(carm, a, b):
    assert_close(carm.orbit(a) @ carm.orbit(b), carm.orbit(a + b), atol=1e-11, rtol=0)
    isocentre = torch.tensor(carm.isocentre_mm, dtype=torch.float64)
    on_axis = torch.stack([isocentre, isocentre + 50 * torch.tensor(carm.orbit_axis, dtype=torch.float64)])
    assert_close(transform_points(carm.orbit(a), on_axis), on_axis, atol=1e-11, rtol=0)


def test_orbit_of_a_batch_of_angles():
    half = math.radians(45)
    found = orbit_angles(45, 0.5)
    assert len(found) == 181
    assert_close(found[[0, 90, -1]], torch.tensor([-half, 0.0, half], dtype=torch.float64))
    poses = CARM.orbit(found)
    assert poses.shape == (181, 4, 4)
    assert_close(poses[90], torch.eye(4, dtype=torch.float64))


def test_defaults_of_an_own_carm():
    carm = carm_from_dict(GOOD, "case.yaml, carm")
    assert carm.camera.principal_point_px == (99.5, 49.5)
    assert carm.isocentre_mm == (0.0, 0.0, 620.0)
    assert carm.orbit_axis == (0.0, 1.0, 0.0)
    assert math.isclose(math.hypot(*OBLIQUE.orbit_axis), 1.0)
    own = carm_from_dict(GOOD | {"principal_point_px": [10, 20]}, "case.yaml, carm")
    assert own.camera.principal_point_px == (10.0, 20.0)


def test_what_is_not_said_of_the_uncertainty_is_that_of_a_c_arm_nobody_has_calibrated():
    silent = carm_from_dict(GOOD, "mine")
    assert silent.uncertainty is None
    assert silent.assumed_uncertainty == Uncertainty(2.0, 2.0)
    said = carm_from_dict(GOOD | {"uncertainty": {"sdd_percent": 0}}, "mine").uncertainty
    assert said == Uncertainty(sdd_percent=0.0, principal_point_mm=2.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sdd": 1000}, "unknown key 'sdd'"),
        ({"pixel_mm": 0.2}, "pixel_mm"),
        ({"shape": [100]}, "shape"),
        ({"sdd_mm": "far"}, "sdd_mm"),
        ({"pixel_mm": ["a", "b"]}, "pixel_mm"),
        ({"principal_point_px": [1, 2, 3]}, "principal_point_px"),
        ({"isocentre_mm": 600}, "isocentre_mm"),
        ({"orbit_axis": [0, 0, 0]}, "orbit_axis"),
        ({"sdd_mm": -1}, "positive"),
        ({"uncertainty": 2}, "uncertainty"),
        ({"uncertainty": {"sdd": 2}}, "'sdd'"),
        ({"uncertainty": {"sdd_percent": "some"}}, "uncertainty.sdd_percent"),
        ({"uncertainty": {"principal_point_mm": -1}}, "must not be negative"),
    ],
)
def test_bad_settings_are_refused_with_place_and_key(change, words):
    with pytest.raises(InputError, match=words):
        carm_from_dict(GOOD | change, "case.yaml, carm")


@pytest.mark.parametrize("key", ["sdd_mm", "pixel_mm", "shape"])
def test_a_missing_key_is_named(key):
    with pytest.raises(InputError, match=rf"case.yaml, carm: `{key}` is missing"):
        carm_from_dict({k: v for k, v in GOOD.items() if k != key}, "case.yaml, carm")


def test_a_c_arm_may_stand_in_a_file_and_extend_a_preset(tmp_path):
    (tmp_path / "mine.yaml").write_text("extends: cios_fusion\nsdd_mm: 990\n", encoding="utf-8")
    carm = load_carm(tmp_path / "mine.yaml")
    assert carm.camera == replace(CARM.camera, sdd_mm=990.0)
    assert carm.isocentre_mm == CARM.isocentre_mm
    (tmp_path / "odd.yaml").write_text("extends: cios_fusion\nsdd: 990\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"odd.yaml: unknown key 'sdd'"):
        load_carm(tmp_path / "odd.yaml")


@pytest.mark.parametrize("name", preset_names("carm"))
def test_presets_are_those_of_mobile_c_arms(name):
    """All that ship have flat panels of 30 cm, and an isocentre between half the source distance and two thirds."""
    carm = load_carm(name)
    sides = [n * mm for n, mm in zip(carm.camera.shape, carm.camera.pixel_mm, strict=True)]
    assert sides == pytest.approx([297, 297], abs=3)
    assert 0.5 < carm.isocentre_mm[2] / carm.camera.sdd_mm < 0.67


def test_an_unknown_preset_lists_those_there_are():
    with pytest.raises(InputError, match="cios_fusion"):
        load_carm("siemens")
