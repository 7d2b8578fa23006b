"""The demo from end to end, its accuracy, and the same procedure under other label ids and with other presets."""

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

import femoreg_torch as femoreg
from femoreg_torch.anatomy import HIP, LabelTable, label_table
from femoreg_torch.commands.main import main
from femoreg_torch.volume import read_label_map, write_volume

# Of one simulated procedure, mm: the accuracy study's largest errors are a third of these.
LIMITS = {"pelvis": 0.5, "femur": 1.0, "device": 0.5, "view2": 0.5, "view3": 0.5}
# It leaves the other views where view 1 was, so that no image of them fits, and nothing more is asked.
HARDLY_LOOKS = """
steps:
  - name: pelvis in view 1
    kind: stage
    images: first
    kinds: [anatomy]
    render: [pelvis, femur]
    bodies: [{move: [pelvis, femur], rotation_deg: [5, 5, 5], translation_mm: [6, 6, 30]}]
    level: {pixel_mm: 6.2, step_mm: 3}
    similarity: {kind: grad_ncc, patch_radius: 3}
    optimiser: {kind: levenberg_marquardt, max_iterations: 3}
"""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo") / "demo"
    assert main(["demo", "--out", str(out)]) == 0
    return out


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--out", "{file}"], "is a file, a folder was"),
        (["--out", "{file}er", "--preset", "nope"], "no registration preset 'nope'"),
    ],
)
def test_what_the_demo_cannot_do_is_told_before_it_begins(
    options: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.touch()
    assert main(["demo", *(text.format(file=file) for text in options)]) == 2
    told = capsys.readouterr()
    assert says in told.err
    assert told.err.count("\n") == 1
    assert told.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.fixture(scope="module")
def scene(demo: Path) -> femoreg.Scene:
    return femoreg.prepare_scene(femoreg.read_case(demo / "case"))


def result_of(run: Path) -> dict[str, Any]:
    return json.loads((run / "result.json").read_text(encoding="utf-8"))


def test_the_demo_finds_femur_and_device(demo: Path) -> None:
    result = result_of(demo / "run")
    assert result["trusted"] is True
    assert result["reasons"] == result["skipped"] == []
    for name, limit in LIMITS.items():
        assert result["errors"][name]["mm"] < limit, name
    assert result["errors"]["relative_mm"] < 1.0
    assert result["errors"]["path_deg"] < 1.0


def test_the_demo_writes_all_that_it_says(demo: Path) -> None:
    names = {path.name for path in (demo / "run").iterdir()}
    assert names == {"result.json", "navigation.json", "navigation", "errors.json", "overlay.png", "report.html"}
    text = (demo / "run" / "report.html").read_text(encoding="utf-8")
    assert "Every check passed" in text
    errors = json.loads((demo / "run" / "errors.json").read_text(encoding="utf-8"))
    assert errors["femur"]["mm"] == pytest.approx(result_of(demo / "run")["errors"]["femur"]["mm"], abs=1e-6)


def permuted(case: femoreg.Case, table: LabelTable, path: Path) -> femoreg.Case:
    """The case with a label map of other ids."""
    assert case.labels_path is not None
    labels = read_label_map(case.labels_path)
    data = torch.zeros_like(labels.data, dtype=torch.int32)
    for bone, ids in case.bones.items():
        data[labels.data == ids[0]] = table[bone][0]
    write_volume(path, labels.with_data(data.to(torch.uint8)))
    return replace(case, labels_path=path, bones=table)


@pytest.mark.parametrize("table", ["totalsegmentator_v2", "totalsegmentator_v1", "permuted"])
def test_other_label_ids_give_the_same_scene_bit_for_bit(
    demo: Path, scene: femoreg.Scene, tmp_path: Path, table: str
) -> None:
    """The registration is a function of the scene and the seed, so that it is the same as well."""
    case = femoreg.read_case(demo / "case")
    ids = (
        {bone: (7 * n % 31 + 1,) for n, bone in enumerate(HIP.bone_names, 1)}
        if table == "permuted"
        else label_table(table)
    )
    theirs = femoreg.prepare_scene(permuted(case, ids, tmp_path / "labels.nii.gz"))
    for name, thing in scene.objects.items():
        other = theirs.objects[name]
        assert torch.equal(thing.volume.data, other.volume.data), name
        assert torch.equal(thing.volume.lps_from_index, other.volume.lps_from_index), name
        assert torch.equal(thing.reference_point, other.reference_point), name
        assert thing.classes == other.classes
    assert scene.outline is not None
    assert theirs.outline is not None
    assert scene.outline.bones == theirs.outline.bones == HIP.outline
    assert torch.equal(scene.outline.mask.data, theirs.outline.mask.data)


def test_a_registration_starts_where_a_file_says_and_ends_in_status_3_if_it_is_to_be_trusted_and_is_not(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A preset of one's own that hardly looks: its result says that it must not be trusted."""
    (tmp_path / "hardly_looks.yaml").write_text(HARDLY_LOOKS, encoding="utf-8")
    arguments = ["register", str(demo / "case"), "--preset", str(tmp_path / "hardly_looks.yaml"), "--out"]
    start = ["--start", str(demo / "run" / "result.json")]
    assert main([*arguments, str(tmp_path / "run"), *start, "--require-trust"]) == 3
    begun, found = (result_of(run) for run in (tmp_path / "run", demo / "run"))
    assert begun["start"]["source"] == "poses that were given"
    torch.testing.assert_close(
        torch.tensor(begun["start"]["camera1_from_pelvis"]),
        torch.tensor(found["camera_from_pelvis"][0]),
        atol=1e-6,
        rtol=0,
    )
    assert any("outlines" in note for note in begun["skipped"])
    assert "outlines" in capsys.readouterr().out
    assert begun["trusted"] is False
    assert begun["reasons"]
    assert main(["navigate", str(tmp_path / "run")]) == 0
    assert json.loads((tmp_path / "run" / "navigation.json").read_text(encoding="utf-8"))["trusted"] is False


def test_a_batch_keeps_what_is_done_and_tells_what_was_refused(
    demo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset, runs = tmp_path / "hardly_looks.yaml", tmp_path / "runs"
    preset.write_text(HARDLY_LOOKS, encoding="utf-8")
    cases = [tmp_path / name for name in ("whole", "broken")]
    for case in cases:
        shutil.copytree(demo / "case", case)
    (cases[1] / "view1.tif").unlink()
    arguments = ["batch", *map(str, cases), "--out", str(runs), "--preset", str(preset), "--jobs", "2"]

    def table() -> dict[str, dict[str, str]]:
        with (runs / "table.csv").open(encoding="utf-8") as file:
            return {row["case"]: row for row in csv.DictReader(file)}

    assert main(arguments) == 2
    rows = table()
    assert list(rows) == ["whole", "broken"]
    assert [row["status"] for row in rows.values()] == ["done", "refused"]
    assert "view1.tif" in rows["broken"]["reasons"]
    assert rows["whole"]["trusted"] == "false"
    assert float(rows["whole"]["pelvis_mm"]) == pytest.approx(
        result_of(runs / "whole")["errors"]["pelvis"]["mm"], abs=1e-4
    )
    assert not (runs / "broken").exists()
    shutil.copy(demo / "case" / "view1.tif", cases[1] / "view1.tif")
    capsys.readouterr()
    assert main([*arguments, "--require-trust"]) == 3
    rows = table()
    assert [row["status"] for row in rows.values()] == ["kept", "done"]
    assert rows["broken"]["pelvis_mm"] == rows["whole"]["pelvis_mm"]
    assert "whole" in capsys.readouterr().out
