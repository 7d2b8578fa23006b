"""From the ids of whatever label map a user brings to bones by name.

What follows asks for bones, never for ids: a map with other ids gives the same volume here, voxel for voxel.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy, LabelTable, fitting_tables
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import transform_points
from femoreg_torch.volume.grid import Volume
from femoreg_torch.volume.labels import label_box, looked_up

_OTHER_BONE_HU = 80.0  # mean above which a label that no table names is bone, and a bone's rim does not grow into it
_NEAR_MM = 15.0  # along every axis: a landmark lies closer than this to its bone
# From side to side, of two in one label: the middles of hip bones and femora of twenty adults lay 127 mm apart and
# more, those of the halves of one bone at most 40.
_SIDES_APART_MM, _MOST_VOXELS, _ROUNDS = 80.0, 100_000, 10


@dataclass(frozen=True, eq=False)
class BoneLabels:
    """A label map whose ids are numbered here, and what they are."""

    labels: Volume  # uint8, 0 where there is no bone
    ids: dict[str, int]  # of every bone that occurs in it, or of a group of bones that it does not tell apart
    absent: LabelTable = field(default_factory=dict)  # what the user's table names, and no voxel carries
    notes: tuple[str, ...] = ()  # what had to be done to CT and label map, in words
    against: tuple[str, ...] = ()  # what speaks against where the label map lies, in words

    def of(self, bones: Sequence[str], anatomy: Anatomy | None) -> tuple[int, ...]:
        """Ids of bones and groups. Raises `InputError` for a bone that the map does not tell."""
        wanted = self._members(bones, anatomy)
        for bone in wanted:
            if bone in self.absent:
                ids = ", ".join(map(str, self.absent[bone]))
                raise InputError(
                    f"label map: no voxel carries the label {ids}, the {bone}. Check its ids in case.yaml."
                )
            if bone not in self.ids:
                known = ", ".join(self.ids)
                raise InputError(
                    f"label map: does not tell which voxels are {bone}. It tells: {known}. See `ct.bones`."
                )
        return tuple(self.ids[bone] for bone in wanted)

    def _members(self, bones: Sequence[str], anatomy: Anatomy | None) -> list[str]:
        """Single bones; a group that the map holds as a whole stays, bones that it lacks of another are left out."""
        found: list[str] = []
        for name in bones:
            if name in self.ids or anatomy is None or name not in anatomy.groups:
                found.append(name)
            else:
                inside = [bone for bone in anatomy.members(name) if bone in self.ids]
                found += inside or [name]
        return list(dict.fromkeys(found))


def bone_labels(
    labels: Volume, ct: Volume, table: LabelTable, anatomy: Anatomy | None, landmarks: Mapping[str, Tensor]
) -> BoneLabels:
    """The bones of a user's label map, by the ids that `table` has for them; `ct` in HU on the same grid.

    Where a table names a group of bones by several ids (the pelvis, say), the `landmarks` (3,), LPS mm, tell which id
    is which bone. Where both sides share an id, they are parted half-way between their landmarks, or between their
    middles where no landmark of either is known. Labels that the table does not name are left out where they are soft
    tissue. Raises `InputError` if sides cannot be parted, or where the ids are those of another table.
    """
    counts = torch.bincount(labels.data.flatten()).numpy()
    _check_table(set(np.flatnonzero(counts).tolist()), table, anatomy)
    table = _with_groups_told_apart(labels, table, anatomy, landmarks)
    order = anatomy.bone_names if anatomy else ()
    names = [*(name for name in order if name in table), *(name for name in table if name not in order)]
    data = labels.data.numpy()
    # bones of the anatomy have their own numbers, whatever else is in the table
    number = {name: 1 + order.index(name) for name in names if name in order}
    number |= {name: n for n, name in enumerate((name for name in names if name not in order), 1 + len(order))}
    lookup = np.zeros(max(len(counts), 1 + max(n for ids in table.values() for n in ids)), np.uint8)
    for name in reversed(names):  # of two that share an id the first takes it; they are parted below
        lookup[list(table[name])] = number[name]
    lookup[_other_bones(data, counts, ct, table)] = max(number.values()) + 1
    found = torch.from_numpy(looked_up(lookup, data))
    present = set(lookup[np.flatnonzero(counts)].tolist())
    for name in names:
        mirror = anatomy.bone(name).mirror if anatomy and name in order else name
        if mirror in number and number[mirror] > number[name] and set(table[name]) & set(table[mirror]):
            _part_sides(labels.with_data(found), name, mirror, number, anatomy, landmarks)
            present = set(torch.bincount(found.flatten()).nonzero()[:, 0].tolist())
    return BoneLabels(
        labels.with_data(found),
        {name: n for name, n in number.items() if n in present},
        {name: table[name] for name, n in number.items() if n not in present},
    )


def _check_table(there: set[int], table: LabelTable, anatomy: Anatomy | None) -> None:
    """Raises `InputError` where no hip bone of the table is `there`, but another table finds all bones of the hips.

    The hip bones are those that outlines are compared by; ids of another table's femora may stand for muscles here.
    """
    if anatomy is None:
        return
    named = {bone for bone in table if set(anatomy.outline) & set(anatomy.members(bone))}
    wanted = {n for bone in named for n in table[bone]}
    if not wanted or wanted & there or not (fitting := fitting_tables(there)):
        return
    ids = ", ".join(map(str, sorted(wanted)))
    one = len(fitting) == 1
    name = fitting[0] if one else "NAME"
    advice = "Name that one:" if one else "Name the one of them by whose program the map was made:"
    raise InputError(
        f"label map: no voxel carries the {' or '.join(sorted(named))} of its table ({ids}), but hip bones and femora "
        f"of the table {' and of '.join(fitting)} are there. {advice} `--bones {name}`, or `bones: {name}` under `ct:` "
        "in case.yaml."
    )


def _other_bones(data: np.ndarray, counts: np.ndarray, ct: Volume, table: LabelTable) -> list[int]:
    """Ids in the map that the table does not name, and that are as dense as bone."""
    named = {0, *(n for ids in table.values() for n in ids)}
    unnamed = [n for n in np.flatnonzero(counts).tolist() if n not in named]
    if not unnamed:
        return []
    sums = np.bincount(data.ravel(), weights=ct.data.numpy().ravel())
    return [n for n in unnamed if sums[n] / counts[n] > _OTHER_BONE_HU]


def _part_sides(
    labels: Volume,
    bone: str,
    mirror: str,
    number: Mapping[str, int],
    anatomy: Anatomy | None,
    landmarks: Mapping[str, Tensor],
) -> None:
    """Give the voxels of `bone` that lie beyond the plane half-way to its `mirror` to that one, in place."""
    assert anatomy is not None  # without one no bone has a mirror
    ids = [number[bone]]
    known = {n: [landmarks[mark] for mark in anatomy.landmarks_of(n) if mark in landmarks] for n in (bone, mirror)}
    if any(known.values()):
        for name, points in known.items():
            if not points:
                raise InputError(
                    f"label map: {bone} and {mirror} share an id, and no landmark of {name} tells them apart. Give "
                    "landmarks of both sides, or a label map with an id for each."
                )
        middles = [torch.stack(points).double().mean(0) for points in known.values()]
    else:
        middles = _middles_of_sides(labels, ids[0], bone, mirror)
    low, high = label_box(labels, ids)
    axes = [torch.arange(a, b, dtype=torch.float64) for a, b in zip(low, high, strict=True)]
    part = labels.data[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    normal = middles[1] - middles[0]
    towards = labels.lps_from_index[:3, :3].T @ normal
    offset = (labels.lps_from_index[:3, 3] - (middles[0] + middles[1]) / 2) @ normal
    beyond = (
        offset
        + axes[2][:, None, None] * towards[2]
        + axes[1][None, :, None] * towards[1]
        + axes[0][None, None, :] * towards[0]
    ) > 0
    part[beyond & (part == number[bone])] = number[mirror]


def _middles_of_sides(labels: Volume, label: int, bone: str, mirror: str) -> list[Tensor]:
    """The middles (3,), LPS mm, of `bone` and `mirror`, which share a label: two means of its voxels.

    Raises `InputError` if they lie so near one another that there may be one side alone, and where the names do not say
    which side is which.
    """
    voxels = (labels.data == label).nonzero().flip(1).double()
    voxels = voxels[:: max(1, len(voxels) // _MOST_VOXELS)]
    points = transform_points(labels.lps_from_index, voxels)
    to_left = points[:, 0] > points[:, 0].mean()
    for _ in range(_ROUNDS):
        left, right = points[to_left].mean(0), points[~to_left].mean(0)
        to_left = (points - (left + right) / 2) @ (left - right) > 0
    is_left = ["left" in name for name in (bone, mirror)]
    if not abs(float((left - right)[0])) > _SIDES_APART_MM or is_left[0] == is_left[1]:
        raise InputError(
            f"label map: {bone} and {mirror} share an id, and may be one side alone. Give landmarks of both sides, or "
            "a label map with an id for each."
        )
    return [left, right] if is_left[0] else [right, left]


def _with_groups_told_apart(
    labels: Volume, table: LabelTable, anatomy: Anatomy | None, landmarks: Mapping[str, Tensor]
) -> LabelTable:
    """The table with every group of bones replaced by its bones, where landmarks tell which id is which."""
    if anatomy is None:
        return table
    told: LabelTable = {}
    for name, ids in table.items():
        told |= (_told_apart(labels, name, ids, anatomy, landmarks) if name in anatomy.groups else None) or {name: ids}
    return told


def _told_apart(
    labels: Volume, group: str, ids: tuple[int, ...], anatomy: Anatomy, landmarks: Mapping[str, Tensor]
) -> LabelTable | None:
    """Ids of a group by bone: each goes to the bone whose landmarks lie on it, what is left to the one without any.

    None if that leaves a doubt.
    """
    if len(ids) < 2:
        return None
    told: LabelTable = {}
    without = []
    for bone in anatomy.members(group):
        marks = [landmarks[mark] for mark in anatomy.landmarks_of(bone) if mark in landmarks]
        votes = Counter(label for point in marks if (label := nearest_label(labels, ids, point)) is not None)
        if not votes:
            without.append(bone)
            continue
        (label, most), *_ = votes.most_common(1)
        if 2 * most <= votes.total():
            return None
        told[bone] = (label,)
    left = [n for n in ids if (n,) not in told.values()]
    if len(set(told.values())) < len(told) and not left:
        return None  # both sides in one id, and perhaps the rest as well
    if len(left) > 1 or len(without) > 1 or (left and not without):
        return None
    return told | {bone: tuple(left) for bone in without if left}


def nearest_label(labels: Volume, ids: Sequence[int], point: Tensor) -> int | None:
    """The label among `ids` of the voxel closest to a point (3,), or None if none of them is near."""
    found = nearest_voxel(labels, ids, point)
    return None if found is None else found[0]


def nearest_voxel(labels: Volume, ids: Sequence[int], point: Tensor) -> tuple[int, float] | None:
    """Label and distance, mm, of the voxel with one of the `ids` closest to a point (3,), or None if none is near."""
    index = transform_points(torch.linalg.inv(labels.lps_from_index), point[None].double())[0].round().int()
    reach = (_NEAR_MM / torch.tensor(labels.spacing_mm)).ceil().int()
    low = (index - reach).clamp_min(0).tolist()
    high = (index + reach + 1).clamp_min(0).tolist()
    part = labels.data[low[2] : high[2], low[1] : high[1], low[0] : high[0]]
    where = torch.isin(part, torch.tensor(ids, dtype=part.dtype)).nonzero()
    if len(where) == 0:
        return None
    offsets = (where.flip(1) + torch.tensor(low) - index).double() * torch.tensor(labels.spacing_mm).double()
    distances = offsets.norm(dim=1)
    nearest = int(distances.argmin())
    z, y, x = where[nearest].tolist()
    return int(part[z, y, x]), float(distances[nearest])
