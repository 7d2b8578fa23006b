"""Devices: closed CAD meshes in mm, and their voxels.

Closedness and orientation are trimesh's. Its voxels, however, are either inside or outside; a projector needs
the fraction of each that is inside, or thin walls come out by up to half a voxel too thick or thin.
"""

import math
from typing import TYPE_CHECKING

import numba
import numpy as np
import torch

from femoreg_torch.arrays import check_voxels
from femoreg_torch.errors import InputError, shortened
from femoreg_torch.volume.attenuation import hu_to_attenuation
from femoreg_torch.volume.grid import Volume, axis_aligned

if TYPE_CHECKING:
    import trimesh

_SUB = 4  # columns of sub-samples per voxel side; along the columns the coverage is exact
_MARGIN = 2  # empty voxels around the mesh
_LEAST_FILLING = 1e-9  # volume per cubed diagonal of the bounding box; a wire of 0.1 mm and 300 mm has 9e-8


def check_closed(mesh: "trimesh.Trimesh", where: str) -> "trimesh.Trimesh":
    """`mesh` itself, with outward normals, if it is closed. Raises `InputError` that names `where` if it is not.

    Bodies may touch or overlap, as those of an assembly in one file do: every edge is to be run through as often one
    way as the other. What lies in two bodies lies inside, once. A body that stands twice in the mesh is left once.
    A body that is inside out is turned, unless it lies in another one, in which it is a hollow.
    """
    if len(mesh.faces) == 0:
        raise InputError(f"{where}: the mesh holds no triangle.")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{where}: the mesh holds vertices that are not finite. Export it anew.")
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        edges = mesh.edges_unique_inverse
        uses = np.bincount(edges)
        one_way = np.bincount(edges, np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1))
        if (uses % 2).any():
            raise InputError(
                f"{where}: the mesh is open ({np.count_nonzero(uses % 2)} of {len(uses)} edges do not join two faces). "
                "Close its holes in the CAD program; only a closed surface has an inside."
            )
        if one_way.any():
            raise InputError(f"{where}: the faces of the mesh disagree about which side is out. Unify its normals.")
    with np.errstate(divide="ignore", invalid="ignore"):  # trimesh divides by the volume for the centre of mass
        volume = float(mesh.volume)
    if not abs(volume) > _LEAST_FILLING * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) ** 3:
        raise InputError(f"{where}: the mesh is flat and encloses nothing. Export the solid, not a sketch or a face.")
    if volume < 0:
        mesh = mesh.copy()
        mesh.invert()
    return _bodies_turned(_each_body_once(mesh))


