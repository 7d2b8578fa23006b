"""Landmarks that do not lie where the label map has the femoral heads: the plan stands in their frame."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP
from femoreg_torch.case import Case, CaseObject
from femoreg_torch.case.femoroplasty import planned
from femoreg_torch.geometry import load_carm
from femoreg_torch.registration.prepare.plan_and_landmarks import (
    doubts_about_the_ends,
    doubts_about_the_frame,
    doubts_about_the_labels,
    doubts_about_the_points,
    doubts_about_the_slices,
    heads_near_landmarks,
    notes_on_the_slices,
)
from femoreg_torch.volume import BoneLabels, Volume, axis_aligned
from femoreg_torch.volume.contradictions import bare_bone

HEADS = {"left": torch.tensor([88.0, -3.0, 4.0]).double(), "right": torch.tensor([-90.0, 2.0, 0.0]).double()}
IDS = {"femur_left": 1, "femur_right": 2, "hip_left": 3, "hip_right": 4}


def bones(moved: Tensor | None = None) -> BoneLabels:
    """Balls of 48 mm on shafts, in sockets that are open below."""
    affine = axis_aligned((2.0, 2.0, 2.0), (-140.0, -50.0, -110.0))
    z, y, x = torch.meshgrid(*(torch.arange(n).double() for n in (85, 50, 140)), indexing="ij")
    points = torch.stack([x, y, z], -1) * 2 + affine[:3, 3]
    data = torch.zeros(x.shape, dtype=torch.int16)
    for side, head in HEADS.items():
        away = points - head
        distance = away.norm(dim=-1)
        shaft = (away[..., :2].norm(dim=-1) < 14) & (away[..., 2] < 0)
        data[(distance < 24) | shaft] = IDS[f"femur_{side}"]
        data[(distance > 27) & (distance < 36) & (away[..., 2] > 0)] = IDS[f"hip_{side}"]
    if moved is not None:
        affine[:3, 3] += moved
    return BoneLabels(Volume(data, affine), IDS)


def case(left: Tensor, right: Tensor) -> Case:
    landmarks = {"FH-l": left, "FH-r": right}
    plan = planned(left + torch.tensor([40.0, 0, -60]).double(), left, None)
    femur = CaseObject("femur", bones=("femur_left",))
    return Case(Path("case"), load_carm("cios_fusion"), {"femur": femur}, (), landmarks=landmarks, plan=plan)


def told_of_frame(of: Case, there: BoneLabels) -> tuple[str, ...]:
    return doubts_about_the_frame(of, there, heads_near_landmarks(of, there))


def told_of_files(of: Case, ct: Volume, there: BoneLabels) -> tuple[str, ...]:
    of_points = doubts_about_the_points(of, ct, there, heads_near_landmarks(of, there))
    return (*doubts_about_the_labels(ct, there), *doubts_about_the_slices(ct, there), *of_points)


@pytest.mark.parametrize(("beside_mm", "told"), [(0, 0), (3, 0), (8, 1), (30, 0)])  # the last is told elsewhere
def test_an_entry_point_outside_the_bone(beside_mm: float, told: int) -> None:
    right = case(HEADS["left"], HEADS["right"])
    assert right.plan is not None
    entry = HEADS["left"] + torch.tensor([14.0 + beside_mm, 0, -50], dtype=torch.float64)
    found = doubts_about_the_ends(replace(right, plan=replace(right.plan, entry_point=entry)), bones())
    assert len(found) == told
    assert all(each.startswith("the planned entry point lies") for each in found)


def test_a_plan_in_the_other_femur() -> None:
    right = replace(case(HEADS["left"], HEADS["right"]), anatomy=HIP)
    assert right.plan is not None
    entry = HEADS["right"] - torch.tensor([14.0, 0, 50], dtype=torch.float64)
    (told,) = doubts_about_the_ends(replace(right, plan=replace(right.plan, entry_point=entry)), bones())
    assert told.startswith("the planned entry point lies on the femur_right, and the femur is that of the other side")


@pytest.mark.parametrize(
    ("left", "right", "says"),
    [
        ((0, 0, 0), (0, 0, 0), None),
        ((2, -1, 1), (-1, 2, 0), None),  # as readers are off
        ((0, 4, 0), (0, -4, 0), None),
        ((0, 8, 0), (0, 0, 0), "FH-l, where the planned path ends, lies 8.0 mm from the middle"),
        ((0, 0, 0), (0, 8, 0), None),  # the path ends in the other one
        ((0, 0, 4), (0, 0.5, 4), "both femoral heads of the label map lie "),
    ],
)
def test_heads_beside_their_landmarks(left: tuple[float, ...], right: tuple[float, ...], says: str | None) -> None:
    off = [torch.tensor(one, dtype=torch.float64) for one in (left, right)]
    told = told_of_frame(case(HEADS["left"] + off[0], HEADS["right"] + off[1]), bones())
    assert len(told) == (says is not None)
    assert all(each.startswith(says or "") for each in told)


def test_a_label_map_beside_the_bones_of_the_ct() -> None:
    right, there = case(HEADS["left"], HEADS["right"]), bones()
    ct = there.labels.with_data(torch.where(there.labels.data > 0, 400.0, 30.0))
    assert told_of_files(right, ct, there) == ()
    (told,) = told_of_files(right, ct.with_data(ct.data.roll(2, 1)), there)  # 4 mm
    assert "if it were moved by (0, 4, 0) mm LPS" in told


def test_a_label_map_of_shells_holds_no_middle_of_a_head() -> None:
    right, hollow = case(HEADS["left"], HEADS["right"]), bones()
    points = torch.stack(torch.meshgrid(*(torch.arange(n).double() for n in (85, 50, 140)), indexing="ij"), -1).flip(-1)
    away = (points * 2 + hollow.labels.lps_from_index[:3, 3] - HEADS["left"]).norm(dim=-1)
    hollow.labels.data[away < 18] = 0
    assert doubts_about_the_ends(right, hollow) == ()
    assert told_of_frame(right, hollow) == ()


def test_a_ct_of_another_origin() -> None:
    right = case(HEADS["left"], HEADS["right"])
    assert told_of_frame(right, bones(torch.tensor([1.0, 0, 0]).double())) == ()
    (told,) = told_of_frame(right, bones(torch.tensor([0, 10.0, 0]).double()))
    assert "both femoral heads of the label map lie" in told
    far = bones(torch.tensor([0, 0, 300.0]).double())  # other checks tell that the landmarks lie outside of the CT
    assert told_of_frame(right, far) == ()


@pytest.mark.parametrize(("factor", "says"), [(1.0, None), (0.9, "less"), (1.1, "more")])
@pytest.mark.parametrize("sides", [("left", "right"), ("left",)])
def test_slices_that_are_told_too_far_apart_make_heads_longer_than_wide(
    factor: float, says: str | None, sides: tuple[str, ...]
) -> None:
    """As the CT, so its labels and the landmarks in it: nothing contradicts another thing."""
    stretch = torch.diag(torch.tensor([1.0, 1.0, factor, 1.0], dtype=torch.float64))
    there = bones()
    stretched = replace(there, labels=Volume(there.labels.data, stretch @ there.labels.lps_from_index))
    right = case(*(HEADS[side] * stretch.diagonal()[:3] for side in HEADS))
    right = replace(right, landmarks={f"FH-{side[0]}": right.landmarks[f"FH-{side[0]}"] for side in sides})
    told = notes_on_the_slices(stretched, heads_near_landmarks(right, stretched))
    assert len(told) == (says is not None)
    if says is not None:
        which = "both femoral heads" if len(sides) == 2 else "the femoral head"
        percent, direction = re.findall(rf"{which} of the label map measures? (\d+) % (\w+) across", told[0])[0]
        assert direction == says
        assert float(percent) == pytest.approx(10, abs=1.5)
        assert f"are the slices of the CT {2 * factor:.3g} mm apart" in told[0]


@pytest.mark.parametrize(
    ("lost", "hu", "told"),
    [
        ("hip_left", 400.0, True),
        ("hip_left", 120.0, False),  # the CT shows none: it was cut there, or the socket is of plastic
        ("hip_left", 3000.0, False),  # metal
        ("hip_right", 400.0, False),  # of the other side: that femur is not registered
    ],
)
def test_a_bone_beside_the_operated_head_that_no_label_covers(lost: str, hu: float, told: bool) -> None:
    right, whole = case(HEADS["left"], HEADS["right"]), bones()
    data = torch.where(whole.labels.data > 0, 400.0, 30.0)
    ct = whole.labels.with_data(torch.where(whole.labels.data == IDS[lost], hu, data))
    rest = whole.labels.with_data(torch.where(whole.labels.data == IDS[lost], 0, whole.labels.data))
    there = BoneLabels(rest, {name: n for name, n in IDS.items() if name != lost})
    words = told_of_files(right, ct, there)
    assert [each for each in words if each.startswith("about FH-l the CT shows")] == list(words)
    assert bool(words) == told


def test_a_head_beyond_the_ct_is_not_asked_for_bone() -> None:
    whole = bones()
    ct = whole.labels.with_data(torch.where(whole.labels.data > 0, 400.0, 30.0))
    assert bare_bone(ct, whole.labels.with_data(torch.zeros_like(whole.labels.data)), HEADS["left"]) is not None
    assert bare_bone(ct, whole.labels, HEADS["left"] + 1000) is None
