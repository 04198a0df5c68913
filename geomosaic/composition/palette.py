"""Colours that tell frames from each other where a raster says which one gave each pixel."""

from __future__ import annotations

import colorsys

from geomosaic.constants import sourced, tuned

_TURN = sourced(0.618_033_988_749_895, "share", "hue step: near numbers differ", "Knuth 1998, vol. 3, 6.4")
_SATURATION = tuned(0.75, "1", "of the colours: less makes them alike; more hides what lies below")
_SHADES = tuned((0.95, 0.825, 0.7), "1", "by turns, so that near hues differ")


def frame_colour(number: int) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of the frame of a number."""
    shade = _SHADES[number % len(_SHADES)]
    red, green, blue = colorsys.hsv_to_rgb(number * _TURN % 1.0, _SATURATION, shade)
    return round(255 * red), round(255 * green), round(255 * blue)
