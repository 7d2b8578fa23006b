"""Shutters of every shape are found to a millimetre, and nothing else is taken for one."""

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from femoreg_torch.fluoro import (
    Circle,
    Polygon,
    attenuation_image,
    exposed_field,
    find_shutter,
    shades,
    without_penumbra,
)
from femoreg_torch.geometry import centred_camera

CAMERA = centred_camera(1020.0, (0.776, 0.776), (384, 384))
SIZE = 384
ROW, COLUMN = torch.meshgrid(torch.arange(SIZE).float(), torch.arange(SIZE).float(), indexing="ij")


def anatomy(seed: int = 0, dense: float = 3.5) -> Tensor:
    """Intensity (H, W) behind a patient: soft tissue, bones with edges, and a bright strip of open field."""
    generator = torch.Generator().manual_seed(seed)
    lumps = F.interpolate(torch.rand(1, 1, 7, 7, generator=generator), (SIZE, SIZE), mode="bicubic")[0, 0]
    bones = F.interpolate(torch.rand(1, 1, 24, 24, generator=generator), (SIZE, SIZE), mode="bicubic")[0, 0]
    through = dense + 1.0 * lumps + 0.8 * (bones > 0.6)
    through = through * (COLUMN < 350).float()  # beside the patient
    return 50000 * torch.exp(-smooth(through, 1.0))


def smooth(image: Tensor, sigma_px: float) -> Tensor:
    reach = math.ceil(3 * sigma_px)
    taps = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / sigma_px) ** 2)
    taps = taps / taps.sum()
    padded = F.pad(image[None, None], (reach,) * 4, mode="replicate")
    return F.conv2d(F.conv2d(padded, taps.view(1, 1, 1, -1)), taps.view(1, 1, -1, 1))[0, 0]


def shaded(beam: Tensor, exposed: Tensor, seed: int = 0, scatter: float = 0.03) -> Tensor:
    """What is counted with shutters in the beam: penumbra, a little scattered light beyond them, and noise."""
    light = beam * smooth(exposed.float(), 0.9) + scatter * beam.median()
    return torch.poisson(light, generator=torch.Generator().manual_seed(seed))


