"""Do CT, landmarks and plan lie where the label map has the bones?

Images do not tell: they place the bones of the label map. Landmarks that lie some mm beside them still start the
registration, and the planned path, which stands in their frame, ends beside the head by as much. The femoral heads are
round, so that the label map by itself says where their middles are.
"""

from collections.abc import Mapping
from itertools import chain
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from femoreg_torch.case import Case
from femoreg_torch.volume import BoneLabels, Volume, shifted_labels, turned_labels
from femoreg_torch.volume.bones import nearest_voxel
from femoreg_torch.volume.contradictions import bare_bone
from femoreg_torch.volume.lost_slices import told_of_lost_slice

if TYPE_CHECKING:  # with trimesh, whose import the reading of CT and images hides
    from femoreg_torch.segment import Head

# Seen of 60 cases of three simulators, whose landmarks were told by a surface, by rules or by their makers: at most
# 2.7 mm, and both heads alike by at most 1.0 mm.
MOST_OFF_HEAD_MM = 5.0
_HEADS = {"left": "FH-l", "right": "FH-r"}
MOST_OFF_BONE_MM, _FAR_OFF_BONE_MM = 5.0, 12.0  # of an entry point or target, from the middle of the nearest voxel
_NOT_ASKED_MM = 1.0  # of the head that the path ends in, or of the left one: then both cannot be off alike
# Of both in one direction, besides half a voxel, and how far that may differ between them.
_MOST_ALIKE_MM, _ALIKE_MM = 2.0, 2.0


def heads_near_landmarks(case: Case, bones: BoneLabels) -> dict[str, "Head"]:
    """The femoral heads of the label map, spheres or not, by the names of the landmarks that they are looked for by."""
    from femoreg_torch.segment import head_of  # see above

    found = {
        name: head_of(bones, side, case.landmarks[name]) for side, name in _HEADS.items() if name in case.landmarks
    }
    return {name: head for name, head in found.items() if head is not None}


def doubts_about_the_labels(ct: Volume, bones: BoneLabels) -> tuple[str, ...]:
    """What a CT says against where its label map lies, which is on its grid, in words."""
    turned = turned_labels(ct, bones.labels)
    if turned is not None:
        return (turned,)
    shift = shifted_labels(ct, bones.labels)
    if shift is None:
        return ()
    by = ", ".join(f"{mm + 0.0:.0f}" for mm in shift.tolist())
    return (
        f"the label map would lie on the bones of the CT if it were moved by ({by}) mm LPS: check that it belongs "
        "to this CT, and the origin of both",
    )


def doubts_about_the_slices(ct: Volume, bones: BoneLabels) -> tuple[str, ...]:
    """Slices that a CT seems to lack, in words."""
    lost = told_of_lost_slice(ct, bones.labels, list(bones.ids.values()))
    return () if lost is None else (lost,)


def doubts_about_the_points(case: Case, ct: Volume, bones: BoneLabels, heads: Mapping[str, "Head"]) -> tuple[str, ...]:
    """What bones and femoral heads of the label map say against landmarks and plan, in words."""
    bare = doubts_about_bare_bone(case, ct, bones)
    return (*bare, *doubts_about_the_frame(case, bones, heads), *doubts_about_the_ends(case, bones))


def doubts_about_bare_bone(case: Case, ct: Volume, bones: BoneLabels) -> tuple[str, ...]:
    """Heads of femora that are registered, about which the CT shows bone that no label covers, in words."""
    placed = {bone for thing in case.objects.values() for bone in thing.bones}
    heads = [name for side, name in _HEADS.items() if f"femur_{side}" in placed and name in case.landmarks]
    return tuple(chain(*(told_of_bare_bone(name, case.landmarks[name], ct, bones) for name in heads)))


