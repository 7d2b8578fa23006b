"""The 14 hip landmarks, found on the fields of the bones by geometric rules, in LPS mm.

FH centre of the femoral head; GSN deepest point of the greater sciatic notch in the side view; IOF and MOF lowest and
most medial point of the obturator foramen's rim, seen along the direction that opens it widest; SPS and IPS ends of the
symphyseal face; ASIS most anterior point of the iliac wing. Anterior, up and medial refer to the anterior pelvic plane
(both ASIS and the front of the pubis), as is usual in pelvic navigation.
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.morphology import convex_hull_image

from femoreg_torch.errors import InputError
from sim.patient.distance_field import Field
from sim.patient.skeleton import SIDES, Skeleton

Points = NDArray[np.float64]
Mask = NDArray[np.bool_]
PIXEL_MM = 1.0
SEARCH_PIXEL_MM = 3.0  # for finding the direction of the view; wider than the nodes' distance in any direction


@dataclass(frozen=True, eq=False)
class Shadow:
    """Parallel projection of a bone: per pixel the least distance along the ray, and the point where it is least."""

    least: NDArray[np.float32]
    points: Points


def _unit(vector: Points) -> Points:
    unit: Points = vector / np.linalg.norm(vector)
    return unit


def pelvic_frame(surfaces: dict[str, Points], heads: dict[str, Points]) -> tuple[Points, dict[str, Points]]:
    """Rows (3, 3) pointing left, back and up in the anterior pelvic plane, and the ASIS per side (3,).

    The contact points of the plane and its tilt are iterated until they agree.
    """
    left = _unit(heads["left"] - heads["right"])
    up = _unit(np.array([0, 0, 1.0]) - left * left[2])
    asis: dict[str, Points] = {}
    rows = np.zeros((3, 3))
    for _ in range(20):
        before, rows = rows, np.array([left, np.cross(up, left), up])
        if np.array_equal(rows, before):
            break
        pubis = {}
        for side, surface in surfaces.items():
            local = surface @ rows.T
            wing, ring = local[:, 2] > 40, (local[:, 2] < 15) & (np.abs(local[:, 0]) < 45)
            asis[side] = surface[wing][local[wing, 1].argmin()]
            pubis[side] = surface[ring][local[ring, 1].argmin()]
        left = _unit(asis["left"] - asis["right"])
        rise = asis["left"] + asis["right"] - pubis["left"] - pubis["right"]
        up = _unit(rise - left * (rise @ left))
    return rows, asis


def _shadow(field: Field, columns: Points, rows: Points, ray: Points) -> Shadow:
    """Shadow (C, R) along `ray` with pixels of `PIXEL_MM`; the three directions are orthogonal unit vectors."""
    corners = field.lo + np.array(list(np.ndindex(2, 2, 2))) * (np.array(field.values.shape) - 1) * field.step
    spans = [
        np.arange((corners @ d).min(), (corners @ d).max(), pitch)
        for d, pitch in ((columns, PIXEL_MM), (rows, PIXEL_MM), (ray, 1.5))
    ]
    base = spans[0][:, None, None] * columns + spans[1][None, :, None] * rows
    least, depth = _least_along(field.values, field.lo, field.step, base, ray, spans[2])
    return Shadow(least, base + depth[..., None] * ray)


@nb.njit(cache=True, parallel=True)
def _least_along(values, lo, step, base, ray, distances):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """The least of the trilinear values along rays from `base` (C, R, 3), and how far it is; at first inf, 0."""
    least = np.full(base.shape[:2], np.inf, np.float32)
    depth = np.zeros(base.shape[:2])
    most = np.array(values.shape) - 1.0
    for c in nb.prange(base.shape[0]):
        for r in range(base.shape[1]):
            for t in distances:
                x = (base[c, r, 0] + t * ray[0] - lo[0]) / step
                y = (base[c, r, 1] + t * ray[1] - lo[1]) / step
                z = (base[c, r, 2] + t * ray[2] - lo[2]) / step
                if 0 <= x <= most[0] and 0 <= y <= most[1] and 0 <= z <= most[2]:
                    value = _trilinear(values, x, y, z)
                    if value < least[c, r]:
                        least[c, r], depth[c, r] = value, t
    return least, depth


@nb.njit(cache=True)
def _trilinear(values, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover (compiled)
    """Value at indices within a volume (X, Y, Z)."""
    i, j, k = min(int(x), values.shape[0] - 2), min(int(y), values.shape[1] - 2), min(int(z), values.shape[2] - 2)
    u, v, w = x - i, y - j, z - k
    c00 = (1 - w) * values[i, j, k] + w * values[i, j, k + 1]
    c01 = (1 - w) * values[i, j + 1, k] + w * values[i, j + 1, k + 1]
    c10 = (1 - w) * values[i + 1, j, k] + w * values[i + 1, j, k + 1]
    c11 = (1 - w) * values[i + 1, j + 1, k] + w * values[i + 1, j + 1, k + 1]
    return (1 - u) * ((1 - v) * c00 + v * c01) + u * ((1 - v) * c10 + v * c11)


def _onto_surface(field: Field, points: Points) -> Points:
    """The surface points (N, 3) reached from near ones along the gradient."""
    shift = 0.5 * field.step * np.eye(3)
    for _ in range(5):
        slope = np.stack([field.at(points + s) - field.at(points - s) for s in shift], 1) / field.step
        points = points - (field.at(points) / np.maximum((slope**2).sum(1), 0.25))[:, None] * slope
    return points


def _largest_hole(image: Mask) -> Mask:
    """Largest part of the background that does not reach the image's edge."""
    parts, count = ndimage.label(~image)
    size = np.bincount(parts.ravel(), minlength=count + 1)
    border = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    size[np.unique(np.r_[0, border])] = 0
    hole: Mask = (parts == size.argmax()) & (size.max() > 0)
    return hole


