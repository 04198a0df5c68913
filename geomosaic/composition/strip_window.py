"""A part of the scene as one strip shows it: places between knots, pixels resampled once."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.ccd.layout import StripLookup
from geomosaic.composition.strip_lines import LineBlock
from geomosaic.composition.strip_taps import between
from geomosaic.constants import tuned

_ROWS = tuned(32, "px", "resampled at once: more do not fit a processor's cache")
_STRETCHES = tuned(64, "stretches", "in a piece, as wide as a TH-1 strip: more widen its weights")
_STRETCH_PX = tuned(64, "px", "most columns with one shift, computed past an edge: more save little")


@dataclass(frozen=True, eq=False)
class StripPart:
    """Pixels and which of them are valid, (rows, cols)."""

    pixels: Floats32
    valid: Bools


@dataclass(frozen=True, eq=False)
class StripBlock:
    """What a strip gives a block of rows: from raster row `top` on where they see it, and those lines."""

    top: int
    places: StripLookup
    lines: LineBlock | None


def part_of_strip(
    block: StripBlock, count: int, rows: tuple[int, int], cols: tuple[int, int], resampling: str
) -> StripPart:
    """Raster rows and cols (first, one beyond the last) of a strip of `count` lines."""
    (top, bottom), lines, places = rows, block.lines, block.places
    shape = bottom - top, cols[1] - cols[0]
    part = StripPart(np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=bool))
    if lines is None:
        return part
    knots, image = places.knots_px, places.image_px[:, top - block.top : bottom - block.top]
    off = _off(knots, image, lines)
    stretch = _stretch(knots, off)
    # Counted from the CCD's first column, so that a pixel is the same in whatever part.
    first = cols[0] - (cols[0] - int(knots[0])) % stretch
    for left in range(first, cols[1], stretch * _STRETCHES):
        here = max(left, cols[0]), min(left + stretch * _STRETCHES, cols[1])
        across, down = _between_knots(
            knots, off, np.arange(left + 0.5 * stretch, here[1] + 0.5 * stretch, stretch)
        )
        into = slice(here[0] - cols[0], here[1] - cols[0])
        part.valid[:, into] = _valid(lines, count, knots, image, here)
        for row in range(0, shape[0], _ROWS):
            at = slice(row, row + _ROWS), into
            if part.valid[at].any():
                off_here = down[at[0]] + (row - lines.first), across[at[0]] + left
                shown = between(lines.pixels, *off_here, stretch, resampling)
                part.pixels[at] = shown[:, here[0] - left : here[1] - left]
    return part


def _off(knots_px: Floats, image_px: Floats, lines: LineBlock) -> Floats:
    """How much farther right and lower (2, rows, m) the strip has what is seen at knots, in rows from 0 on.

    Where it has nothing near, as if straight on between the knots where it has.
    """
    col, line = image_px
    height, width = lines.pixels.shape
    near = _within(col, width, _STRETCH_PX) & _within(line - lines.first, height, _STRETCH_PX)
    off = np.stack([col - knots_px, line - (np.arange(len(line))[:, None] + 0.5)])
    if near.all():
        return off
    known = np.flatnonzero(near.any(axis=1))
    for row in np.flatnonzero(~near.all(axis=1)) if known.size else ():
        like = row if near[row].any() else known[np.abs(known - row).argmin()]
        for of_axis in off:
            of_axis[row] = np.interp(knots_px, knots_px[near[like]], of_axis[like, near[like]])
    return off


def _stretch(knots_px: Floats, off_px: Floats) -> int:
    """How many columns lie off their places alike, by the steepest slope between knots."""
    steepest = np.abs(np.diff(off_px, axis=2) / np.diff(knots_px)).max()
    stretch = _STRETCH_PX
    while stretch > 1 and steepest * stretch * cv2.INTER_TAB_SIZE > 1.0:
        stretch //= 2
    return stretch


def _valid(lines: LineBlock, count: int, knots_px: Floats, image_px: Floats, cols: tuple[int, int]) -> Bools:
    """Where the nearest pixel is one of the strip's and valid, (rows, cols)."""
    height, width = lines.pixels.shape
    middles = np.arange(cols[0] + 0.5, cols[1])
    first, last = np.searchsorted(knots_px, middles[[0, -1]], side="right")
    valid = np.ones((image_px.shape[1], cols[1] - cols[0]), dtype=bool)
    for at, size in zip(image_px, (width, count), strict=True):
        about = at[:, max(first - 1, 0) : last + 1]
        valid[(about < 0.0).all(axis=1) | (about > size).all(axis=1)] = False
        asked = valid.any(axis=1) & ~_within(about, size).all(axis=1)
        if asked.any():
            valid[asked] &= _within(_between_knots(knots_px, at[asked], middles), size)
    if lines.valid is not None:
        col, line = np.floor(np.nan_to_num(_between_knots(knots_px, image_px, middles))).astype(np.intp)
        valid &= lines.valid[np.clip(line - lines.first, 0, height - 1), np.clip(col, 0, width - 1)]
    return valid


def _within(at_px: Floats, size: int, beyond_px: float = 0.0) -> Bools:
    """What lies within 0 and a size, or as much beyond; not what isn't known."""
    return np.asarray((at_px >= -beyond_px) & (at_px <= size + beyond_px))


def _between_knots(knots_px: Floats, at_knots: Floats, cols: Floats) -> Floats:
    """What is given (..., m) at knots, straight in between at raster cols (n,): (..., n)."""
    k = np.clip(np.searchsorted(knots_px, cols, side="right") - 1, 0, len(knots_px) - 2)
    share = (cols - knots_px[k]) / (knots_px[k + 1] - knots_px[k])
    return np.asarray(at_knots[..., k] + share * (at_knots[..., k + 1] - at_knots[..., k]))
