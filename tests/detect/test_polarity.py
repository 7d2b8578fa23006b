"""Bones are told to be bright or dark by their rims, whatever soft tissue and the beam do."""

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from femoreg_torch.detect.polarity import bone_is_dark, rim_contrast

_ROW, _COLUMN = torch.meshgrid(torch.arange(192.0), torch.arange(192.0), indexing="ij")
DISC = (_ROW - 90).hypot(_COLUMN - 100) < 40  # a bone on the image's grid


def segmentation(bone: Tensor) -> Tensor:
    """Probabilities (2, 96, 96) of background and one bone."""
    there = bone[::2, ::2].float() * 0.9 + 0.05
    return torch.stack([1 - there, there])


def picture(bone: float, noise: float = 0.1) -> Tensor:
    """Soft tissue that is six times as dark on one side as a bone of 0.5 is bright, and a bone."""
    grain = torch.randn(192, 192, generator=torch.Generator().manual_seed(0))
    return 3 * _COLUMN / 192 + bone * DISC + noise * grain


@pytest.mark.parametrize(("bone", "dark"), [(0.5, False), (-0.5, True)])
def test_the_rims_of_a_bone_tell_it_from_soft_tissue(bone: float, dark: bool) -> None:
    assert bone_is_dark(segmentation(DISC), picture(bone)) is dark


def test_inverted_grey_values_change_the_sign() -> None:
    image = picture(0.5)
    assert_close(rim_contrast(segmentation(DISC), -image), -rim_contrast(segmentation(DISC), image))


def test_two_flat_levels_differ_by_what_lies_between_their_quartiles() -> None:
    """Half of the pixels on either level, but for the surroundings' own slope."""
    flat = DISC.float()
    assert rim_contrast(segmentation(DISC), flat) == pytest.approx(1.35, abs=0.2)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_steel_rail_along_a_bone_does_not_outweigh_its_rim(sign: int) -> None:
    """Where a rail crosses the picture, its shadow is ten times as deep as a bone's, just beyond the bone's outline."""
    image = picture(0.5)
    image[:, 141:156] += 5.0
    assert bone_is_dark(segmentation(DISC), sign * image) is (sign < 0)


def test_little_is_said_without_contrast_and_nothing_without_a_bone() -> None:
    nothing = torch.zeros_like(DISC)
    assert math.isnan(rim_contrast(segmentation(nothing), picture(0.5)))
    assert bone_is_dark(segmentation(nothing), picture(0.5)) is None
    assert abs(rim_contrast(segmentation(DISC), picture(0.0))) < 0.3  # of 300 pixels of noise: 0.12, one deviation
