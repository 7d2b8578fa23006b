"""Poses of the objects of a case from their beads: shadows found or given, matched, and all fitted at once.

Objects go in the order in which the user names them. The first one is matched by itself, with a rough pose where there
is one. What is then known helps the next images: one camera takes all images of a view, and an object that is placed
in one view is placed in all whose camera is known. A rough pose says which shadow is which bead, and nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from femoreg_torch.beads.bundle import Bundle, Sight, bundle
from femoreg_torch.beads.edges import beside_metal, read_metal
from femoreg_torch.beads.given import Given, Mark
from femoreg_torch.beads.matching import Match, match_beads
from femoreg_torch.beads.model import Beads
from femoreg_torch.beads.spots import blur_on, find_spots
from femoreg_torch.case import Case
from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import Display
from femoreg_torch.geometry import Poses, invert_rigid, project_points, transform_points
from femoreg_torch.registration.prepare.images import ByKind, read_images

# longer by shorter side of a pixel: of drawn shadows of 4 pixels radius, in noise of 0.01, centres are off by 0.014 px
# (root mean square) at 1 and at 1.05, by 0.022 at 1.1 and 0.040 at 1.15; at 1.2 half of them are found, at 1.25 none
_MOST_OBLONG = 1.05
_DEPTH = 0.7  # of the source-to-detector distance, where nothing says where an object is
_REGISTERED_MM, _NOMINAL_MM, _SAME_CAMERA_MM, _PLACED_MM = 10.0, 40.0, 2.0, 5.0  # gates, on the detector
_AGAIN = 2  # rounds: edges are drawn where the round before has left the device
_TAKEN_MM = 1.0  # from where a bead of another object is seen, on the detector

Report = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Measured:
    """Poses from beads, and what they were measured on."""

    bundle: Bundle
    beads: tuple[Beads, ...]
    images: ByKind  # attenuation (H, W) of every view, by kind
    placed: dict[str, Tensor]  # camera1_from_object (4, 4) by all views, to draw the beads
    cameras: dict[int, Tensor]  # camera_from_camera1 (4, 4) of the views that are known
    notes: tuple[str, ...]  # images whose beads were left out, and why, in words


def measure(case: Case, given: Given, rough: Poses | None = None, report: Report = lambda _: None) -> Measured:
    """Poses of all objects with beads, and of the C-arm in every view, or, of the first view alone, as `given` says.

    `rough` are poses of a registration of this case. `report` is told each step. Raises `InputError` where an object's
    beads are not seen or cannot be told apart.
    """
    if not case.views:
        raise InputError(f"{case.folder}/case.yaml, views: empty. At least one fluoroscopic image is needed.")
    if any(case.display_of(n) != Display() or view.grid is not None for n, view in enumerate(case.views)):
        raise InputError(
            f"{case.folder}/case.yaml: beads are measured in straight images as a source in front of the patient sees "
            "them. Store the images so, and leave `display` and `grid` out."
        )
    rows, columns = case.carm.camera.pixel_mm
    if max(rows, columns) > _MOST_OBLONG * min(rows, columns):
        raise InputError(
            f"{case.folder}/case.yaml, carm: its pixels are {rows:g} × {columns:g} mm. Shadows of beads are taken for "
            "circles, so sides of pixels that differ by 5 % at most were expected. Resample the images to square ones."
        )
    report("reading the images")
    images, fields, _ = read_images(case)
    worker = _Matcher(case, given, rough, images, fields)
    for thing in given.beads:
        for view in range(len(case.views)):
            report(f"beads of {thing.object} in view {view + 1}")
            worker.match(thing, view)
    for view in range(len(case.views)):
        if view not in worker.cameras:
            problem = worker.problems.get(view, f"view {view + 1}: no beads are annotated there.")
            if not given.first_view_only:
                raise InputError(f"{problem} To use the first view alone, say `views: first`.")
            worker.notes.append(f"{problem} They stay in its images")
    report("fitting all beads")
    known = [view for view in range(len(case.views)) if view in worker.cameras]
    everywhere = Poses(torch.stack([worker.cameras[view] for view in known]), worker.placed)
    sights = [replace(sight, view=known.index(sight.view)) for sight in worker.sights]
    found = whole = bundle(given.beads, sights, everywhere, case.carm.camera, given.noise_px)
    models = {name: case.objects[name].model for name in whole.poses.camera1_from}
    metal = {name: read_metal(model) for name, model in models.items() if model is not None}
    if given.marks is None and any(metal.values()):
        report("shadows beside metal")
        shown = {kind: tuple(of_views[view] for view in known) for kind, of_views in images.items()}
        at = replace(case, views=tuple(case.views[view] for view in known))
        for _ in range(_AGAIN):
            sights = beside_metal(sights, at, shown, given.beads, metal, whole.poses)
            found = whole = bundle(given.beads, sights, whole.poses, case.carm.camera, given.noise_px)
    if given.first_view_only:
        first = [sight for sight in sights if sight.view == 0]
        found = bundle(given.beads, first, everywhere.first_views(1), case.carm.camera, given.noise_px)
    drawn = {view: whole.poses.camera_from_camera1[n] for n, view in enumerate(known)}
    return Measured(found, given.beads, images, whole.poses.camera1_from, drawn, tuple(worker.notes))


class _Matcher:
    """Matches objects and views in turn, and keeps what has become known."""

    def __init__(self, case: Case, given: Given, rough: Poses | None, images: ByKind, fields: ByKind) -> None:
        self.case, self.given, self.rough, self.images, self.fields = case, given, rough, images, fields
        self.camera = case.carm.camera
        self.cameras: dict[int, Tensor] = {0: torch.eye(4, dtype=torch.float64)}  # from camera 1
        self.placed: dict[str, Tensor] = {}  # camera 1 from object
        self.sights: list[Sight] = []
        self.notes: list[str] = []
        self.problems: dict[int, str] = {}  # of views whose camera may stay unknown

    def match(self, thing: Beads, view: int) -> None:
        """Match the beads of an object in all images of a view that show it."""
        shown = self.case.objects[thing.object].images or self.case.kinds
        there = [kind for kind in shown if kind in self.images and self.images[kind][view] is not None]
        pose, problem = None, None
        for kind in there:
            name = self.case.views[view].images[kind].name
            if self.given.marks is not None and name not in self.given.marks:
                continue
            rough, gate = (pose, _SAME_CAMERA_MM) if pose is not None else self._expected(thing, view)
            try:
                pixels, match = self._matched(thing, view, kind, name, rough, gate)
            except InputError as error:
                problem = problem or error
                self.notes.append(str(error))
                continue
            pose = match.camera_from_object
            self.notes += self._left_out(thing, name, match)
            for bead, spot in enumerate(match.spots.tolist()):
                if spot >= 0:
                    column, row = pixels[spot].tolist()
                    self.sights.append(Sight(thing.object, bead, view, name, (column, row), kind=kind))
        if pose is not None:
            self._learn(thing, view, pose)
        elif view == 0:
            raise problem or InputError(f"beads of {thing.object}: none are annotated in view 1. Annotate them there.")
        elif problem is not None:
            self.problems.setdefault(view, str(problem))

    def _left_out(self, thing: Beads, name: str, match: Match) -> list[str]:
        """In words, which shadows that somebody gave the name of a bead do not lie where the others put that bead."""
        if self.given.marks is None:
            return []
        marks = [mark for mark in self.given.marks[name] if _may_be(mark, thing)]
        used = set(match.spots.tolist())
        told = []
        for number, mark in enumerate(marks):
            if mark.bead is not None and number not in used:
                point = thing.points[thing.names.index(mark.bead)]
                drawn = project_points(self.camera, transform_points(match.camera_from_object, point[None]))[0]
                off = float((drawn - torch.tensor(mark.pixel, dtype=torch.float64)).norm())
                told.append(f"{mark.bead} ({off:.0f} pixels off)")
        if not told:
            return []
        return [
            f"beads of {thing.object} in {name}: left out, as the others put them elsewhere: {', '.join(told)}. Were "
            "two names exchanged, or another shadow taken?"
        ]

    def _learn(self, thing: Beads, view: int, pose: Tensor) -> None:
        if view == 0:
            self.placed[thing.object] = pose
        elif view not in self.cameras:
            self.cameras[view] = pose @ invert_rigid(self.placed[thing.object])

    def _expected(self, thing: Beads, view: int) -> tuple[Tensor | None, float]:
        """A rough pose of an object in a view, if anything tells it, and how wrong it may be on the detector, mm."""
        if thing.object in self.placed and view in self.cameras:
            return self.cameras[view] @ self.placed[thing.object], _PLACED_MM
        if self.rough is not None and thing.object in self.rough.camera1_from:
            return self.rough.camera_from(thing.object)[view], _REGISTERED_MM
        nominal = self.case.objects[thing.object].start.camera1_from
        if nominal is not None and view in self.cameras:
            return self.cameras[view] @ nominal, _NOMINAL_MM
        return None, 0.0

    def _matched(
        self, thing: Beads, view: int, kind: str, name: str, rough: Tensor | None, gate_mm: float
    ) -> tuple[Tensor, Match]:
        pixels, labels = self._shadows(thing, view, kind, name, rough)
        where = f"beads of {thing.object} in {name}"
        return pixels, match_beads(
            thing.points, pixels, self.camera, rough, gate_mm, float(thing.deviations_mm.max()), labels, where
        )

    def _shadows(
        self, thing: Beads, view: int, kind: str, name: str, rough: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """Shadows (M, 2) that may be of an object's beads, and which bead (M,) each is, −1 where nobody says."""
        if self.given.marks is not None:
            marks = [mark for mark in self.given.marks[name] if _may_be(mark, thing)]
            pixels = torch.tensor([mark.pixel for mark in marks], dtype=torch.float64).reshape(-1, 2)
            labels = [-1 if mark.bead is None else thing.names.index(mark.bead) for mark in marks]
            return pixels, torch.tensor(labels)
        image, field = self.images[kind][view], self.fields[kind][view]
        assert image is not None  # seen by the caller
        depth = _DEPTH * self.camera.sdd_mm
        if rough is not None:
            depth = float(transform_points(rough, thing.points)[:, 2].mean())
        radius = thing.diameter_mm / 2 * self.camera.sdd_mm / depth / self.camera.mean_pixel_mm
        pixels = find_spots(image, radius, field, blur_on(self.camera.mean_pixel_mm)).pixels
        return pixels[~self._taken(thing, view, pixels)], None

    def _taken(self, thing: Beads, view: int, pixels: Tensor) -> Tensor:
        """Which shadows (M,) are those of beads of other objects."""
        taken = torch.zeros(len(pixels), dtype=torch.bool)
        for other in self.given.beads:
            if other.object != thing.object and other.object in self.placed and view in self.cameras:
                pose = self.cameras[view] @ self.placed[other.object]
                drawn = project_points(self.camera, transform_points(pose, other.points))
                taken |= (torch.cdist(pixels, drawn) * self.camera.mean_pixel_mm < _TAKEN_MM).any(1)
        return taken


def _may_be(mark: Mark, thing: Beads) -> bool:
    return mark.bead is None or mark.bead in thing.names
