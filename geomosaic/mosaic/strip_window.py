"""A part of the scene as one strip shows it: places between knots, pixels resampled once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from geomosaic.ccd.layout import Places
from geomosaic.ccd.model import Floats
from geomosaic.constants import CHOSEN, Because
from geomosaic.mosaic.strip_lines import Lines
from geomosaic.projection.resample import resample

Floats32 = NDArray[np.float32]
Flags = NDArray[np.bool_]
_ROWS: Annotated[
    int,
    Because(
        "px",
        "of a piece that is resampled at once: of this size it stays in the processor's cache",
        CHOSEN,
    ),
] = 64
_COLS: Annotated[
    int,
    Because(
        "px",
        "of a piece that is resampled at once: of this size it stays in the processor's cache",
        CHOSEN,
    ),
] = 4096


@dataclass(frozen=True, eq=False)
class StripPart:
    """Pixels and which of them are valid, (rows, cols)."""

    pixels: Floats32
    valid: Flags


def part_of_strip(
    lines: Lines | None,
    count: int,
    places: Places,
    rows: tuple[int, int, int],
    cols: tuple[int, int],
    resampling: str,
) -> StripPart:
    """Raster cols (first, one beyond the last) of a strip of `count` lines.

    rows: the raster row at which `places` begin, the first row wanted, and one beyond the last.
    """
    begin, top, bottom = rows
    shape = bottom - top, cols[1] - cols[0]
    part = StripPart(np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=bool))
    if lines is None:
        return part
    for row in range(top, bottom, _ROWS):
        here = slice(row - begin, min(row + _ROWS, bottom) - begin)
        into = slice(row - top, row - top + here.stop - here.start)
        for col in range(cols[0], cols[1], _COLS):
            end = min(col + _COLS, cols[1])
            x, y = _between_knots(places, here, col, end, lines.first)
            at = into, slice(col - cols[0], end - cols[0])
            part.valid[at] = _valid(lines, count, x, y)
            part.pixels[at] = resample(lines.pixels[..., None], x, y, resampling)[..., 0]
    return part


def _between_knots(
    places: Places, rows: slice, first: int, end: int, first_line: int
) -> tuple[Floats32, Floats32]:
    """Strip col, and line counted from first_line, (rows, cols), at middles of raster cols first to end."""
    knots = places.knots_px
    image: Floats = places.image_px[:, rows]
    xy = np.empty((2, image.shape[1], end - first), dtype=np.float32)
    least = max(int(np.searchsorted(knots, first + 0.5, side="right")) - 1, 0)
    done = first
    for k in range(min(least, len(knots) - 2), len(knots) - 1):
        last = end if k == len(knots) - 2 else min(end, int(np.ceil(knots[k + 1] - 0.5)))
        if last <= done:
            continue
        middles = np.arange(done, last) + 0.5
        share = ((middles - knots[k]) / (knots[k + 1] - knots[k])).astype(np.float32)
        start = image[..., k] - np.array([0.0, first_line])[:, None]
        step = image[..., k + 1] - image[..., k]
        piece = xy[..., done - first : last - first]
        np.multiply(step.astype(np.float32)[..., None], share, out=piece)
        piece += start.astype(np.float32)[..., None]
        done = last
    return xy[0], xy[1]


def _valid(lines: Lines, count: int, x: Floats32, y: Floats32) -> Flags | bool:
    """Where the nearest pixel is one of the strip's and valid."""
    width, top, bottom = lines.pixels.shape[1], -lines.first, count - lines.first
    inside: Flags | bool = True
    if not (x.min() >= 0.0 and x.max() <= width and y.min() >= top and y.max() <= bottom):  # or NaN
        inside = (x >= 0.0) & (x <= width) & (y >= top) & (y <= bottom)
    if lines.valid is None:
        return inside
    row = np.clip(np.floor(np.nan_to_num(y)), 0, len(lines.valid) - 1).astype(np.intp)
    col = np.clip(np.floor(np.nan_to_num(x)), 0, width - 1).astype(np.intp)
    return np.asarray(lines.valid[row, col] & inside)
