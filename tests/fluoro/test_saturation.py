"""Light that is cut off is told from the image itself, whatever its bits; an image that is not cut off holds none."""

import pytest
import torch
from torch import Tensor

from femoreg_torch.fluoro import Display, attenuation_image, intensity_of, saturated

AIR = 60  # columns of 160


def picture(bits: int = 16, gain: float = 1.0, cut: bool = True) -> Tensor:
    """A slope of tissue beside air, with noise, in whole grey values; air is twice as bright as can be told, if cut."""
    noise = torch.randn(120, 160, generator=torch.Generator().manual_seed(0))
    light = torch.linspace(0.2, 0.9, 160).repeat(120, 1)
    light[:, -AIR:] = 2.0 if cut else 0.9
    return ((light * (1 + 0.01 * noise)).clamp(max=1) * gain * (2**bits - 1)).round()


@pytest.mark.parametrize("bits", [8, 12, 14, 16])
@pytest.mark.parametrize("gain", [1.0, 0.8])  # some detectors stop below what the file could hold
def test_air_that_is_cut_off_is_found(bits: int, gain: float) -> None:
    found = saturated(attenuation_image(picture(bits, gain)))
    assert found is not None
    assert found[:, -AIR:].all()
    assert not found[:, :-AIR].any()


def test_logarithms_of_it_and_turned_ones_tell_the_same() -> None:
    image = attenuation_image(picture())
    found = saturated(image)
    assert found is not None
    for log in (image, 1000 * image.round(decimals=3)):
        again = saturated(log)
        assert again is not None
        assert torch.equal(again, found)
    again = saturated(attenuation_image(intensity_of(image)))
    assert again is not None
    assert torch.equal(again, found)
    display = Display("posterior", turned_deg=90)
    turned = saturated(display.to_camera(image))
    assert turned is not None
    assert torch.equal(turned, display.to_camera(found))


def test_letters_brighter_than_the_air_do_not_hide_it() -> None:
    raw = picture(gain=0.8)
    raw[:10, :10] = 65535
    found = saturated(attenuation_image(raw))
    assert found is not None
    assert found[:, -AIR:].all()


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_nothing_is_found_where_light_is_not_cut_off(bits: int) -> None:
    raw = picture(bits, cut=False)
    assert saturated(attenuation_image(raw)) is None
    raw[:10, :10] = 2**bits - 1  # letters alone
    assert saturated(attenuation_image(raw)) is None


def test_only_what_is_exposed_is_asked() -> None:
    image = attenuation_image(picture())
    field = torch.zeros_like(image, dtype=torch.bool)
    assert saturated(image, field) is None
    field[:, :60] = True
    assert saturated(image, field) is None
