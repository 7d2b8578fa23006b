"""Patch Grad-NCC against a slow, literal computation, and the laws it obeys."""

import cv2
import numpy as np
import pytest
import torch
from pictures import picture
from torch import Tensor

from femoreg_torch.errors import InputError
from femoreg_torch.similarity import GradientOrientation, GradNcc, Ncc
from femoreg_torch.similarity.kernels import derivative_taps, image_gradients, patch_sums


def literal_cost(fixed: Tensor, moving: Tensor, radius: int) -> float:
    """Mean over patches and derivatives of 1 − NCC, patch by patch with OpenCV's Sobel and NumPy's correlation."""
    total, count = 0.0, 0
    for dx, dy in ((1, 0), (0, 1)):
        f, m = (cv2.Sobel(i.numpy(), cv2.CV_64F, dx, dy, borderType=cv2.BORDER_REPLICATE) for i in (fixed, moving))
        for y in range(radius, f.shape[0] - radius):
            for x in range(radius, f.shape[1] - radius):
                window = np.s_[y - radius : y + radius + 1, x - radius : x + radius + 1]
                total += 1 - np.corrcoef(f[window].ravel(), m[window].ravel())[0, 1]
                count += 1
    return total / count


def test_equals_the_literal_definition() -> None:
    fixed, moving = picture(0), picture(1)
    cost = GradNcc(3, smoothing_px=0).against(fixed)(moving[None])
    assert float(cost) == pytest.approx(literal_cost(fixed, moving, 3), abs=1e-5)


def test_derivatives_equal_a_smoothed_sobel_away_from_the_border() -> None:
    image = picture(2)
    dx, dy = image_gradients(image[None].double(), derivative_taps(1.1))[0].numpy()
    smooth = cv2.GaussianBlur(image.numpy().astype(np.float64), (5, 5), 1.1)
    inside = np.s_[4:-4, 4:-4]
    np.testing.assert_allclose(dx[inside], (cv2.Sobel(smooth, cv2.CV_64F, 1, 0) / 8)[inside], atol=1e-9)
    np.testing.assert_allclose(dy[inside], (cv2.Sobel(smooth, cv2.CV_64F, 0, 1) / 8)[inside], atol=1e-9)


def test_patch_sums_equal_direct_sums() -> None:
    maps = torch.rand(2, 9, 11, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sums = patch_sums(maps, 2)
    assert sums.shape == (2, 5, 7)
    torch.testing.assert_close(sums[1, 3, 4], maps[1, 3:8, 4:9].sum())


def test_a_perfect_match_costs_nothing_whatever_its_scale_and_offset() -> None:
    fixed = picture(3)
    costs = GradNcc(4).against(fixed)(torch.stack([fixed, 3 * fixed + 7, -fixed]))
    torch.testing.assert_close(costs, torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64), atol=1e-5, rtol=0)


def test_flat_patches_count_as_uncorrelated_and_have_no_gradient() -> None:
    fixed = picture(4)
    nothing = torch.zeros(1, *fixed.shape, requires_grad=True)
    cost = GradNcc(4).against(fixed)(nothing)
    cost.sum().backward()
    assert cost.item() == 1.0
    assert nothing.grad is not None
    assert not nothing.grad.any()
    assert float(GradNcc(3).against(torch.zeros(20, 20))(picture(5, 20, 20)[None])) == 1.0


def test_compiled_and_plain_torch_agree_in_value_and_gradient() -> None:
    fixed = picture(6)
    fixed[:12] = 0.4  # flat patches too
    moving = torch.stack([picture(7), picture(8), fixed])
    similarity = GradNcc(3).against(fixed)
    fast, slow = moving.clone().requires_grad_(), moving.double().requires_grad_()
    upstream = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    a, b = similarity(fast), similarity(slow)
    torch.testing.assert_close(a, b, atol=2e-6, rtol=0)
    (a * upstream).sum().backward()
    (b * upstream).sum().backward()
    assert fast.grad is not None
    assert slow.grad is not None
    torch.testing.assert_close(fast.grad[:2].double(), slow.grad[:2], atol=1e-6, rtol=1e-3)


