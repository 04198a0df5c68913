"""A strip's pixels between its pixels: down the lines first, then across, by a few taps each.

The displacement of a strip against the scene is nearly the same for many columns. So there is one set of
weights for each row and stretch of columns, not one for each pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from geomosaic.arrays import Floats, Floats32
from geomosaic.constants import tuned
from geomosaic.projection.resample import KERNEL_RADIUS_PX

_STEPS = tuned(256, "steps per px", "of tabled weights, 0.002 off: fewer show; more take memory")


def _bilinear(t: Floats) -> Floats:
    return np.asarray(1.0 - t)


def _cubic(t: Floats) -> Floats:
    """Keys 1981 with a = -0.75, as OpenCV's."""
    a = -0.75
    near = ((a + 2.0) * t - (a + 3.0)) * t * t + 1.0
    return np.asarray(np.where(t <= 1.0, near, ((a * t - 5.0 * a) * t + 8.0 * a) * t - 4.0 * a))


def _lanczos(t: Floats) -> Floats:
    return np.asarray(np.sinc(t) * np.sinc(t / KERNEL_RADIUS_PX["lanczos"]))


_KERNELS: Final[dict[str, Callable[[Floats], Floats]]] = {
    "bilinear": _bilinear,
    "cubic": _cubic,
    "lanczos": _lanczos,
}
"""Weights at distances in px, not beyond the kernel's radius, of `projection.resample.RESAMPLING`."""


def between(pixels: Floats32, down: Floats, across: Floats, stretch: int, resampling: str) -> Floats32:
    """Pixels (rows, stretches * stretch) between an image's; beyond its edges these go on.

    Args: down, across (rows, stretches): shifts in px. The image shows what pixel (r, c) of the result shows
    so far below and right of its own pixel (r, c). The values are the same for `stretch` columns of a row.
    """
    rows, many = down.shape
    top, by_row = _weights(down, resampling)
    left, by_col = _weights(across, resampling)
    high, wide = by_row.shape[-1] - 1, by_col.shape[-1] - 1
    part = _part(pixels, top, left, rows + high, many * stretch + wide)
    given = sliding_window_view(part, stretch + wide, axis=1)[:, ::stretch]
    # Row r of a matrix has its weights from column r on: one multiplication for all rows of a stretch.
    matrix = np.zeros((many, rows, rows + high + 1), dtype=np.float32)
    matrix[..., : high + 1] = by_row.transpose(1, 0, 2)
    matrix = matrix.reshape(many, -1)[:, : rows * (rows + high)].reshape(many, rows, rows + high)
    moved = np.matmul(matrix, given.transpose(1, 0, 2)).transpose(1, 0, 2)
    out = by_col[..., :1] * moved[..., :stretch]
    term = np.empty_like(out)
    for k in range(1, wide + 1):
        np.multiply(by_col[..., k : k + 1], moved[..., k : k + stretch], out=term)
        out += term
    return np.asarray(out.reshape(rows, -1))


def _weights(shift: Floats, resampling: str) -> tuple[int, Floats32]:
    """The pixel, counted from the one that is asked for, of the first weight; weights (..., taps)."""
    least = int(np.floor(shift.min()))
    step = np.rint((shift - least) * _STEPS).astype(np.intp)
    table = _table(resampling, int(step.max()) // _STEPS)
    return least + 1 - KERNEL_RADIUS_PX[resampling], table[step]


@lru_cache(maxsize=64)
def _table(resampling: str, spread: int) -> Floats32:
    """Weights (steps, taps) of shifts of 0 to spread + 1 px; they sum to 1."""
    radius = KERNEL_RADIUS_PX[resampling]
    shift = np.arange(_STEPS * (spread + 1)) / _STEPS
    distance = np.abs(np.arange(1 - radius, radius + spread + 1) - shift[:, None])
    weights = np.where(distance < radius, _KERNELS[resampling](np.minimum(distance, radius)), 0.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=np.float32)


def _part(pixels: Floats32, top: int, left: int, rows: int, cols: int) -> Floats32:
    """Part of an image, repeating its edges beyond them."""
    height, width = pixels.shape
    if min(top, left) >= 0 and top + rows <= height and left + cols <= width:
        return pixels[top : top + rows, left : left + cols]
    row = np.clip(np.arange(top, top + rows), 0, height - 1)
    col = np.clip(np.arange(left, left + cols), 0, width - 1)
    return pixels[row[:, None], col]
