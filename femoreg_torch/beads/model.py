"""Beads of rigid objects: small metal spheres whose centres are known in the object's own space."""

from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError, in_mm

MINIMUM = 4  # beads: three leave up to four poses (Fischler and Bolles, Commun ACM 24 (1981) 381)
_SPREAD_MM = 1.0  # least extent of a set of beads, the diameter of one
_ACROSS_MM = 2.0  # least extent beside the longest: of beads in one line the turn about it is unknown
_LARGEST_MM = 600.0  # no femur and no device is longer


@dataclass(frozen=True, eq=False)
class Beads:
    """The beads of one object, mm in its space (LPS of the CT, or that of its CAD model)."""

    object: str
    names: tuple[str, ...]
    points: Tensor  # (N, 3) float64, centres
    diameter_mm: float
    deviations_mm: Tensor  # (N,) float64, standard deviation of each centre along each axis

    def __len__(self) -> int:
        return len(self.names)


def check_count(count: int, where: str) -> None:
    """Raises `InputError` that starts with `where` for too few beads."""
    if count < MINIMUM:
        raise InputError(f"{where}: {count} beads, at least {MINIMUM} are needed; from three follow up to four poses.")


def check_beads(points: Tensor, where: str) -> None:
    """Raises `InputError` that starts with `where` unless a pose can follow from beads (N, 3) in mm."""
    check_count(len(points), where)
    if not torch.isfinite(points).all():
        raise InputError(f"{where}: holds coordinates that are not finite.")
    middle = points - points.mean(0)
    extent = 2 * float(middle.norm(dim=1).max())
    if extent == 0:
        raise InputError(f"{where}: all {len(points)} beads lie in one point. Give the centre of each.")
    if extent < _SPREAD_MM:
        raise InputError(
            f"{where}: all {len(points)} beads lie within {extent:.2g} mm, closer than beads can. Are the coordinates "
            "in metres? Give mm."
        )
    if extent > _LARGEST_MM:
        raise InputError(f"{where}: the beads spread over {in_mm(extent)}, more than any bone or device. Give mm.")
    axes = torch.linalg.svd(middle).Vh
    across = 2 * float((middle @ axes[1:].T).norm(dim=1).max())
    if across < _ACROSS_MM:
        raise InputError(
            f"{where}: the beads lie in one line (within {across:.2g} mm), so the turn about it stays unknown. Add "
            "one beside it."
        )
