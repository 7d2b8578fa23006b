"""What is registered: volumes of the rigid objects, the fluoroscopic images, and the poses that tie them together."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from femoreg_torch.geometry import Camera, CArm, about_point, exp_se3, transform_points
from femoreg_torch.volume import Volume

Kind = Literal["anatomy", "device"]  # an image without the device, or with it


@dataclass(frozen=True, eq=False)
class RigidObject:
    """Something rigid that is registered, in a space of its own: the CT's LPS or that of its CAD model, mm."""

    volume: Volume  # attenuation, 1/mm
    reference_point: Tensor  # (3,) mm: what rotations turn about
    shown_in: tuple[Kind, ...]  # the kinds of images that hold it
    camera1_from: Tensor | None = None  # (4, 4) nominal start pose; None for what starts where the CT has it
    classes: tuple[int, ...] = ()  # of the segmentation that show it; none for what the network does not know


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What the network sees in the anatomy image of one view."""

    probabilities: Tensor  # (C, h, w) of the classes
    camera: Camera  # of their grid, on the detector of the image


@dataclass(frozen=True, eq=False)
class Scene:
    """The fixed part of a registration: named objects and images."""

    carm: CArm
    objects: dict[str, RigidObject]
    images: dict[Kind, tuple[Tensor, ...]]  # attenuation images (H, W), one per view
    segmentations: tuple[Segmentation, ...] = ()  # one per view; none unless a stage weighs its pixels by them
    tissue: Volume | None = None  # attenuation of the soft tissue, 1/mm, in the CT's LPS
    hips: Volume | None = None  # 1 inside the hip bones, in the CT's LPS; None where labels do not tell them apart

    @property
    def views(self) -> int:
        """The number of C-arm poses."""
        return len(self.images["anatomy"])

    def shown(self, names: Iterable[str], kind: Kind) -> list[str]:
        """Those of the named objects that images of a kind hold."""
        return [name for name in names if kind in self.objects[name].shown_in]

    def start(self, camera1_from_ct: Tensor) -> "Poses":
        """Poses at the start of all objects that any image holds, given where the CT lies, (4, 4), in view 1."""
        placed = {
            name: camera1_from_ct if thing.camera1_from is None else thing.camera1_from
            for name, thing in self.objects.items()
            if any(kind in self.images for kind in thing.shown_in)
        }
        return first_view_only(placed, self.views)


@dataclass(frozen=True, eq=False)
class Poses:
    """The moving part. Camera 1 is the frame that everything is tied to."""

    camera_from_camera1: Tensor  # (V, 4, 4); the first is the identity
    camera1_from: dict[str, Tensor]  # (4, 4) of every object placed so far

    def camera_from(self, name: str) -> Tensor:
        """Poses (V, 4, 4) of an object in every view."""
        return self.camera_from_camera1 @ self.camera1_from[name]

    def with_object(self, name: str, camera1_from_object: Tensor) -> "Poses":
        """The same with one object placed anew."""
        return replace(self, camera1_from={**self.camera1_from, name: camera1_from_object})

    def with_view(self, view: int, camera_from_camera1: Tensor) -> "Poses":
        """The same with the C-arm of one view placed anew."""
        cameras = self.camera_from_camera1.clone()
        cameras[view] = camera_from_camera1
        return replace(self, camera_from_camera1=cameras)


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


def first_view_only(camera1_from: dict[str, Tensor], views: int) -> Poses:
    """Poses at the start: every C-arm stands where the first one does until it is found."""
    return Poses(torch.eye(4, dtype=torch.float64).repeat(views, 1, 1), dict(camera1_from))