def _each_body_once(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """The closed mesh without faces that stand in it twice alike, if it is still closed, or itself."""
    lowest_first = np.take_along_axis(mesh.faces, (mesh.faces.argmin(1)[:, None] + np.arange(3)) % 3, 1)
    first = np.unique(lowest_first, axis=0, return_index=True)[1]
    if len(first) == len(mesh.faces):
        return mesh
    once = mesh.copy()
    once.update_faces(np.sort(first))
    # a wall that two nested bodies share is needed by both
    ways = np.where(once.edges[:, 0] < once.edges[:, 1], 1, -1)
    return mesh if np.bincount(once.edges_unique_inverse, ways).any() else once


def _bodies_turned(mesh: "trimesh.Trimesh") -> "trimesh.Trimesh":
    """The closed mesh with its bodies that are inside out turned, unless they are hollows of others, or itself.

    Bodies that share edges are not told apart, and left as they are.
    """
    import trimesh

    if not mesh.is_watertight:  # by trimesh, for whom an edge joins two faces
        return mesh
    bodies = trimesh.graph.connected_components(mesh.face_adjacency, nodes=np.arange(len(mesh.faces)))
    if len(bodies) == 1:
        return mesh
    corners = mesh.triangles
    middle = mesh.bounds.mean(0)
    volumes = np.einsum("fi,fi->f", corners[:, 0] - middle, np.cross(corners[:, 1] - middle, corners[:, 2] - middle))
    turned = [body for body in bodies if volumes[body].sum() < 0 and _stands_out(body, corners)]
    if not turned:
        return mesh
    faces = np.array(mesh.faces)
    whole = np.concatenate(turned)
    faces[whole] = faces[whole, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def _stands_out(body: np.ndarray, triangles: np.ndarray) -> bool:
    """Whether one of the outermost corners of a body, faces by number, lies in none of the others."""
    corners = triangles[body].reshape(-1, 3)
    others = np.delete(triangles, body, axis=0)
    return any(_windings(others, corners[k]) < 0.5 for k in {*corners.argmin(0), *corners.argmax(0)})


def _windings(triangles: np.ndarray, point: np.ndarray) -> float:
    """How often closed triangles (F, 3, 3) wind around a point: 1 inside a body, 0 outside all.

    Sum of solid angles: Van Oosterom and Strackee, IEEE Trans Biomed Eng 30 (1983), equation 8.
    """
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    p, q, r = (np.linalg.norm(edge, axis=1) for edge in (a, b, c))
    above = np.einsum("fi,fi->f", a, np.cross(b, c))
    dot = np.einsum("kfi,kfi->kf", np.stack([a, b, c]), np.stack([b, c, a]))
    below = p * q * r + dot[0] * r + dot[1] * p + dot[2] * q
    return float(np.arctan2(above, below).sum() / (2 * np.pi))


@numba.njit(cache=True, nogil=True)
def _accumulate(triangles: np.ndarray, coverage: np.ndarray) -> None:  # pragma: no cover (compiled)
    """Add every crossing of a triangle and a column of sub-samples to `coverage` (Z + 1, Y, X).

    `triangles` (F, 3, 3) are in index units, shifted so that voxel k spans [k, k + 1] along each axis. A crossing at
    height z opens or closes the column by the sign of the triangle's normal; what it adds to the voxel it lies in and
    to the one above is such that the running sum along z is the share of each voxel that is inside.
    """
    weight = 1.0 / (_SUB * _SUB)
    rows, columns = coverage.shape[1] * _SUB, coverage.shape[2] * _SUB
    for f in range(triangles.shape[0]):
        ax, ay, az = triangles[f, 0]
        bx, by, bz = triangles[f, 1]
        cx, cy, cz = triangles[f, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0:
            continue
        sign = -weight if area > 0 else weight  # normal up: the column leaves the solid here
        first_row = max(0, int(np.ceil(min(ay, by, cy) * _SUB - 0.5)))
        last_row = min(rows - 1, int(np.floor(max(ay, by, cy) * _SUB - 0.5)))
        first_column = max(0, int(np.ceil(min(ax, bx, cx) * _SUB - 0.5)))
        last_column = min(columns - 1, int(np.floor(max(ax, bx, cx) * _SUB - 0.5)))
        for j in range(first_row, last_row + 1):
            y = (j + 0.5) / _SUB
            for i in range(first_column, last_column + 1):
                x = (i + 0.5) / _SUB
                u = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                v = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                w = 1.0 - u - v
                if u < 0 or v < 0 or w < 0:
                    continue
                z = u * az + v * bz + w * cz
                k = int(np.floor(z))
                above = k + 1 - z  # share of voxel k above the crossing
                coverage[k, j // _SUB, i // _SUB] += sign * above
                coverage[k + 1, j // _SUB, i // _SUB] += sign * (1.0 - above)


def voxelise_mesh(mesh: "trimesh.Trimesh", spacing_mm: float, hu: float) -> Volume:
    """Attenuation (1/mm) of a solid of `hu` within a closed mesh, on cubic voxels along the mesh's own axes.

    Each voxel is weighted by the fraction of it that lies inside (exact along z, 4 × 4 sub-samples across), so that
    edges are anti-aliased and the volume is kept. `lps_from_index` maps indices to the mesh's CAD mm. HU count from air
    (−1000).
    Raises `InputError` for an open mesh, a spacing that is not positive, and HU of less than nothing.
    """
    if not 0 < spacing_mm < math.inf:
        raise InputError(f"voxelise_mesh: spacing_mm must be positive and finite, got {shortened(spacing_mm)}.")
    if not -1000 <= hu < math.inf:
        raise InputError(f"voxelise_mesh: hu must be finite and at least -1000 (air), got {shortened(hu)}.")
    mesh = check_closed(mesh, "device")
    grid = empty_grid(mesh.bounds, spacing_mm)
    return grid.with_data(hu_to_attenuation(torch.tensor(float(hu)), -1000.0) * mesh_share(mesh, grid))


def empty_grid(bounds: np.ndarray, spacing_mm: float) -> Volume:
    """Zeros on cubic voxels around `bounds` (2, 3), the lowest and the highest corner in mm, with a margin.

    Raises `InputError` for more voxels than can be worked with.
    """
    lowest = bounds[0] - _MARGIN * spacing_mm  # outer corner of the grid
    size = np.ceil((bounds[1] - lowest) / spacing_mm).astype(int) + _MARGIN
    check_voxels(size, "device", "It is larger than a device: crop the model, or check its unit.")
    x, y, z = (lowest + 0.5 * spacing_mm).tolist()
    return Volume(torch.zeros(*size[::-1].tolist()), axis_aligned((spacing_mm, spacing_mm, spacing_mm), (x, y, z)))


def mesh_share(mesh: "trimesh.Trimesh", grid: Volume) -> torch.Tensor:
    """The fraction of each voxel of a grid (Z, Y, X) along the axes of the mesh that lies inside the closed mesh."""
    lowest = (grid.lps_from_index[:3, 3] - 0.5 * grid.lps_from_index[:3, :3].sum(1)).numpy()
    # the tiny shift keeps vertices and edges of CAD with round numbers off the columns, where they would count twice
    nudge = np.array([1.37e-5, 2.11e-5, 0.0])
    depth, rows, columns = grid.data.shape
    coverage = np.zeros((depth + 1, rows, columns))
    _accumulate((mesh.triangles - lowest) / np.array(grid.spacing_mm) + nudge, coverage)
    inside = np.cumsum(coverage, axis=0)[:-1].clip(0, 1).round(6)  # outside is exactly 0, inside exactly 1
    return torch.from_numpy(inside).float()
