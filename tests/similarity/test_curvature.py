"""Patch Grad-NCC as a quadratic, against automatic differentiation and a patch-by-patch computation."""

import pytest
import torch
from test_grad_ncc import picture
from torch import Tensor

from femoreg_torch.similarity import curvature, grad_ncc, grad_ncc_quadratic
from femoreg_torch.similarity.kernels import image_gradients

_RADIUS = 4


def scene() -> tuple[Tensor, Tensor, Tensor]:
    """A fixed image, a moving one like it, and the moving one's derivatives (H, W, 3) by three parameters."""
    fixed = picture(0, 60, 53)
    moving = fixed + 0.3 * picture(1, 60, 53)
    return fixed, moving, torch.stack([picture(n, 60, 53) for n in (2, 3, 4)], -1)


def test_value_and_gradient_are_those_of_the_similarity() -> None:
    fixed, moving, jacobian = scene()
    similarity = grad_ncc(fixed, _RADIUS)
    cost, scores, _ = grad_ncc_quadratic(similarity, moving, jacobian)
    delta = torch.zeros(3, requires_grad=True)
    expected = similarity((moving + jacobian @ delta)[None])[0]
    (gradient,) = torch.autograd.grad(expected, delta)
    assert cost == pytest.approx(expected.item(), abs=1e-7)
    torch.testing.assert_close(scores.sum(0), gradient.double(), rtol=1e-4, atol=1e-7)
    assert len(scores) == 4  # tiles of 36 pixels


def test_curvature_equals_a_literal_sum_over_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(curvature, "_STRIDE", 1)
    fixed, moving, jacobian = scene()
    similarity = grad_ncc(fixed, _RADIUS)
    _, _, found = grad_ncc_quadratic(similarity, moving, jacobian)
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
    coarse = _stride_of(4, fixed, moving, jacobian, monkeypatch)
    assert (coarse - found).norm() < 0.1 * found.norm()


def _stride_of(stride: int, fixed: Tensor, moving: Tensor, jacobian: Tensor, monkeypatch: pytest.MonkeyPatch) -> Tensor:
    monkeypatch.setattr(curvature, "_STRIDE", stride)
    return grad_ncc_quadratic(grad_ncc(fixed, _RADIUS), moving, jacobian)[2]


def test_flat_images_have_no_curvature() -> None:
    fixed, _, jacobian = scene()
    flat = torch.zeros(60, 53)
    for still, moving in ((fixed, flat), (flat, fixed)):
        cost, scores, hessian = grad_ncc_quadratic(grad_ncc(still, _RADIUS), moving, jacobian)
        assert cost == pytest.approx(1)
        assert torch.isfinite(scores).all()
        assert hessian.abs().max() == 0
