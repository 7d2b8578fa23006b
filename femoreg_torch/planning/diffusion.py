"""How cement spreads in spongy bone: a slow front on a grid of blocks.

Cement is so viscous that inertia is nil: its flow is Darcy's, and the marrow it drives out gives way (pressure 0 at the
front). Its shape then depends on ratios of permeability and on where how much is injected, not on viscosity or rate
(Baroud et al. 2004; Trivedi et al. 2023: cement thicker than marrow fills evenly). The front is tracked by the share of
each block that is full, and its distance from the last full block grows with that share.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import cg

from femoreg_torch.errors import InputError
from femoreg_torch.planning.mesh import Blocks, blocks
from femoreg_torch.planning.model import Bone, check_volume
from femoreg_torch.planning.settings import DiffusionSettings

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_FRONT_SHARE = 0.03  # of the blocks of the front filled at a time
_FULL = 1 - 1e-9
_LEAST_MARROW = 0.5  # of a block: less takes no cement
_LEAST_SHARE = 1e-3  # of an injection that is worth a front of its own
_REACH_BLOCKS = 2.5  # a source so near to marrow opens into it


class NoMarrowError(InputError):
    """An injection that lies outside the marrow."""


@dataclass(frozen=True, eq=False)
class Injection:
    """An amount of cement at one place."""

    point: Array  # (3,) LPS mm
    volume_ml: float


def diffuse(bone: Bone, injections: Sequence[Injection], settings: DiffusionSettings) -> Array:
    """The share (X, Y, Z) of each voxel's pores that cement fills after the injections, one after another.

    Permeability follows porosity p as p³ / (1 − p)² (Kozeny and Carman). Raises `InputError` if the volume does not
    fit, or an injection lies outside the marrow.
    """
    check_volume(bone, sum(injection.volume_ml for injection in injections))
    grid = blocks(bone.femur, settings.voxel_mm)
    marrow = grid.mean(bone.marrow)
    allowed = marrow >= _LEAST_MARROW
    pores = np.where(allowed, grid.mean(bone.pores), 0.0)
    porosity = np.clip(np.divide(pores, marrow, where=allowed, out=np.zeros_like(pores)), 0.0, 0.99)
    permeability = porosity**3 / (1 - porosity) ** 2
    number = np.full(allowed.shape, -1)
    number[allowed] = np.arange(allowed.sum())
    places = np.argwhere(allowed)
    room = pores[allowed] * settings.voxel_mm**3 / 1000
    links = _links(number, permeability, (settings.across, settings.across, 1.0))
    piece = _pieces(np.ones(len(room), bool), links[0], links[1])
    centres = grid.centres(places)
    sources = [_sources(grid, centres, injection.point, number, piece) for injection in injections]
    full = np.zeros(len(room))
    for around, injection in zip(sources, injections, strict=True):
        for source, share_of_it in around:
            _inject(full, room, links, source, share_of_it * injection.volume_ml)
    share = np.zeros(allowed.shape)
    share[allowed] = full
    # a voxel takes the mean of its blocks, so that blocks give away just what they hold
    return np.asarray(grid.spread(share) * bone.marrow)


def _sources(grid: Blocks, centres: Array, point: Array, number: Ints, piece: Ints) -> list[tuple[int, float]]:
    """The blocks of marrow around an injection at a point (3,), LPS mm, and the share that each receives.

    The eight around it by trilinear interpolation, so that cement follows a path that moves by less than a block; of
    these, those in one piece of marrow with the nearest. Where none is marrow, the nearest block that is.
    """
    place_in_blocks = grid.index(point)
    low = np.floor(place_in_blocks).astype(int)
    beyond = place_in_blocks - low
    found = []
    for corner in np.ndindex(2, 2, 2):
        place = low + corner
        if (place < 0).any() or (place >= number.shape).any() or number[tuple(place)] < 0:
            continue
        found.append((int(number[tuple(place)]), float(np.where(corner, beyond, 1 - beyond).prod())))
    found = [(block, share) for block, share in found if share > _LEAST_SHARE]
    if not found:
        return [(_nearest(centres, point, grid.size_mm), 1.0)]
    main = max(found, key=lambda entry: entry[1])[0]
    found = [(block, share) for block, share in found if piece[block] == piece[main]]
    total = sum(share for _, share in found)
    return [(block, share / total) for block, share in found]


def _nearest(centres: Array, point: Array, size_mm: float) -> int:
    distance = np.linalg.norm(centres - point, axis=1)
    nearest = int(distance.argmin())
    if distance[nearest] > _REACH_BLOCKS * size_mm:
        place = ", ".join(f"{v:.1f}" for v in point)
        raise NoMarrowError(
            f"injection at ({place}) mm LPS lies {distance[nearest]:.0f} mm from any marrow: the path leaves the bone, "
            "or lies in its cortex. Move it."
        )
    return nearest


def _links(number: Ints, permeability: Array, factors: tuple[float, float, float]) -> tuple[Ints, Ints, Array]:
    """Pairs of neighbours, and the harmonic mean of their permeability along the axis between them."""
    first, second, conduct = [], [], []
    for axis, factor in enumerate(factors):
        low, high = (np.moveaxis(number, axis, 0)[part].ravel() for part in (slice(None, -1), slice(1, None)))
        k1, k2 = (np.moveaxis(permeability, axis, 0)[part].ravel() for part in (slice(None, -1), slice(1, None)))
        both = (low >= 0) & (high >= 0)
        first.append(low[both])
        second.append(high[both])
        conduct.append(factor * 2 * k1[both] * k2[both] / np.maximum(k1[both] + k2[both], 1e-30))
    return np.concatenate(first), np.concatenate(second), np.concatenate(conduct)


def _inject(full: Array, room: Array, links: tuple[Ints, Ints, Array], source: int, volume_ml: float) -> None:
    """Add a volume at one block to what blocks hold (N,), in place."""
    left = volume_ml
    pressure = np.zeros(len(full))  # the last one, from which the next is found in few iterations
    while left > 1e-12:
        if full[source] < _FULL:
            left = _pour(full, room, np.array([source]), np.array([1.0]), left)
            continue
        front, flux = _front_flux(full, links, source, pressure)
        if not flux.any():
            raise InputError(
                f"diffusion: {left:.2f} ml find no room, the marrow around the injection is full. Inject less, or "
                "elsewhere."
            )
        times = np.sort((1 - full[front]) * room[front] / np.maximum(flux, 1e-30))  # until each is full
        step = min(left, times[min(len(front) - 1, int(_FRONT_SHARE * len(front)))])
        left = left - step + _pour(full, room, front, flux, step)


def _pour(full: Array, room: Array, blocks_: Ints, share: Array, volume_ml: float) -> float:
    """Spread a volume over blocks by their shares, what is too much over the others; returns what was not placed."""
    left = volume_ml
    while left > 1e-13:
        part = np.where(full[blocks_] < _FULL, share, 0.0)
        if part.sum() <= 0:  # what the flow reaches is full; where it goes next is another front
            return left
        wanted = left * part / part.sum()
        taken = np.minimum(wanted, (1 - full[blocks_]) * room[blocks_])
        full[blocks_] += taken / room[blocks_]
        left -= float(taken.sum())
    return 0.0


def _front_flux(full: Array, links: tuple[Ints, Ints, Array], source: int, pressure: Array) -> tuple[Ints, Array]:
    """Blocks at the front of the cement around a source, and the share of the flow that each receives.

    `pressure` (N,) is where the search for the pressure starts, and is brought up to date in place.
    """
    first, second, conduct = links
    wet = _connected(full >= _FULL, first, second, source)
    inner = wet[first] & wet[second]
    outward = wet[first] != wet[second]
    inside = np.where(wet[first[outward]], first[outward], second[outward])
    outside = np.where(wet[first[outward]], second[outward], first[outward])
    open_ = full[outside] < _FULL
    inside, outside = inside[open_], outside[open_]
    to_front = conduct[outward][open_] / (0.5 + full[outside])  # the front stands so far within the block
    number = np.cumsum(wet) - 1
    count = int(wet.sum())
    a, b, c = number[first[inner]], number[second[inner]], conduct[inner]
    diagonal = np.bincount(a, c, count) + np.bincount(b, c, count) + np.bincount(number[inside], to_front, count)
    if not len(outside):
        return outside, to_front
    matrix = sparse.coo_array(
        (np.concatenate([-c, -c, diagonal]), (np.r_[a, b, np.arange(count)], np.r_[b, a, np.arange(count)])),
        shape=(count, count),
    ).tocsr()
    at_source = (np.arange(count) == number[source]).astype(float)
    found, _ = cg(matrix, at_source, x0=pressure[wet], rtol=1e-5, M=sparse.diags_array(1 / diagonal))
    pressure[wet] = found
    front, place = np.unique(outside, return_inverse=True)
    flux = np.bincount(place, to_front * np.maximum(found, 0)[number[inside]], len(front))
    return front, flux / max(float(flux.sum()), 1e-30)


def _connected(wet: NDArray[np.bool_], first: Ints, second: Ints, source: int) -> NDArray[np.bool_]:
    """Those of the full blocks that hang together with the source."""
    piece = _pieces(wet, first, second)
    return np.asarray(wet & (piece == piece[source]))


def _pieces(wet: NDArray[np.bool_], first: Ints, second: Ints) -> Ints:
    """A number (N,) for each block, the same for those that hang together."""
    both = wet[first] & wet[second]
    graph = sparse.coo_array((np.ones(both.sum()), (first[both], second[both])), shape=(len(wet), len(wet)))
    _, piece = csgraph.connected_components(graph.tocsr(), directed=False)
    return np.asarray(piece, np.int64)
