"""What is registered: volumes of the rigid objects, the fluoroscopic images, and where everything starts."""

from collections.abc import Iterable
from dataclasses import dataclass, field

from torch import Tensor

from femoreg_torch.case import Start
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import Camera, CArm, Poses, about_point, exp_se3, first_view_only, transform_points
from femoreg_torch.volume import Volume

Kind = str  # of images: all views have one of each kind; those without and those with the device, say


@dataclass(frozen=True, eq=False)
class RigidObject:
    """Something rigid that is registered, in a space of its own: the CT's LPS or that of its CAD model, mm."""

    volume: Volume  # attenuation, 1/mm
    reference_point: Tensor  # (3,) mm: what rotations turn about
    shown_in: tuple[Kind, ...]  # the kinds of images that hold it
    start: Start = field(default_factory=Start)  # where the landmarks put it, if nothing else is said
    classes: tuple[int, ...] = ()  # of the segmentation that show it; none for what the network does not know


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What the network sees in the first image of one view."""

    probabilities: Tensor  # (C, h, w) of the classes
    camera: Camera  # of their grid, on the detector of the image


@dataclass(frozen=True, eq=False)
class Outline:
    """Bones whose outlines, drawn at the start pose, are compared with what the network sees."""

    mask: Volume  # 1 inside
    bones: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """The fixed part of a registration: named objects and images."""

    carm: CArm
    objects: dict[str, RigidObject]
    images: dict[
        Kind, tuple[Tensor, ...]
    ]  # attenuation images (H, W), one per view; landmarks are seen in the first kind
    segmentations: tuple[Segmentation, ...] = ()  # one per view; none unless a stage weighs its pixels by them
    tissue: Volume | None = None  # attenuation of the soft tissue, 1/mm, in the space of `anchor`
    outline: Outline | None = None  # what checks the start, in the space of `anchor`
    camera_from_camera1: Tensor | None = None  # (V, 4, 4) where the C-arm's poses are known and stay; None: to be found
    missing: tuple[str, ...] = ()  # what the case lacks, in words

    @property
    def first_kind(self) -> Kind:
        """The kind of images that landmarks are seen in."""
        return next(iter(self.images))

    @property
    def views(self) -> int:
        """The number of C-arm poses."""
        return len(self.images[self.first_kind])

    @property
    def anchor(self) -> str:
        """The object that landmarks place; the first one where nothing starts from landmarks."""
        placed = (name for name, thing in self.objects.items() if thing.start.by_landmarks)
        return next(placed, next(iter(self.objects)))

    @property
    def needs_landmarks(self) -> bool:
        """Whether an object starts where landmarks put it."""
        return any(thing.start.by_landmarks for thing in self.objects.values())

    def shown(self, names: Iterable[str], kind: Kind) -> list[str]:
        """Those of the named objects that images of a kind hold."""
        return [name for name in names if kind in self.objects[name].shown_in]

    def start(self, camera1_from_anchor: Tensor | None = None) -> Poses:
        """Poses at the start of all objects that any image holds, given where landmarks put the anchor, (4, 4).

        Raises `InputError` for an object that starts from landmarks if none are given, or beside one without a place.
        """
        placed: dict[str, Tensor] = {}
        waiting = [name for name, thing in self.objects.items() if any(kind in self.images for kind in thing.shown_in)]
        while waiting:
            left = []
            for name in waiting:
                where = self._start_of(name, placed, camera1_from_anchor)
                if where is None:
                    left.append(name)
                else:
                    placed[name] = where
            if len(left) == len(waiting):
                raise InputError(
                    f"object {left[0]}: starts beside {self.objects[left[0]].start.beside!r}, which is nowhere."
                )
            waiting = left
        # in the order of the objects, whichever was placed first
        poses = first_view_only({name: placed[name] for name in self.objects if name in placed}, self.views)
        if self.camera_from_camera1 is None:
            return poses
        return Poses(self.camera_from_camera1.clone(), poses.camera1_from)

    def _start_of(self, name: str, placed: dict[str, Tensor], camera1_from_anchor: Tensor | None) -> Tensor | None:
        start = self.objects[name].start
        if start.camera1_from is not None:
            return start.camera1_from
        if start.beside is not None:
            return placed[start.beside] @ start.beside_from_object if start.beside in placed else None
        if camera1_from_anchor is None:
            raise InputError(
                f"object {name}: starts from landmarks, and none are known. Give landmarks or a start pose."
            )
        return camera1_from_anchor


@dataclass(frozen=True, eq=False)
class Body:
    """Something that one twist moves: objects that move together in camera 1, or all objects in the camera of one view.

    The twist turns about `centre` (3,) mm and acts along the axes of that camera. `scale` (6,), rad and mm, is the size
    of one unit of each degree of freedom; those with scale zero stay as they are.
    """

    objects: tuple[str, ...]
    view: int  # 0 for objects in camera 1, else the view that moves
    centre: Tensor
    scale: Tensor

    @property
    def free(self) -> Tensor:
        """Indices (n,) of the degrees of freedom that move."""
        return self.scale.nonzero()[:, 0]

    def motion(self, delta: Tensor) -> Tensor:
        """Rigid motions (P, 4, 4) in the body's camera for deltas (P, n) in units of `scale`."""
        twist = delta.new_zeros(len(delta), 6)
        twist[:, self.free] = delta * self.scale[self.free]
        return about_point(exp_se3(twist), self.centre)


def reference_point_in_view(scene: Scene, poses: Poses, name: str, view: int) -> Tensor:
    """The reference point (3,) of an object, mm, in the camera of a view."""
    return transform_points(poses.camera_from(name)[view], scene.objects[name].reference_point[None])[0]


def split(deltas: Tensor, bodies: tuple[Body, ...]) -> list[Tensor]:
    """The part (P, n_b) of deltas (P, Σ n_b) that belongs to each body."""
    return list(deltas.split([len(body.free) for body in bodies], -1))


def moved(poses: Poses, bodies: tuple[Body, ...], delta: Tensor) -> Poses:
    """Poses after one delta (Σ n_b,) of the bodies."""
    for body, part in zip(bodies, split(delta[None], bodies), strict=True):
        motion = body.motion(part)[0]
        if body.view:
            poses = poses.with_view(body.view, motion @ poses.camera_from_camera1[body.view])
        for name in body.objects:
            poses = poses.with_object(name, motion @ poses.camera1_from[name])
    return poses
