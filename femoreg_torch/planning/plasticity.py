"""Elastic, perfectly plastic bone at the Gauss points of all elements at once.

Radial return for von Mises' yield surface with its consistent tangent (Simo and Hughes, "Computational
Inelasticity", 1998, box 3.2). Where tension and compression have strengths T and C of their own, the surface is Drucker
and Prager's: q + m p = k with m = 3 (C − T) / (C + T) and k = 2 C T / (C + T), p the mean stress. Plastic flow is
deviatoric, so p stays elastic and the return radial. With T = C this is von Mises.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from femoreg_torch.planning.element import Template, moduli, stiffness, template
from femoreg_torch.planning.laws import Material

Array = NDArray[np.float64]

_LEAST_YIELD = 0.1  # of k: hydrostatic tension leaves so much, as the cone would otherwise have an apex


@dataclass(frozen=True, eq=False)
class State:
    """Plastic strain: (E, 8, 6) as the tensor's deviator, and its equivalent (E, 8), summed up over the history."""

    strain: Array
    equivalent: Array


@dataclass(frozen=True, eq=False)
class Response:
    """What elements of edge 1 answer to displacements; forces are to be scaled by h², stiffness by h."""

    force: Array  # (E, 24)
    state: State
    share: Array  # (E, 8) yield over trial stress, 1 where elastic
    normal: Array  # (E, 8, 6) direction of the deviatoric stress, tensor components, of norm 1
    mises: Array  # (E, 8) equivalent stress after the return


class Plasticity:
    """The constitutive law of the elements of a mesh."""

    def __init__(self, material: Material, poisson: float) -> None:
        bulk, shear = moduli(poisson)
        self._made: Template = template()
        self._bulk, self._shear = bulk * material.modulus, shear * material.modulus
        tension, compression = material.tension, material.compression
        finite = np.isfinite(tension) & np.isfinite(compression)
        total = np.where(finite, compression + tension, 1.0)
        difference = np.subtract(compression, tension, where=finite, out=np.zeros_like(total))
        self._slope = 3 * difference / total
        self._cohesion = np.where(finite, 2 * compression * tension / total, np.inf)

    def fresh(self) -> State:
        """Bone that has never yielded."""
        count = len(self._bulk)
        return State(np.zeros((count, 8, 6)), np.zeros((count, 8)))

    def respond(self, displacement: Array, size_mm: float, state: State) -> Response:
        """Stress after a step that ends at displacements (E, 24) in mm, from a state before it."""
        strained = displacement / size_mm
        made, count = self._made, len(strained)
        pressure = self._bulk * (strained @ made.dilatation)[:, None]  # the mean stress, above 0 in tension
        deviator = (strained @ made.deviator.reshape(48, 24).T).reshape(count, 8, 6)
        deviator[:, :, 3:] /= 2
        trial = 2 * self._shear[:, :, None] * (deviator - state.strain)
        norm = _norm(trial)
        yields = np.maximum(self._cohesion - self._slope * pressure, _LEAST_YIELD * self._cohesion)
        mises = np.sqrt(1.5) * norm
        share = np.minimum(1.0, yields / np.maximum(mises, 1e-30))
        stress = share[:, :, None] * trial
        flow = (1 - share[:, :, None]) * trial / (2 * self._shear[:, :, None])
        normal = trial / np.maximum(norm, 1e-30)[:, :, None]
        made_force = (stress.reshape(count, 48) @ made.deviator.reshape(48, 24)) / 8
        force = made_force + pressure.mean(1)[:, None] * made.dilatation
        after = State(state.strain + flow, state.equivalent + np.sqrt(2 / 3) * _norm(flow))
        return Response(force, after, share, normal, share * mises)

    def tangent(self, response: Response) -> Array:
        """Consistent stiffness (E, 24, 24) of elements of edge 1; that of a pressure-dependent yield is left out.

        Without that part it is symmetric and, for von Mises, exact: 2G θ (I − n ⊗ n) + K 1 ⊗ 1.
        """
        made = self._made
        scales = 2 * self._shear * response.share
        tangent = stiffness(self._bulk, scales / 2)
        yielded = np.flatnonzero((response.share < 1).any(1))
        along = np.einsum("gij,egi->egj", made.deviator, response.normal[yielded])
        weight = np.where(response.share[yielded] < 1, scales[yielded], 0.0) / 8
        tangent[yielded] -= (along * weight[:, :, None]).transpose(0, 2, 1) @ along
        return tangent


def _norm(tensor: Array) -> Array:
    """Norm of symmetric tensors (..., 6) by their components."""
    square = tensor**2
    return np.asarray(np.sqrt(square[..., :3].sum(-1) + 2 * square[..., 3:].sum(-1)))
