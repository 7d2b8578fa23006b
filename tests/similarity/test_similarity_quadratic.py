"""Similarities as quadratics, against automatic differentiation, known hessians and a patch-by-patch computation."""

from dataclasses import dataclass

import pytest
import torch
from pictures import picture
from torch import Tensor
from torch.autograd.function import once_differentiable

from femoreg_torch.errors import InputError
from femoreg_torch.similarity import GradientOrientation, GradNcc, Ncc, Similarity, similarity_quadratic
from femoreg_torch.similarity.kernels import image_gradients
from femoreg_torch.similarity.quadratic import tile_scores

_RADIUS = 4


def scene() -> tuple[Tensor, Tensor, Tensor]:
    """A fixed image, a moving one like it, and the moving one's derivatives (H, W, 3) by three parameters."""
    fixed = picture(0, 60, 53)
    moving = fixed + 0.3 * picture(1, 60, 53)
    return fixed, moving, torch.stack([picture(n, 60, 53) for n in (2, 3, 4)], -1)


@dataclass(frozen=True)
class SquaredDifferences:
    """Half the sum of squared differences, and further terms that a test adds: its hessian is known."""

    tilt: float = 0.0  # of a term that is linear in the image
    saddle: float = 0.0  # of a term whose second derivative is negative

    def against(self, fixed: Tensor, weights: Tensor | None):  # type: ignore[no-untyped-def]
        def cost(images: Tensor) -> Tensor:
            squares = (images - fixed).square()
            return (0.5 * (1 - self.saddle) * squares + self.tilt * images).sum((1, 2))

        return cost


def absolute_differences(images: Tensor) -> Tensor:
    return (images - picture(0, 60, 53)).abs().sum((1, 2))


@pytest.mark.parametrize("similarity", [GradNcc(_RADIUS), Ncc(), Ncc(_RADIUS), GradientOrientation()], ids=str)
def test_value_and_gradient_are_those_of_the_similarity(similarity: Similarity) -> None:
    fixed, moving, jacobian = scene()
    prepared = similarity.against(fixed, None)
    cost, scores, hessian = similarity_quadratic(prepared, moving, jacobian)
    delta = torch.zeros(3, requires_grad=True)
    expected = prepared((moving + jacobian @ delta)[None])[0]
    (gradient,) = torch.autograd.grad(expected, delta)
    assert cost == pytest.approx(expected.item(), abs=1e-7)
    torch.testing.assert_close(scores.sum(0), gradient.double(), rtol=1e-4, atol=1e-6)
    assert len(scores) == 4  # two by two tiles
    assert torch.linalg.eigvalsh(hessian).min() > 0


def test_the_curvature_of_squared_differences_is_that_of_least_squares() -> None:
    fixed, moving, jacobian = scene()
    _, _, hessian = similarity_quadratic(SquaredDifferences(tilt=0.2).against(fixed, None), moving, jacobian)
    columns = jacobian.flatten(0, 1).double()
    torch.testing.assert_close(hessian, columns.T @ columns, rtol=1e-5, atol=1e-4)


def test_negative_curvature_counts_by_its_size() -> None:
    fixed, moving, jacobian = scene()
    bowl, dome = (
        similarity_quadratic(SquaredDifferences(saddle=saddle).against(fixed, None), moving, jacobian)
        for saddle in (0.0, 2.0)
    )
    torch.testing.assert_close(dome[1], -bowl[1])
    torch.testing.assert_close(dome[2], bowl[2])


def test_at_a_match_the_curvature_of_ncc_is_that_of_its_values() -> None:
    fixed, _, jacobian = scene()
    prepared = Ncc().against(fixed, picture(5, 60, 53).square())
    _, _, hessian = similarity_quadratic(prepared, fixed, jacobian)
    expected = torch.autograd.functional.hessian(
        lambda delta: prepared((fixed.double() + jacobian.double() @ delta)[None])[0], torch.zeros(3).double()
    )
    assert isinstance(expected, Tensor)
    torch.testing.assert_close(hessian, expected, rtol=1e-4, atol=1e-5)


class _Once(torch.autograd.Function):
    @staticmethod
    def forward(ctx, images):  # type: ignore[no-untyped-def]
        return images.sum((1, 2))

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):  # type: ignore[no-untyped-def]
        return upstream[:, None, None].expand(-1, 60, 53)


