"""Where everything is: the C-arm of every view, and every object, all tied to camera 1."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.geometry.camera import Camera, CameraChange
from femoreg_torch.geometry.rigid import invert_rigid


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of the C-arm and of named rigid objects. Camera 1, the camera of the first view, is their common frame."""

    camera_from_camera1: Tensor  # (V, 4, 4) float64, mm; the first is the identity
    camera1_from: dict[str, Tensor]  # (4, 4) float64 of every object placed so far, mm
    changes: tuple[CameraChange, ...] = ()  # of every view's camera, where they were refined; none: as the C-arm says

    def camera(self, view: int, camera: Camera) -> Camera:
        """The camera of a view (from 0), given what the C-arm says of the same grid of pixels."""
        return camera.changed(self.changes[view]) if self.changes else camera

    def camera_from(self, name: str) -> Tensor:
        """Poses (V, 4, 4) of an object in every view."""
        return self.camera_from_camera1 @ self.camera1_from[name]

    def with_object(self, name: str, camera1_from_object: Tensor) -> "Poses":
        """The same with one object placed anew, (4, 4)."""
        return replace(self, camera1_from={**self.camera1_from, name: camera1_from_object})

    def with_view(self, view: int, camera_from_camera1: Tensor) -> "Poses":
        """The same with the C-arm of one view (from 0) placed anew, (4, 4)."""
        cameras = self.camera_from_camera1.clone()
        cameras[view] = camera_from_camera1
        return replace(self, camera_from_camera1=cameras)

    def with_changes(self, changes: tuple[CameraChange, ...]) -> "Poses":
        """The same with the camera of every view changed once more."""
        before = self.changes or (CameraChange(),) * len(changes)
        return replace(self, changes=tuple(old.then(new) for old, new in zip(before, changes, strict=True)))

    def slid(self, motions: Tensor, names: Collection[str]) -> "Poses":
        """The same with the named objects moved in the camera of each view by (V, 4, 4), which moves the C-arm too."""
        first = motions[0]
        return replace(
            self,
            camera_from_camera1=motions @ self.camera_from_camera1 @ invert_rigid(first),
            camera1_from={n: first @ pose if n in names else pose for n, pose in self.camera1_from.items()},
        )

    def seen_from(self, view: int) -> "Poses":
        """The same geometry with the camera of another view (from 0) as the common frame."""
        here = self.camera_from_camera1[view]
        return replace(
            self,
            camera_from_camera1=self.camera_from_camera1 @ invert_rigid(here),
            camera1_from={n: here @ pose for n, pose in self.camera1_from.items()},
        )

    def first_views(self, count: int) -> "Poses":
        """The same with the first so many views alone."""
        return replace(self, camera_from_camera1=self.camera_from_camera1[:count], changes=self.changes[:count])


def poses_by_object(camera_from_object: Tensor, name: str, camera1_from: dict[str, Tensor]) -> Poses:
    """Poses where the C-arm is told by where one object is in every view, (V, 4, 4), and others (4, 4) in camera 1."""
    cameras = camera_from_object @ invert_rigid(camera_from_object[0])
    cameras[0] = torch.eye(4, dtype=cameras.dtype)
    return Poses(cameras, {name: camera_from_object[0], **camera1_from})


def first_view_only(camera1_from: dict[str, Tensor], views: int) -> Poses:
    """Poses at the start: every C-arm stands where the first one does until it is found."""
    return Poses(torch.eye(4, dtype=torch.float64).repeat(views, 1, 1), dict(camera1_from))
