"""Labelled images at full physics strength: what is drawn, what is seen where, and the files."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from femoreg_torch.errors import InputError
from femoreg_torch.files import write_json
from femoreg_torch.geometry import load_carm, project_points, transform_points
from femoreg_torch.volume import HIP_LANDMARKS, Volume, axis_aligned, write_landmarks, write_volume
from sim.commands import dataset
from sim.deepfluoro import deepfluoro_camera, read_dataset
from sim.labelled_images import read_labelled, render_views, write_labelled
from sim.labelled_views import draw_model, load_labelled_settings, prepare_anatomy
from sim.xray import XrayModel

CAMERA = load_carm("cios_fusion").camera
MARKED = ("FH-l", "FH-r", "SPS-l", "ASIS-r")


def landmarks():
    left = [[90.3, -10, -80], [75, 15.5, -25], [48, 10, -120.2], [30, -10, -112], [8, -45, -90], [9, -20, -120.7]]
    points = [[s * x, y, z] for x, y, z in [*left, [119.0, -70.4, -25]] for s in (1, -1)]
    return dict(zip(HIP_LANDMARKS, torch.tensor(points, dtype=torch.float64), strict=True))


@pytest.fixture(scope="module")
def scan():
    """Bones as boxes in a body, and dense balls about some landmarks; CT in HU and labels at 2 mm."""
    affine = axis_aligned((2.0, 2.0, 2.0), (-150.0, -90.0, -180.0))
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (120, 85, 150)), indexing="ij")
    points = torch.stack([x, y, z], -1) * 2 + affine[:3, 3]
    hu = torch.full(points.shape[:3], -1000.0)
    hu[:, 4:-4, 4:-4] = 40.0
    labels = torch.zeros_like(hu, dtype=torch.uint8)
    boxes = {
        1: (80, 140, 60, 110),
        2: (10, 70, 60, 110),
        4: (66, 84, 80, 115),
        5: (105, 140, 5, 55),
        6: (10, 45, 5, 55),
    }
    for label, (x0, x1, z0, z1) in boxes.items():
        labels[z0:z1, 30:50, x0:x1] = label
    hu[labels > 0] = 250.0
    for name in MARKED:
        hu += 5000 * ((6 - (points - landmarks()[name]).norm(dim=-1)) / 2).clamp(0, 1).float()
    return Volume(hu, affine), Volume(labels, affine)


@pytest.fixture(scope="module")
def anatomy(scan):
    return prepare_anatomy(*scan, landmarks())


@pytest.fixture(scope="module")
def settings():
    known = load_labelled_settings("labelled")
    return replace(known, device=replace(known.device, share=0.5, count=1), step_mm=2.0, binning=8)


@pytest.fixture(scope="module")
def labelled(anatomy, settings):
    return render_views(anatomy, settings, CAMERA, 4, seed=3, source="boxes")


def test_every_effect_is_drawn_within_its_range():
    ranges = load_labelled_settings("labelled").xray
    drawn = [draw_model(ranges, np.random.default_rng(seed)) for seed in range(50)]
    assert set(ranges) == set(XrayModel.__dataclass_fields__)
    for name, value in ranges.items():
        values = [getattr(model, name) for model in drawn]
        if isinstance(value, tuple):
            assert value[0] <= min(values) < max(values) <= value[1]
            assert max(values) - min(values) > 0.7 * (value[1] - value[0])
        else:
            assert set(values) == {value}


def test_dense_balls_are_seen_where_the_landmarks_say(labelled):
    """The marked points are on the pelvis or in the middle of a turned head, so one pose tells where they are."""
    seen = 0
    for image, points in zip(labelled.images[~labelled.device], labelled.landmarks[~labelled.device], strict=True):
        dark = -image.float().clamp_min(1).log()
        for name in MARKED:
            column, row = points[HIP_LANDMARKS.index(name)].round().int().tolist()
            if 12 <= column < 180 and 12 <= row < 180:
                around = dark[row - 8 : row + 9, column - 8 : column + 9]
                spot = (around - around.quantile(0.75)).clamp_min(0)
                offset = torch.arange(17.0) - 8
                centre = torch.stack([(spot.sum(0) * offset).sum(), (spot.sum(1) * offset).sum()]) / spot.sum()
                assert centre.norm() < 2.0, name
                seen += 1
    assert seen >= 4


def test_poses_and_landmarks_agree(labelled):
    points = transform_points(labelled.camera_from_lps, labelled.landmarks_lps.expand(4, -1, -1))
    assert_close(project_points(labelled.camera, points).float(), labelled.landmarks)
    for n, name in enumerate(("FH-l", "FH-r")):
        head = labelled.landmarks_lps[HIP_LANDMARKS.index(name)][None].expand(4, 1, 3)
        turned = transform_points(labelled.camera_from_femur[:, n], head)
        assert_close(turned, transform_points(labelled.camera_from_lps, head))
    assert not torch.allclose(labelled.camera_from_femur[:, 0], labelled.camera_from_lps)


def test_labels_lie_on_their_side_and_on_half_the_grid(labelled):
    assert labelled.images.shape == (4, 192, 192)
    assert labelled.labels.shape == (4, 96, 96)
    for labels in labelled.labels:
        columns = {
            label: (labels == label).nonzero()[:, 1].float().mean() for label in (1, 2) if (labels == label).any()
        }
        if len(columns) == 2:
            assert columns[1] > columns[2]  # patient's left on the right


def test_files_hold_what_was_rendered(labelled, anatomy, settings, tmp_path):
    write_labelled(tmp_path / "a.safetensors", labelled)
    back = read_labelled(tmp_path / "a.safetensors")
    assert back.camera == labelled.camera
    assert back.source == "boxes"
    assert torch.equal(back.images, labelled.images)
    assert back.xray_names == labelled.xray_names
    assert 62 <= back.xray[0, back.xray_names.index("kvp")] <= 92
    again = render_views(anatomy, settings, CAMERA, 1, seed=3, source="boxes")
    assert torch.equal(again.images[0], labelled.images[0])


def test_stretched_patients_are_refused(anatomy, settings):
    with pytest.raises(InputError, match="stretch"):
        render_views(anatomy, replace(settings, views=replace(settings.views, size=0.1)), CAMERA, 1, 0, "")


def test_the_public_grid_keeps_every_eighth_pixel_from_the_fiftieth():
    camera = deepfluoro_camera(CAMERA, 8)
    assert camera.shape == (180, 180)
    points = torch.tensor([[20.0, -30.0, 800.0]], dtype=torch.float64)
    assert_close(project_points(camera, points), (project_points(CAMERA, points) - 50) / 8)


@pytest.fixture(scope="module")
def written(scan, tmp_path_factory):
    """A file of one patient and two views, made by the command."""
    from importlib.resources import files

    folder = tmp_path_factory.mktemp("deepfluoro")
    write_volume(folder / "ct.nii.gz", scan[0])
    write_volume(folder / "labels.nii.gz", scan[1])
    write_landmarks(folder / "landmarks.json", landmarks())
    text = files("femoreg_torch.configs").joinpath("simulation", "deepfluoro.yaml").read_text(encoding="utf-8")
    for old, new in (
        ("seeds: [1, 2, 3, 4, 5, 6, 7]", "seeds: []"),
        ("folders: []", f"folders: [{folder}]"),
        ("views: 100", "views: 2"),
        ("step_mm: 1.0", "step_mm: 2.0"),
        ("count: 4", "count: 1"),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "mine.yaml").write_text(text, encoding="utf-8")
    dataset(str(folder / "mine.yaml"), out=folder / "out.h5")
    return folder / "out.h5"


def test_the_file_has_the_layout_of_the_public_one(written):
    with h5py.File(written) as file:
        assert set(file) == {"land-names", "01"}
        assert file["land-names/num-lands"][()] == 14
        assert file["land-names/land-00"][()] == b"FH-l"
        assert file["land-names/land-13"][()] == b"ASIS-r"
        assert set(file["01"]) == {"projs", "segs", "lands"}
        projs, segs, lands = (file["01"][name] for name in ("projs", "segs", "lands"))
        assert (projs.shape, projs.dtype, projs.chunks) == ((2, 180, 180), np.float32, (1, 180, 180))
        assert (segs.shape, segs.dtype) == ((2, 180, 180), np.uint8)
        assert (lands.shape, lands.dtype) == ((2, 2, 14), np.float32)
        assert (projs.compression, projs.compression_opts) == ("gzip", 9)


def test_bone_is_bright_and_left_is_on_the_right_with_the_head_up(written):
    patient = read_dataset(written)["01"]
    for image, labels, points in zip(patient.projs, patient.segs, patient.lands, strict=True):
        columns, rows = points
        assert columns[0::2].mean() > columns[1::2].mean()  # left landmarks, then right ones
        assert rows[12:].mean() < rows[:2].mean()  # iliac spines above the heads
        if (labels == 0).any() and (labels > 0).any():
            assert image[labels > 0].mean() > image[labels == 0].mean()


def test_other_files_are_refused(written, tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_dataset(tmp_path / "none.h5")
    write_json(tmp_path / "text.h5", {})
    with pytest.raises(InputError, match="layout"):
        read_dataset(tmp_path / "text.h5")
    with h5py.File(written) as known, h5py.File(tmp_path / "other.h5", "w") as other:
        known.copy("land-names", other)
        del other["land-names/land-00"]
        other["land-names/land-00"] = "ASIS-l"
    with pytest.raises(InputError, match="landmarks ASIS-l"):
        read_dataset(Path(tmp_path / "other.h5"))