def test_the_quadratic_has_value_and_gradient_of_plain_torch() -> None:
    fixed = GradNcc(3).against(picture(0))
    image = picture(1)
    jacobian = torch.stack([picture(2), picture(3)], -1)
    cost, scores, _ = fixed.quadratic(image, jacobian)
    moving = image.double()[None].requires_grad_()
    plain = 1 - fixed._reference(moving)[0]
    (slope,) = torch.autograd.grad(plain, moving)
    assert float(cost) == pytest.approx(plain.item(), abs=1e-6)
    expected = (jacobian.double() * slope[0, :, :, None]).sum((0, 1))
    torch.testing.assert_close(scores.sum(0), expected, atol=2e-6, rtol=1e-4)


def test_gradient_equals_finite_differences() -> None:
    similarity = GradNcc(2).against(picture(9, 17, 15))
    image = picture(10, 17, 15)[None].double().requires_grad_()
    torch.autograd.gradcheck(similarity, (image,), eps=1e-5, atol=1e-6)


def test_a_batch_gives_what_each_image_gives_alone() -> None:
    similarity = GradNcc(3).against(picture(11))
    batch = torch.stack([picture(seed) for seed in range(5)])
    alone = torch.cat([similarity(image[None]) for image in batch])
    assert torch.equal(similarity(batch), alone)


def test_weights_choose_where_images_are_compared() -> None:
    fixed = picture(12)
    moving = fixed.clone()
    moving[:, 16:] = picture(13)[:, 16:]  # right half wrong
    left = torch.zeros_like(fixed)
    left[:, :9] = 1  # patches that touch it end before the wrong half
    assert float(GradNcc(2).against(fixed, left)(moving[None])) < 1e-5
    assert float(GradNcc(2).against(fixed)(moving[None])) > 0.2


@pytest.mark.parametrize(
    ("weights", "radius", "says"),
    [
        (torch.zeros(40, 33), 3, "all pixel weights are zero"),
        (torch.full((40, 33), torch.nan), 3, "must be finite and not negative"),
        (torch.ones(40, 33).index_fill(0, torch.tensor([3]), -1.0), 3, "must be finite and not negative"),
        (None, 20, "no patch of radius 20 fits"),
    ],
)
def test_nothing_to_compare_is_said(weights: Tensor | None, radius: int, says: str) -> None:
    with pytest.raises(InputError, match=says):
        GradNcc(radius).against(picture(14), weights)


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(InputError, match="images are"):
        GradNcc(3).against(picture(15))(torch.zeros(1, 8, 8))


@pytest.mark.parametrize("kind", [GradNcc(3), Ncc(), Ncc(3), GradientOrientation()])
def test_whole_numbers_and_what_is_no_image_are_refused(kind: GradNcc | Ncc | GradientOrientation) -> None:
    whole = (100 * picture(15)).int()
    with pytest.raises(InputError, match=r"the fixed image holds torch.int32, floating-point numbers were expected"):
        kind.against(whole)
    with pytest.raises(InputError, match=r"images hold torch.int32"):
        kind.against(picture(15))(whole[None])
    with pytest.raises(InputError, match=r"shape \(H, W\) was expected, got \(1, 40, 33\)"):
        kind.against(picture(15)[None])
    with pytest.raises(InputError, match="must be a torch tensor, got ndarray"):
        kind.against(picture(15).numpy())  # type: ignore[arg-type]


def test_a_cost_cannot_be_differentiated_twice_and_says_so() -> None:
    moving = picture(16)[None].requires_grad_()
    cost = GradNcc(3).against(picture(15))(moving).sum()
    (slope,) = torch.autograd.grad(cost, moving, create_graph=True)
    with pytest.raises(RuntimeError, match="a cost of GradNcc cannot be differentiated twice"):
        slope.sum().backward()
