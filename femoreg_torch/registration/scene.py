"""What is registered: volumes of the rigid objects, the fluoroscopic images, and where everything starts."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from femoreg_torch.case import Start, anchor_of
from femoreg_torch.errors import InputError
from femoreg_torch.geometry import (
    Camera,
    CameraChange,
    CArm,
    Poses,
    about_point,
    exp_se3,
    first_view_only,
    project_points,
    transform_points,
)
from femoreg_torch.registration.intrinsics import Intrinsics
from femoreg_torch.registration.roundness import Axis
from femoreg_torch.volume import Volume

Kind = str  # of images: those without and those with the device, say


@dataclass(frozen=True, eq=False)
class RigidObject:
    """Something rigid that is registered, in a space of its own: the CT's LPS or that of its CAD model, mm."""

    volume: Volume  # attenuation, 1/mm
    reference_point: Tensor  # (3,) mm: what rotations turn about
    shown_in: tuple[Kind, ...]  # the kinds of images that hold it
    start: Start = field(default_factory=Start)  # where the landmarks put it, if nothing else is said
    classes: tuple[int, ...] = ()  # of the segmentation that show it; none for what the network does not know
    # of a model, each of one material; on the grid of `volume`, which is their sum; a bone has none
    parts: tuple[Volume, ...] = ()
    axis: Axis | None = None  # of a model that is round, as it was told
    guide: tuple[Tensor, Tensor] | None = None  # base and tip (3,), mm, of a tool
    materials_known: bool = False  # whether materials were named and the images, once asked, agree; HU may be a guess
    sharp: bool = False  # whether it is made of solids with surfaces, over which its voxels average
    hardening: float = 0.0  # of the beam in it, see `registration.imaging.hardened`
    # differences of attenuation, 1/mm, of what was estimated: each comes in with an amount of mean 0 and variance 1
    unsure: tuple[Volume, ...] = ()

    def to(self, device: torch.device) -> "RigidObject":
        """The same with its volumes on a device."""
        return replace(
            self,
            volume=self.volume.to(device),
            parts=tuple(part.to(device) for part in self.parts),
            unsure=tuple(difference.to(device) for difference in self.unsure),
        )


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
    # attenuation images (H, W), one per view or None where it lacks one; landmarks are seen in the first kind, which
    # every view has
    images: dict[Kind, tuple[Tensor | None, ...]]
    # pixels (H, W), bool, that no shutter shades, one mask per view; None, or no entry, where all are exposed
    fields: dict[Kind, tuple[Tensor | None, ...]] = field(default_factory=dict)
    # pixels (H, W), bool, as bright as the image can tell, one mask per view; None, or no entry, where none is
    saturated: dict[Kind, tuple[Tensor | None, ...]] = field(default_factory=dict)
    segmentations: tuple[Segmentation, ...] = ()  # one per view; none unless a stage weighs its pixels by them
    tissue: Volume | None = None  # attenuation of the soft tissue, 1/mm, in the space of `anchor`
    outline: Outline | None = None  # what checks the start, in the space of `anchor`
    camera_from_camera1: Tensor | None = None  # (V, 4, 4) where the C-arm's poses are known and stay; None: to be found
    scatter: float | None = None  # see `Imaging`, as the shadow of a device tells it
    left_on_left: tuple[int, ...] = ()  # views (from 0) seen from behind the patient: left is left
    missing: tuple[str, ...] = ()  # what the case lacks and what shutters hide, in words
    contradictions: tuple[str, ...] = ()  # of its files among one another, in words, which are doubts of a result

    @property
    def device(self) -> torch.device:
        """Where volumes and images lie, and all that is drawn; poses and points lie on the CPU."""
        return next(iter(self.objects.values())).volume.data.device

    def to(self, device: torch.device) -> "Scene":
        """The same with volumes and images on a device; the scene itself if they lie there."""
        if device == self.device:
            return self

        def moved(images: dict[Kind, tuple[Tensor | None, ...]]) -> dict[Kind, tuple[Tensor | None, ...]]:
            return {kind: tuple(None if one is None else one.to(device) for one in of) for kind, of in images.items()}

        return replace(
            self,
            objects={name: thing.to(device) for name, thing in self.objects.items()},
            images=moved(self.images),
            fields=moved(self.fields),
            saturated=moved(self.saturated),
            segmentations=tuple(replace(s, probabilities=s.probabilities.to(device)) for s in self.segmentations),
            tissue=None if self.tissue is None else self.tissue.to(device),
            outline=None if self.outline is None else replace(self.outline, mask=self.outline.mask.to(device)),
        )

    @property
    def first_kind(self) -> Kind:
        """The kind of images that landmarks are seen in."""
        return next(iter(self.images))

    @property
    def views(self) -> int:
        """The number of C-arm poses."""
        return len(self.images[self.first_kind])

    def image(self, kind: Kind, view: int) -> Tensor:
        """The image (H, W) of a kind in a view (from 0). Raises `InputError` where there is none."""
        image = self.images[kind][view] if kind in self.images else None
        if image is None:
            raise InputError(f"view {view + 1} has no {kind} image.")
        return image

    def field(self, kind: Kind, view: int) -> Tensor | None:
        """The exposed pixels (H, W), bool, of the image of a kind in a view (from 0); None where all are."""
        return self.fields[kind][view] if kind in self.fields else None

    def where_unsaturated(self) -> "Scene":
        """The same with only those pixels exposed that are not saturated, the scene itself if none is.

        Of images of other kinds than the first, also where that of the first kind is not: there a shadow is cut off.
        """
        if not any(mask is not None for masks in self.saturated.values() for mask in masks):
            return self

        def left(kind: Kind, view: int) -> Tensor | None:
            exposed = self.field(kind, view)
            for each in dict.fromkeys((self.first_kind, kind)):
                mask = self.saturated[each][view] if each in self.saturated else None
                if mask is not None:
                    exposed = ~mask if exposed is None else exposed & ~mask
            return exposed

        fields = {kind: tuple(left(kind, view) for view in range(self.views)) for kind in self.images}
        return replace(self, fields=fields, saturated={})

    def there(self, kinds: Iterable[Kind], views: Iterable[int]) -> list[tuple[Kind, int]]:
        """Those images, (kind, view) pairs, of some kinds and views (from 0) that the scene has."""
        of = [kind for kind in kinds if kind in self.images]
        views = tuple(views)
        return [(kind, view) for kind in of for view in views if self.images[kind][view] is not None]

    @property
    def anchor(self) -> str:
        """The object that landmarks place; where nothing starts from landmarks, the first bone, or else the first one.

        In its space lie the landmarks and the soft tissue, which a model's space has nothing to do with. What no image
        shows has no pose, and others come before it.
        """
        shown = [name for name, thing in self.objects.items() if self.there(thing.shown_in, range(self.views))]
        bones = [name for name, thing in self.objects.items() if not thing.parts]
        return anchor_of(shown, {name: thing.start for name, thing in self.objects.items()}, bones)

    @property
    def needs_landmarks(self) -> bool:
        """Whether an object starts where landmarks put it."""
        return any(thing.start.by_landmarks for thing in self.objects.values())

    def camera(self, poses: Poses, view: int) -> Camera:
        """The camera of the images of a view (from 0), as refined as the poses."""
        return poses.camera(view, self.carm.camera)

    def shown(self, names: Iterable[str], kind: Kind) -> list[str]:
        """Those of the named objects that images of a kind hold."""
        return [name for name in names if kind in self.objects[name].shown_in]

    def first_images(self, name: str) -> list[tuple[Kind, int]]:
        """The first image, (kind, view), of every view that shows an object."""
        shown = self.objects[name].shown_in
        return [image for view in range(self.views) for image in self.there(shown, (view,))[:1]]

    def start(self, camera1_from_anchor: Tensor | None = None) -> Poses:
        """Poses at the start of all objects that any image holds, given where landmarks put the anchor, (4, 4).

        Raises `InputError` for an object that starts from landmarks if none are given, or beside one without a place.
        """
        placed: dict[str, Tensor] = {}
        waiting = [name for name, thing in self.objects.items() if self.there(thing.shown_in, range(self.views))]
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
                    f"object {left[0]}: starts beside {self.objects[left[0]].start.beside}, which is nowhere."
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

    @cached_property
    def free(self) -> Tensor:
        """Indices (n,) of the degrees of freedom that move."""
        return self.scale.nonzero()[:, 0]

    def twist(self, delta: Tensor) -> Tensor:
        """Twists (P, 6) in rad and mm of deltas (P, n) in units of `scale`."""
        twist = delta.new_zeros(len(delta), 6)
        twist[:, self.free] = delta * self.scale[self.free]
        return twist

    def motion(self, delta: Tensor) -> Tensor:
        """Rigid motions (P, 4, 4) in the body's camera for deltas (P, n) in units of `scale`."""
        return about_point(exp_se3(self.twist(delta)), self.centre)