def turned(degrees: float, half: tuple[float, float]) -> Polygon:
    """A rectangle about the middle of the detector."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ends = [(a * half[0], b * half[1]) for a, b in signs]
    return Polygon(tuple((190 + x * cos - y * sin, 193 + x * sin + y * cos) for x, y in ends))


def iris(blades: int, radius: float, degrees: float) -> Polygon:
    """A regular polygon about the middle of the detector."""
    angles = [math.radians(degrees) + 2 * math.pi * n / blades for n in range(blades)]
    return Polygon(tuple((190 + radius * math.cos(one), 193 + radius * math.sin(one)) for one in angles))


FIELDS: dict[str, tuple[Tensor, str]] = {
    "round": (Circle((185, 200), 150).exposed((SIZE, SIZE)), "round"),
    "ring of an image intensifier": (Circle((191, 191), 196).exposed((SIZE, SIZE)), "round"),
    "ring in the corners": (Circle((191, 191), 225).exposed((SIZE, SIZE)), "round"),
    "rectangle": (turned(0, (150, 120)).exposed((SIZE, SIZE)), "rectangular"),
    "turned rectangle": (turned(25, (140, 120)).exposed((SIZE, SIZE)), "rectangular"),
    "turned rectangle over the border": (turned(10, (140, 260)).exposed((SIZE, SIZE)), "rectangular"),
    "iris of six blades": (iris(6, 170, 7).exposed((SIZE, SIZE)), "polygonal"),
    "iris of eight blades": (iris(8, 165, 22.5).exposed((SIZE, SIZE)), "polygonal"),
    "six blades of all lengths": (
        Polygon(((25, 40), (190, 8), (365, 31), (372, 346), (173, 376), (15, 346))).exposed((SIZE, SIZE)),
        "polygonal",
    ),
    "iris and blades": (
        Circle((190, 190), 170).exposed((SIZE, SIZE)) & turned(0, (110, 300)).exposed((SIZE, SIZE)),
        "round and straight",
    ),
}


def overlap(a: Tensor, b: Tensor) -> float:
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("dense", [0.0, 4.0])
def test_the_field_is_found(name: str, dense: float) -> None:
    exposed, shape = FIELDS[name]
    found = find_shutter(shaded(anatomy(1, dense), exposed), CAMERA)
    assert found is not None
    assert found.shape == shape
    assert found.exposed == pytest.approx(float(exposed.float().mean()), abs=0.01)
    assert overlap(found.field, without_penumbra(exposed, CAMERA)) > 0.98
    assert not (found.field & ~exposed).any()


@pytest.mark.parametrize("degrees", [0, 17, -31])
def test_blades_beside_a_bright_field_are_found_though_scattered_light_fills_their_shadow(degrees: float) -> None:
    """Beside open air their shadow is brighter than what lies behind bones: no grey value parts shadow and field."""
    exposed = turned(degrees, (150, 125)).exposed((SIZE, SIZE))
    thickness = 1.0 + 3.2 * (COLUMN / SIZE + 1 - ROW / SIZE) / 2  # the lower left corner is thin
    beam = 60000 * torch.exp(-thickness + 0.4 * smooth((anatomy() < 900).float(), 2.0))
    light = beam * smooth(exposed.float(), 0.9)
    light = light + 0.12 * smooth(light, 40.0) + 60
    found = find_shutter(torch.poisson(light, generator=torch.Generator().manual_seed(1)), CAMERA)
    assert found is not None
    assert overlap(found.field, without_penumbra(exposed, CAMERA)) > 0.98


def test_a_shutter_of_another_image_is_found_where_a_thick_body_is_darker_than_its_shadow() -> None:
    """Light scattered beside a strip of air fills the shadow."""
    exposed = Circle((191, 191), 150).exposed((SIZE, SIZE))
    shutter = find_shutter(shaded(anatomy(1), exposed), CAMERA)
    assert shutter is not None
    light = smooth(exposed.float(), 0.9) * torch.where(COLUMN < 90, 60000.0, 3000 * torch.exp(-3 * COLUMN / SIZE))
    light = light + 0.03 * 60000 * torch.exp(-(((ROW - 191) / 150) ** 2 + (COLUMN / 110) ** 2) / 2)
    image = torch.poisson(light, generator=torch.Generator().manual_seed(1))
    assert find_shutter(image, CAMERA) is None
    assert shades(shutter, image, CAMERA)
    for other in (anatomy(2), anatomy(3, 0.0), dense_at_the_border(), shaded(anatomy(2), FIELDS["rectangle"][0])):
        assert not shades(shutter, other, CAMERA)


def test_instruments_may_cross_the_edge_and_lie_inside() -> None:
    exposed, _ = FIELDS["round"]
    beam = anatomy(2)
    beam[180:200, 150:] *= 0.002  # held from outside
    beam[250:280, 150:180] *= 0.002
    found = exposed_field(shaded(beam, exposed), CAMERA)
    assert found is not None
    assert overlap(found, without_penumbra(exposed, CAMERA)) > 0.98


def test_pixels_of_another_size_and_those_that_are_no_squares() -> None:
    exposed = Circle((150, 100), 90).exposed((192, 384))
    camera = replace(CAMERA, pixel_mm=(1.552, 0.776), shape=(192, 384))
    there = ((ROW[:192] * 2 - 191) ** 2 + (COLUMN[:192] - 190) ** 2).sqrt() < 150
    found = exposed_field(shaded(anatomy(3)[::2], there), camera)
    assert found is not None
    assert not (found & ~there).any()
    assert overlap(found, there) > 0.94
    assert not torch.equal(exposed, there)
    coarse = centred_camera(1020.0, (3.104, 3.104), (96, 96))
    whole, _ = FIELDS["round"]
    there = F.avg_pool2d(whole[None].float(), 4)[0] > 0.5
    found = exposed_field(F.avg_pool2d(shaded(anatomy(3), whole)[None], 4)[0], coarse)
    assert found is not None
    assert overlap(found, without_penumbra(there, coarse)) > 0.95


def dense_at_the_border() -> Tensor:
    beam = anatomy(4)
    beam[:, :70] *= torch.exp(-smooth(4.0 * ((55 + 12 * torch.sin(ROW / 25) > COLUMN).float()), 3.0))[:, :70]
    return beam


def steel_bar(rows: slice, columns: slice) -> Tensor:
    beam = anatomy(5)
    beam[rows, columns] *= 1e-4
    return beam


def vignetted() -> Tensor:
    away = torch.hypot(COLUMN - 100, ROW - 120) / 384
    return anatomy(6) * torch.exp(-8 * (away - 0.55).clamp_min(0))


def beside_smooth_skin(open_px: float) -> Tensor:
    """Air in a corner, bounded by trunk and thigh: cylinders with straight edges, nearly as sharp as blades."""
    inside = ((COLUMN - open_px, 300.0), (0.45 * (COLUMN - open_px / 3) + 0.9 * (ROW - 1.2 * open_px), 300.0))
    depths = [(0.575 * px).clamp(0, radius) for px, radius in inside]  # mm, at two thirds of the detector's distance
    chords = [2 * (radius**2 - (radius - d) ** 2).sqrt() for d, (_, radius) in zip(depths, inside, strict=True)]
    return 50000 * torch.exp(-smooth(0.021 * torch.maximum(*chords), 1.0))


UNCOLLIMATED: dict[str, Callable[[], Tensor]] = {
    "plain": lambda: anatomy(7),
    "air": lambda: torch.full((SIZE, SIZE), 50000.0),
    "noise": lambda: torch.full((SIZE, SIZE), 20.0),
    "dense at the border": dense_at_the_border,
    "bar from the border": lambda: steel_bar(slice(0, 250), slice(100, 140)),
    "bar across": lambda: steel_bar(slice(150, 190), slice(0, 384)),
    "bar along the border": lambda: steel_bar(slice(0, 384), slice(0, 40)),
    "bar at a corner": lambda: steel_bar(slice(0, 200), slice(0, 60)),
    "dark corner": vignetted,
    "very dense patient": lambda: anatomy(8, 5.5),
    "a little air beside skin": lambda: beside_smooth_skin(80),
    "air beside skin": lambda: beside_smooth_skin(130),
    "much air beside skin": lambda: beside_smooth_skin(180),
}


@pytest.mark.parametrize("name", UNCOLLIMATED)
def test_nothing_else_is_taken_for_a_shutter(name: str) -> None:
    beam = UNCOLLIMATED[name]()
    counted = torch.poisson(beam + 20, generator=torch.Generator().manual_seed(1))
    assert exposed_field(counted, CAMERA) is None


def test_a_turned_bar_across_a_corner_is_no_shutter() -> None:
    beam = anatomy(9)
    along = (COLUMN + ROW) / math.sqrt(2)
    beam[(along > 60) & (along < 100)] *= 1e-4
    assert exposed_field(torch.poisson(beam + 5, generator=torch.Generator().manual_seed(1)), CAMERA) is None


def test_a_field_told_in_pixels() -> None:
    circle = Circle((10, 20), 5).exposed((40, 30))
    assert float(circle.sum()) == pytest.approx(math.pi * 25, rel=0.05)
    assert circle[25, 10]
    assert not circle[26, 10]
    square = Polygon(((3.5, 4.5), (9.5, 4.5), (9.5, 14.5), (3.5, 14.5))).exposed((40, 30))
    assert torch.equal(square.nonzero().amin(0), torch.tensor([5, 4]))
    assert torch.equal(square.nonzero().amax(0), torch.tensor([14, 9]))
    assert int(square.sum()) == 60


def test_a_margin_is_taken_off_along_the_edge_and_not_along_the_border() -> None:
    exposed = COLUMN < 200
    kept = without_penumbra(exposed, CAMERA)
    assert torch.equal(kept, (199.5 - COLUMN) * 0.776 >= 2.5)


@pytest.mark.parametrize("pixel_mm", [(0.2, 0.2), (0.4, 0.2), (0.2, 0.4)])
def test_the_margin_is_as_wide_along_both_sides_of_a_pixel(pixel_mm: tuple[float, float]) -> None:
    """2.5 mm and less than a pixel more, of a rectangle whose edges lie half a pixel before its first pixels."""
    exposed = torch.zeros(200, 200, dtype=torch.bool)
    exposed[50:150, 50:150] = True
    kept = without_penumbra(exposed, centred_camera(1000.0, pixel_mm, (200, 200)))
    for axis, mm in enumerate(pixel_mm):
        lines = kept.any(1 - axis).nonzero()
        for margin in ((int(lines[0]) + 0.5 - 50) * mm, (150 - 0.5 - int(lines[-1])) * mm):
            assert 2.5 - 1e-9 <= margin < 2.5 + mm


def test_the_open_beam_is_looked_for_within_the_field() -> None:
    raw = torch.full((60, 60), 1000.0)
    raw[:, 40:] = 60000.0  # letters burnt into the shadow
    field = torch.arange(60).expand(60, 60) < 30
    assert float(attenuation_image(raw, field)[10, 10]) == pytest.approx(0, abs=1e-5)
    assert float(attenuation_image(raw)[10, 10]) == pytest.approx(math.log(60), abs=1e-3)
