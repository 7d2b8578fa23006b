"""NCC and gradient orientation: against NumPy, and the laws that every similarity obeys."""

import math

import numpy as np
import pytest
import torch
from pictures import picture

from femoreg_torch.errors import InputError
from femoreg_torch.similarity import GradientOrientation, GradNcc, Ncc, Similarity
from femoreg_torch.similarity.kernels import derivative_taps, image_gradients

every_similarity = pytest.mark.parametrize("similarity", [GradNcc(3), Ncc(), Ncc(3), GradientOrientation()], ids=str)


@every_similarity
def test_the_fixed_image_costs_least_and_a_shift_costs_more(similarity: Similarity) -> None:
    fixed = picture(0)
    costs = similarity.against(fixed, None)(torch.stack([fixed, 2 * fixed + 1, fixed.roll(2, 1), picture(1)]))
    torch.testing.assert_close(costs[:2], torch.zeros(2, dtype=costs.dtype), atol=2e-5, rtol=0)
    assert costs[0] < costs[2] < costs[3] + 0.2
    assert costs[2] > 0.05


@every_similarity
def test_nothing_drawn_is_finite_and_so_is_its_gradient(similarity: Similarity) -> None:
    image = torch.zeros(1, 40, 33, requires_grad=True)
    cost = similarity.against(picture(2), None)(image)
    cost.sum().backward()
    assert cost.item() == pytest.approx(1.0)
    assert image.grad is not None
    assert torch.isfinite(image.grad).all()


@every_similarity
def test_a_batch_gives_what_each_gives_alone(similarity: Similarity) -> None:
    prepared = similarity.against(picture(3), None)
    batch = torch.stack([picture(seed) for seed in range(4)])
    torch.testing.assert_close(prepared(batch), torch.cat([prepared(image[None]) for image in batch]))


@every_similarity
def test_gradient_equals_finite_differences(similarity: Similarity) -> None:
    prepared = similarity.against(picture(4, 12, 11), None)
    image = picture(5, 12, 11)[None].double().requires_grad_()
    torch.autograd.gradcheck(prepared, (image,), eps=1e-7, atol=1e-4, fast_mode=True)


@every_similarity
def test_an_image_of_another_size_is_refused(similarity: Similarity) -> None:
    with pytest.raises(InputError, match="images are"):
        similarity.against(picture(6), None)(torch.zeros(1, 8, 8))


def test_ncc_equals_numpy() -> None:
    fixed, moving = picture(7), picture(8)
    expected = 1 - np.corrcoef(fixed.numpy().ravel(), moving.numpy().ravel())[0, 1]
    assert Ncc().against(fixed)(moving[None]).item() == pytest.approx(expected, abs=1e-6)


def test_weighted_ncc_equals_the_weighted_correlation_of_numpy() -> None:
    fixed, moving, weights = picture(7), picture(8), picture(9).square()
    covariance = np.cov(fixed.numpy().ravel(), moving.numpy().ravel(), aweights=weights.numpy().ravel().astype(float))
    expected = 1 - covariance[0, 1] / math.sqrt(covariance[0, 0] * covariance[1, 1])
    assert Ncc().against(fixed, weights)(moving[None]).item() == pytest.approx(expected, abs=1e-6)


def test_patch_ncc_of_the_only_patch_equals_the_whole_image() -> None:
    fixed, moving = picture(9, 9, 9), picture(10, 9, 9)
    assert Ncc(4).against(fixed)(moving[None]).item() == pytest.approx(
        Ncc().against(fixed)(moving[None]).item(), abs=1e-9
    )


def test_orientation_equals_angles_compared_pixel_by_pixel() -> None:
    fixed, moving = picture(13), picture(14)
    (fx, fy), (mx, my) = (image_gradients(i[None], derivative_taps(1.1))[0].numpy() for i in (fixed, moving))
    strong = np.hypot(fx, fy) > np.median(np.hypot(fx, fy))
    both = strong & (np.hypot(mx, my) > np.median(np.hypot(mx, my)))
    turn = np.arctan2(my, mx) - np.arctan2(fy, fx)
    angle = np.abs((turn + math.pi) % (2 * math.pi) - math.pi)
    agreement = np.maximum(2 - np.log(angle + 1), 0) / 2
    expected = 1 - agreement[both].sum() / strong.sum()
    assert GradientOrientation().against(fixed)(moving[None]).item() == pytest.approx(expected, abs=1e-5)


@every_similarity
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("pixels", ["one", "all"])
def test_an_image_that_holds_nan_costs_nan_and_no_other_does(
    similarity: Similarity, pixels: str, dtype: torch.dtype
) -> None:
    images = torch.stack([picture(3), picture(4)]).to(dtype)
    if pixels == "one":
        images[0, 20, 16] = math.nan
    else:
        images[0] = math.nan
    costs = similarity.against(picture(5).to(dtype), None)(images)
    assert costs.isnan().tolist() == [True, False]
    costs = similarity.against(picture(5).to(dtype), None)(images.requires_grad_())
    assert costs.isnan().tolist() == [True, False]


@pytest.mark.parametrize("similarity", [GradNcc(3), Ncc(), Ncc(3)], ids=str)
def test_against_a_fixed_image_that_holds_nan_all_costs_are_nan(similarity: Similarity) -> None:
    fixed = picture(5)
    fixed[20, 16] = math.nan
    assert similarity.against(fixed, None)(picture(3)[None]).isnan().all()


def test_weights_choose_where_to_look() -> None:
    fixed = picture(11)
    moving = fixed.clone()
    moving[:, 15:] = picture(12)[:, 15:]
    left = torch.zeros_like(fixed)
    left[:, :8] = 1
    assert Ncc(2).against(fixed, left)(moving[None]).item() < 1e-6
    assert GradientOrientation().against(fixed, left)(moving[None]).item() < GradientOrientation().against(fixed)(
        moving[None]
    )


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: Ncc(40).against(picture(0)), "no patch of radius 40"),
        (lambda: Ncc(2).against(picture(0), torch.zeros(40, 33)), "all pixel weights are zero"),
        (lambda: Ncc().against(picture(0), torch.zeros(40, 33)), "all pixel weights are zero"),
        (lambda: Ncc().against(picture(0), torch.ones(40, 30)), "weights are"),
        (lambda: GradientOrientation().against(torch.ones(9, 9)), "no edge"),
        (lambda: GradientOrientation().against(torch.full((9, 9), math.nan)), "the fixed image holds nan"),
        (lambda: Ncc(2.5), "patch_radius: a whole number was expected, found 2.5"),  # type: ignore[arg-type]
        (lambda: GradNcc(5.0), "patch_radius: a whole number"),  # type: ignore[arg-type]
    ],
)
def test_bad_input_is_told(call, says: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=says):
        call()