def _view_through_foramen(inside: Points, rows: Points, sign: int) -> tuple[Points, Points, Points]:
    """Columns, rows and ray of the view in which the obturator foramen is widest; `inside` (N, 3) fills the bone."""
    best = -1, rows[0], rows[2], rows[1]
    for yaw in np.radians(np.arange(-8, 57, 8)):
        for pitch in np.radians(np.arange(-28, 29, 8)):
            ray = np.array([sign * np.sin(yaw) * np.cos(pitch), -np.cos(yaw) * np.cos(pitch), np.sin(pitch)]) @ rows
            across = _unit(rows[0] - ray * (rows[0] @ ray))
            upwards = np.cross(across, ray)
            upwards *= np.sign(upwards @ rows[2])
            pixels = np.floor(np.stack([inside @ across, inside @ upwards], 1) / SEARCH_PIXEL_MM).astype(int)
            pixels -= pixels.min(0) - 2
            image = np.zeros(pixels.max(0) + 3, bool)
            image[tuple(pixels.T)] = True
            area = int(_largest_hole(image).sum())
            if area > best[0]:
                best = area, across, upwards, ray
    return best[1:]


def obturator_rim(field: Field, rows: Points, sign: int) -> Points:
    """Rim of the obturator foramen (N, 3) mm."""
    top = int((30 - field.lo[2]) / field.step)  # the ring of the foramen lies below
    ring = Field(field.values[:, :, :top], field.lo, field.step)
    inside = np.argwhere(ring.values[::2, ::2, ::2] < 0) * 2 * field.step + field.lo
    shadow = _shadow(ring, *_view_through_foramen(inside, rows, sign))
    hole = _largest_hole(shadow.least < 0)
    rim = hole & ndimage.binary_dilation(~hole)
    return _onto_surface(field, shadow.points[rim])


def sciatic_notch(field: Field, rows: Points) -> Points:
    """Largest bay of the side view's convex hull behind the hip; in it the point farthest from its mouth."""
    shadow = _shadow(field, rows[1], rows[2], rows[0])
    image = ndimage.binary_fill_holes(shadow.least < 0)
    hull = convex_hull_image(image)
    parts, count = ndimage.label(hull & ~image)
    back, up = shadow.points @ rows[1], shadow.points @ rows[2]
    sizes = [
        0,
        *(
            (parts == k).sum() * (back[parts == k].mean() > 0) * (up[parts == k].mean() > -25)
            for k in range(1, count + 1)
        ),
    ]
    bay = parts == int(np.argmax(sizes))
    from_mouth = ndimage.distance_transform_edt(~(bay & ndimage.binary_dilation(~hull)))
    edge = bay & ndimage.binary_dilation(image)
    return _onto_surface(field, shadow.points[edge][from_mouth[edge].argmax()][None])[0]


def _symphysis(surface: Points, other: Points, rows: Points) -> tuple[Points, Points]:
    """Upper and lower end of the symphyseal face: the points within 4 mm of the narrowest gap to the other bone."""
    surface, other = (points[np.abs(points @ rows[0]) < 30] for points in (surface, other))
    gap = cKDTree(other).query(surface)[0]
    face = surface[gap < gap.min() + 4]
    local = (face - face.mean(0)) @ rows.T
    axis = np.linalg.svd(local, full_matrices=False)[2][0]
    along = local @ (axis * np.sign(axis[2]))
    return face[along.argmax()], face[along.argmin()]


def find_landmarks(skeleton: Skeleton) -> dict[str, Points]:
    """The 14 landmarks by name, (3,) LPS mm, left before right."""
    return find_on_hips({side: skeleton.bones[f"hip_{side}"] for side in SIDES}, skeleton.heads)


def find_on_hips(hips: dict[str, Field], heads: dict[str, Points]) -> dict[str, Points]:
    """The same from the fields of both hip bones and the femoral heads' centres, by side.

    The origin lies near the middle of the heads. Raises `InputError` if an obturator foramen is not to be seen.
    """
    surfaces = {side: hip.surface() for side, hip in hips.items()}
    rows, asis = pelvic_frame(surfaces, heads)
    found: dict[str, dict[str, Points]] = {kind: {} for kind in ("FH", "GSN", "IOF", "MOF", "SPS", "IPS", "ASIS")}
    for (side, sign), other in zip(SIDES.items(), ("right", "left"), strict=True):
        rim = obturator_rim(hips[side], rows, sign)
        if not len(rim):
            raise InputError(f"landmarks: the {side} hip bone has no obturator foramen to see through.")
        found["FH"][side], found["ASIS"][side] = heads[side], asis[side]
        found["GSN"][side] = sciatic_notch(hips[side], rows)
        found["IOF"][side] = rim[(rim @ rows[2]).argmin()]
        found["MOF"][side] = rim[(sign * rim @ rows[0]).argmin()]
        found["SPS"][side], found["IPS"][side] = _symphysis(surfaces[side], surfaces[other], rows)
    return {f"{kind}-{side[0]}": point for kind, sides in found.items() for side, point in sides.items()}
