"""A strip resampled onto its neighbour: each row moved by its own offsets."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import spline_filter1d

from geomosaic.arrays import Bools, Floats, Floats32, Ints64
from geomosaic.matching.least_squares_matching import bspline_weights


def resampled_onto(
    image: Floats32, valid: Bools, cols: Floats, lines: Floats, wider: int
) -> tuple[Floats32, Bools]:
    """An image (n, w) resampled row by row: row i, col c is the image's row i + lines[i], col c + cols[i].

    By cubic B-splines; `wider` columns more on the right. Not valid within a pixel of what isn't.
    """
    n, w = image.shape
    row, row_weights = _taps(np.arange(n) + lines)
    col, col_weights = _taps(cols)
    coefficients = spline_filter1d(
        spline_filter1d(image, axis=0, output=np.float32), axis=1, output=np.float32
    )
    down = np.zeros((n, w), dtype=np.float32)
    sound = np.ones((n, w), dtype=bool)
    for k in range(4):
        at = row + k - 1
        down += row_weights[:, k, None] * coefficients[np.clip(at, 0, n - 1)]
        sound &= valid[np.clip(at, 0, n - 1)] & ((at >= 0) & (at < n))[:, None]
    out = np.zeros((n, w + wider), dtype=np.float32)
    out_valid = np.zeros((n, w + wider), dtype=bool)
    for shift in np.unique(col):
        here = np.flatnonzero(col == shift)
        begin, end = max(0, 1 - shift), min(w + wider, w - 2 - shift)
        if end <= begin:
            continue
        kept = np.ones((here.size, end - begin), dtype=bool)
        for k in range(4):
            part = slice(begin + shift + k - 1, end + shift + k - 1)
            out[here, begin:end] += col_weights[here, k, None] * down[here, part]
            kept &= sound[here, part]
        out_valid[here, begin:end] = kept
    return out, out_valid


def _taps(at: Floats) -> tuple[Ints64, Floats32]:
    """Whole parts (n,), and the weights (n, 4) of the nodes one before to two beyond them."""
    whole = np.floor(at).astype(np.int64)
    return whole, bspline_weights(at - whole)
