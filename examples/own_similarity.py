"""A similarity and an optimiser of one's own, used by a stage. Nothing of the toolkit has to be touched.

A similarity is a frozen record of settings with `against`; what that returns maps images to costs. An optimiser is one
with `minimise`. To name them in a preset (`similarity: {kind: mutual_information, bins: 32}`), a package registers
them:

    [project.entry-points."femoreg_torch.similarities"]
    mutual_information = "my_package:MutualInformation"
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from own_stages import PLAN
from phantom_parts import MIDDLE, two_views
from scipy.optimize import minimize
from torch import Tensor

import femoreg_torch as femoreg
from femoreg_torch.geometry import pose_difference
from femoreg_torch.optimize import Objective, Result, Stop


@dataclass(frozen=True)
class MutualInformation:
    """Negative mutual information of grey values (Viola and Wells, IJCV 24 (1997) 137), from a joint histogram."""

    bins: int = 24

    def against(self, fixed: Tensor, weights: Tensor | None) -> Callable[[Tensor], Tensor]:
        """Costs (B,) of images (B, H, W)."""
        share = (torch.ones_like(fixed) if weights is None else weights).flatten().double()
        row = self._bin(fixed[None])[0].flatten()

        def costs(images: Tensor) -> Tensor:
            pairs = row * self.bins + self._bin(images).flatten(1)  # (B, pixels)
            joint = torch.stack([torch.bincount(pair, share, minlength=self.bins**2) for pair in pairs])
            joint = joint.view(-1, self.bins, self.bins) / share.sum()
            product = joint.sum(2, keepdim=True) * joint.sum(1, keepdim=True)
            return -(joint * (joint.clamp_min(1e-12) / product.clamp_min(1e-12)).log()).sum((1, 2))

        return costs

    def _bin(self, images: Tensor) -> Tensor:
        low, high = images.flatten(1).aminmax(dim=1)
        unit = (images - low[:, None, None]) / (high - low).clamp_min(1e-12)[:, None, None]
        return (unit * self.bins).long().clamp_max(self.bins - 1)


@dataclass(frozen=True)
class Powell:
    """Powell's method of scipy: one line search after the other, no derivatives."""

    tol_x: float = 0.01

    def minimise(self, objective: Objective, n: int, seed: int) -> Result:
        """The best delta (n,) from zero; nothing is random."""
        found = minimize(
            lambda x: float(objective(torch.from_numpy(x)[None])[0]),
            [0.0] * n,
            method="Powell",
            options={"xtol": self.tol_x},
        )
        delta = torch.from_numpy(found.x)
        return Result(
            delta, float(found.fun), Stop.SMALL_STEP, found.nfev, ((found.nfev, float(found.fun), tuple(found.x)),)
        )


def main() -> tuple[float, float]:
    """Register one object to two images by one's own similarity and optimiser; returns degrees and mm off."""
    stage = replace(PLAN.stages[1], similarity=MutualInformation(bins=24), optimiser=Powell())
    scene, truth = two_views(8, (1.5, -1.0, 3.0))
    outcome = femoreg.run_plan(scene, femoreg.Plan("mine", (stage,)), None, seed=1)
    off = pose_difference(truth, outcome.poses.camera1_from["object"], MIDDLE)
    print(f"{off[0]:.2f}° and {off[1]:.2f} mm off after {outcome.trace[0].evaluations} evaluations")
    return off


if __name__ == "__main__":
    main()