def motions(bodies: Sequence[Body], deltas: Sequence[Tensor]) -> list[Tensor]:
    """As `Body.motion` of several bodies, each with its deltas (P, n_b), at once: (P, 4, 4) each."""
    if not bodies:
        return []
    twists = torch.stack([body.twist(delta) for body, delta in zip(bodies, deltas, strict=True)])
    return list(about_point(exp_se3(twists), torch.stack([body.centre for body in bodies])[:, None]))


def in_view(scene: Scene, poses: Poses, name: str, points: Tensor) -> Tensor:
    """Which points (N, 3) of an object, mm in its space, some image that holds it shows in its exposed field: (N,)."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for image in scene.there(scene.objects[name].shown_in, range(scene.views)):
        seen |= shown_by(scene, poses, name, image, points)
    return seen


def shown_by(scene: Scene, poses: Poses, name: str, image: tuple[Kind, int], points: Tensor) -> Tensor:
    """Which points (N, 3) of an object, mm in its space, an image (kind, view) shows in its exposed field: (N,)."""
    kind, view = image
    camera, field = scene.camera(poses, view), scene.field(kind, view)
    seen_at = project_points(camera, transform_points(poses.camera_from(name)[view], points))
    pixels = seen_at.nan_to_num(-1).round().long()  # nan: behind the source
    size = torch.tensor(camera.shape[::-1])
    inside = ((pixels >= 0) & (pixels < size)).all(1)
    if field is None:
        return inside
    column, row = pixels.clamp_min(0).minimum(size - 1).unbind(1)
    return inside & field.cpu()[row, column]


def reference_point_in_view(scene: Scene, poses: Poses, name: str, view: int) -> Tensor:
    """The reference point (3,) of an object, mm, in the camera of a view."""
    return transform_points(poses.camera_from(name)[view], scene.objects[name].reference_point[None])[0]


Moving = Body | Intrinsics


def split(deltas: Tensor, bodies: tuple[Moving, ...]) -> list[Tensor]:
    """The part (P, n_b) of deltas (P, Σ n_b) that belongs to each body."""
    return list(deltas.split([len(body.free) for body in bodies], -1))


def moved(poses: Poses, bodies: tuple[Moving, ...], delta: Tensor) -> Poses:
    """Poses after one delta (Σ n_b,) of the bodies."""
    for body, part in zip(bodies, split(delta[None], bodies), strict=True):
        if isinstance(body, Intrinsics):
            continue
        motion = body.motion(part)[0]
        if body.view:
            poses = poses.with_view(body.view, motion @ poses.camera_from_camera1[body.view])
        for name in body.objects:
            poses = poses.with_object(name, motion @ poses.camera1_from[name])
    for body, part in zip(bodies, split(delta[None], bodies), strict=True):
        if isinstance(body, Intrinsics):  # after all else has moved
            poses = poses.slid(body.slides(part)[0], body.objects).with_changes(body.changes(part[0]))
    return poses


def intrinsics_of(scene: Scene, poses: Poses, objects: Sequence[str]) -> Intrinsics:
    """The intrinsics of all views, free as far as the C-arm's file is uncertain, about the anchor's reference point.

    `objects` are those drawn.
    """
    uncertainty, views = scene.carm.assumed_uncertainty, len(poses.camera_from_camera1)
    scale = [uncertainty.sdd_percent / 100] + 2 * views * [uncertainty.principal_point_mm]
    changes = poses.changes or (CameraChange(),) * views
    offset = [math.log(changes[0].sdd_factor)] + [mm for change in changes for mm in change.principal_point_shift_mm]
    sdd_mm = scene.camera(poses, 0).sdd_mm
    depths = [float(reference_point_in_view(scene, poses, scene.anchor, view)[2]) for view in range(views)]
    reach = torch.tensor(depths, dtype=torch.float64) / sdd_mm
    if scene.camera_from_camera1 is not None:
        reach = torch.zeros_like(reach)
    return Intrinsics(tuple(objects), reach.new_tensor(scale), reach.new_tensor(offset), reach, sdd_mm)
