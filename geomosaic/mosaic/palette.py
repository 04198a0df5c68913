"""Colours that tell frames from each other where a raster says which one gave each pixel."""

from __future__ import annotations

import colorsys
from typing import Annotated

from geomosaic.constants import CHOSEN, Because

_TURN: Annotated[
    float,
    Because(
        "share of the circle of hues",
        "from one number to the next: by the golden section any few numbers in a row differ well",
        "Knuth 1998, The Art of Computer Programming 3, section 6.4, exercise 9",
    ),
] = 0.618_033_988_749_895
_SATURATION: Annotated[
    float,
    Because("1", "of every colour: with less they look alike, with more they hide what lies below", CHOSEN),
] = 0.75
_SHADES: Annotated[
    tuple[float, ...], Because("1", "of numbers in turn: hues that come near again differ in shade", CHOSEN)
] = (0.95, 0.825, 0.7)


def frame_colour(number: int) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of the frame of a number."""
    shade = _SHADES[number % len(_SHADES)]
    red, green, blue = colorsys.hsv_to_rgb(number * _TURN % 1.0, _SATURATION, shade)
    return round(255 * red), round(255 * green), round(255 * blue)
