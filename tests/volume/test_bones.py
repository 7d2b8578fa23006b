"""Bones by name from whatever ids a label map has."""

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from femoreg_torch.anatomy import HIP, LabelTable, label_table
from femoreg_torch.errors import InputError
from femoreg_torch.volume import BoneLabels, Volume, axis_aligned, bone_labels

GRID = axis_aligned((4.0, 4.0, 4.0), (-78.0, -38.0, -58.0))  # x from −78 to 78 mm: +x is the patient's left
# Blocks by index ranges z, y, x.
BLOCKS = {
    "hip_left": (slice(14, 26), slice(4, 14), slice(24, 34)),
    "hip_right": (slice(14, 26), slice(4, 14), slice(6, 16)),
    "sacrum": (slice(16, 28), slice(12, 18), slice(17, 23)),
    "femur_left": (slice(2, 12), slice(6, 12), slice(28, 34)),
    "femur_right": (slice(2, 12), slice(6, 12), slice(6, 12)),
}
LANDMARKS = {
    "FH-l": [46.0, -5, -15], "FH-r": [-46.0, -5, -15], "GSN-l": [40.0, 10, 10], "GSN-r": [-40.0, 10, 10],
    "ASIS-l": [50.0, -20, 40], "ASIS-r": [-50.0, -20, 40], "SPS-l": [22.0, -22, 2], "SPS-r": [-22.0, -22, 2],
}  # fmt: skip


def marks() -> dict[str, Tensor]:
    return {name: torch.tensor(point, dtype=torch.float64) for name, point in LANDMARKS.items()}


def label_map(table: LabelTable, extra: Mapping[str, int] | None = None) -> Volume:
    data = torch.zeros(30, 20, 40, dtype=torch.int32)
    for name, block in BLOCKS.items():
        if name in table:
            data[block] = table[name][0]
    if extra:
        data[28:30, :, :] = extra["muscle"]
        data[0:2, :, :] = extra["tibia"]
    return Volume(data, GRID)


def ct() -> Volume:
    hu = torch.full((30, 20, 40), 50.0)
    for block in BLOCKS.values():
        hu[block] = 600.0
    hu[0:2] = 700.0
    return Volume(hu, GRID)


def told(table: LabelTable, **kwargs: int) -> BoneLabels:
    return bone_labels(label_map(table, kwargs or None), ct(), table, HIP, marks())


def test_other_ids_give_the_same_bones_voxel_for_voxel() -> None:
    ours = told(label_table("femoreg"))
    for name in ("totalsegmentator_v1", "totalsegmentator_v2", "autoseg"):
        theirs = told(label_table(name))
        assert theirs.ids == ours.ids, name
        assert torch.equal(theirs.labels.data, ours.labels.data), name


def test_what_was_not_found_in_the_map_is_not_told() -> None:
    table = {name: ids for name, ids in label_table("femoreg").items() if name != "sacrum"}
    bones = told(table | {"sacrum": (77,)})
    assert set(bones.ids) == set(BLOCKS)
    without = bone_labels(label_map(table), ct(), table | {"sacrum": (77,)}, HIP, marks())
    assert "sacrum" not in without.ids
    assert without.of(["pelvis"], HIP) == without.of(["hip_left", "hip_right"], HIP)
    with pytest.raises(InputError, match="no voxel carries the label 77, the sacrum"):
        without.of(["sacrum"], HIP)
    with pytest.raises(InputError, match=r"does not tell which voxels are femur_left. It tells: .*sacrum"):
        told({"sacrum": (4,)}).of(["femur_left"], HIP)


def test_soft_tissue_with_a_label_is_left_out_and_other_bone_is_not() -> None:
    bones = told(label_table("femoreg"), muscle=80, tibia=90)
    assert not bones.labels.data[29, 0, 0]
    other = bones.labels.data[0, 0, 0]
    assert other
    assert other not in bones.ids.values()


@pytest.mark.parametrize("ids", [(1, 2, 4), (4, 1, 2), (2, 9, 1)])
def test_a_pelvis_by_its_ids_is_told_apart_by_landmarks(ids: tuple[int, int, int]) -> None:
    """Which id is which bone differs from map to map; the landmarks lie on the hip bones."""
    by_bone = {
        "hip_left": (ids[0],),
        "hip_right": (ids[1],),
        "sacrum": (ids[2],),
        "femur_left": (50,),
        "femur_right": (60,),
    }
    labels = label_map(by_bone)
    table = {"pelvis": tuple(sorted(ids)), "femur_left": (50,), "femur_right": (60,)}
    bones = bone_labels(labels, ct(), table, HIP, marks())
    for name, block in BLOCKS.items():
        found = bones.labels.data[block].unique().tolist()
        assert found == [bones.ids[name]], name


def test_a_pelvis_of_one_id_stays_whole() -> None:
    by_bone: LabelTable = dict.fromkeys(("hip_left", "hip_right", "sacrum"), (1,)) | {"femur_left": (5,)}
    bones = bone_labels(label_map(by_bone), ct(), {"pelvis": (1,), "femur_left": (5,)}, HIP, marks())
    assert set(bones.ids) == {"pelvis", "femur_left"}
    assert bones.of(["pelvis"], HIP) == (bones.ids["pelvis"],)


def test_sides_that_share_an_id_are_parted_between_their_landmarks() -> None:
    bones = told(label_table("pelvic_ref"))
    for name, block in BLOCKS.items():
        assert bones.labels.data[block].unique().tolist() == [bones.ids[name]], name
    assert torch.equal(bones.labels.data > 0, label_map(label_table("pelvic_ref")).data > 0)


def test_sides_that_share_an_id_are_parted_between_their_middles_where_no_landmark_is_known() -> None:
    """Blocks of half the size of bones: so the map is twice as large."""
    labels = Volume(label_map(label_table("pelvic_ref")).data, axis_aligned((8.0, 8.0, 8.0), (-156.0, -76.0, -116.0)))
    bones = bone_labels(labels, Volume(ct().data, labels.lps_from_index), label_table("pelvic_ref"), HIP, {})
    for name, block in BLOCKS.items():
        assert bones.labels.data[block].unique().tolist() == [bones.ids[name]], name


def test_one_side_alone_is_not_parted() -> None:
    labels = label_map({name: ids for name, ids in label_table("pelvic_ref").items() if not name.endswith("right")})
    with pytest.raises(InputError, match="hip_left and hip_right share an id, and may be one side alone"):
        bone_labels(labels, ct(), label_table("pelvic_ref"), HIP, {})


def test_sides_that_share_an_id_need_landmarks_of_both() -> None:
    one_side = {name: point for name, point in marks().items() if name != "FH-r"}
    with pytest.raises(InputError, match="femur_left and femur_right share an id, and no landmark of femur_right"):
        bone_labels(label_map(label_table("pelvic_ref")), ct(), label_table("pelvic_ref"), HIP, one_side)


def test_bones_without_an_anatomy_are_those_of_the_table() -> None:
    table = {"tibia": (3,), "wire": (300,)}
    data = torch.zeros(30, 20, 40, dtype=torch.int32)
    data[2:8], data[10:12] = 3, 300
    bones = bone_labels(Volume(data, GRID), ct(), table, None, {})
    assert bones.labels.data[10, 0, 0] == bones.of(["wire"], None)[0]
    assert bones.labels.data[2, 0, 0] == bones.of(["tibia"], None)[0]
