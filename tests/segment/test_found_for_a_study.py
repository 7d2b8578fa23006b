"""A study's case whose bones and landmarks are found in its CT."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hip_scenes import FEMUR_LEFT, HEAD, answering, dice, hip_scene, shares_of

from femoreg_torch.volume import read_ct, read_labels, read_landmarks, write_landmarks, write_volume
from sim.study.imperfect_ct import ImperfectCt, spoil_ct

SPACING = (1.5, 1.5, 1.5)


def test_bones_and_landmarks_of_a_case_are_those_found_in_its_ct(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ct, truth = hip_scene(SPACING)
    monkeypatch.setattr("sim.study.imperfect_ct.load_bone_network", lambda: answering(shares_of(truth, SPACING)))
    write_volume(tmp_path / "ct.nii.gz", ct.with_data(ct.data.round().to(torch.int16)))
    nothing = torch.zeros(ct.data.shape, dtype=torch.uint8)
    nothing[0, 0, 0] = 1
    write_volume(tmp_path / "labels.nii.gz", ct.with_data(nothing))
    write_landmarks(tmp_path / "landmarks.json", {"ASIS-l": torch.zeros(3, dtype=torch.float64)})
    spoil_ct(tmp_path, torch.zeros(3), ImperfectCt(found_labels=True, found_landmarks=True))
    found = read_ct(tmp_path / "ct.nii.gz")
    assert dice(read_labels(tmp_path / "labels.nii.gz", found).data, truth, FEMUR_LEFT) > 0.95
    points = read_landmarks(tmp_path / "landmarks.json")
    assert "ASIS-l" not in points or float(points["ASIS-l"].norm()) > 1
    np.testing.assert_allclose(points["FH-l"], HEAD, atol=0.7)
