"""Similarities of other packages: their faults are told in one line, with their names."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.extensions import guarded, is_built_in, name_of
from femoreg_torch.similarity.interface import FieldSimilarity, FixedSimilarity, Similarity, SmoothFixedSimilarity

_T = TypeVar("_T")


def against_field(
    similarity: Similarity, fixed: Tensor, weights: Tensor | None, field: Tensor | None
) -> FixedSimilarity:
    """A similarity prepared with a fixed image (H, W) of which only `field` (H, W), bool, is exposed; None: all of it.

    For one without `inside` the pixels outside weigh nothing. One of another package tells its faults by its name.
    """

    def prepare() -> FixedSimilarity:
        if field is None:
            return similarity.against(fixed, weights)
        shown = fixed.where(field, fixed.new_zeros(()))
        if isinstance(similarity, FieldSimilarity):
            return similarity.inside(field, shown, weights)
        return similarity.against(shown, field.to(fixed) if weights is None else weights * field)

    return watched(told(similarity, prepare), similarity)


def similarity_name(similarity: Any) -> str:
    """How messages call a similarity or its settings: by the class, of other packages with their kind and module."""
    if isinstance(similarity, WatchedSimilarity):
        return similarity_name(similarity.settings)
    return type(similarity).__name__ if is_built_in(similarity) else name_of("femoreg_torch.similarities", similarity)


def watched(prepared: FixedSimilarity, settings: Any) -> FixedSimilarity:
    """A prepared similarity that tells its faults by the name of its settings; one of this package as it is."""
    if isinstance(prepared, WatchedSimilarity) or is_built_in(prepared):
        return prepared
    kind = WatchedSmoothSimilarity if isinstance(prepared, SmoothFixedSimilarity) else WatchedSimilarity
    return kind(prepared, settings)


def told(settings: Any, work: Callable[[], _T]) -> _T:
    """What `work` gives; see `guarded`."""
    return guarded("similarity", "femoreg_torch.similarities", settings, work)


@dataclass(frozen=True, eq=False)
class WatchedSimilarity:
    """A prepared similarity that raises `InputError`, with the name of its settings, where its costs are none."""

    prepared: Any  # a FixedSimilarity
    settings: Any  # what `against` was called of

    def __call__(self, images: Tensor) -> Tensor:
        """Costs (B,) of images (B, H, W). On the CPU, nan for all of them is refused; a device is not waited for."""
        costs: Tensor = told(self.settings, lambda: self.prepared(images))
        self._expect("costs", costs, (len(images),), "one for each image (B, H, W)")
        if costs.device.type == "cpu" and len(costs) and bool(costs.isnan().all()):
            raise gave_nan(self)
        return costs

    def _expect(self, what: str, found: Any, shape: tuple[int, ...], means: str) -> None:
        if not isinstance(found, Tensor) or found.shape != shape or not found.is_floating_point():
            size = f"{tuple(found.shape)} {found.dtype}" if isinstance(found, Tensor) else type(found).__name__
            raise InputError(
                f"similarity {similarity_name(self)}: {what} of shape {shape} were expected, {means}, got {size}."
            )


@dataclass(frozen=True, eq=False)
class WatchedSmoothSimilarity(WatchedSimilarity):
    """One that knows its own derivatives."""

    def quadratic(self, image: Tensor, jacobian: Tensor) -> tuple[Tensor | float, Tensor, Tensor]:
        """As `SmoothFixedSimilarity`; the shapes are checked."""
        cost, scores, hessian = told(self.settings, lambda: self.prepared.quadratic(image, jacobian))
        n = jacobian.shape[-1]
        self._expect("second derivatives", hessian, (n, n), "one for each pair of parameters")
        tiles = len(scores) if isinstance(scores, Tensor) and scores.ndim == 2 else 1
        self._expect("scores", scores, (tiles, n), "one for each tile and parameter")
        return cost, scores, hessian


def gave_nan(similarity: Any) -> InputError:
    """What to raise for a similarity without a cost."""
    return InputError(
        f"similarity {similarity_name(similarity)}: gave nan. Where there is nothing to compare the largest cost is "
        "expected; images that hold nan have none."
    )
