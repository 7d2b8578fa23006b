"""The 14 hip landmarks, found on closed bone surfaces by geometry alone, in LPS mm.

The rules are those of `sim.patient.landmarks`, which finds them on distance fields: FH centre of the sphere fitted
to the femoral head; GSN deepest point of the greater sciatic notch in the side view; IOF and MOF lowest and most medial
point of the obturator foramen's rim, seen along the direction that opens it widest; SPS and IPS ends of the symphyseal
face; ASIS most anterior point of the iliac wing. Anterior, up and medial refer to the anterior pelvic plane (both ASIS
and the front of the pubis).
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from femoreg_torch.anatomy import HIP
from femoreg_torch.errors import InputError
from femoreg_torch.segment.silhouettes import convex_hull, largest_hole, silhouette, vertex_behind
from femoreg_torch.segment.sphere import most_supported_sphere, refitted_sphere

Points = NDArray[np.float64]
Surfaces = dict[str, trimesh.Trimesh]

SIDES = {"left": 1, "right": -1}  # the sign of x

_SEARCH_PIXEL_MM = 1.0  # for finding the direction of the view
_PIXEL_MM = 0.5
HEAD_RADIUS_MM = (15.0, 35.0)  # of what may be a femoral head at all; other spheres are none
DOUBTED_RESIDUAL_MM = 1.5  # of a head's surface from its sphere
_ABOUT_MM = 10.0  # beyond a head's sphere: what lies further off belongs to another part of the femur
_HEADS_APART_MM = 50.0  # centres of the femoral heads; some 170 in adults
_HALF_HEADS_MM = 88.0  # half the distance of the femoral heads of adults


@dataclass(frozen=True, eq=False)
class SurfaceLandmarks:
    """What is found on the bones of one subject."""

    points: dict[str, Points]  # (3,) LPS mm, in the order of the anatomy's; those that could be found
    head_radius: dict[str, float]  # by side, mm
    head_residual: dict[str, float]  # by side, mm: root mean square from the sphere, of the surface in the socket
    pelvic_frame: Points  # rows (3, 3) that point left, back and up in the anterior pelvic plane


def unit(vector: Points) -> Points:
    """The vector at length 1."""
    result: Points = vector / np.linalg.norm(vector)
    return result


def find_surface_landmarks(bones: Surfaces, whole: bool = True, edge_mm: float = 6.0) -> SurfaceLandmarks:
    """The 14 landmarks of the bones by name, which have no edge longer than `edge_mm`.

    Raises `InputError` if an obturator foramen is not to be seen. If not `whole`, hip bones may be cut or missing, and
    what cannot be found is left out; there must be one hip bone.
    """
    hips = {side: bones[f"hip_{side}"] for side in SIDES if whole or f"hip_{side}" in bones}
    femora = {side: bones[f"femur_{side}"] for side in hips if whole or f"femur_{side}" in bones}
    spheres = {side: femoral_head(femur, hips[side]) for side, femur in femora.items()}
    heads = {side: sphere[:3] for side, (sphere, _) in spheres.items()}
    frame, middle, asis = _pelvic_frame(hips, heads)
    found: dict[str, Points] = {f"FH-{side[0]}": head for side, head in heads.items()}
    for side, other in zip(SIDES, reversed(SIDES), strict=True):
        if side not in hips:
            continue
        if side in asis:
            found[f"ASIS-{side[0]}"] = asis[side]
        rim = _obturator_rim(hips[side], frame, middle, SIDES[side], edge_mm)
        if len(rim):
            local = (rim - middle) @ frame.T
            found[f"IOF-{side[0]}"] = rim[local[:, 2].argmin()]
            found[f"MOF-{side[0]}"] = rim[np.abs(local[:, 0]).argmin()]
        elif whole:
            raise InputError(f"landmarks: hip_{side} has no obturator foramen to see through.")
        notch = _sciatic_notch(hips[side], frame, middle, edge_mm)
        if notch is not None:
            found[f"GSN-{side[0]}"] = notch
        if other in hips:
            found[f"SPS-{side[0]}"], found[f"IPS-{side[0]}"] = _symphysis(hips[side], hips[other], frame, middle)
    return SurfaceLandmarks(
        {name: np.array(found[name]) for name in HIP.landmark_names if name in found},
        {side: float(sphere[3]) for side, (sphere, _) in spheres.items()},
        {side: residual for side, (_, residual) in spheres.items()},
        frame,
    )


def femoral_head(femur: trimesh.Trimesh, hip: trimesh.Trimesh) -> tuple[Points, float]:
    """Centre and radius (4,): fitted to the vertices next to the hip bone, then again to those near the sphere.

    Where these do not lie on that sphere, as of a femur that comes near the ischium too, the best of many spheres
    through four of them each is taken. Also the root mean square distance from the sphere of those about it.
    """
    gap = cKDTree(hip.vertices).query(femur.vertices)[0]
    socket = gap < np.percentile(gap, 2) + 3
    sphere = refitted_sphere(femur.vertices, socket)
    if _residual(sphere, femur.vertices[socket]) > DOUBTED_RESIDUAL_MM:
        sphere = most_supported_sphere(femur.vertices, socket, HEAD_RADIUS_MM, sphere)
    return sphere, _residual(sphere, femur.vertices[socket])


def _residual(sphere: Points, points: Points) -> float:
    """Root mean square distance from a sphere (4,) of points (N, 3) in and about it; of all, where none is."""
    off = np.linalg.norm(points - sphere[:3], axis=1) - sphere[3]
    about = off < _ABOUT_MM
    return float(np.sqrt((off[about if about.any() else slice(None)] ** 2).mean()))


def _pelvic_frame(hips: Surfaces, heads: dict[str, Points]) -> tuple[Points, Points, dict[str, Points]]:
    """Rows (3, 3) pointing left, back and up in the anterior pelvic plane, the middle of the heads, the ASIS by side.

    The contact points of the plane (ASIS, front of the pubis) and its tilt are iterated until they agree. With one side
    alone, left is that of the patient's frame, and the middle lies beside its head by half the usual distance.
    """
    both = len(heads) == 2
    left = np.array([1.0, 0, 0])
    if both:
        apart = heads["left"] - heads["right"]
        if not apart[0] > _HEADS_APART_MM:
            raise InputError(
                f"the left femoral head lies {apart[0]:.0f} mm left of the right one, at least {_HEADS_APART_MM:g} mm "
                "were expected. Are sides and axes (LPS, mm) right?"
            )
        left = unit(apart)
    up = unit(np.array([0, 0, 1.0]) - left * left[2])
    middle = np.mean(list(heads.values()), 0) if heads else np.mean([hip.vertices.mean(0) for hip in hips.values()], 0)
    if len(hips) == 1 or len(heads) == 1:
        side = next(iter(heads or hips))
        middle = middle - SIDES[side] * _HALF_HEADS_MM * left
    asis: dict[str, Points] = {}
    for _ in range(20):
        rows = np.array([left, np.cross(up, left), up])
        asis, pubis = {}, {}
        for side, hip in hips.items():
            local = (hip.vertices - middle) @ rows.T
            wing, ring = local[:, 2] > 40, (local[:, 2] < 15) & (np.abs(local[:, 0]) < 45)
            if wing.any():
                asis[side] = _foremost(hip, local, wing)
            if ring.any():
                pubis[side] = _foremost(hip, local, ring)
        if len(asis) == 2:
            left = unit(asis["left"] - asis["right"])
        if not set(asis) & set(pubis):
            break
        rise = np.mean([asis[side] - pubis[side] for side in asis if side in pubis], 0)
        up = unit(rise - left * (rise @ left))
    return rows, middle, asis


def _foremost(hip: trimesh.Trimesh, local: Points, region: NDArray[np.bool_]) -> Points:
    chosen = np.flatnonzero(region)
    if not len(chosen):
        raise InputError("a hip bone has no spine above the femoral heads, or no pubis. Are the axes LPS, in mm?")
    vertex: Points = hip.vertices[chosen[local[chosen, 1].argmin()]]
    return vertex


def _symphysis(hip: trimesh.Trimesh, other: trimesh.Trimesh, frame: Points, middle: Points) -> tuple[Points, Points]:
    """Upper and lower end of the symphyseal face: the vertices within 4 mm of the narrowest gap to the other bone."""
    gap = cKDTree(other.vertices).query(hip.vertices)[0]
    face = hip.vertices[gap < gap.min() + 4]
    local = (face - middle) @ frame.T
    local -= local.mean(0)
    axis = np.linalg.svd(local, full_matrices=False)[2][0]
    along = local @ (axis * np.sign(axis[2]))
    return face[along.argmax()], face[along.argmin()]


def _obturator_rim(hip: trimesh.Trimesh, frame: Points, middle: Points, sign: int, edge_mm: float) -> Points:
    """Rim of the obturator foramen (N, 3), seen along the direction in which it is widest; empty if there is none."""
    widest, best = 0.0, np.zeros((0, 2))
    for yaw in range(-10, 56, 6):  # degrees; the foramen faces forwards, outwards and down
        for pitch in range(-30, 31, 6):
            a, b = np.radians(sign * yaw), np.radians(pitch)
            ray = frame.T @ np.array([np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)])
            across = unit(frame[0] - ray * (frame[0] @ ray))
            upwards = np.cross(across, ray)
            upwards *= np.sign(upwards @ frame[2])
            points2 = np.c_[(hip.vertices - middle) @ across, (hip.vertices - middle) @ upwards]
            area = largest_hole(silhouette(points2, hip.faces, _SEARCH_PIXEL_MM, edge_mm)[0])[1]
            if area > widest:
                widest, best = area, points2
    if not widest:
        return np.zeros((0, 3))
    image, origin = silhouette(best, hip.faces, _PIXEL_MM, edge_mm)
    hole, _ = largest_hole(image)
    ring = np.argwhere(ndimage.binary_dilation(hole, iterations=2) & ~hole) * _PIXEL_MM + origin + _PIXEL_MM / 2
    return np.array([vertex_behind(hip, best, place, 1.0) for place in ring])


def _sciatic_notch(hip: trimesh.Trimesh, frame: Points, middle: Points, edge_mm: float) -> Points | None:
    """Largest bay of the side view's convex hull behind the hip; in it the point farthest from its mouth.

    None if there is no bay.
    """
    points2 = ((hip.vertices - middle) @ frame.T)[:, 1:]  # back, up
    image, origin = silhouette(points2, hip.faces, _PIXEL_MM, edge_mm)
    image = ndimage.binary_fill_holes(image)
    hull = convex_hull(image)
    parts, count = ndimage.label(hull & ~image)
    largest = (0, 0)
    for part in range(1, count + 1):
        pixels = np.argwhere(parts == part)
        back, up = pixels.mean(0) * _PIXEL_MM + origin + _PIXEL_MM / 2
        if back > 0 and up > -25:
            largest = max(largest, (len(pixels), part))
    if not largest[1]:
        return None
    bay = parts == largest[1]
    from_mouth = ndimage.distance_transform_edt(~(bay & ndimage.binary_dilation(~hull)))
    edge = bay & ndimage.binary_dilation(image)
    place = np.argwhere(edge)[from_mouth[edge].argmax()] * _PIXEL_MM + origin + _PIXEL_MM / 2
    return vertex_behind(hip, points2, place, 1.5)
