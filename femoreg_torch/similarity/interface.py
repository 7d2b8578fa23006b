"""What every similarity is: settings that, prepared with a fixed image, map moving images to costs."""

from typing import Protocol, runtime_checkable

from torch import Tensor


class FixedSimilarity(Protocol):
    """A similarity against one fixed image (H, W): maps moving images (B, H, W) to costs (B,), lower is better."""

    def __call__(self, images: Tensor) -> Tensor: ...


@runtime_checkable
class SmoothFixedSimilarity(FixedSimilarity, Protocol):
    """One that knows its own derivatives of first and second order."""

    def quadratic(self, image: Tensor, jacobian: Tensor) -> tuple[Tensor | float, Tensor, Tensor]:
        """Cost (), scores (T, n) and a positive semi-definite hessian (n, n), float64, about an image (H, W).

        `jacobian` (H, W, n) holds the image's derivatives by n parameters. The scores are the gradient's parts from T
        tiles of the image, nearly independent of each other; their sum is the gradient.
        """


class Similarity(Protocol):
    """Settings of a similarity, by convention a frozen dataclass, which presets read by its `kind`."""

    def against(self, fixed: Tensor, weights: Tensor | None) -> FixedSimilarity:
        """Prepare with a fixed image (H, W), where `weights` (H, W) say how much each pixel counts; None: all alike."""


@runtime_checkable
class FieldSimilarity(Similarity, Protocol):
    """One that can keep away from pixels altogether."""

    def inside(self, field: Tensor | None, fixed: Tensor, weights: Tensor | None) -> FixedSimilarity:
        """As `against`, but no number outside `field` (H, W), bool, of either image changes any cost; nan may.

        Raises `InputError` if that leaves nothing to compare.
        """
