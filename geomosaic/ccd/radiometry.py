"""Gain and offset of every CCD from what neighbours see of the same ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.ccd.model import Floats, Overlap
from geomosaic.survey.strips import StripGeometry

_BLOCK_LINES = 64
_LEAST_BLOCKS = 4


@dataclass(frozen=True)
class Radiometry:
    """`gain[k] * value + offset[k]` of CCD k is on the scale all share; (ccds,) both."""

    gain: Floats
    offset: Floats


def pair_radiometry(overlap: Overlap, geometry: StripGeometry, highest: float) -> tuple[float, float] | None:
    """(g, o) with right = g * left + o, from means of blocks of 64 lines; None where too little is seen.

    Means over all columns of the overlap leave little of the columns' pattern, and blocks so large do not
    mind offsets of some pixels. Saturated blocks (any pixel at `highest`) are left out. Robust: Cauchy weights
    at three times the middle residual; the offset is drawn to 0 as far as the blocks' greys do not tell it.
    """
    margin = geometry.read_px - geometry.overlap_px
    n = len(overlap.left) // _BLOCK_LINES
    shape = (n, _BLOCK_LINES, geometry.overlap_px)
    rows = n * _BLOCK_LINES
    left = overlap.left[:rows, margin:].reshape(shape)
    right = overlap.right[:rows, : geometry.overlap_px].reshape(shape)
    whole = overlap.valid[:rows].all(axis=1).reshape(n, _BLOCK_LINES).all(axis=1)
    whole &= (left.max(axis=(1, 2)) < highest) & (right.max(axis=(1, 2)) < highest)
    if whole.sum() < _LEAST_BLOCKS:
        return None
    x, y = (v[whole].mean(axis=(1, 2), dtype=np.float64) for v in (left, right))
    return _line(x, y)


def radiometry(overlaps: Sequence[Overlap], geometry: StripGeometry) -> Radiometry:
    """Gains and offsets of all CCDs; their logarithms' mean and the offsets' mean are 0 in each unbroken run."""
    ccds = len(geometry.ccds)
    found = {o.pair: pair_radiometry(o, geometry, 2.0**geometry.bit_depth - 1) for o in overlaps}
    gain, offset = np.ones(ccds), np.zeros(ccds)
    first = 0
    for k in range(ccds):
        pair = found.get(k)
        if k < ccds - 1 and pair is not None:
            g, o = pair
            gain[k + 1] = gain[k] / g
            offset[k + 1] = offset[k] - gain[k + 1] * o
            continue
        run = slice(first, k + 1)
        scale = float(np.exp(np.log(gain[run]).mean()))
        gain[run] /= scale
        offset[run] = offset[run] / scale - (offset[run] / scale).mean()
        first = k + 1
    return Radiometry(gain, offset)


def _line(x: Floats, y: Floats) -> tuple[float, float]:
    """Robust straight line y = g x + o."""
    middle = float(np.median(x))
    weight = np.ones_like(x)
    g, o = 1.0, 0.0
    for _ in range(12):
        total = weight.sum()
        mx, my = float((weight * x).sum() / total), float((weight * y).sum() / total)
        ratio = my / mx if mx > 0 else 1.0
        # A line through 0 is taken for known as well as one block 5 % of the middle grey off would tell it.
        ridge = (0.05 * middle) ** 2
        g = float(
            ((weight * (x - mx) * (y - my)).sum() + ridge * ratio) / ((weight * (x - mx) ** 2).sum() + ridge)
        )
        o = my - g * mx
        rest = np.abs(y - g * x - o)
        scale = max(1.4826 * float(np.median(rest)), 1e-6)
        weight = 1.0 / (1.0 + (rest / (3.0 * scale)) ** 2)
    return g, o
