"""Colours of overlays and of the 3-D scene, told apart by the colour-blind too: Okabe and Ito's palette.

Okabe and Ito, Color universal design (2008), https://jfly.uni-koeln.de/color/.
"""

from collections.abc import Iterable

Colour = tuple[int, int, int]  # red, green, blue

_SKY_BLUE, _ORANGE, _GREEN, _VERMILION, _BLUE = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (213, 94, 0),
    (0, 114, 178),
)
OBJECT_COLOURS: tuple[Colour, ...] = (_SKY_BLUE, _ORANGE, _GREEN, _VERMILION, _BLUE)
PATH: Colour = (204, 121, 167)  # the planned path, also dashed
GUIDE: Colour = (240, 228, 66)


def object_colours(names: Iterable[str]) -> dict[str, Colour]:
    """A colour for every object, by their order; a sixth one has that of the first again."""
    return {name: OBJECT_COLOURS[number % len(OBJECT_COLOURS)] for number, name in enumerate(names)}


def hexadecimal(colour: Colour) -> str:
    """A colour as web pages write it."""
    return "#{:02x}{:02x}{:02x}".format(*colour)
