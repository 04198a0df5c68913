"""Colours that tell frames from each other where a raster says which one gave each pixel."""

from __future__ import annotations

import colorsys

from geomosaic.constants import sourced, tuned

_TURN = sourced(
    0.618_033_988_749_895,
    "share of the circle of hues",
    "from one number to the next: by the golden section any few numbers in a row differ well",
    "Knuth 1998, The Art of Computer Programming 3, section 6.4, exercise 9",
)
_SATURATION = tuned(
    0.75,
    "1",
    "of every colour: with less they look alike, with more they hide what lies below",
)
_SHADES: tuple[float, ...] = tuned(
    (0.95, 0.825, 0.7),
    "1",
    "of numbers in turn: hues that come near again differ in shade",
)


def frame_colour(number: int) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of the frame of a number."""
    shade = _SHADES[number % len(_SHADES)]
    red, green, blue = colorsys.hsv_to_rgb(number * _TURN % 1.0, _SATURATION, shade)
    return round(255 * red), round(255 * green), round(255 * blue)
