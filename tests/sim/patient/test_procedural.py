"""The procedural patient: anatomy where it belongs, landmarks on the bone, the seed fixes every voxel."""

from dataclasses import asdict

import numba
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import euler_number

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.errors import InputError
from sim.patient import Patient, make_patient
from sim.patient.parameters import draw_parameters

SEED, SPACING = 3, 2.0
IDS = {bone: ids[0] for bone, ids in label_table("femoreg").items()}


@pytest.fixture(scope="module")
def patient() -> Patient:
    return make_patient(SEED, SPACING)


def _mask(patient: Patient, bone: str) -> NDArray[np.bool_]:
    return np.asarray(patient.labels.data.numpy() == IDS[bone])


def _centre(patient: Patient, bone: str) -> NDArray[np.float64]:
    """Centroid of a bone, LPS mm."""
    index = np.argwhere(_mask(patient, bone)).mean(0)[::-1]
    return (patient.labels.lps_from_index.numpy() @ [*index, 1])[:3]


def _distance(patient: Patient, mask: NDArray[np.bool_], name: str) -> float:
    """mm from a landmark's voxel to the boundary of a mask, positive outside, negative inside."""
    point = patient.landmarks[name].numpy()
    index = np.linalg.solve(patient.labels.lps_from_index.numpy(), [*point, 1])[:3][::-1]
    low = np.maximum(index.astype(int) - 20, 0)
    near = mask[tuple(slice(k, k + 41) for k in low)]
    signed = ndimage.distance_transform_edt(~near) - ndimage.distance_transform_edt(near)
    return float(ndimage.map_coordinates(signed, (index - low)[:, None], order=1)[0] * SPACING)


def test_volumes_share_one_grid_and_have_plausible_hu(patient: Patient) -> None:
    ct, labels = patient.ct, patient.labels
    assert ct.data.dtype == torch.float32
    assert labels.data.dtype == torch.uint8
    assert ct.data.shape == labels.data.shape
    assert torch.equal(ct.lps_from_index, labels.lps_from_index)
    assert np.allclose(ct.spacing_mm, SPACING)
    assert set(np.unique(labels.data)) == {0, *IDS.values()}
    assert ct.data[:, 0, 0].max() == -1000  # air at the edge
    shaft = ct.data[2][labels.data[2] == IDS["femur_left"]]
    assert shaft.max() > 1100
    assert shaft.min() < 60
    assert -120 < float(ct.data[(ct.data > -160) & (ct.data < -60)].median()) < -70  # fat
    assert 30 < float(ct.data[(ct.data > 0) & (ct.data < 100)].median()) < 70  # muscle


def test_left_is_plus_x_and_the_head_is_up(patient: Patient) -> None:
    for bone in ("hip", "femur"):
        assert _centre(patient, f"{bone}_left")[0] > 40 > -40 > _centre(patient, f"{bone}_right")[0]
    spine, sacrum, femur = (_centre(patient, bone) for bone in ("vertebrae", "sacrum", "femur_left"))
    assert abs(sacrum[0]) < 15
    assert spine[2] > sacrum[2] > femur[2]
    assert sacrum[1] > _centre(patient, "hip_left")[1]  # the sacrum lies behind


@pytest.mark.parametrize("side", ["left", "right"])
def test_landmarks_lie_on_the_hip_bone_or_in_the_middle_of_the_head(patient: Patient, side: str) -> None:
    hip, femur = _mask(patient, f"hip_{side}"), _mask(patient, f"femur_{side}")
    for stem in ("GSN", "IOF", "MOF", "SPS", "IPS", "ASIS"):
        assert abs(_distance(patient, hip, f"{stem}-{side[0]}")) < 1.2 * SPACING, stem
    depth = -_distance(patient, femur, f"FH-{side[0]}")
    assert abs(depth - patient.parameters["head_radius"]) < SPACING


def test_landmarks_are_in_anatomical_order(patient: Patient) -> None:
    assert tuple(patient.landmarks) == tuple(HIP.landmark_names)
    for side, sign in (("l", 1), ("r", -1)):
        fh, gsn, iof, mof, sps, ips, asis = (
            patient.landmarks[n].numpy() for n in HIP.landmark_names if n.endswith(side)
        )
        outwards = sign * np.array([p[0] for p in (ips, mof, iof, asis)])
        assert np.all(np.diff(outwards) > 5)
        assert outwards[0] > 0
        assert asis[2] > gsn[2] > fh[2] > sps[2] > ips[2]
        assert mof[2] > iof[2]
        assert asis[1] < fh[1] < gsn[1]
        assert sps[1] < ips[1]
        assert 20 < np.linalg.norm(sps - ips) < 50
    left, right = (patient.landmarks[f"FH-{s}"].numpy() for s in "lr")
    assert np.isclose(np.linalg.norm(left - right), patient.parameters["inter_head"])


@pytest.mark.parametrize("bone", ["hip_left", "hip_right"])
def test_obturator_foramen_is_the_one_hole_through_the_hip_bone(patient: Patient, bone: str) -> None:
    mask = _mask(patient, bone)
    parts, count = ndimage.label(mask)
    assert count == 1 or np.bincount(parts.ravel())[2:].sum() < 20
    largest = parts == 1 + np.argmax(np.bincount(parts.ravel())[1:])
    assert euler_number(largest, connectivity=3) == 0  # one body (1) with one handle (-1)


@pytest.mark.parametrize("side", ["left", "right"])
def test_hip_joint_and_symphysis_are_open(patient: Patient, side: str) -> None:
    gap = (
        ndimage.distance_transform_edt(~_mask(patient, f"hip_{side}"))[_mask(patient, f"femur_{side}")].min() * SPACING
    )
    assert 2.0 <= gap <= 6.5
    between = ndimage.distance_transform_edt(~_mask(patient, "hip_left"))[_mask(patient, "hip_right")].min() * SPACING
    assert 2.0 <= between <= 9.0


def test_same_seed_same_bits_on_any_number_of_threads(patient: Patient) -> None:
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    again = make_patient(SEED, SPACING)
    numba.set_num_threads(threads)
    assert torch.equal(again.ct.data, patient.ct.data)
    assert torch.equal(again.labels.data, patient.labels.data)
    assert again.parameters == patient.parameters
    assert all(torch.equal(again.landmarks[name], patient.landmarks[name]) for name in HIP.landmark_names)


def test_parameters_stay_within_adult_ranges_and_differ_between_seeds() -> None:
    drawn = [asdict(draw_parameters(np.random.default_rng(seed))) for seed in range(300)]
    ranges = {
        "head_radius": (19, 28.5),
        "inter_head": (150, 215),
        "inter_asis": (190, 290),
        "neck_shaft": (110, 142),
        "anteversion": (-10, 32),
        "femoral_offset": (28, 58),
        "bone_density": (0.3, 1.2),
    }
    for name, (low, high) in ranges.items():
        values = np.array([parameters[name] for parameters in drawn])
        assert values.min() >= low, name
        assert values.max() <= high, name
        assert len(np.unique(values)) > 250, name
    male, female = (np.mean([p["head_radius"] for p in drawn if p["female"] is f]) for f in (False, True))
    assert 1.5 < male - female < 4


@pytest.mark.parametrize(("seed", "spacing_mm"), [(-1, 1.0), (0, 0.2), (0, 4.0)])
def test_bad_input_is_named(seed: int, spacing_mm: float) -> None:
    with pytest.raises(InputError, match="patient: "):
        make_patient(seed, spacing_mm)
