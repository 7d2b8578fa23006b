"""Labelled images at full physics strength: what is drawn, what is seen where, and the files."""

from dataclasses import MISSING, asdict, fields, replace

import numpy as np
import pytest
import torch
import yaml
from boxes import box_scan, landmarks
from torch.testing import assert_close

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import project_points, transform_points
from femoreg_torch.volume import write_landmarks, write_volume
from sim.commands import labelled_images
from sim.labelled.image_files import read_labelled, render_views, write_labelled
from sim.labelled.imaged_patient import prepare_patient
from sim.labelled.settings import ImageGrid, load_labelled_settings
from sim.physics.fluoroscopy import XrayModel
from training.labelled import images_of_file

MARKED = ("FH-l", "FH-r", "SPS-l", "ASIS-r")


@pytest.fixture(scope="module")
def scan():
    """The body with dense balls about some landmarks."""
    ct, labels = box_scan()
    index = torch.stack(torch.meshgrid(*(torch.arange(n) for n in ct.data.shape), indexing="ij"), -1).flip(-1)
    points = transform_points(ct.lps_from_index, index.reshape(-1, 3).double()).reshape(index.shape)
    for name in MARKED:
        ct.data.add_(5000 * ((6 - (points - landmarks()[name]).norm(dim=-1)) / 2).clamp(0, 1).float())
    return ct, labels


@pytest.fixture(scope="module")
def patient(scan):
    return prepare_patient(*scan, landmarks())


@pytest.fixture(scope="module")
def settings():
    known = load_labelled_settings("labelled")
    return replace(known, device=replace(known.device, share=0.5, count=1), image=ImageGrid(binning=8, step_mm=2.0))


@pytest.fixture(scope="module")
def labelled(patient, settings):
    return render_views(patient, settings, 4, seed=3, source="boxes")


def test_every_effect_is_drawn_within_its_range():
    ranges = asdict(load_labelled_settings("labelled").xray)
    drawn = [asdict(load_labelled_settings("labelled").xray.draw(np.random.default_rng(seed))) for seed in range(50)]
    assert list(ranges) == [f.name for f in fields(XrayModel) if f.default is MISSING]  # others may be left out
    spans = {name: value for name, value in ranges.items() if isinstance(value, tuple)}
    assert len(spans) == 10
    for name, (low, high) in spans.items():
        values = [model[name] for model in drawn]
        assert low <= min(values) < max(values) <= high, name
        assert max(values) - min(values) > 0.7 * (high - low), name
    for name in set(ranges) - set(spans):
        assert {model[name] for model in drawn} == {ranges[name]}


def test_dense_balls_are_seen_where_the_landmarks_say(labelled):
    """The marked points are on the pelvis or in the middle of a turned head, so one pose tells where they are."""
    marks = [HIP.landmark_names.index(name) for name in MARKED]
    plain = ~labelled.device
    places = [(n, place) for n, points in enumerate(labelled.landmarks[plain]) for place in points[marks].round().int()]
    inside = [(n, place) for n, place in places if ((place >= 12) & (place < 180)).all()]
    assert len(inside) >= 4
    offset = torch.arange(17.0) - 8
    for n, (column, row) in inside:
        dark = -labelled.images[plain][n].float().clamp_min(1).log()
        around = dark[row - 8 : row + 9, column - 8 : column + 9]
        spot = (around - around.quantile(0.75)).clamp_min(0)
        centre = torch.stack([(spot.sum(0) * offset).sum(), (spot.sum(1) * offset).sum()]) / spot.sum()
        assert centre.norm() < 2.0


def test_poses_and_landmarks_agree(labelled):
    points = transform_points(labelled.camera_from_lps, labelled.landmarks_lps.expand(4, -1, -1))
    assert_close(project_points(labelled.camera, points).float(), labelled.landmarks)
    for n, name in enumerate(("FH-l", "FH-r")):
        head = labelled.landmarks_lps[HIP.landmark_names.index(name)][None].expand(4, 1, 3)
        turned = transform_points(labelled.camera_from_femur[:, n], head)
        assert_close(turned, transform_points(labelled.camera_from_lps, head))
    assert not torch.allclose(labelled.camera_from_femur[:, 0], labelled.camera_from_lps)


