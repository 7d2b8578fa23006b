"""Dead pixels and lines that were put into an image are found and mended, and nothing else is touched."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from femoreg_torch.fluoro import without_defects

SIZE = 400


def picture(photons: float = 400.0, seed: int = 1) -> Tensor:
    """Raw intensities of a soft ball behind a table's edge, with a wire of four pixels and Poisson's noise."""
    axis = torch.arange(SIZE, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    depth = 2.5 * (1 - ((x - 210) ** 2 + (y - 190) ** 2) / 170**2).clamp_min(0).sqrt()
    depth = depth + 0.3 * (y > 300) + 2.0 * ((x - 0.7 * y - 60).abs() < 2)
    light = torch.from_numpy(cv2.GaussianBlur((photons * torch.exp(-depth)).numpy(), (0, 0), 0.8))
    return 20 * torch.poisson(light, generator=torch.Generator().manual_seed(seed)).float()


def test_dead_and_stuck_pixels_and_lines_are_taken_from_their_neighbours() -> None:
    true, draw = picture(), np.random.default_rng(2)
    raw, count = true.clone(), 300
    for value in (0.0, 60_000.0):
        y, x = torch.from_numpy(draw.integers(0, SIZE, (2, count)))
        raw[y, x] = value
    raw[101:104], raw[:, 250] = 0.0, 65_535.0
    sure = 300 * (true / 20).clamp_min(1).sqrt() + 0.3 * true  # 15 standard deviations
    wrong = (raw - true).abs() > sure
    mended, told = without_defects(raw, raw, 0.2)
    assert told is not None
    assert "4 lines" in told
    left = ((mended - true).abs() > sure) & wrong
    assert int(left.sum()) < 0.01 * int(wrong.sum())
    assert int(wrong.sum()) > 600
    touched = (mended != raw) & ~wrong
    touched[101:104], touched[:, 250] = False, False
    assert int(touched.sum()) < 200  # of 600: those that are dark in the shade


def test_logarithms_are_mended_where_their_light_is_off() -> None:
    raw = picture()
    y, x = torch.from_numpy(np.random.default_rng(3).integers(0, SIZE, (2, 200)))
    raw[y, x] = 60_000.0
    logs = -raw.clamp_min(1).log()
    mended, told = without_defects(logs, raw, 0.2)
    again, _ = without_defects(raw, raw, 0.2)
    assert told is not None
    assert torch.allclose(mended, -again.clamp_min(1).log(), atol=1e-5)


@pytest.mark.parametrize("photons", [3.0, 40.0, 2000.0])
def test_noise_is_left_as_it_is(photons: float) -> None:
    raw = picture(photons)
    mended, told = without_defects(raw, raw, 0.2)
    assert told is None
    assert torch.equal(mended, raw)


def letters(raw: Tensor) -> Tensor:
    mask = np.zeros(raw.shape, np.uint8)
    cv2.putText(mask, "L  12.03.1951", (10, 40), cv2.FONT_HERSHEY_SIMPLEX, 1.2, 255, 3)
    return torch.where(torch.from_numpy(mask) > 0, 65_535.0, raw)


def eight_bits(raw: Tensor) -> Tensor:
    return (raw / raw.max() * 255).round()


def saturated(raw: Tensor) -> Tensor:
    return raw.clamp_max(0.5 * float(raw.max()))


@pytest.mark.parametrize("altered", [letters, eight_bits, saturated])
def test_what_is_no_defect_stays(altered: Callable[[Tensor], Tensor]) -> None:
    raw = altered(picture())
    mended, told = without_defects(raw, raw, 0.2)
    assert told is None or "line" not in told
    assert int((mended != raw).sum()) < 0.2 * int((raw != picture()).sum())  # dots of letters


def test_single_pixels_of_a_coarse_image_stay() -> None:
    raw = picture()
    raw[::10, ::10] = 60_000.0
    mended, told = without_defects(raw, raw, 0.8)
    assert told is None
    assert torch.equal(mended, raw)


def test_a_constant_image_has_no_defects() -> None:
    raw = torch.full((50, 50), 7.0)
    assert without_defects(raw, raw, 0.2)[1] is None
