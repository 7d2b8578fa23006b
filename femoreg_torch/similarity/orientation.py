"""Gradient orientation: where both images have an edge, do the edges run the same way?"""

from dataclasses import dataclass

import torch
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.settings import check_within
from femoreg_torch.similarity.checks import check_image, check_size, check_weights
from femoreg_torch.similarity.kernels import away_from, derivative_taps, image_gradients


@dataclass(frozen=True)
class GradientOrientation:
    """Mean of `(2 − ln(|Δθ| + 1)) / 2` over the pixels whose gradient is above the fixed image's median.

    Nothing where it is not above the median in the moving image. De Silva et al., 3D–2D image registration for target
    localization in spine surgery, Phys. Med. Biol. 61 (2016) 3009.
    """

    smoothing_px: float = 1.1  # standard deviation of a Gaussian, before Sobel

    def __post_init__(self) -> None:
        check_within(self, smoothing_px=(0, 100))

    def against(self, fixed: Tensor, weights: Tensor | None = None) -> "FixedGradientOrientation":
        """Prepare with the fixed image (H, W); `weights` (H, W) say where to look.

        Raises `InputError` if the fixed image has no edge there, or holds nan.
        """
        return self.inside(None, fixed, weights)

    def inside(self, field: Tensor | None, fixed: Tensor, weights: Tensor | None = None) -> "FixedGradientOrientation":
        """As `against`, by the pixels whose derivatives need none outside `field`, see `FieldSimilarity`."""
        check_image(fixed)
        check_weights(fixed, weights)
        taps = derivative_taps(self.smoothing_px, fixed.device)
        maps = image_gradients(fixed[None], taps)[0]
        strength = maps.square().sum(0)
        kept = torch.ones_like(strength, dtype=torch.bool) if field is None else away_from(~field, len(taps[0]) // 2)
        if not kept.any():
            raise InputError("similarity: the field leaves no pixel to compare.")
        middle = strength[kept].median()
        if middle.isnan():
            raise InputError("similarity: the fixed image holds nan where it is to be compared.")
        strong = (strength > middle) & (strength > 0) & kept
        share = torch.ones_like(fixed) if weights is None else weights.to(fixed)
        if not (strong & (share > 0)).any():
            raise InputError("similarity: the fixed image has no edge where it is to be compared.")
        return FixedGradientOrientation(maps, strong, share, kept, taps)


@dataclass(frozen=True, eq=False)
class FixedGradientOrientation:
    """Gradient orientation against one fixed image; made by `GradientOrientation.against`."""

    fixed: Tensor  # (2, H, W) derivatives
    strong: Tensor  # (H, W) bool: edges of the fixed image that count
    weights: Tensor  # (H, W)
    kept: Tensor  # (H, W) bool: pixels that are looked at
    taps: tuple[Tensor, Tensor]  # of the derivative, see `derivative_taps`

    def __call__(self, images: Tensor) -> Tensor:
        """Costs (B,) in [0, 1] of images (B, H, W): one minus the mean agreement of the directions.

        An edge of the fixed image where the moving one is flat agrees by nothing. The gradient is that of the angles:
        which pixels are above the median changes too, by jumps that no derivative tells, so a search by values alone
        (`cma_es`, `bobyqa`) suits it. An image that holds nan costs nan.
        """
        check_size(images, self.fixed)
        moving = image_gradients(images, self.taps)  # (B, 2, H, W)
        strength = moving.detach().square().sum(1)
        middle = strength[:, self.kept].median(1).values  # nan if any of them is
        counts = self.strong & (strength > middle[:, None, None]) & (strength > 0)
        dot = (moving * self.fixed).sum(1)
        cross = moving[:, 0] * self.fixed[1] - moving[:, 1] * self.fixed[0]
        # Where nothing is compared, a dummy angle keeps the gradient of atan2 finite.
        angle = torch.atan2(torch.where(counts, cross, torch.zeros_like(cross)).abs(), torch.where(counts, dot, 1.0))
        agreement = (2 - torch.log(angle + 1)).clamp(min=0) / 2
        share = self.weights * self.strong
        cost = 1 - (torch.where(counts, agreement, torch.zeros_like(agreement)) * share).sum((1, 2)) / share.sum()
        return torch.where(middle.isnan(), middle, cost)
