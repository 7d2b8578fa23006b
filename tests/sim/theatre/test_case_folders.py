"""Folders of the simulator, from a procedural patient to a complete case."""

import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from femoreg_torch.anatomy import label_table
from femoreg_torch.case import read_case, write_case
from femoreg_torch.case.femoroplasty import device_of
from femoreg_torch.errors import InputError
from femoreg_torch.files import read_json, write_json
from femoreg_torch.fluoro import attenuation_image, read_image
from femoreg_torch.volume import Volume, read_ct, read_labels, read_mesh, write_volume
from sim.commands import phantom, simulate
from sim.theatre.case_folders import SIMULATION_STEPS, write_simulation


@pytest.fixture(scope="module")
def patient(tmp_path_factory):
    """A coarse procedural patient under a C-arm with 16 × 16 of its pixels in one, to be quick."""
    folder = tmp_path_factory.mktemp("phantom") / "patient"
    phantom(folder, seed=2, side="right", spacing_mm=2.0)
    case = read_case(folder)
    write_case(folder, replace(case, carm=replace(case.carm, camera=case.carm.camera.downsampled(16))))
    return folder


@pytest.fixture(scope="module")
def simulated(patient, tmp_path_factory):
    out = tmp_path_factory.mktemp("simulated") / "case"
    simulate(patient, out=out, seed=5)
    return out


def test_a_phantom_is_a_case_without_images(patient):
    case = read_case(patient)
    assert case.side == "right"
    assert case.views == ()
    assert len(case.landmarks) == 14
    assert read_mesh(device_of(case).model.path).is_watertight
    labels = read_labels(case.labels_path, read_ct(case.ct_path))
    assert set(np.unique(labels.data)) == {0, *(n for ids in label_table("femoreg").values() for n in ids)}
    assert case.plan.entry_point[0] < case.landmarks["FH-r"][0]  # on the right, lateral is −x


def test_a_simulated_case_is_complete(simulated):
    case = read_case(simulated)
    assert case.side == "right"
    assert len(case.views) == 3
    assert case.truth.camera_from("pelvis").shape == (3, 4, 4)
    assert set(case.truth.camera1_from) == {"pelvis", "femur", "device"}
    preview = cv2.imread(str(simulated / "preview.png"), cv2.IMREAD_GRAYSCALE)
    assert preview is not None
    rows, columns = case.carm.camera.shape
    assert preview.shape == (2 * rows, 3 * columns)
    for view in range(3):  # neither black nor white in the middle, where the hip is
        middle = preview[rows // 4 : 3 * rows // 4, view * columns : (view + 1) * columns][
            :, columns // 4 : -columns // 4
        ]
        assert 40 < np.median(middle) < 215
    for view in case.views:
        anatomy, device = read_image(view.images["anatomy"]), read_image(view.images["device"])
        assert anatomy.shape == case.carm.camera.shape
        assert anatomy.max() > 2 * anatomy.min()
        assert ((device < 0.7 * anatomy).float().mean() > 0.01).item()


def test_the_same_seed_writes_the_same_case(patient, simulated, tmp_path):
    for seed, same in ((5, True), (6, False)):
        out = tmp_path / str(seed)
        simulate(patient, out=out, seed=seed)
        for name in ("view1.tif", "view3_device.tif", "truth.json"):
            assert ((out / name).read_bytes() == (simulated / name).read_bytes()) is same


def test_the_other_hip_gets_a_plan_of_its_own(patient, tmp_path):
    simulate(patient, out=tmp_path / "left", seed=5, side="left")
    case = read_case(tmp_path / "left")
    assert case.side == "left"
    assert case.plan.entry_point[0] > case.landmarks["FH-l"][0]


def test_the_file_of_a_plan_goes_with_the_case(patient, tmp_path):
    """A report finds loads and pictures of the plan, wherever the case is taken."""
    planned, given = tmp_path / "planned", read_case(patient)
    planned.mkdir()
    points = {"entry_point": given.plan.entry_point.tolist(), "target": given.landmarks["FH-r"].tolist()}
    write_json(planned / "plan.json", {"side": "right", "plan": points, "planned": {"gain": 0.4}})
    (planned / "overlay.png").write_bytes(b"picture")
    before = tmp_path / "patient"
    shutil.copytree(patient, before)
    write_case(before, replace(read_case(before), plan=replace(given.plan, file=planned / "plan.json")))
    simulate(before, out=tmp_path / "deep" / "case", seed=5)
    shutil.move(tmp_path / "deep" / "case", tmp_path / "moved")
    shutil.rmtree(planned)
    plan = read_case(tmp_path / "moved").plan
    assert plan.entry_point.tolist() == pytest.approx(points["entry_point"])
    assert read_json(plan.file)["planned"] == {"gain": 0.4}
    assert (plan.file.parent / "overlay.png").read_bytes() == b"picture"


def test_every_step_is_reported(patient, tmp_path):
    steps = []
    write_simulation(patient, tmp_path / "case", 5, None, "paper", steps.append)
    assert len(steps) == SIMULATION_STEPS


def test_bad_input_leaves_nothing_behind(patient, tmp_path):
    with pytest.raises(InputError, match="no simulation preset"):
        simulate(patient, out=tmp_path / "case", config="none")
    with pytest.raises(InputError, match=r"ct\.nii\.gz"):
        simulate(tmp_path, out=tmp_path / "case")
    assert list(tmp_path.iterdir()) == []


def test_images_may_come_from_a_finer_scan_of_the_same_patient(patient, simulated, tmp_path):
    """The case keeps the coarse CT and the truth; only the images differ, and not by much."""
    finer = tmp_path / "finer"
    phantom(finer, seed=2, side="right", spacing_mm=1.5)
    write_simulation(patient, tmp_path / "case", 5, None, "paper", lambda _: None, finer)
    case, coarse = read_case(tmp_path / "case"), read_case(simulated)
    assert read_ct(case.ct_path).spacing_mm == pytest.approx((2.0, 2.0, 2.0))
    assert torch.equal(case.truth.camera_from("pelvis"), coarse.truth.camera_from("pelvis"))
    one, other = (attenuation_image(read_image(known.views[0].images["anatomy"])) for known in (case, coarse))
    assert not torch.equal(one, other)
    assert np.corrcoef(one.flatten(), other.flatten())[0, 1] > 0.99


def test_a_finer_scan_of_somebody_else_is_refused(patient, tmp_path):
    finer = tmp_path / "finer"
    ct = read_ct(patient / "ct.nii.gz")
    moved = ct.lps_from_index.clone()
    moved[0, 3] += 7
    labels = read_labels(patient / "labels.nii.gz", ct)
    finer.mkdir()
    write_volume(finer / "ct.nii.gz", Volume(ct.data, moved))
    write_volume(finer / "labels.nii.gz", Volume(labels.data, moved))
    with pytest.raises(InputError, match=r"7\.0 mm elsewhere"):
        write_simulation(patient, tmp_path / "case", 5, None, "paper", lambda _: None, finer)
    assert not (tmp_path / "case").exists()


def test_a_label_map_that_cannot_be_read_is_named_where_it_was_given(patient, tmp_path):
    shutil.copytree(patient, tmp_path / "patient")
    labels = tmp_path / "patient" / "labels.nii.gz"
    labels.write_bytes(labels.read_bytes()[:99])
    with pytest.raises(InputError, match=f"^{re.escape(str(labels))}: "):
        simulate(tmp_path / "patient", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
