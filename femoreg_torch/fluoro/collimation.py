"""Which part of the detector is exposed: shutters, and the black ring of an image intensifier, found in a raw image.

A shutter is told from dense bone and from steel by its shape. What is dark and reaches the border must be all that lies
beyond a circle, straight lines, or both, and nearly all along these the image must drop sharply to nearly black. One
straight edge alone is not enough: a steel bar along the border looks just like it. And shutters close about the middle
of the image: what leaves only its side is the skin of a flat body, which is nearly as sharp, with air beside it.
Everything is fitted on pixels of about 1 mm, in mm on the detector.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from torch import Tensor

from femoreg_torch.fluoro.intensity import downsample
from femoreg_torch.fluoro.shutter_sides import Array, Grid, Line, Mask, Ring, best_side
from femoreg_torch.geometry import Camera

MARGIN_MM = 2.5  # on the detector, from the edge: the penumbra of a focal spot of 0.6 mm
_PIXEL_MM = 1.0  # that edges are looked for on
_LEVELS = 20  # tried as the grey value that parts shadow and field
_LEAST_SHADOW, _LEAST_FIELD = 0.02, 0.04  # shares of the detector
_LEAST_CORNERS = 3  # of the detector that a circle, or two blades, put in the dark
_LEAST_WHOLE = 0.7  # of what is no shadow: one piece; dense bone may cut off others
_MOST_SIDES = 8  # of an iris
_BLADES = 4  # of a collimator without one
_MOST_POINTS = 800  # of an edge
_TOLERANCE_MM = 1.0  # of edge points from a circle or line
_LEAST_SHARE = 0.06  # of the edge points: what fewer lie on is no side
_LEAST_DARK = 0.97  # of what lies beyond a side; the rest may be letters
_NEAR_MM, _FAR_MM = 3.0, 6.0  # from the edge: where grey values on both sides of it are taken
_MOST_RATIO = 0.45  # of the grey value beyond the edge to that inside
_LEAST_SHARP = 0.75  # share of the edge that is as dark and as sharp; an instrument may cross the rest
_SHARP_ENOUGH = 0.985  # to try no other grey value
_MOST_RESIDUAL_MM = 0.7
_SAME_WAY = 0.9  # cosine between the normals of one blade found twice
_LEAST_REACH = 0.15  # of a blade from the middle, of half the diagonal
_LEAST_BLADE = 0.4  # length of a blade in the image, of half the detector's side
_BLADE_STEP_MM = 2.0  # between places where a blade may be
_MOST_BEYOND = 0.6  # of the grey value anywhere beyond a blade to that inside


@dataclass(frozen=True)
class Shutter:
    """A shutter in one image."""

    shape: str  # in words
    exposed: float  # share of the detector
    field: Tensor  # (H, W) bool: the pixels inside, without the penumbra
    sides: tuple[Ring | Line, ...]  # of its edge, in mm on the detector


def exposed_field(raw: Tensor, camera: Camera) -> Tensor | None:
    """The pixels (H, W), bool, of a raw image (bone dark) that no shutter shades; None if there is none.

    A margin of 2.5 mm is taken off inside the shutter's edge.
    """
    shutter = find_shutter(raw, camera)
    return None if shutter is None else shutter.field


def without_penumbra(exposed: Tensor, camera: Camera) -> Tensor:
    """A mask (H, W) less a margin of 2.5 mm along its edge; the detector's border is no edge."""
    reach = [int(MARGIN_MM / edge) + 1 for edge in camera.pixel_mm]
    between = [(np.abs(np.arange(-n, n + 1)) - 0.5).clip(0) for n in reach]  # pixels to where one that is dark begins
    away_mm = np.hypot(*np.ix_(*(steps * edge for steps, edge in zip(between, camera.pixel_mm, strict=True))))
    return torch.from_numpy(cv2.erode(exposed.numpy().astype(np.uint8), (away_mm < MARGIN_MM).astype(np.uint8)) > 0)


def find_shutter(raw: Tensor, camera: Camera) -> Shutter | None:
    """The shutter in a raw image (H, W), bone dark; None where there is none."""
    image, grid = _coarse(raw, camera)
    best = None
    for level in _levels(image):
        fit = _fit(image, level, grid)
        if fit is not None and (best is None or fit.sharp > best.sharp):
            best = fit
        if best is not None and best.sharp > _SHARP_ENOUGH:
            break
    if best is None:
        return None
    best = _with_other_blades(best, image, grid)
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in raw.shape)
    # from the middle of the coarse pixels' first to pixels of the image
    x = (columns + 0.5) * camera.pixel_mm[1] - 0.5 * grid.pixel_mm[0]
    y = (rows + 0.5) * camera.pixel_mm[0] - 0.5 * grid.pixel_mm[1]
    places = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2).numpy()
    exposed = torch.from_numpy(best.inside(places)).reshape(raw.shape)
    return Shutter(best.name, float(exposed.double().mean()), without_penumbra(exposed, camera), tuple(best.sides))


