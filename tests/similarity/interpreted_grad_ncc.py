"""Grad-NCC's Triton kernels on CPU tensors, through Triton's interpreter, against plain torch and the CPU's kernels.

Run by `test_grad_ncc_on_a_gpu.py` in a process of its own, because the interpreter must be chosen before Triton is
imported: `TRITON_INTERPRET=1 pytest tests/similarity/interpreted_grad_ncc.py`. The interpreter is slow, so all images
are tiny.
"""

import pytest
import torch
from torch import Tensor

from femoreg_torch.similarity import GradNcc, cuda
from femoreg_torch.similarity.quadratic import tile_scores

SHAPE = (13, 16)
SIMILARITIES = [GradNcc(patch_radius=3), GradNcc(patch_radius=2, smoothing_px=0)]


def images(count: int, seed: int) -> Tensor:
    """Random images with a corner that is flat."""
    made = torch.rand((count, *SHAPE), generator=torch.Generator().manual_seed(seed))
    made[:, :9, :10] = 0.5
    return made


@pytest.mark.parametrize("similarity", SIMILARITIES)
@pytest.mark.parametrize("weighted", [False, True])
def test_values_and_gradients(similarity: GradNcc, weighted: bool) -> None:
    fixed = images(1, 0)[0]
    against = similarity.against(fixed, images(1, 7)[0] if weighted else None)
    moving = torch.cat([images(1, 1), fixed[None]]).requires_grad_()
    expected = against._reference(moving.double())
    (slopes,) = torch.autograd.grad(expected.sum(), moving)
    assert expected[1] > 0.6
    torch.testing.assert_close(cuda.grad_ncc(moving.detach(), against), expected.detach(), rtol=1e-5, atol=1e-6)
    values, gradient = cuda.grad_ncc_and_gradient(moving.detach(), against)
    torch.testing.assert_close(values, expected.detach(), rtol=1e-5, atol=1e-6)
    assert slopes.abs().max() > 1e-4
    torch.testing.assert_close(gradient, slopes, rtol=1e-3, atol=1e-6)


def test_an_image_with_nan_costs_nan() -> None:
    moving = images(2, 1)
    moving[0, 3, 4] = torch.nan
    values = cuda.grad_ncc(moving, GradNcc(patch_radius=3).against(images(1, 0)[0]))
    assert values.isnan().tolist() == [True, False]


@pytest.mark.parametrize("similarity", SIMILARITIES)
@pytest.mark.parametrize("stride", [1, 4])
def test_curvature(similarity: GradNcc, stride: int) -> None:
    against = similarity.against(images(1, 0)[0], images(1, 7)[0])
    moving, changes = images(1, 0)[0] + 0.3 * images(1, 1)[0], images(4, 2)
    found = cuda.curvature(moving, changes, against, stride)
    expected = against.curvature(moving.double(), changes.double(), stride)  # plain torch
    assert expected.norm() > 1e-3
    assert float((found - expected).norm() / expected.norm()) < 1e-4


@pytest.mark.parametrize("tile", [5, 16])
def test_sums_over_tiles(tile: int) -> None:
    changes, slope = images(3, 3), images(1, 4)
    expected = tile_scores(changes.double(), slope.double(), tile)
    torch.testing.assert_close(cuda.tile_sums(changes, slope[0], tile).T, expected, rtol=1e-6, atol=1e-6)
