"""The objective of a stage: mean similarity cost of a batch of candidate deltas, and penalties (paper, equation 1)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.optimize import Quadratic, SmoothObjective
from femoreg_torch.registration.costs import ImageCosts
from femoreg_torch.registration.intrinsics import PRIOR_WEIGHT, Intrinsics
from femoreg_torch.registration.scene import Moving
from femoreg_torch.settings import check_within


@dataclass(frozen=True)
class Prior:
    """R(θ) of equation 1: the penalty weight · ½ (|rotation|² / σ² + |translation|² / σ²) on each body's motion."""

    rotation_deg: float
    translation_mm: float
    weight: float

    def __post_init__(self) -> None:
        check_within(self, rotation_deg=(1e-6, 1e9), translation_mm=(1e-6, 1e9), weight=(0, 1e9))


def stage_objective(costs: ImageCosts, bodies: tuple[Moving, ...], prior: Prior | None) -> SmoothObjective:
    """Mean cost over the images, plus the penalties on how far bodies move, and the cameras from the C-arm's file."""
    stiffness = torch.cat([_stiffness(body, prior) for body in bodies])  # (Σ n_b,)
    # The penalty is ½ Σ k (δ + offset)².
    offset = torch.cat([b.units_off if isinstance(b, Intrinsics) else b.scale.new_zeros(len(b.free)) for b in bodies])

    def values(deltas: Tensor) -> Tensor:
        return costs(deltas).mean(1) + 0.5 * ((deltas + offset).square() @ stiffness)

    def quadratic(delta: Tensor) -> Quadratic:
        model = image_quadratic(costs, delta)
        away = delta + offset
        return Quadratic(
            model.value + float(0.5 * (away.square() @ stiffness)),
            torch.cat([model.scores, (stiffness * away)[None]]),
            model.hessian + stiffness.diag(),
        )

    return SmoothObjective(values, quadratic)


def along_ways(objective: SmoothObjective, ways: Tensor) -> SmoothObjective:
    """An objective of how far (m,) its unknowns (n,) go along some ways (n, m) alone."""

    def quadratic(delta: Tensor) -> Quadratic:
        model = objective.quadratic(ways @ delta)
        return Quadratic(model.value, model.scores @ ways, ways.T @ model.hessian @ ways)

    return SmoothObjective(lambda deltas: objective.values(deltas @ ways.T), quadratic)


def image_quadratic(costs: ImageCosts, delta: Tensor) -> Quadratic:
    """Mean cost over the images about one delta (Σ n_b,), without penalties."""
    return mean_quadratic(costs.quadratics(delta))


def mean_quadratic(parts: Sequence[Quadratic]) -> Quadratic:
    """The mean of what images say, one by one, of the same delta."""
    return Quadratic(
        sum(part.value for part in parts) / len(parts),
        torch.cat([part.scores / len(parts) for part in parts]),
        torch.stack([part.hessian for part in parts]).mean(0),
    )


def _stiffness(body: Moving, prior: Prior | None) -> Tensor:
    """Second derivatives (n,) of the penalty by the body's deltas."""
    if isinstance(body, Intrinsics):
        return torch.full((len(body.free),), PRIOR_WEIGHT, dtype=torch.float64)
    if prior is None:
        return torch.zeros(len(body.free), dtype=torch.float64)
    sigma = body.scale.new_tensor([prior.rotation_deg * torch.pi / 180] * 3 + [prior.translation_mm] * 3)
    return prior.weight * (body.scale / sigma).square()[body.free]