def shades(shutter: Shutter, raw: Tensor, camera: Camera) -> bool:
    """Whether a shutter that was found in another image of the camera shades a raw image (H, W), bone dark, too.

    Then the image drops as sharply along its edge as `find_shutter` asks. No grey value need part shadow and field:
    beside air, scattered light makes a shadow brighter than a thick body is.
    """
    image, grid = _coarse(raw, camera)
    sharp = total = 0
    for side in shutter.sides:
        places = _edge(side, shutter.sides, grid)
        kept, known = _sharp_edge(image, places, side.outwards(places), grid)
        sharp, total = sharp + len(kept), total + known
    return total > 0 and sharp >= _LEAST_SHARP * total


def _coarse(raw: Tensor, camera: Camera) -> "tuple[Array, Grid]":
    """A raw image on the pixels that edges are looked for on."""
    factor = max(1, round(_PIXEL_MM / camera.mean_pixel_mm))
    image = cv2.medianBlur(downsample(raw, factor).clamp_min(0).numpy(), 3).astype(np.float64)
    return image, Grid(image.shape, (camera.pixel_mm[1] * factor, camera.pixel_mm[0] * factor))


@dataclass(frozen=True)
class _Fit:
    """Sides that bound the field, and the share of its edge that is sharp."""

    sides: list[Ring | Line] = field(default_factory=list)
    sharp: float = 0.0

    @property
    def name(self) -> str:
        round_, straight = (any(isinstance(side, kind) for side in self.sides) for kind in (Ring, Line))
        if round_:
            return "round and straight" if straight else "round"
        return "rectangular" if len(self.sides) <= _BLADES else "polygonal"

    def inside(self, places: Array) -> Mask:
        """Which places (N, 2) lie in the field."""
        return np.asarray(np.all([side.depth(places) >= 0 for side in self.sides], axis=0))


def _levels(image: Array) -> Iterator[float]:
    """Grey values that may part shadow and field, the darkest first."""
    dark, bright = np.quantile(image, [0.002, 0.995])
    lowest = max(float(dark) * 1.2, float(bright) * 1e-4)
    if bright > 0 and lowest < 0.3 * bright:
        yield from np.geomspace(lowest, 0.3 * bright, _LEVELS).tolist()


def _fit(image: Array, level: float, grid: Grid) -> _Fit | None:
    """The field of a shutter whose shadow is darker than `level`."""
    shadow = _reaching_the_border(image < level)
    if not _LEAST_SHADOW <= shadow.mean() <= 1 - _LEAST_FIELD or _dark_corners(shadow) < _LEAST_CORNERS:
        return None
    bright = _largest(~shadow)
    if bright.sum() < _LEAST_WHOLE * (~shadow).sum():
        return None
    sides = _sides(shadow, bright, grid)
    if not sides:
        return None
    refined: list[Ring | Line] = []
    sharp = total = 0
    seen = set()
    for side in sides:
        places = _edge(side, sides, grid)
        kept, known = _sharp_edge(image, places, side.outwards(places), grid)
        if len(kept) < 8:
            continue  # bones, where a grey value is taken that lies within them
        total += known
        sharp += len(kept)
        better = side.refitted(kept)
        for _ in range(2):  # without what lies off
            off = np.abs(better.depth(kept))
            better = side.refitted(kept[off <= max(3 * float(np.median(off)), 0.1)])
        if np.quantile(np.abs(better.depth(kept)), 0.8) > _MOST_RESIDUAL_MM * max(1.0, 0.5 * grid.edge_mm):
            return None
        if isinstance(better, Ring):
            apart = kept - better.middle
            seen = set(zip((apart[:, 0] > 0).tolist(), (apart[:, 1] > 0).tolist(), strict=True))
        refined.append(better)
    if sharp < _LEAST_SHARP * total or (len(seen) < 3 and sum(isinstance(side, Line) for side in refined) < 2):
        return None
    fit = _Fit(refined, sharp / total)
    return fit if fit.inside(grid.middle[None]).all() else None


def _edge(side: Ring | Line, sides: Sequence[Ring | Line], grid: Grid) -> Array:
    """Places (N, 2) along a side, on the detector, where the other sides leave it."""
    places = side.edge(grid.edge_mm, grid)
    here = np.all([other.depth(places) >= -grid.edge_mm for other in sides if other is not side], axis=0)
    return np.asarray(places[grid.within(places) & here])


def _with_other_blades(fit: _Fit, image: Array, grid: Grid) -> _Fit:
    """A fit with the blades whose shadow no single grey value shows: beside a bright field, scattered light fills it.

    Blades stand parallel or at right angles to those that were found, and all that lies beyond is darker than the field
    beside it.
    """
    sides = list(fit.sides)
    found = [side for side in sides if isinstance(side, Line)]
    if len(found) > _BLADES:
        return fit
    ways = [way for line in found[:1] for way in (line.normal, -line.normal, line.normal[::-1] * [-1, 1])]
    ways += [-ways[2]] if ways else []
    for normal in ways:
        if any(line.normal @ normal > _SAME_WAY for line in found) or len(found) == _BLADES:
            continue
        reach = float(np.linalg.norm(grid.middle))
        blades = []
        for beyond_middle in np.arange(_LEAST_REACH * reach, reach, _BLADE_STEP_MM):
            line = Line(normal, float(grid.middle @ normal + beyond_middle))
            kept, share = _blade(line, sides, image, grid)
            if share >= _LEAST_SHARP:
                blades.append((len(kept), line.refitted(kept)))
        if blades:
            best = max(blades, key=lambda blade: blade[0])[1]
            found.append(best)
            sides.append(best)
    return replace(fit, sides=sides)


