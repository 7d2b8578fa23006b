"""Random CTs around bone shapes, and the training of the network on them, at the smallest size."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from femoreg_torch.anatomy import HIP
from femoreg_torch.commands.main import main
from femoreg_torch.errors import InputError
from femoreg_torch.segment import load_bone_network
from training.segmentation.learn import (
    WEIGHTS_NAME,
    SegmentationSettings,
    _altered,
    _NetworkShape,
    _ScanRanges,
    read_segmentation_settings,
    segmentation_loss,
    train_segmentation,
)
from training.segmentation.scans import Scan, ScanSettings, random_scan
from training.segmentation.shapes import STEP_MM, UNIT_MM, BoneShape, _save

SMALL = ScanSettings(sizes=((3, 3), (3, 3), (4, 4)))


def ball_shape(name: str = "balls") -> BoneShape:
    """Balls in place of bones: hips at both sides, femoral heads beside them, sacrum and vertebrae in the middle."""
    places = {
        "hip_left": (60, 0, 40, 30),
        "hip_right": (-60, 0, 40, 30),
        "vertebrae": (0, 30, 110, 25),
        "sacrum": (0, 40, 40, 25),
        "femur_left": (90, 0, -10, 22),
        "femur_right": (-90, 0, -10, 22),
    }
    axes = [np.arange(low, high, STEP_MM) for low, high in ((-130, 130), (-60, 90), (-60, 150))]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    fields = []
    for bone in HIP.bone_names:
        a, b, c, r = places[bone]
        fields.append(np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2) - r)
    distance = np.clip(np.round(np.stack(fields) / UNIT_MM), -127, 127).astype(np.int8)
    heads = np.array([places["femur_left"][:3], places["femur_right"][:3]], float)
    return BoneShape(name, torch.from_numpy(distance), np.array([-130.0, -60, -60]), heads, np.full(2, 22.0), True)


@pytest.fixture(scope="module")
def scans() -> list[Scan]:
    return [random_scan(ball_shape(), seed, SMALL) for seed in range(6)]


def test_a_seed_gives_the_same_scan_again(scans: list[Scan]) -> None:
    again = random_scan(ball_shape(), 0, SMALL)
    assert torch.equal(again.hu, scans[0].hu)
    assert torch.equal(again.labels, scans[0].labels)


def test_left_is_left_however_a_scan_is_mirrored(scans: list[Scan]) -> None:
    pairs = 0
    for scan in scans:
        for bone in ("hip", "femur"):
            left, right = (scan.labels == 1 + HIP.bone_names.index(f"{bone}_{side}") for side in ("left", "right"))
            if left.sum() > 50 and right.sum() > 50:
                pairs += 1
                assert left.nonzero()[:, 2].float().mean() > right.nonzero()[:, 2].float().mean()
    assert pairs


def test_values_are_those_of_a_scanner_and_bone_is_brighter_than_what_is_around(scans: list[Scan]) -> None:
    brighter = []
    for scan in scans:
        assert scan.hu.isfinite().all()
        assert scan.hu.min() > -1300
        assert scan.hu.max() <= 3500
        bone, soft = scan.labels > 0, (scan.labels == 0) & (scan.hu > -300)
        if bone.sum() > 500 and soft.sum() > 500:
            brighter.append(float(scan.hu[bone].mean() - scan.hu[soft].mean()))
    assert np.median(brighter) > 100
    assert sum(float(scan.hu.min()) <= -800 for scan in scans) >= 0.8 * len(scans)  # few crops hold no air


def test_a_used_scan_comes_back_as_its_mirror_image_with_sides_exchanged(scans: list[Scan]) -> None:
    import random

    scan = scans[0]
    again = _altered(scan, random.Random(0))
    femur = [1 + HIP.bone_names.index(f"femur_{side}") for side in ("left", "right")]
    assert torch.equal(again.labels == femur[0], (scan.labels == femur[1]).flip(2))
    assert torch.corrcoef(torch.stack([again.hu.flip(2).flatten(), scan.hu.flatten()]))[0, 1] > 0.98


def test_the_loss_falls_to_nearly_nothing_for_the_truth() -> None:
    labels = torch.randint(0, 3, (1, 4, 4, 4), generator=torch.Generator().manual_seed(0))
    sure = 20 * torch.nn.functional.one_hot(labels, 3).movedim(-1, 1).float()
    assert segmentation_loss(sure, labels) < 0.01
    assert segmentation_loss(-sure, labels) > 5


def test_a_run_is_resumed_and_its_weights_are_read(tmp_path: Path) -> None:
    settings = SegmentationSettings(
        steps=2,
        held_out=["held"],
        network=_NetworkShape([8, 16]),
        scans=_ScanRanges(3.0, [[2, 2], [2, 2], [2, 2]]),
        checkpoint_steps=1,
    )
    for name in ("balls", "held"):
        _save(ball_shape(name), tmp_path / f"{name}.npz")
    told: list[str] = []
    paths, out = [Path("balls.npz"), Path("held.npz")], tmp_path / "run"
    weights = train_segmentation(settings, paths, out, tmp_path, False, told.append)
    assert weights == out / WEIGHTS_NAME
    with pytest.raises(InputError, match="holds a training run"):
        train_segmentation(settings, paths, out, tmp_path, False, told.append)
    train_segmentation(replace(settings, steps=3), paths, out, tmp_path, True, told.append)
    assert "step 3" in told[-1]
    assert len((out / "progress.csv").read_text(encoding="utf-8").splitlines()) == 4
    assert load_bone_network(weights).multiple == 4
    checkpoint = out / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"checkpoint\.pt: is cut off"):
        train_segmentation(replace(settings, steps=4), paths, out, tmp_path, True, told.append)


def test_a_shape_that_is_not_there_is_told_before_a_folder_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing, out = tmp_path / "none.npz", tmp_path / "run"
    assert main(["train-segmentation", "bones6", "--shapes", f"[{missing}]", "--out", str(out)]) == 2
    assert f"--shapes: {missing}: no such file" in capsys.readouterr().err
    assert not out.exists()


def test_the_shipped_settings_can_be_read() -> None:
    settings = read_segmentation_settings("bones6")
    assert settings.shape.classes == 1 + len(HIP.bones)
    assert not {"z013", "z035", "z042", "z055"} & set(settings.held_out)