@pytest.mark.parametrize(
    ("cost", "reason"),
    [
        (lambda images: images.detach().sum((1, 2)), "its costs carry no derivatives by the images"),
        (lambda images: images.sum((1, 2)), "its second derivative is zero"),
        (absolute_differences, "its second derivative is zero"),
        (lambda images: _Once.apply(images) ** 2, "it cannot be differentiated twice"),
        (lambda images: (images * 0).sum((1, 2)).sqrt(), "its derivatives are not finite"),
    ],
)
def test_what_has_no_slope_or_curvature_is_told(cost, reason) -> None:  # type: ignore[no-untyped-def]
    _, moving, jacobian = scene()
    with pytest.raises(InputError, match=f"similarity .*: {reason}.*Choose an optimiser without derivatives"):
        similarity_quadratic(cost, moving, jacobian)


@pytest.mark.parametrize("similarity", [GradNcc(_RADIUS), Ncc(), GradientOrientation(), SquaredDifferences()], ids=str)
def test_nan_is_told_as_nan(similarity: Similarity) -> None:
    fixed, moving, jacobian = scene()
    with pytest.raises(InputError, match=r"similarity .*: gave nan"):
        similarity_quadratic(similarity.against(fixed, None), moving * float("nan"), jacobian)


def test_curvature_equals_a_literal_sum_over_patches() -> None:
    fixed, moving, jacobian = scene()
    similarity = GradNcc(_RADIUS).against(fixed)
    found = similarity.curvature(moving, jacobian.movedim(-1, 0), stride=1)
    maps = image_gradients(torch.cat([fixed[None], moving[None], jacobian.movedim(-1, 0)]).double(), similarity.taps)
    side, literal, patches = 2 * _RADIUS + 1, torch.zeros(3, 3, dtype=torch.float64), 0
    for d in range(2):
        for y in range(60 - side + 1):
            for x in range(53 - side + 1):
                rows = maps[:, d, y : y + side, x : x + side].flatten(1)
                rows = rows - rows.mean(1, keepdim=True)
                f, m, changes = rows[0] / rows[0].norm(), rows[1], rows[2:]
                norm, unit = m.norm(), m / m.norm()
                across = (changes - (changes @ unit)[:, None] * unit) / norm
                literal += max(float(f @ unit), 0.0) * across @ across.T
                patches += 1
    torch.testing.assert_close(found, literal / patches, rtol=1e-3, atol=1e-6)
    coarse = similarity.quadratic(moving, jacobian)[2]
    assert (coarse - found).norm() < 0.1 * found.norm()


def test_compiled_and_plain_torch_agree_in_curvature_and_scores() -> None:
    """Changes that are nowhere, somewhere within, and up to the border; weights that leave part of the image out."""
    fixed, moving = picture(0, 60, 53), picture(0, 60, 53) + 0.3 * picture(1, 60, 53)
    changes = torch.stack([picture(n, 60, 53) for n in range(2, 8)])
    changes[1] = 0
    changes[2, :20], changes[2, 45:], changes[2, :, :17], changes[2, :, 30:] = 0, 0, 0, 0
    changes[3, 5:], changes[4, :, :50] = 0, 0
    weights = torch.ones(60, 53)
    weights[:, 35:] = 0
    compiled = GradNcc(_RADIUS).against(fixed, weights)
    found = compiled.curvature(moving, changes, stride=4)
    assert found.abs().max() > 1e-3
    torch.testing.assert_close(
        found, compiled.curvature(moving.double(), changes.double(), stride=4), rtol=1e-4, atol=1e-7
    )
    slope = picture(9, 60, 53)[None] - 0.5
    plain = tile_scores(changes.double(), slope.double(), 22)
    torch.testing.assert_close(tile_scores(changes, slope, 22), plain, rtol=1e-4, atol=1e-5)
    assert plain.shape == (9, 6)


def test_flat_images_have_no_curvature() -> None:
    fixed, _, jacobian = scene()
    flat = torch.zeros(60, 53)
    for still, moving in ((fixed, flat), (flat, fixed)):
        for similarity in (GradNcc(_RADIUS), Ncc(), Ncc(_RADIUS)):
            cost, scores, hessian = similarity_quadratic(similarity.against(still), moving, jacobian)
            assert cost == pytest.approx(1)
            assert torch.isfinite(scores).all()
            assert hessian.abs().max() == 0
