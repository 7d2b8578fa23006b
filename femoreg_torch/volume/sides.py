"""Do label map and landmarks tell left from right, and do they lie on one another? Patient space says what left is."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from femoreg_torch.anatomy import Anatomy
from femoreg_torch.volume.bones import BoneLabels, nearest_label, nearest_voxel
from femoreg_torch.volume.labels import label_box_centre

_CLOSER_MM, _FAR_MM = 2.0, 30.0
_ON_MM, _OFF_MM = 2.0, 6.0  # so near to a bone a landmark lies on it, and so far away it does not
_ACROSS_MM = 12.0  # labels leak across a symphysis or into a joint by less
_BESIDE_MM = 5.0  # seen of 17 right cases: at most 1.3; those that people place are 2 to 3 mm off
_MM_PER_CM = 10.0
_METRES_MM = 2.0  # no patient is so small, and none lies farther from a scanner's middle in metres
_RAS = torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)


def swapped_sides(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy | None) -> list[str]:
    """In words, where the names of sides contradict patient space, or landmarks (3,), LPS mm, the label map.

    Empty if nothing does. A bone `…_left` must lie to the left (+x) of its mirror, and most landmarks on bones of their
    own side.
    """
    if anatomy is None:
        return []
    told = []
    for bone in anatomy.bones:
        if not bone.name.endswith("_left") or not {bone.name, bone.mirror} <= set(bones.ids):
            continue
        left, right = (label_box_centre(bones.labels, [bones.ids[name]])[0] for name in (bone.name, bone.mirror))
        if left < right:
            told.append(
                f"label map: {bone.name} lies to the right of {bone.mirror}: left and right are swapped in `ct.bones`, "
                "or the label map is mirrored. Exchange the two ids, or export it anew"
            )
    own, other = _votes(bones, landmarks, anatomy)
    if len(other) > len(own) and _mixed_up(bones, landmarks, anatomy):
        told.append(
            f"landmarks: {', '.join(other)} lie on the other side, and fit the bones better with x and y negated: the "
            "file holds RAS and says LPS, or the other way round. Correct its coordinate system"
        )
    elif len(other) > len(own):
        told.append(
            f"landmarks: left and right are swapped: {', '.join(other)} lie on bones of the other side. "
            + (
                "That may come from the label map: mend it first, and only it"
                if told
                else "Exchange the endings -l and -r"
            )
        )
    elif crossed := _crossed(bones, landmarks, anatomy, other):
        told.append(
            f"landmarks: {', '.join(crossed)} lie{'s' * (len(crossed) == 1)} on the other side. Exchange the endings "
            "-l and -r there, or place them anew"
        )
    return told


def mostly_stray(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy | None) -> list[str]:
    """What `stray_landmarks` tells, if it is of more than half of the landmarks: no pose can come of them."""
    if anatomy is None:
        return []
    asked = [mark.name for mark in anatomy.landmarks if mark.name in landmarks and mark.bone in bones.ids]
    near = sum(len(names) for names in _votes(bones, landmarks, anatomy))
    return stray_landmarks(bones, landmarks, anatomy) if 2 * near < len(asked) else []


def stray_landmarks(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy | None) -> list[str]:
    """In words, which landmarks (3,), LPS mm, lie near no voxel of their bone; empty if none does."""
    if anatomy is None:
        return []
    asked = [mark for mark in anatomy.landmarks if mark.name in landmarks and mark.bone in bones.ids]
    own, other = _votes(bones, landmarks, anatomy)
    stray = [mark.name for mark in asked if mark.name not in (*own, *other)]
    if not stray:
        return []
    flipped, _ = _votes(bones, {name: landmarks[name] * _RAS for name in stray}, anatomy)
    if 2 * len(flipped) > len(stray):
        return [
            f"landmarks: {', '.join(stray)} lie on no bone, but would with x and y negated: the file holds RAS and "
            "says LPS, or the other way round. Correct its coordinate system"
        ]
    longer, _ = _votes(bones, {name: landmarks[name] * _MM_PER_CM for name in stray}, anatomy)
    if 2 * len(longer) > len(stray):
        return [
            f"landmarks: {', '.join(stray)} lie on no bone, but would ten times as far from the origin: are they in "
            "cm? Multiply them by 10"
        ]
    if len(stray) == len(asked) > 1 and max(float(landmarks[name].abs().max()) for name in stray) < _METRES_MM:
        return [
            f"landmarks: {', '.join(stray)} lie within {_METRES_MM:g} mm of the origin: are they in metres? "
            "Multiply them by 1000"
        ]
    return [f"landmarks: {', '.join(stray)} lie far from the bones that they are named after. Place them anew"]


def landmarks_beside_bones(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy | None) -> list[str]:
    """In words, which landmarks (3,), LPS mm, lie near their bone and yet more than 5 mm beside it."""
    told = []
    for mark in anatomy.landmarks if anatomy else ():
        if mark.name in landmarks and mark.bone in bones.ids:
            found = nearest_voxel(bones.labels, [bones.ids[mark.bone]], landmarks[mark.name])
            if found is not None and found[1] > _BESIDE_MM:
                told.append(f"landmarks: {mark.name} lies {found[1]:.0f} mm beside the {mark.bone}: look at it")
    return told


def landmarks_without_bones(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy | None) -> list[str]:
    """In words, which bones have landmarks and are not told by the label map."""
    if anatomy is None:
        return []
    known = {*bones.ids, *bones.absent}
    known |= {bone for group in known & set(anatomy.groups) for bone in anatomy.members(group)}
    told = []
    for bone in anatomy.bones:
        given = [mark for mark in anatomy.landmarks_of(bone.name) if mark in landmarks]
        if given and bone.name not in known:
            told.append(
                f"label map: does not tell the {bone.name}, which landmarks lie on ({', '.join(given)}): does it have "
                "another name or id there than `ct.bones` lists? What is not told is not drawn"
            )
    return told


def merged_bones(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy | None) -> list[str]:
    """In words, bones that the label map has as part of another one, or under its id; empty if there are none.

    Most of the `landmarks` (3,), LPS mm, of such a bone lie on that one, and none of its own voxels is near. Two of
    which each lies on the other have exchanged ids.
    """
    elsewhere = {} if anatomy is None else _on_others(bones, landmarks, anatomy)
    exchanged = [pair for pair in elsewhere if pair[::-1] in elsewhere]
    told = [
        f"label map: landmarks of the {bone} lie on the {other}, and those of the {other} on the {bone}. Exchange "
        "their ids in `ct.bones`"
        for bone, other in exchanged
        if (other, bone) not in exchanged[: exchanged.index((bone, other))]
    ]
    return told + [
        f"label map: {', '.join(marks)} of the {bone} lie on the {other}: does the label map hold both as one, or "
        "parts of one under the other's id? Part them"
        for (bone, other), marks in elsewhere.items()
        if (bone, other) not in exchanged
    ]


def _on_others(
    bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy
) -> dict[tuple[str, str], list[str]]:
    """Landmarks of bones, by name, most of which lie on the voxels of another one, by the names of both."""
    found_on: dict[tuple[str, str], list[str]] = {}
    for bone in (bone for bone in anatomy.bones if bone.name in bones.ids or bone.name in bones.absent):
        marked = anatomy.landmarks_of(bone.name)
        given = [mark for mark in marked if mark in landmarks]
        others = {n: name for name, n in bones.ids.items() if name != bone.name}
        own = [bones.ids[bone.name]] if bone.name in bones.ids else []
        on: dict[str, list[str]] = {}
        for mark in given:
            found = nearest_voxel(bones.labels, list(others), landmarks[mark]) if others else None
            if found is None or found[1] > _ON_MM:
                continue
            near = nearest_voxel(bones.labels, own, landmarks[mark]) if own else None
            if near is None or near[1] > _OFF_MM:
                on.setdefault(others[found[0]], []).append(mark)
        for other, marks in on.items():
            # one alone may be of the symphysis, which has a bone on either side
            if 2 * len(marks) > len(given) and len(marks) >= min(2, len(marked)):
                found_on[bone.name, other] = marks
    return found_on


def _crossed(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy, other: Sequence[str]) -> list[str]:
    """Landmarks on `other` sides that are far from their own bone; at the symphysis both sides are near."""
    bone_of = {mark.name: mark.bone for mark in anatomy.landmarks}
    near = {name: nearest_voxel(bones.labels, [bones.ids[bone_of[name]]], landmarks[name]) for name in other}
    return [name for name, found in near.items() if found is None or found[1] > _ACROSS_MM]


def _mixed_up(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy) -> bool:
    """Whether landmarks lie much closer to the bones, of either side, with x and y negated."""
    told = _misfit_mm(bones, landmarks, anatomy)
    negated = _misfit_mm(bones, {name: point * _RAS for name, point in landmarks.items()}, anatomy)
    return negated < told / 2 and told - negated > _CLOSER_MM


def _misfit_mm(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy) -> float:
    """Mean distance of landmarks from their bones or the mirrors of these; where none is near, that counts as far."""
    distances = []
    for mark in anatomy.landmarks:
        sides = [name for name in (mark.bone, anatomy.bone(mark.bone).mirror) if name in bones.ids]
        if mark.name in landmarks and sides:
            found = nearest_voxel(bones.labels, [bones.ids[name] for name in sides], landmarks[mark.name])
            distances.append(_FAR_MM if found is None else found[1])
    return sum(distances) / max(len(distances), 1)


def _votes(bones: BoneLabels, landmarks: Mapping[str, Tensor], anatomy: Anatomy) -> tuple[list[str], list[str]]:
    """Names of the landmarks that lie nearest to their own bone, and to its mirror, as far as any is near."""
    own, other = [], []
    for mark in anatomy.landmarks:
        if mark.name not in landmarks or mark.bone not in bones.ids:
            continue
        sides = [name for name in (mark.bone, anatomy.bone(mark.bone).mirror) if name in bones.ids]
        near = nearest_label(bones.labels, [bones.ids[name] for name in sides], landmarks[mark.name])
        if near == bones.ids[mark.bone]:
            own.append(mark.name)
        elif near is not None:
            other.append(mark.name)
    return own, other
