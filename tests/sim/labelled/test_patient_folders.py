"""Patients on disk: bones by the table that a case names, and refusals of maps whose ids nobody names."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import yaml
from boxes import box_scan, landmarks

from femoreg_torch.anatomy import HIP, label_table
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.volume import Volume, write_landmarks, write_volume
from sim.labelled.imaged_patient import read_imaged_patient
from sim.labelled.patient_folders import find_patient, hip_labels, read_patient

BONES = ("hip_left", "hip_right", "sacrum", "femur_left", "femur_right")
CASE = {
    "version": 2,
    "anatomy": "hip",
    "landmarks": "landmarks.json",
    "objects": {"pelvis": {"bones": "pelvis", "start": "landmarks"}},
    "carm": "cios_fusion",
}


def renumbered(labels: Volume, ids: dict[str, int]) -> Volume:
    """Labels of the table `femoreg` with other ids; bones that have none are background."""
    data = torch.zeros_like(labels.data)
    for bone, n in ids.items():
        data[labels.data == label_table("femoreg")[bone][0]] = n
    return labels.with_data(data)


def first_ids(table: str) -> dict[str, int]:
    return {bone: label_table(table)[bone][0] for bone in BONES}


def plain_folder(folder: Path, ids: dict[str, int] | None = None) -> Path:
    """ct.nii.gz, labels.nii.gz and landmarks.json of the boxes, without a case.yaml."""
    folder.mkdir(parents=True)
    ct, labels = box_scan()
    write_volume(folder / "ct.nii.gz", ct)
    write_volume(folder / "labels.nii.gz", labels if ids is None else renumbered(labels, ids))
    write_landmarks(folder / "landmarks.json", landmarks())
    return folder


def case_folder(folder: Path, ids: dict[str, int], bones: object) -> Path:
    """The same as a case, whose files have other names."""
    plain_folder(folder, ids)
    (folder / "ct.nii.gz").rename(folder / "scan.nii.gz")
    (folder / "labels.nii.gz").rename(folder / "bones of it.nii.gz")
    write_case_yaml(folder, {"image": "scan.nii.gz", "labels": "bones of it.nii.gz", "bones": bones})
    return folder


def write_case_yaml(folder: Path, ct: dict[str, object]) -> None:
    (folder / "case.yaml").write_text(yaml.safe_dump({**CASE, "ct": ct}), encoding="utf-8")


def labels_of(folder: Path) -> torch.Tensor:
    return hip_labels(read_patient(find_patient(folder)).bones).data


def refusal(folder: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_patient(find_patient(folder))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_without_a_case_the_ids_are_kept(tmp_path: Path) -> None:
    assert labels_of(plain_folder(tmp_path / "a")).equal(box_scan()[1].data)


@pytest.mark.parametrize(
    ("ids", "bones"),
    [
        (first_ids("totalsegmentator_v2"), "totalsegmentator_v2"),
        (first_ids("autoseg"), "autoseg"),
        (first_ids("femoreg"), "femoreg"),
        (dict(zip(BONES, (6, 5, 4, 2, 1), strict=True)), dict(zip(BONES, (6, 5, 4, 2, 1), strict=True))),
    ],
    ids=["totalsegmentator_v2", "autoseg", "femoreg", "own"],
)
def test_a_case_says_which_ids_are_which_bones(tmp_path: Path, ids: dict[str, int], bones: object) -> None:
    assert labels_of(case_folder(tmp_path / "a", ids, bones)).equal(box_scan()[1].data)


def test_masks_of_a_case_by_their_names(tmp_path: Path) -> None:
    folder = case_folder(tmp_path / "a", first_ids("femoreg"), "femoreg")
    labels = box_scan()[1]
    (folder / "masks").mkdir()
    for bone in BONES:
        write_volume(folder / "masks" / f"{bone}.nii.gz", renumbered(labels, {bone: 1}))
    write_case_yaml(folder, {"image": "scan.nii.gz", "labels": "masks"})
    assert labels_of(folder).equal(labels.data)


def test_images_of_a_case_with_another_table_show_the_same_bones(tmp_path: Path) -> None:
    ours = read_imaged_patient(plain_folder(tmp_path / "a"))
    other = read_imaged_patient(case_folder(tmp_path / "b", first_ids("totalsegmentator_v2"), "totalsegmentator_v2"))
    assert list(other.masks) == list(ours.masks) == list(BONES)
    assert all(other.masks[bone].data.equal(ours.masks[bone].data) for bone in BONES)
    assert all(other.femora[femur].data.equal(ours.femora[femur].data) for femur in ours.femora)


def test_bone_that_no_table_names_is_nobodys_and_is_told(tmp_path: Path) -> None:
    ids = first_ids("femoreg")
    named = {bone: n for bone, n in ids.items() if bone != "sacrum"}
    patient = read_patient(find_patient(case_folder(tmp_path / "a", ids, named)))
    sacrum = box_scan()[1].data == ids["sacrum"]
    found = hip_labels(patient.bones).data[sacrum]
    known = {n for numbers in label_table("femoreg").values() for n in numbers}
    assert not known & set(found.tolist())
    assert (found > 0).all()  # a rim does not grow into it
    assert any("none of hip_left" in note for note in patient.bones.notes)
    named["sacrum"] = ids["sacrum"]
    assert read_patient(find_patient(case_folder(tmp_path / "b", ids, named))).bones.notes == ()


def test_ids_of_another_table_without_a_case(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = plain_folder(tmp_path / "a", first_ids("totalsegmentator_v2"))
    assert main(["labelled-images", str(folder), "--out", str(tmp_path / "x.safetensors"), "--count", "1"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert f"{folder}/labels.nii.gz: holds the ids 25, 75, 76, 77, 78" in told
    assert "femoreg new-case" in told
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("lacking", ["hip_left", "hip_right", "femur_left", "femur_right"])
def test_a_map_that_lacks_a_bone_with_landmarks(tmp_path: Path, lacking: str) -> None:
    ids = {bone: n for bone, n in first_ids("femoreg").items() if bone != lacking}
    told = refusal(plain_folder(tmp_path / "a", ids))
    assert told.startswith(f"{tmp_path}/a/labels.nii.gz: no voxel is told to be {lacking}. It holds the ids ")
    assert "femoreg new-case" in told


def test_the_wrong_table_in_a_case(tmp_path: Path) -> None:
    told = refusal(case_folder(tmp_path / "a", first_ids("totalsegmentator_v2"), "totalsegmentator_v1"))
    assert told.startswith(f"{tmp_path}/a/bones of it.nii.gz: label map: no voxel carries the hip_left or hip_right")
    assert "`bones: totalsegmentator_v2` under `ct:` in case.yaml" in told
    none_fits = {bone: 200 + n for bone, n in first_ids("femoreg").items()}
    told = refusal(case_folder(tmp_path / "b", none_fits, "totalsegmentator_v1"))
    assert "no voxel is told to be hip_left, hip_right, femur_left, femur_right. It holds the ids 201, 202" in told
    assert f"{tmp_path}/b/case.yaml" in told


def test_sides_that_are_exchanged(tmp_path: Path) -> None:
    ids = first_ids("femoreg")
    ids["hip_left"], ids["hip_right"] = ids["hip_right"], ids["hip_left"]
    assert "hip_left lies to the right of hip_right" in refusal(plain_folder(tmp_path / "a", ids))


def test_what_a_folder_lacks(tmp_path: Path) -> None:
    assert "no such folder" in refusal(tmp_path / "none")
    folder = plain_folder(tmp_path / "a")
    (folder / "labels.nii.gz").unlink()
    assert refusal(folder).startswith(f"{folder}/labels.nii.gz: no such file")
    plan = {"entry_point": [90, -10, -120], "target": "FH"}
    case = {"version": 2, "template": "femoroplasty", "side": "left", "ct": {"image": "ct.nii.gz"}, "plan": plan}
    case |= {key: CASE[key] for key in ("landmarks", "carm")}
    (folder / "case.yaml").write_text(yaml.safe_dump(case), encoding="utf-8")
    assert "case.yaml, ct.labels: missing" in refusal(folder)
    folder = plain_folder(tmp_path / "b")
    write_landmarks(folder / "landmarks.json", {k: v for k, v in landmarks().items() if k not in ("FH-r", "SPS-l")})
    assert "it lacks FH-r, SPS-l." in refusal(folder)


def touched(path: Path) -> None:
    """Written once more, a second later."""
    stat = path.stat()
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 10**9))


@pytest.mark.parametrize(
    "edit",
    [
        lambda folder: touched(folder / "scan.nii.gz"),
        lambda folder: touched(folder / "bones of it.nii.gz"),
        lambda folder: touched(folder / "landmarks.json"),
        lambda folder: write_case_yaml(
            folder, {"image": "scan.nii.gz", "labels": "bones of it.nii.gz", "bones": "autoseg"}
        ),
    ],
    ids=["ct", "labels", "landmarks", "table"],
)
def test_the_fingerprint_knows_every_file(tmp_path: Path, edit: Callable[[Path], None]) -> None:
    folder = case_folder(tmp_path / "a", first_ids("femoreg"), "femoreg")
    before = find_patient(folder).fingerprint()
    touched(folder / "case.yaml")  # which may say other things too, of images for instance
    assert find_patient(folder).fingerprint() == before
    edit(folder)
    assert find_patient(folder).fingerprint() != before


def test_the_bones_that_must_be_there_bear_all_landmarks() -> None:
    assert {HIP.landmarks[n].bone for n in range(len(HIP.landmarks))} == set(BONES) - {"sacrum"}
