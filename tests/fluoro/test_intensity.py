"""The log transform against Beer and Lambert, and coarser pixels against the camera that goes with them."""

import math

import pytest
import torch

from femoreg_torch.errors import InputError
from femoreg_torch.fluoro import attenuation_image, below_zero, binned, downsample, intensity_of
from femoreg_torch.geometry import centred_camera, project_points


def test_attenuation_is_recovered_from_counts() -> None:
    thickness = torch.zeros(64, 48)
    thickness[20:40, 10:30] = torch.linspace(0.5, 3.0, 20)  # line integrals of a bone; the beam is open around it
    torch.testing.assert_close(attenuation_image(30000 * torch.exp(-thickness)), thickness, atol=1e-5, rtol=0)


def test_one_hot_pixel_does_not_set_the_open_beam() -> None:
    """A Gaussian of variance 2 px² leaves of a single pixel the share that its middle has in the sum of its weights."""
    raw = torch.full((32, 32), 1000.0)
    raw[15, 15] = 60000.0
    share = sum(math.exp(-(n**2) / 4) for n in range(-6, 7)) ** -2
    attenuation = attenuation_image(raw)
    assert attenuation[25, 25] == pytest.approx(math.log(1 + 59 * share), abs=1e-4)
    assert attenuation[15, 15] < 0


def test_pixels_without_a_count_are_as_dark_as_the_darkest_other() -> None:
    raw = torch.full((16, 16), 1000.0)
    raw[4, 4], raw[8, 8], raw[9, 9] = 0.0, 10.0, -3.0
    attenuation = attenuation_image(raw)
    assert torch.isfinite(attenuation).all()
    assert attenuation[4, 4] == attenuation[8, 8] == attenuation[9, 9] == attenuation.max()


def test_an_image_without_a_positive_pixel_is_refused() -> None:
    with pytest.raises(InputError, match="no pixel is positive"):
        attenuation_image(-torch.rand(8, 8, generator=torch.Generator().manual_seed(0)))


def test_downsampling_averages_blocks_and_drops_what_fills_none() -> None:
    images = torch.rand(2, 3, 14, 21, generator=torch.Generator().manual_seed(0))
    coarse = downsample(images, 4)
    assert tuple(coarse.shape) == (2, 3, 3, 5)
    torch.testing.assert_close(coarse[1, 2, 2, 4], images[1, 2, 8:12, 16:20].mean())
    torch.testing.assert_close(downsample(images[0, 0], 4), coarse[0, 0])


def test_larger_pixels_average_intensities_as_a_detector_does() -> None:
    counts = 20000 * torch.exp(-5 * torch.rand(24, 32, generator=torch.Generator().manual_seed(1)))
    fine, coarse = attenuation_image(counts), attenuation_image(downsample(counts, 4))
    offset = (binned(fine, 4) - coarse).mean()  # of the open beam, smoothed over pixels of another size
    torch.testing.assert_close(binned(fine, 4), coarse + offset, atol=1e-5, rtol=0)
    assert torch.equal(binned(fine, 1), fine)
    torch.testing.assert_close(binned(binned(fine, 2), 2), binned(fine, 4), atol=1e-5, rtol=0)


def test_grey_values_that_are_no_attenuation_are_averaged_themselves() -> None:
    grey = 255 * torch.rand(64, 64, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(binned(grey, 4), downsample(grey, 4))


def test_a_pixel_without_light_does_not_darken_its_block_for_good() -> None:
    image = torch.full((64, 64), 1.0)
    image[5, 5] = 200.0
    assert binned(image, 4)[1, 1] == pytest.approx(1 - math.log(15 / 16), abs=1e-5)


def test_a_blob_stays_where_the_coarser_camera_sees_it() -> None:
    camera = centred_camera(1000.0, (0.5, 0.4), (96, 128))
    pixel = project_points(camera, torch.tensor([[3.0, -4.0, 700.0]]).double())[0]
    rows, columns = torch.meshgrid(torch.arange(96.0), torch.arange(128.0), indexing="ij")
    blob = torch.exp(-((columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2) / (2 * 5.0**2))
    coarse = downsample(blob, 4)
    expected = project_points(camera.downsampled(4), torch.tensor([[3.0, -4.0, 700.0]]).double())[0]
    rows, columns = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    found = torch.stack([(coarse * columns).sum(), (coarse * rows).sum()]) / coarse.sum()
    torch.testing.assert_close(found.double(), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("scale", [1.0, 1000 / math.log(10), 40.0])
def test_logarithms_of_any_scale_give_intensities_in_their_order(scale: float) -> None:
    """Those of another base than e give other intensities, as dark as a patient's."""
    depth = torch.linspace(-0.2, 6, 400).view(20, 20)
    found = intensity_of(scale * depth + 3)
    assert (found.flatten().diff() < 0).all()
    assert 1e-5 < float(found.min()) < 5e-3
    if scale == 1:
        torch.testing.assert_close(found, torch.exp(-(depth + 0.2)))


def test_many_pixels_below_zero_are_told_and_padding_is_none() -> None:
    raw = torch.ones(10, 10)
    raw[0] = -5
    assert "has 10 % of its pixels below 0" in str(below_zero(raw))
    assert below_zero(raw, raw < 0) is None
    raw[0, 1:] = 0  # a shutter
    assert below_zero(raw) is None
