"""Fisher information of images about unknowns, and the least error that it leaves: the Cramér–Rao bound.

An image of independent pixels with expected photons λ(θ) and variance v informs of θ by F = Σ (∂λ/∂θ)ᵀ (∂λ/∂θ) / v: for
v = λ that is exact for Poisson counts, and electronic noise adds to v. No unbiased estimate has a covariance below F⁻¹
(Kay, Fundamentals of Statistical Signal Processing: Estimation Theory, 1993, chapters 3.4 to 3.9). Images are
independent, so their informations add up. Unknowns that nobody asks for (how much light is scattered, say) are columns
like the others: to invert the whole F is to find them from the same images.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

Widths = dict[str, int]  # of blocks of unknowns, by name
Response = Mapping[str, Tensor]  # (r, w) of blocks: how r numbers change with them

_NULL = 1e-11  # of F scaled to a diagonal of ones: what has less is not informed of
_TOUCHES = 1e-6  # share of a response in what is not informed of, beyond rounding


@dataclass(frozen=True, eq=False)
class Information:
    """Fisher information of one image, or of what is known before, about blocks of unknowns."""

    name: str
    widths: Widths
    matrix: Tensor  # (n, n) float64, the blocks in their order


def image_information(name: str, changes: Mapping[str, Tensor], variance: Tensor) -> Information:
    """That of an image whose photons (N,) have a variance (N,), and change with the unknowns of blocks by (w, N)."""
    whitened = torch.cat(list(changes.values())).double() / variance.double().sqrt()
    return Information(name, {block: len(rows) for block, rows in changes.items()}, whitened @ whitened.T)


def known_before(name: str, deviations: Mapping[str, float]) -> Information:
    """That of a prior: single unknowns that are known up to standard deviations."""
    weights = torch.tensor(list(deviations.values()), dtype=torch.float64)
    return Information(name, dict.fromkeys(deviations, 1), torch.diag(weights**-2))


@dataclass(frozen=True, eq=False)
class Bound:
    """What several images together leave open."""

    widths: Widths
    parts: tuple[Information, ...]
    basis: Tensor  # (n, m): directions in the unknowns
    variances: Tensor  # (m,): along them; infinite where nothing informs
    unseen: frozenset[str] = frozenset()  # unknown blocks that no part is about

    def deviation(self, response: Response) -> float:
        """Least root mean square length of r numbers that respond to the unknowns; infinite if images leave it open."""
        if any(rows.any() for block, rows in response.items() if block in self.unseen):
            return math.inf
        return float((self._answers(response)[0] ** 2).sum().sqrt())

    def shares_of_noise(self, response: Response) -> dict[str, float]:
        """Shares of the squared deviation, which has to be finite, that the noise of each part brings; they sum to 1.

        The best estimate is F⁻¹ Σ sᵢ, of scores with covariances Fᵢ, so its covariance is Σ F⁻¹ Fᵢ F⁻¹.
        """
        answers, towards = self._answers(response)
        whole = float((answers**2).sum())
        found = {}
        for part in self.parts:
            at = towards[:, _places(self.widths, part.widths)]
            found[part.name] = float(((at @ part.matrix) * at).sum()) / whole
        return found

    def _answers(self, response: Response) -> tuple[Tensor, Tensor]:
        """Deviations (r, m) of the response along the basis, and how it answers to scores (r, n)."""
        height = len(next(iter(response.values())))
        rows = [response.get(block, torch.zeros(height, width)).double() for block, width in self.widths.items()]
        along = torch.cat(rows, 1) @ self.basis
        open_ = self.variances.isinf()
        size = along.abs().amax(1, keepdim=True)
        along = torch.where(open_ & (along.abs() < _TOUCHES * size), torch.zeros_like(along), along)
        answers = torch.where(along == 0, along, along * self.variances.sqrt())
        finite = torch.where(open_, 0.0, self.variances)
        return answers, (along * finite) @ self.basis.T


def bound(parts: Sequence[Information], unknown: Sequence[str]) -> Bound:
    """What parts leave open of the blocks `unknown`; all other blocks are taken to be known."""
    widths = {block: width for part in parts for block, width in part.widths.items() if block in unknown}
    kept = tuple(_restricted(part, widths) for part in parts)
    whole = torch.zeros(sum(widths.values()), sum(widths.values()), dtype=torch.float64)
    for part in kept:
        places = _places(widths, part.widths)
        whole[places[:, None], places] += part.matrix
    # Scaled to a diagonal of ones, so that mm, radians and shares can be inverted together.
    scale = torch.where(whole.diagonal() > 0, whole.diagonal(), torch.ones_like(whole.diagonal())).rsqrt()
    values, vectors = torch.linalg.eigh(scale[:, None] * whole * scale)
    variances = torch.where(values > _NULL, 1 / values.clamp_min(_NULL), torch.inf)
    return Bound(widths, kept, scale[:, None] * vectors, variances, frozenset(unknown) - widths.keys())


def shares_of_information(parts: Sequence[Information], block: str) -> dict[str, float]:
    """Of what all parts tell of a block, all else being known: the share of each; they sum to 1.

    tr(F⁻¹ Fᵢ) / w, which does not depend on the units of the block.
    """
    own = [_restricted(part, {block: part.widths.get(block, 0)}) for part in parts if block in part.widths]
    inverse = torch.linalg.pinv(torch.stack([part.matrix for part in own]).sum(0), hermitian=True)
    found = {part.name: float((inverse * part.matrix).sum()) / len(inverse) for part in own}
    return {part.name: found.get(part.name, 0.0) for part in parts}


def _restricted(part: Information, widths: Widths) -> Information:
    """The part about those blocks alone."""
    kept = {block: width for block, width in part.widths.items() if block in widths}
    places = _places(part.widths, kept)
    return Information(part.name, kept, part.matrix[places[:, None], places])


def _places(widths: Widths, blocks: Widths) -> Tensor:
    """Where the unknowns of some blocks stand among those of all."""
    starts, at = {}, 0
    for block, width in widths.items():
        starts[block], at = at, at + width
    places = [torch.arange(starts[block], starts[block] + width) for block, width in blocks.items()]
    return torch.cat(places) if places else torch.zeros(0, dtype=torch.long)