def told_of_bare_bone(name: str, head: Tensor, ct: Volume, bones: BoneLabels) -> tuple[str, ...]:
    """How much bone the CT shows about the head (3,) of this name that no label covers, if it is much, in words."""
    bare = bare_bone(ct, bones.labels, head)
    if bare is None:
        return ()
    return (
        f"about {name} the CT shows {bare[1]:.0f} ml of bone, {100 * bare[0]:.0f} % of what is there, that no label "
        "covers: is a bone missing in the label map, or its id in `ct.bones`? What is not labelled is not drawn",
    )


def notes_on_the_slices(bones: BoneLabels, heads: Mapping[str, "Head"]) -> tuple[str, ...]:
    """What the femoral heads of the label map say against the slice spacing, in words."""
    from femoreg_torch.segment import doubted_slices  # see above

    return tuple(doubted_slices(heads.values(), bones.labels.spacing_mm))


def doubts_about_the_ends(case: Case, bones: BoneLabels) -> tuple[str, ...]:
    """Entry points and targets a little outside the planned bone of the label map, or on its mirror, in words.

    What else is far outside is told by its attenuation, which knows no edge to a millimetre (`doubts_about_the_plan`).
    """
    plan = case.plan
    if plan is None or not case.objects[plan.object].bones:
        return ()
    ids = bones.of(case.objects[plan.object].bones, case.anatomy)
    mirrors = {bone.mirror: bone.name for bone in case.anatomy.bones} if case.anatomy is not None else {}
    across = {bones.ids[name]: name for name, of in mirrors.items() if name in bones.ids and bones.ids.get(of) in ids}
    told = []
    for name, point in (("entry point", plan.entry_point), ("target", plan.target)):
        if any(torch.equal(point, landmark) for landmark in case.landmarks.values()):
            continue  # the middle of a head: the label map may hold the shells of bones alone
        near = nearest_voxel(bones.labels, ids, point)
        other = nearest_voxel(bones.labels, list(across), point) if across and near is None else None
        if other is not None and other[1] <= MOST_OFF_BONE_MM:
            told.append(
                f"the planned {name} lies on the {across[other[0]]}, and the {plan.object} is that of the other side: "
                "check `side` and the plan"
            )
        if near is not None and MOST_OFF_BONE_MM < near[1] <= _FAR_OFF_BONE_MM:
            told.append(
                f"the planned {name} lies {near[1]:.0f} mm outside the {plan.object}: check `plan`; its points are LPS "
                "mm of the CT"
            )
    return tuple(told)


def doubts_about_the_frame(case: Case, bones: BoneLabels, heads: Mapping[str, "Head"]) -> tuple[str, ...]:
    """Landmarks of femoral heads that lie beside those of the label map, in words; none where these are no spheres."""
    target = None if case.plan is None else case.plan.target
    off = {}
    for name in sorted(heads, key=lambda name: target is None or not torch.equal(case.landmarks[name], target)):
        if heads[name].may_be_one and heads[name].is_round:
            off[name] = heads[name].centre - case.landmarks[name]
            if len(off) == 1 and float(off[name].norm()) < _NOT_ASKED_MM:
                return ()  # so both cannot be off alike, and no path ends in the other one
    if len(off) == 2:
        one, other = off.values()
        alike = float((one + other).norm() / 2)
        most = _MOST_ALIKE_MM + max(bones.labels.spacing_mm) / 2
        if alike > most and float((one - other).norm()) < _ALIKE_MM:
            return (
                f"both femoral heads of the label map lie {alike:.1f} mm from FH-l and FH-r, in the same direction: "
                "landmarks, and likely the plan, are not in the frame of CT and label map; check the origin of both",
            )
    return tuple(
        f"{name}, where the planned path ends, lies {float(away.norm()):.1f} mm from the middle of the femoral head of "
        "the label map: check that landmark, and that it is in the frame of the CT"
        for name, away in off.items()
        if float(away.norm()) > MOST_OFF_HEAD_MM and target is not None and torch.equal(case.landmarks[name], target)
    )
