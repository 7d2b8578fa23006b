"""The data set in the layout of the public DeepFluoro files."""

import h5py
import numpy as np
import pytest
import torch
import yaml
from boxes import box_scan, landmarks
from torch.testing import assert_close

from femoreg_torch.errors import InputError
from femoreg_torch.geometry import load_carm, project_points
from femoreg_torch.volume import write_landmarks, write_volume
from sim.commands import dataset
from sim.labelled.deepfluoro import deepfluoro_camera

CAMERA = load_carm("cios_fusion").camera


@pytest.fixture(scope="module")
def scan():
    return box_scan()


def test_the_public_grid_keeps_every_eighth_pixel_from_the_fiftieth():
    camera = deepfluoro_camera(CAMERA, 8)
    assert camera.shape == (180, 180)
    points = torch.tensor([[20.0, -30.0, 800.0]], dtype=torch.float64)
    assert_close(project_points(camera, points), (project_points(CAMERA, points) - 50) / 8)


@pytest.fixture(scope="module")
def written(scan, tmp_path_factory):
    """A file of one patient and two views, made by the command."""
    folder = tmp_path_factory.mktemp("deepfluoro")
    write_volume(folder / "ct.nii.gz", scan[0])
    write_volume(folder / "labels.nii.gz", scan[1])
    write_landmarks(folder / "landmarks.json", landmarks())
    mine = {
        "extends": "deepfluoro",
        "patients": {"seeds": [], "folders": [str(folder)], "views": 2},
        "image": {"step_mm": 2.0},
        "device": {"count": 1},
    }
    (folder / "mine.yaml").write_text(yaml.safe_dump(mine), encoding="utf-8")
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
    with h5py.File(written) as file:
        projs, segs, lands = (torch.from_numpy(file["01"][name][()]) for name in ("projs", "segs", "lands"))
    for image, labels, points in zip(projs, segs, lands, strict=True):
        columns, rows = points
        assert columns[0::2].mean() > columns[1::2].mean()  # left landmarks, then right ones
        assert rows[12:].mean() < rows[:2].mean()  # iliac spines above the heads
        assert image[labels > 0].mean() > image[labels == 0].mean()


@pytest.mark.parametrize(
    ("change", "match"),
    [({"patients": {"folders": []}}, "neither"), ({"bed": 1}, "bed"), ({"carm": "none"}, "no carm preset")],
)
def test_settings_that_do_not_fit_are_named(tmp_path, change, match):
    text = yaml.safe_dump(
        {"extends": "deepfluoro", **change} | {"patients": {"seeds": [], **change.get("patients", {})}}
    )
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=match):
        dataset(str(tmp_path / "mine.yaml"), out=tmp_path / "out.h5")
    assert not (tmp_path / "out.h5").exists()
