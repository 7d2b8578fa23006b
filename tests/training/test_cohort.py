"""Who is rendered into the cache: patients of one's own by their tables, told apart by name, anew when they change."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml

import training.cohort
from femoreg_torch.anatomy import label_table
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.tensors import read_metadata, read_tensors
from femoreg_torch.volume import read_ct, read_label_map, read_labels, read_landmarks, write_volume
from sim.labelled.attenuation_layers import Layers, split_layers
from training.cohort import CohortSettings, render_cohort

SETTINGS = CohortSettings(patient_seeds=[], validation_seeds=[], case_variants=2, patient_variants=1, views=1)
TABLE = "totalsegmentator_v2"
TINY = """
cohort: {patient_seeds: [], validation_seeds: [], case_variants: 2, patient_variants: 1, views: 1}
network: {kind: multitask_unet, channels: [4, 8], convolutions: [1, 1]}
loss: {kind: multitask}
optimisation: {epochs: 1, batches_per_epoch: 1, batch_size: 1}
workers: 0
"""


def in_another_table(case: Path, folder: Path) -> Path:
    """The case with ids of TotalSegmentator, and a case.yaml that says so."""
    shutil.copytree(case, folder)
    labels = read_label_map(folder / "labels.nii.gz")
    data = torch.zeros_like(labels.data)
    for bone, ids in label_table("femoreg").items():
        data[labels.data == ids[0]] = label_table(TABLE)[bone][0]
    write_volume(folder / "labels.nii.gz", labels.with_data(data))
    content = {
        "version": 2,
        "anatomy": "hip",
        "ct": {"image": "ct.nii.gz", "labels": "labels.nii.gz", "bones": TABLE},
        "landmarks": "landmarks.json",
        "objects": {"pelvis": {"bones": "pelvis", "start": "landmarks"}},
        "carm": "cios_fusion",
    }
    (folder / "case.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return folder


def rendered(cases: list[Path], cache: Path, settings: CohortSettings = SETTINGS) -> tuple[list[Path], list[str]]:
    """The files to train on, and what was told while they were rendered."""
    told: list[str] = []
    return render_cohort(settings, cases, cache, told.append).training, told


def test_views_of_a_case_with_another_table_are_the_same(case: Path, tmp_path: Path) -> None:
    ours, _ = rendered([shutil.copytree(case, tmp_path / "a" / "mine")], tmp_path / "cache_a")
    other, _ = rendered([in_another_table(case, tmp_path / "b" / "mine")], tmp_path / "cache_b")
    for one, two in zip(ours, other, strict=True):
        expected, found = read_tensors(one)[1], read_tensors(two)[1]
        assert all(found[name].equal(expected[name]) for name in expected)
        assert expected["labels"].any()


def test_a_map_of_another_table_without_its_case(
    case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = in_another_table(case, tmp_path / "mine")
    (folder / "case.yaml").unlink()
    out = tmp_path / "out"
    assert main(["train", "quick", "--cases", f"[{folder}]", "--out", str(out)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"{folder}/labels.nii.gz: holds the ids 25, 75, 76, 77, 78" in told
    assert list((out / "cache").iterdir()) == []


def test_two_folders_of_one_name(case: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = (shutil.copytree(case, tmp_path / parent / "case") for parent in "ab")
    out = tmp_path / "out"
    assert main(["train", "quick", "--cases", f"[{one}, {two}]", "--out", str(out)]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"--cases: {one} and {two} have one name, 'case', " in told
    assert not out.exists()
    with pytest.raises(InputError, match="or give it once"):
        rendered([one, one], tmp_path / "cache")


def test_cases_given_by_their_case_yaml_are_told_apart_by_their_folders(case: Path, tmp_path: Path) -> None:
    one, other = (in_another_table(case, tmp_path / name) for name in ("one", "other"))
    files, _ = rendered([one / "case.yaml", other / "case.yaml"], tmp_path / "cache")
    assert [file.name for file in files[::2]] == ["case_one_00.safetensors", "case_other_00.safetensors"]
    assert rendered([one], tmp_path / "cache") == (files[:2], [])
    (one / "origin.json").write_text('{"licence": "zlib", "source": "a scan"}', encoding="utf-8")
    (tmp_path / "tiny.yaml").write_text(TINY, encoding="utf-8")
    cache = str(tmp_path / "cache")
    command = ["train", str(tmp_path / "tiny.yaml"), "--cases", f"[{one / 'case.yaml'}]", "--cache", cache]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    assert "| one | 2 | 2 | zlib | a scan |" in (tmp_path / "out" / "card.md").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "out" / "settings.json").read_text(encoding="utf-8"))["cases"] == ["one"]


def test_nobody_to_learn_from_is_told_before_anything_is_rendered(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no patient to learn from"):
        rendered([], tmp_path / "cache", replace(SETTINGS, validation_seeds=[101]))
    assert not (tmp_path / "cache").exists()


def test_a_folder_that_does_not_fit_is_told_before_anything_is_rendered(case: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"ct\.nii\.gz: no such file"):
        rendered([case, tmp_path / "empty"], tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_a_case_called_like_a_procedural_patient(case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def make(seed: int, _spacing_mm: float) -> Layers:
        asked.append(seed)
        ct = read_ct(case / "ct.nii.gz")
        return split_layers(ct, read_labels(case / "labels.nii.gz", ct), read_landmarks(case / "landmarks.json"))

    monkeypatch.setattr(training.cohort, "_make_patient", make)
    settings = CohortSettings(patient_seeds=[1], validation_seeds=[], case_variants=1, patient_variants=1, views=1)
    mine = shutil.copytree(case, tmp_path / "patient1")
    files, _ = rendered([mine], tmp_path / "cache", settings)
    assert asked == [1]
    assert [file.name for file in files] == ["case_patient1_00.safetensors", "patient1_00.safetensors"]
    assert ['"case": "patient1"' in read_metadata(file)["source"] for file in files] == [True, False]


@pytest.mark.parametrize("name", ["ct.nii.gz", "labels.nii.gz", "landmarks.json"])
def test_an_edited_case_is_rendered_anew(case: Path, tmp_path: Path, name: str) -> None:
    mine, other = (shutil.copytree(case, tmp_path / folder) for folder in ("mine", "other"))
    cache = tmp_path / "cache"
    files, told = rendered([mine, other], cache)
    assert len(told) == len(files) == 4
    before = [file.stat().st_mtime_ns for file in files]
    assert rendered([mine, other], cache) == (files, [])
    status = (mine / name).stat()
    os.utime(mine / name, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    again, told = rendered([mine, other], cache)
    assert again == files
    assert told == [f"rendered 1 views of mine anew, variant {n} of 2" for n in (1, 2)]
    changed = [file.stat().st_mtime_ns != time for file, time in zip(files, before, strict=True)]
    assert changed == [True, True, False, False]
    assert rendered([mine, other], cache) == (files, [])


def test_procedural_patients_of_another_voxel_size_are_rendered_anew(
    case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def make(_seed: int, spacing_mm: float) -> Layers:
        asked.append(spacing_mm)
        ct = read_ct(case / "ct.nii.gz")
        return split_layers(ct, read_labels(case / "labels.nii.gz", ct), read_landmarks(case / "landmarks.json"))

    monkeypatch.setattr(training.cohort, "_make_patient", make)
    coarse = CohortSettings(patient_seeds=[1], validation_seeds=[], patient_spacing_mm=2, patient_variants=1, views=1)
    cache = tmp_path / "cache"
    for settings in (coarse, coarse, replace(coarse, patient_spacing_mm=1)):
        rendered([], cache, settings)
    assert asked == [2, 1]


def test_an_edited_ct_shows_in_the_views(case: Path, tmp_path: Path) -> None:
    mine = shutil.copytree(case, tmp_path / "mine")
    (file, _), _ = rendered([mine], tmp_path / "cache")
    before = read_tensors(file)[1]["bones"]
    ct = read_ct(mine / "ct.nii.gz")
    write_volume(mine / "ct.nii.gz", ct.with_data(torch.where(ct.data > 600, ct.data + 700, ct.data)))
    rendered([mine], tmp_path / "cache")
    assert read_tensors(file)[1]["bones"].float().sum() > 1.5 * before.float().sum()


def test_a_case_that_changes_does_not_hide_other_settings(case: Path, tmp_path: Path) -> None:
    mine = shutil.copytree(case, tmp_path / "mine")
    rendered([mine], tmp_path / "cache")
    os.utime(mine / "ct.nii.gz", ns=(1, 1))
    settings = CohortSettings(patient_seeds=[], validation_seeds=[], case_variants=2, views=2)
    with pytest.raises(InputError, match="rendered with other settings"):
        rendered([mine], tmp_path / "cache", settings)
