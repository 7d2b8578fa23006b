"""The digest of what a registration reads: every file counts by its content, wherever it lies."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from femoreg_torch.case import read_case
from femoreg_torch.case.inputs import case_digest, inputs_digest
from femoreg_torch.errors import InputError

CASE = """\
version: 2
ct: {image: ../scan, labels: labels.mhd, bones: table.yaml}
landmarks: landmarks.json
objects:
  shank: {bones: [tibia], start: landmarks}
  wire: {model: wire.stl, hu: 9000, points: {tip: [0, 0, 9], base: [0, 0, 0]}, start: {beside: shank}}
plan: {object: shank, file: ../plans/plan.json, tool: wire}
carm: carm.yaml
views: [{image: a.tif, field: mask.tif}]
"""
HEADER = "NDims = 3\nDimSize = 2 1 1\nElementType = MET_UCHAR\nElementDataFile = voxels.raw\n"
FILES = {
    "case/case.yaml": CASE,
    "case/labels.mhd": HEADER,
    "case/voxels.raw": "12",
    "case/table.yaml": "{anatomy: shank, bones: {tibia: 3}}\n",
    "case/landmarks.json": '{"space": "LPS", "unit": "mm", "landmarks": {"knee": [1, 2, 50]}}',
    "case/wire.stl": "wire",
    "case/carm.yaml": "extends: ../base.yaml\n",
    "base.yaml": "{sdd_mm: 1100, pixel_mm: [0.3, 0.3], shape: [64, 64]}\n",
    "case/a.tif": "a",
    "case/mask.tif": "mask",
    "plans/plan.json": '{"plan": {"entry_point": [1, 2, 3], "target": [1, 2, 50]}}',
    "scan/1.dcm": "one",
    "linked/2.dcm": "two",
}
CHANGED = FILES | {
    "case/case.yaml": CASE.replace("hu: 9000", "hu: 8000"),
    "case/labels.mhd": HEADER.replace("DimSize = 2 1 1", "DimSize = 1 2 1"),
    "case/voxels.raw": "21",
    "case/table.yaml": "{anatomy: shank, bones: {tibia: 4}}\n",
    "case/landmarks.json": FILES["case/landmarks.json"].replace("50", "40"),
    "case/carm.yaml": "extends: ../base.yaml\nsdd_mm: 1000\n",
    "base.yaml": FILES["base.yaml"].replace("1100", "1101"),
    "plans/plan.json": FILES["plans/plan.json"].replace("50", "51"),
}


def write(root: Path) -> Path:
    for name, text in FILES.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    (root / "scan" / "more").symlink_to(root / "linked")
    (root / "linked" / "back").symlink_to(root / "scan")  # leads back
    return root / "case"


def of(case: Path) -> str:
    return inputs_digest(read_case(case))


@pytest.mark.parametrize("name", FILES)
def test_a_changed_file_is_told_though_size_and_time_are_those_of_old(name: str, tmp_path: Path) -> None:
    case = write(tmp_path)
    path = tmp_path / name
    os.utime(path, (0, 0))
    before, of_case = of(case), case_digest(read_case(case))
    changed = CHANGED[name] if CHANGED[name] != FILES[name] else FILES[name].swapcase()
    assert len(changed) == len(FILES[name]) or name == "case/carm.yaml"
    path.write_text(changed, encoding="utf-8")
    os.utime(path, (0, 0))
    assert of(case) != before
    assert case_digest(read_case(case)) != of_case


@pytest.mark.parametrize(
    "change",
    [
        lambda root: (root / "linked" / "3.dcm").write_text("three", encoding="utf-8"),
        lambda root: (root / "scan" / "1.dcm").rename(root / "scan" / "0.dcm"),
        lambda root: (root / "linked" / "2.dcm").unlink(),
    ],
    ids=["one more", "renamed", "one less"],
)
def test_files_that_come_and_go_in_a_folder_of_the_ct_are_told(change: Callable[[Path], None], tmp_path: Path) -> None:
    case = write(tmp_path)
    before = of(case)
    change(tmp_path)
    assert of(case) != before


def test_neither_place_nor_time_nor_what_is_not_read_counts(tmp_path: Path) -> None:
    before = of(write(tmp_path / "here"))
    case = write(tmp_path / "there")
    (case / "notes.txt").write_text("looked at", encoding="utf-8")
    os.utime(case / "a.tif", (0, 0))
    assert of(case) == before


def test_a_truth_that_comes_later_and_comments_make_no_other_case(tmp_path: Path) -> None:
    folder = write(tmp_path)
    case = read_case(folder)
    before = case_digest(case)
    (folder / "truth.json").write_text("{}", encoding="utf-8")
    file = folder / "case.yaml"
    file.write_text(f"# looked at\ntruth: truth.json\n{file.read_text(encoding='utf-8')}", encoding="utf-8")
    assert case_digest(case) == before


def test_other_files_and_settings_count(tmp_path: Path) -> None:
    case = read_case(write(tmp_path))
    weights = tmp_path / "weights"
    weights.write_text("1", encoding="utf-8")
    found = [inputs_digest(case, {"weights": weights}, {"steps": 1}), inputs_digest(case, {"start": weights})]
    found += [inputs_digest(case), inputs_digest(case, {}, {"steps": 2}), inputs_digest(case, {"weights": weights})]
    weights.write_text("2", encoding="utf-8")
    found += [inputs_digest(case, {"weights": weights})]
    assert len(set(found)) == len(found)


@pytest.mark.parametrize(("key", "value", "known"), [("space", "RAS", "LPS"), ("unit", "m", "mm")])
def test_a_plan_in_another_space_or_unit_is_refused(key: str, value: str, known: str, tmp_path: Path) -> None:
    folder = write(tmp_path)
    plan = FILES["plans/plan.json"]
    (tmp_path / "plans" / "plan.json").write_text(f'{{"{key}": "{value}", {plan[1:]}', encoding="utf-8")
    with pytest.raises(InputError, match=rf"plan\.json, {key}: {known} was expected, found '{value}'"):
        read_case(folder)
    (tmp_path / "plans" / "plan.json").write_text(f'{{"{key}": "{known.upper()}", {plan[1:]}', encoding="utf-8")
    read_case(folder)
