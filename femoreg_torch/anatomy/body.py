"""A body part: its bones, its landmarks, and the order in which a landmark network knows them."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from femoreg_torch.configs import load_preset
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.settings import read_record


@dataclass(frozen=True)
class Bone:
    """A bone."""

    name: str
    mirror: str  # the bone of the other side; itself in the middle of the body
    colour: tuple[int, int, int]  # RGB, of display
    names: tuple[str, ...] = ()  # what other programs call it, in lower case


@dataclass(frozen=True)
class Landmark:
    """A point that can be found on a bone, in the CT and in an X-ray image."""

    name: str
    bone: str
    mirror: str  # the same point of the other side
    spread_mm: float  # standard deviation along each axis with which it is placed on one bone
    means: str = ""


@dataclass(frozen=True)
class _Outline:
    compare: list[str]
    hidden_by: list[str]


@dataclass(frozen=True)
class _BoneEntry:
    mirror: str
    colour: list[int]
    names: list[str]


@dataclass(frozen=True)
class _LandmarkEntry:
    bone: str
    mirror: str
    spread_mm: float
    means: str = ""


@dataclass(frozen=True)
class _Content:
    bones: dict[str, _BoneEntry]
    groups: dict[str, list[str]]
    landmarks: dict[str, _LandmarkEntry]
    outline: _Outline


@dataclass(frozen=True)
class Anatomy:
    """A body part. A network's segmentation has the background as class 0 and then the bones in this order."""

    name: str
    bones: tuple[Bone, ...]
    groups: dict[str, tuple[str, ...]]  # a name for several bones
    landmarks: tuple[Landmark, ...]  # in the order of the network's heat maps
    outline: tuple[str, ...]  # bones by whose outlines the CT and a segmentation are compared
    hides_outline: tuple[str, ...]  # bones that may lie in front of those

    @property
    def bone_names(self) -> tuple[str, ...]:
        """Names of the bones, in order."""
        return tuple(bone.name for bone in self.bones)

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """Names of the landmarks, in order."""
        return tuple(landmark.name for landmark in self.landmarks)

    @property
    def landmark_spread_mm(self) -> tuple[float, ...]:
        """Standard deviation of each landmark on its bone, along each axis."""
        return tuple(landmark.spread_mm for landmark in self.landmarks)

    def bone(self, name: str) -> Bone:
        """The bone of this name. Raises `InputError` with the known names if there is none."""
        self.members(name)
        return self.bones[self.bone_names.index(name)]

    def members(self, *names: str) -> tuple[str, ...]:
        """The bones that names of bones and groups stand for. Raises `InputError` for a name that is neither."""
        found: list[str] = []
        for name in names:
            if name not in self.groups and name not in self.bone_names:
                known = ", ".join((*self.bone_names, *self.groups))
                raise InputError(f"anatomy {self.name}: there is no bone {shortened(name)}. Known names: {known}.")
            found += self.groups.get(name, (name,))
        return tuple(found)

    def classes(self, names: Iterable[str]) -> tuple[int, ...]:
        """Classes of bones and groups in the network's segmentation; 0 is the background."""
        return tuple(1 + self.bone_names.index(bone) for bone in self.members(*names))

    @property
    def mirrored_classes(self) -> tuple[int, ...]:
        """Which class each class of a segmentation becomes in a mirror, the background included."""
        return (0, *(1 + self.bone_names.index(bone.mirror) for bone in self.bones))

    @property
    def mirrored_landmarks(self) -> tuple[int, ...]:
        """Which landmark each landmark becomes in a mirror, by their numbers."""
        return tuple(self.landmark_names.index(landmark.mirror) for landmark in self.landmarks)

    def landmarks_of(self, *names: str) -> tuple[str, ...]:
        """Names of the landmarks that lie on these bones."""
        bones = self.members(*names)
        return tuple(landmark.name for landmark in self.landmarks if landmark.bone in bones)


def load_anatomy(name: str | Path) -> Anatomy:
    """The anatomy `configs/anatomy/<name>.yaml`, or that of a YAML file. Raises `InputError` that names the key."""
    where = f"anatomy {name}"
    content = read_record(_Content, load_preset("anatomy", name), where)
    anatomy = Anatomy(
        name=Path(name).stem,
        bones=tuple(
            Bone(key, bone.mirror, _rgb(bone.colour, f"{where}, bones.{key}.colour"), tuple(bone.names))
            for key, bone in content.bones.items()
        ),
        groups={key: tuple(bones) for key, bones in content.groups.items()},
        landmarks=tuple(
            Landmark(key, mark.bone, mark.mirror, mark.spread_mm, mark.means) for key, mark in content.landmarks.items()
        ),
        outline=tuple(content.outline.compare),
        hides_outline=tuple(content.outline.hidden_by),
    )
    anatomy.members(*(bone for bones in anatomy.groups.values() for bone in bones))
    anatomy.members(*anatomy.outline, *anatomy.hides_outline, *(bone.mirror for bone in anatomy.bones))
    anatomy.members(*(landmark.bone for landmark in anatomy.landmarks))
    for landmark in anatomy.landmarks:
        if landmark.mirror not in anatomy.landmark_names:
            raise InputError(
                f"{where}, landmarks.{landmark.name}.mirror: there is no landmark {shortened(landmark.mirror)}."
            )
    return anatomy


def _rgb(colour: list[int], where: str) -> tuple[int, int, int]:
    if len(colour) != 3 or not all(0 <= part <= 255 for part in colour):
        raise InputError(f"{where}: three numbers from 0 to 255 were expected, found {colour}.")
    return colour[0], colour[1], colour[2]


HIP = load_anatomy("hip")
