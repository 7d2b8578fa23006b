"""Rows and columns of a file that hold no image."""

import pytest
import torch
from torch import Tensor

from femoreg_torch.fluoro import blank_lines


def picture() -> Tensor:
    return 50 + torch.poisson(torch.full((60, 80), 900.0), generator=torch.Generator().manual_seed(1))


def test_a_picture_set_into_a_larger_one_is_what_is_exposed() -> None:
    light = torch.zeros(100, 120)
    light[20:80, 10:90] = picture()
    blank = blank_lines(light)
    assert blank is not None
    assert torch.equal(~blank, light > 0)


def test_a_file_that_was_cut_short_has_rows_without_an_image() -> None:
    light = picture()
    light[41:] = 0
    blank = blank_lines(light)
    assert blank is not None
    assert torch.equal(blank, light == 0)


@pytest.mark.parametrize("rows", [0, 4])
def test_few_dead_lines_and_dark_metal_are_an_image(rows: int) -> None:
    light = picture()
    light[30 : 30 + rows] = 0
    light[:, 10:30][20:40] = 0
    assert blank_lines(light) is None


def test_an_image_of_one_value_has_no_other_part() -> None:
    assert blank_lines(torch.full((20, 20), 3.0)) is None
