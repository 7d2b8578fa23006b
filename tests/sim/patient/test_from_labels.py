"""Bones from thick slices against the shapes that the slices were cut from."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from femoreg_torch.anatomy import label_table
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.volume import (
    Volume,
    axis_aligned,
    read_ct,
    read_label_map,
    read_labels,
    read_landmarks,
    write_volume,
)
from sim.patient.from_labels import write_label_patient
from sim.patient.from_labels.bones import skeleton_from_labels
from sim.patient.landmarks import find_landmarks
from sim.patient.parameters import draw_parameters
from sim.patient.procedural.bones import build_skeleton
from sim.patient.skeleton import Skeleton

TABLE = label_table("pelvic_ref")  # both sides share an id
NUMBERS = {bone: ids[0] for bone, ids in TABLE.items()}
WRITTEN = {bone: ids[0] for bone, ids in label_table("femoreg").items()}
SPACING = (1.5, 1.5, 3.0)
BOTTOM_MM, AWAY = -150.0, np.array([30.0, -200.0, 500.0])  # where the map cuts the femora, and its frame


@pytest.fixture(scope="module")
def truth() -> Skeleton:
    rng = np.random.default_rng(5)
    return build_skeleton(draw_parameters(rng), rng)


@pytest.fixture(scope="module")
def points(truth: Skeleton) -> dict[str, NDArray[np.float64]]:
    return find_landmarks(truth)


@pytest.fixture(scope="module")
def labels(truth: Skeleton, points: dict[str, NDArray[np.float64]]) -> Volume:
    """What a reader would draw on slices of 3 mm, the hip bones grown together at the symphysis."""
    lows = np.min([field.lo for field in truth.bones.values()], axis=0)
    highs = np.max([f.lo + f.step * np.array(f.values.shape) for f in truth.bones.values()], axis=0)
    lows[2] = BOTTOM_MM
    x, y, z = (np.arange(a, b, s) for a, b, s in zip(lows, highs, SPACING, strict=True))
    values = np.zeros((len(x), len(y), len(z)), np.uint8)
    for name, field in truth.bones.items():
        i, j, k = field.within(x, y, z)
        values[i, j, k][field.on_axes(x[i], y[j], z[k]) < 0] = NUMBERS[name]
    middle = (np.mean([points[f"{kind}-{side}"] for kind in ("SPS", "IPS") for side in "lr"], axis=0) - lows) / SPACING
    a, b, c = (slice(int(m) - n, int(m) + n + 1) for m, n in zip(middle, (4, 2, 2), strict=True))
    values[a, b, c] = NUMBERS["hip_left"]
    origin = lows + AWAY
    return Volume(torch.from_numpy(values.transpose(2, 1, 0).copy()), axis_aligned(SPACING, tuple(origin.tolist())))


@pytest.fixture(scope="module")
def skeleton(labels: Volume) -> tuple[Skeleton, NDArray[np.float64], float]:
    return skeleton_from_labels(labels, TABLE)


def test_surfaces_are_smooth_and_in_place(
    truth: Skeleton, skeleton: tuple[Skeleton, NDArray[np.float64], float]
) -> None:
    found, centre, _ = skeleton
    for name, field in found.bones.items():
        points = field.surface() + centre - AWAY
        inner = points[(points[:, 2] > BOTTOM_MM + 5) & (np.abs(points[:, 0]) > 15)]
        off = np.abs(truth.bones[name].at(inner))
        assert np.median(off) < 0.5, name  # the nearest slice would leave steps of up to 3 mm
        assert np.percentile(off, 95) < 1.8, name


def test_left_and_right_are_apart(skeleton: tuple[Skeleton, NDArray[np.float64], float]) -> None:
    bones = skeleton[0].bones
    for kind in ("hip", "femur"):
        left, right = (bones[f"{kind}_{side}"].surface() for side in ("left", "right"))
        assert left[:, 0].mean() > 30 > -30 > right[:, 0].mean()
        assert bones[f"{kind}_left"].at(right).min() > 2


def test_heads_shafts_and_landmarks(truth: Skeleton, skeleton: tuple[Skeleton, NDArray[np.float64], float]) -> None:
    found, centre, bottom_mm = skeleton
    assert abs(bottom_mm - (BOTTOM_MM + AWAY[2] - centre[2])) < 1e-6
    assert abs(found.head_radius - truth.head_radius) < 1
    for side in ("left", "right"):
        assert np.linalg.norm(found.heads[side] + centre - AWAY - truth.heads[side]) < 1
        assert found.lps_from_femur[side][:, 2] @ truth.lps_from_femur[side][:, 2] > np.cos(np.radians(4))
        assert found.neck[side] @ truth.neck[side] > np.cos(np.radians(10))
        assert np.linalg.det(found.lps_from_femur[side]) > 0.99


def below(labels: Volume, cut_mm: float, skeleton: tuple[Skeleton, NDArray[np.float64], float]) -> Volume:
    """The map, empty from `cut_mm` below the middle of the heads downwards."""
    head = skeleton[1][2]
    data = labels.data.clone()
    data[: round((head - cut_mm - float(labels.lps_from_index[2, 3])) / SPACING[2])] = 0
    return labels.with_data(data)


def test_femora_cut_below_the_trochanters_count_as_upright(
    labels: Volume, skeleton: tuple[Skeleton, NDArray[np.float64], float]
) -> None:
    short, _, bottom_mm = skeleton_from_labels(below(labels, 74.0, skeleton), TABLE)
    assert bottom_mm == pytest.approx(-74, abs=3)
    for side in ("left", "right"):
        axes = short.lps_from_femur[side]
        np.testing.assert_allclose(axes[:, 2], [0, 0, 1])
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
        assert axes[:, 0] @ skeleton[0].lps_from_femur[side][:, 0] > np.cos(np.radians(15))
    with pytest.raises(InputError, match=r"end \d+ mm below the centres of their heads; 70 mm are needed"):
        skeleton_from_labels(below(labels, 45.0, skeleton), TABLE)


def test_the_patient_around_the_bones(labels: Volume, points: dict[str, NDArray[np.float64]], tmp_path: Path) -> None:
    write_volume(tmp_path / "map.nii.gz", labels)
    write_label_patient(tmp_path / "map.nii.gz", TABLE, tmp_path / "case", seed=2, spacing_mm=2.0)
    ct = read_ct(tmp_path / "case" / "ct.nii.gz")
    found = read_labels(tmp_path / "case" / "labels.nii.gz", ct)
    landmarks = read_landmarks(tmp_path / "case" / "landmarks.json")
    assert json.loads((tmp_path / "case" / "origin.json").read_text(encoding="utf-8"))["source"] == "map.nii.gz"
    off = {name: float(np.linalg.norm(landmarks[name].numpy() - AWAY - point)) for name, point in points.items()}
    assert np.median(list(off.values())) < 2.5, off
    assert max(off.values()) < 8, off
    assert set(np.unique(found.data)) == {0, *WRITTEN.values()}
    assert ct.lps_from_index[2, 3] - (BOTTOM_MM + AWAY[2]) == pytest.approx(0, abs=2.5)  # no cap at the femur's end
    shaft = ct.data[2][found.data[2] == WRITTEN["femur_left"]]
    assert shaft.max() > 1000
    assert shaft.min() < 100  # marrow
    assert 20 < float(ct.data[(ct.data > 0) & (ct.data < 100)].median()) < 80  # muscle
    left, right = (  # on the map's grid both hips have one number
        (found.data == WRITTEN[bone]).nonzero()[:, 2].double().mean() * 2.0 + ct.lps_from_index[0, 3] - AWAY[0]
        for bone in ("hip_left", "hip_right")
    )
    assert left > 30 > -30 > right


def test_what_is_missing_is_named(labels: Volume, tmp_path: Path) -> None:
    (tmp_path / "map.nii.gz").write_text("no image", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read"):
        read_label_map(tmp_path / "map.nii.gz")
    with pytest.raises(InputError, match="sacrum, label 77"):
        skeleton_from_labels(labels, TABLE | {"sacrum": (77,)})
    with pytest.raises(InputError, match="no id of sacrum"):
        skeleton_from_labels(labels, {bone: ids for bone, ids in TABLE.items() if bone != "sacrum"})
    one = TABLE["sacrum"]
    with pytest.raises(InputError, match="two separate parts"):
        skeleton_from_labels(labels, TABLE | {"femur_left": one, "femur_right": one})
    turned = Volume(labels.data, torch.diag(torch.tensor([-1.5, 1.5, 3.0, 1.0], dtype=torch.float64)))
    with pytest.raises(InputError, match="axes"):
        skeleton_from_labels(turned, TABLE)


def test_a_damaged_map_prints_nothing_beside_the_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Without its magic number a NIfTI file is of Analyze 7.5, of which ITK complains on stderr."""
    path = tmp_path / "map.nii"
    write_volume(path, Volume(torch.ones(4, 4, 4, dtype=torch.uint8), torch.eye(4, dtype=torch.float64)))
    content = path.read_bytes()
    path.write_bytes(content[:344] + bytes(4) + content[348:])
    assert main(["around-labels", str(path), "--labels", "pelvic_ref", "--out", str(tmp_path / "out")]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()
