"""The 14 hip landmarks, found on closed bone surfaces by geometry alone, in LPS mm.

The rules are those of `sim.patient.landmarks`, on vertices instead of distance fields: FH centre of the sphere fitted
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
from sim.patient.around_surfaces.silhouettes import convex_hull, largest_hole, silhouette, vertex_behind
from sim.patient.skeleton import SIDES
from sim.patient.sphere import refitted_sphere

Points = NDArray[np.float64]
Surfaces = dict[str, trimesh.Trimesh]

_SEARCH_PIXEL_MM = 1.0  # for finding the direction of the view
_PIXEL_MM = 0.5
_HEADS_APART_MM = 50.0  # centres of the femoral heads; some 170 in adults


@dataclass(frozen=True, eq=False)
class SurfaceLandmarks:
    """What is found on the bones of one subject."""

    points: dict[str, Points]  # (3,) LPS mm, in the order of the anatomy's
    head_radius: dict[str, float]  # by side, mm
    pelvic_frame: Points  # rows (3, 3) that point left, back and up in the anterior pelvic plane


def unit(vector: Points) -> Points:
    """The vector at length 1."""
    result: Points = vector / np.linalg.norm(vector)
    return result


def find_surface_landmarks(bones: Surfaces) -> SurfaceLandmarks:
    """The 14 landmarks of the bones by name. Raises `InputError` if an obturator foramen is not to be seen."""
    hips = {side: bones[f"hip_{side}"] for side in SIDES}
    spheres = {side: _femoral_head(bones[f"femur_{side}"], hips[side]) for side in SIDES}
    frame, middle, asis = _pelvic_frame(hips, {side: sphere[:3] for side, sphere in spheres.items()})
    found: dict[str, Points] = {}
    for (side, sign), other in zip(SIDES.items(), reversed(SIDES), strict=True):
        rim = _obturator_rim(hips[side], frame, middle, sign, side)
        local = (rim - middle) @ frame.T
        found[f"FH-{side[0]}"] = spheres[side][:3]
        found[f"GSN-{side[0]}"] = _sciatic_notch(hips[side], frame, middle)
        found[f"IOF-{side[0]}"] = rim[local[:, 2].argmin()]
        found[f"MOF-{side[0]}"] = rim[np.abs(local[:, 0]).argmin()]
        found[f"SPS-{side[0]}"], found[f"IPS-{side[0]}"] = _symphysis(hips[side], hips[other], frame, middle)
        found[f"ASIS-{side[0]}"] = asis[side]
    return SurfaceLandmarks(
        {name: np.array(found[name]) for name in HIP.landmark_names},
        {side: float(sphere[3]) for side, sphere in spheres.items()},
        frame,
    )


def _femoral_head(femur: trimesh.Trimesh, hip: trimesh.Trimesh) -> Points:
    """Centre and radius (4,): fitted to the vertices next to the hip bone, then again to those near the sphere."""
    gap = cKDTree(hip.vertices).query(femur.vertices)[0]
    return refitted_sphere(femur.vertices, gap < np.percentile(gap, 2) + 3)


def _pelvic_frame(hips: Surfaces, heads: dict[str, Points]) -> tuple[Points, Points, dict[str, Points]]:
    """Rows (3, 3) pointing left, back and up in the anterior pelvic plane, the middle of the heads, both ASIS.

    The contact points of the plane (ASIS, front of the pubis) and its tilt are iterated until they agree.
    """
    apart = heads["left"] - heads["right"]
    if not apart[0] > _HEADS_APART_MM:
        raise InputError(
            f"the left femoral head lies {apart[0]:.0f} mm left of the right one, at least {_HEADS_APART_MM:g} mm "
            "were expected. Are sides and axes (LPS, mm) right?"
        )
    left = unit(apart)
    up = unit(np.array([0, 0, 1.0]) - left * left[2])
    middle = (heads["left"] + heads["right"]) / 2
    asis: dict[str, Points] = {}
    for _ in range(20):
        rows = np.array([left, np.cross(up, left), up])
        pubis = {}
        for side, hip in hips.items():
            local = (hip.vertices - middle) @ rows.T
            asis[side] = _foremost(hip, local, local[:, 2] > 40)
            pubis[side] = _foremost(hip, local, (local[:, 2] < 15) & (np.abs(local[:, 0]) < 45))
        left = unit(asis["left"] - asis["right"])
        rise = (asis["left"] + asis["right"] - pubis["left"] - pubis["right"]) / 2
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


def _obturator_rim(hip: trimesh.Trimesh, frame: Points, middle: Points, sign: int, side: str) -> Points:
    """Rim of the obturator foramen (N, 3), seen along the direction in which the foramen is widest."""
    widest, best = 0.0, np.zeros((0, 2))
    for yaw in range(-10, 56, 6):  # degrees; the foramen faces forwards, outwards and down
        for pitch in range(-30, 31, 6):
            a, b = np.radians(sign * yaw), np.radians(pitch)
            ray = frame.T @ np.array([np.sin(a) * np.cos(b), -np.cos(a) * np.cos(b), np.sin(b)])
            across = unit(frame[0] - ray * (frame[0] @ ray))
            upwards = np.cross(across, ray)
            upwards *= np.sign(upwards @ frame[2])
            points2 = np.c_[(hip.vertices - middle) @ across, (hip.vertices - middle) @ upwards]
            area = largest_hole(silhouette(points2, hip.faces, _SEARCH_PIXEL_MM)[0])[1]
            if area > widest:
                widest, best = area, points2
    if not widest:
        raise InputError(f"landmarks: hip_{side} has no obturator foramen to see through.")
    image, origin = silhouette(best, hip.faces, _PIXEL_MM)
    hole, _ = largest_hole(image)
    ring = np.argwhere(ndimage.binary_dilation(hole, iterations=2) & ~hole) * _PIXEL_MM + origin + _PIXEL_MM / 2
    return np.array([vertex_behind(hip, best, place, 1.0) for place in ring])


def _sciatic_notch(hip: trimesh.Trimesh, frame: Points, middle: Points) -> Points:
    """Largest bay of the side view's convex hull behind the hip; in it the point farthest from its mouth."""
    points2 = ((hip.vertices - middle) @ frame.T)[:, 1:]  # back, up
    image, origin = silhouette(points2, hip.faces, _PIXEL_MM)
    image = ndimage.binary_fill_holes(image)
    hull = convex_hull(image)
    parts, count = ndimage.label(hull & ~image)
    largest = (0, 0)
    for part in range(1, count + 1):
        pixels = np.argwhere(parts == part)
        back, up = pixels.mean(0) * _PIXEL_MM + origin
        if back > 0 and up > -25:
            largest = max(largest, (len(pixels), part))
    bay = parts == largest[1]
    from_mouth = ndimage.distance_transform_edt(~(bay & ndimage.binary_dilation(~hull)))
    edge = bay & ndimage.binary_dilation(image)
    place = np.argwhere(edge)[from_mouth[edge].argmax()] * _PIXEL_MM + origin
    return vertex_behind(hip, points2, place, 1.5)