def test_labels_lie_on_their_side_and_on_half_the_grid(labelled):
    assert labelled.images.shape == (4, 192, 192)
    assert labelled.labels.shape == (4, 96, 96)
    left, right = (labelled.labels == n for n in HIP.classes(["hip_left", "hip_right"]))
    both = [n for n in range(4) if left[n].any() and right[n].any()]
    assert len(both) >= 2
    for n in both:  # patient's left on the right
        assert left[n].nonzero()[:, 1].float().mean() > right[n].nonzero()[:, 1].float().mean()


@pytest.mark.parametrize("kind", ["posterior", "sides"])
def test_views_of_other_sides_are_stored_as_the_source_sees_them(patient, settings, tmp_path, kind):
    shares = {"posterior_share": 1.0} if kind == "posterior" else {"side_share": 1.0}
    views = replace(settings.views, one_hip_share=0.0, **shares)
    content = render_views(patient, replace(settings, views=views), 4, seed=5, source="boxes")
    points = transform_points(content.camera_from_lps, content.landmarks_lps.expand(4, -1, -1))
    assert_close(project_points(content.camera, points).float(), content.landmarks)
    write_labelled(tmp_path / "a.safetensors", content)
    images = list(images_of_file(tmp_path / "a.safetensors"))
    sources = {image.display.source for image in images}
    assert sources == ({"posterior"} if kind == "posterior" else {"left", "right"})
    for image in images:
        x_of_left = image.landmarks[HIP.landmark_names.index("FH-l"), 0]
        x_of_right = image.landmarks[HIP.landmark_names.index("FH-r"), 0]
        if kind == "posterior":
            assert x_of_left < x_of_right
            assert image.display.left_on_left


def test_files_hold_what_was_rendered(labelled, patient, settings, tmp_path):
    write_labelled(tmp_path / "a.safetensors", labelled)
    back = read_labelled(tmp_path / "a.safetensors")
    assert back.camera == labelled.camera
    assert back.source == "boxes"
    assert torch.equal(back.images, labelled.images)
    assert back.xray_names == labelled.xray_names
    assert 62 <= back.xray[0, back.xray_names.index("kvp")] <= 92
    again = render_views(patient, settings, 1, seed=3, source="boxes")
    assert torch.equal(again.images[0], labelled.images[0])


def test_stretched_patients_are_refused(patient, settings):
    with pytest.raises(InputError, match="stretch"):
        render_views(patient, replace(settings, views=replace(settings.views, size=0.1)), 1, 0, "")


def test_the_command_writes_what_measure_reads(scan, tmp_path, capsys):
    write_volume(tmp_path / "ct.nii.gz", scan[0])
    write_volume(tmp_path / "labels.nii.gz", scan[1])
    write_landmarks(tmp_path / "landmarks.json", landmarks())
    text = yaml.safe_dump({"extends": "labelled", "image": {"binning": 16, "step_mm": 3.0}, "device": {"count": 1}})
    (tmp_path / "mine.yaml").write_text(text, encoding="utf-8")
    config, out = str(tmp_path / "mine.yaml"), tmp_path / "one.safetensors"
    labelled_images(tmp_path, out=out, count=2, config=config, name="boxes")
    assert "in place of" not in capsys.readouterr().out
    back = read_labelled(out)
    assert back.images.shape == (2, 96, 96)
    assert back.source == "boxes"
    with pytest.raises(InputError, match="count of 1"):
        labelled_images(tmp_path, out=out, count=0, config=config)
    with pytest.raises(InputError, match=r"one.h5: a name that ends in .safetensors was expected"):
        labelled_images(tmp_path, out=tmp_path / "one.h5", count=1, config=config)
    labelled_images(tmp_path, out=out, count=1, config=config)
    assert ", in place of what stood there" in " ".join(capsys.readouterr().out.split())