def _blade(line: Line, sides: list[Ring | Line], image: Array, grid: Grid) -> tuple[Array, float]:
    """Where a line within all sides is a sharp edge with only shadow beyond (N, 2), and along what share of it."""
    places = line.edge(2 * grid.edge_mm, grid)
    within = np.all([side.depth(places) >= 0 for side in sides], axis=0)
    places = places[grid.within(places) & within]
    if len(places) * 2 * grid.edge_mm < _LEAST_BLADE * float(grid.middle.min()):
        return places, 0.0
    kept, known = _sharp_edge(image, places, line.outwards(places), grid)
    if not known or len(kept) < _LEAST_SHARP * known:
        return kept, 0.0
    inner = grid.values(image, kept - _NEAR_MM * line.normal)
    steps = np.arange(_NEAR_MM, 2 * float(np.linalg.norm(grid.middle)), 2 * grid.edge_mm)
    outside = grid.values(image, kept[:, None] + steps[:, None] * line.normal)
    dark = np.isnan(outside) | (outside < _MOST_BEYOND * inner[:, None])
    return kept, float(dark.all(1).sum()) / known


def _sharp_edge(image: Array, places: Array, outwards: Array, grid: Grid) -> tuple[Array, int]:
    """Where the image drops sharply to nearly black along an edge (N, 2): the places of half height, of how many."""
    near, far = (max(mm, pixels * grid.edge_mm) for mm, pixels in ((_NEAR_MM, 1.5), (_FAR_MM, 3.0)))
    steps = np.linspace(-far, far, 49)
    profiles = grid.values(image, places[:, None] + steps[:, None] * outwards[:, None])  # (N, 49)
    usable = np.isfinite(profiles[:, np.abs(steps) <= near]).all(1)
    profiles, places, outwards = profiles[usable], places[usable], outwards[usable]
    if not len(profiles):
        return places, 0
    inner, outer = (np.nanmean(profiles[:, part], axis=1) for part in (steps <= -near, steps >= near))
    height = (profiles - outer[:, None]) / np.maximum(inner - outer, 1e-12)[:, None]
    core = np.abs(steps) <= near
    falls = (height[:, core][:, 0] > 0.6) & (height[:, core][:, -1] < 0.25)
    middle = (height[:, core] > 0.5).sum(1) * (steps[1] - steps[0]) - near
    sharp = (outer < _MOST_RATIO * inner) & falls
    return (places + middle[:, None] * outwards)[sharp], len(profiles)


def _reaching_the_border(mask: Mask) -> Mask:
    """Those parts of a mask that reach the border."""
    _, parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    rim = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    return np.isin(parts, np.unique(rim[rim > 0]))


def _dark_corners(shadow: Mask) -> int:
    """How many corners of the detector lie in a shadow."""
    return int(sum(corner.mean() > 0.5 for half in (shadow[:3], shadow[-3:]) for corner in (half[:, :3], half[:, -3:])))


def _largest(mask: Mask) -> Mask:
    """The largest connected part of a mask."""
    _, parts, counts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return np.asarray(parts == 1 + int(counts[1:, cv2.CC_STAT_AREA].argmax()))


def _sides(shadow: Mask, bright: Mask, grid: Grid) -> list[Ring | Line]:
    """A circle and lines that lie along the edge of a shadow, with nothing but shadow beyond them."""
    edge = bright & ~cv2.erode(bright.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    edge[:3] = edge[-3:] = False
    edge[:, :3] = edge[:, -3:] = False
    left = grid.at(np.argwhere(edge)[:, ::-1])
    left = left[:: 1 + len(left) // _MOST_POINTS]
    count, places, middle = len(left), grid.places, grid.at(np.argwhere(bright)[:, ::-1]).mean(0)
    tolerance = max(_TOLERANCE_MM, 0.75 * grid.edge_mm)
    generator = np.random.default_rng(0)
    sides: list[Ring | Line] = []
    for _ in range(2 * (_MOST_SIDES + 1)):  # some may be edges of an instrument
        if len(left) < max(12, _LEAST_SHARE * count):
            break
        best, near = best_side(left, middle, tolerance, generator, any(isinstance(s, Ring) for s in sides))
        if best is None or near.sum() < max(12, _LEAST_SHARE * count):
            break
        left = left[~near]
        beyond = best.depth(places) < -2 * tolerance
        if beyond.any() and shadow.reshape(-1)[beyond].mean() >= _LEAST_DARK:
            sides.append(best)
    return sides if sum(isinstance(side, Line) for side in sides) <= _MOST_SIDES else []
