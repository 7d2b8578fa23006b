"""Gradient orientation: where both images have an edge, do the edges run the same way?"""

from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.similarity.kernels import derivative_taps, image_gradients


@dataclass(frozen=True, eq=False)
class GradientOrientation:
    """Gradient orientation against one fixed image; made by `gradient_orientation`."""

    fixed: Tensor  # (2, H, W) derivatives
    strong: Tensor  # (H, W) bool: edges of the fixed image that count
    weights: Tensor  # (H, W)
    taps: tuple[Tensor, Tensor]  # of the derivative, see `derivative_taps`

    def __call__(self, images: Tensor) -> Tensor:
        """Costs (B,) in [0, 1] of images (B, H, W): one minus the mean agreement of the directions.

        An edge of the fixed image where the moving one is flat agrees by nothing.
        """
        if images.shape[1:] != self.fixed.shape[1:]:
            raise InputError(
                f"similarity: images are {tuple(images.shape[1:])}, the fixed one {tuple(self.fixed.shape[1:])}."
            )
        moving = image_gradients(images, self.taps)  # (B, 2, H, W)
        strength = moving.detach().square().sum(1)
        counts = self.strong & (strength > strength.flatten(1).median(1).values[:, None, None]) & (strength > 0)
        dot = (moving * self.fixed).sum(1)
        cross = moving[:, 0] * self.fixed[1] - moving[:, 1] * self.fixed[0]
        # Where nothing is compared, a dummy angle keeps the gradient of atan2 finite.
        angle = torch.atan2(torch.where(counts, cross, torch.zeros_like(cross)).abs(), torch.where(counts, dot, 1.0))
        agreement = (2 - torch.log(angle + 1)).clamp(min=0) / 2
        share = self.weights * self.strong
        return 1 - (torch.where(counts, agreement, torch.zeros_like(agreement)) * share).sum((1, 2)) / share.sum()


def gradient_orientation(
    fixed: Tensor, smoothing_px: float = 1.1, weights: Tensor | None = None
) -> GradientOrientation:
    """Gradient orientation against the fixed image (H, W), as a function of moving images (B, H, W).

    Mean of (2 − ln(|Δθ| + 1)) / 2 over the pixels whose gradient is above the image's median, nothing where it is not
    in the moving one; De Silva et al., 3D–2D image registration for target localization in spine surgery, Phys. Med.
    Biol. 61 (2016) 3009. `weights` (H, W) say where to look. Raises `InputError` if the fixed image has no edge there.
    """
    taps = derivative_taps(smoothing_px, fixed.device)
    maps = image_gradients(fixed[None], taps)[0]
    strength = maps.square().sum(0)
    strong = (strength > strength.median()) & (strength > 0)
    share = torch.ones_like(fixed) if weights is None else weights.to(fixed)
    if not (strong & (share > 0)).any():
        raise InputError("similarity: the fixed image has no edge where it is to be compared.")
    return GradientOrientation(maps, strong, share, taps)
