"""Seeded noise on the plane that any window can be cut from: integers hashed, lattices made smooth."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from geomosaic.arrays import Floats, Floats32, Ints64


def hashed(seed: int, salt: int, i: ArrayLike, j: ArrayLike = 0) -> Floats:
    """Numbers in [0, 1) that depend on nothing but seed, salt and the integers i, j (which broadcast).

    Two rounds of a multiply and xor-shift finaliser (Appleby's MurmurHash3 fmix32) over 32 bits.
    """
    i_32, j_32 = (np.asarray(np.asarray(a, dtype=np.int64) & 0xFFFFFFFF, dtype=np.uint64) for a in (i, j))
    key = (seed * 0x9E3779B1 + salt * 0x7FEB352D) & 0xFFFFFFFF
    h = (i_32 * np.uint64(0x85EBCA77) ^ np.uint64(key)) & np.uint64(0xFFFFFFFF)
    h = _mixed(h)
    h = (h ^ (j_32 * np.uint64(0xC2B2AE3D))) & np.uint64(0xFFFFFFFF)
    return np.asarray(_mixed(h) / 2.0**32)


def _mixed(h: NDArray[np.uint64]) -> NDArray[np.uint64]:
    low = np.uint64(0xFFFFFFFF)
    h = h ^ (h >> np.uint64(16))
    h = (h * np.uint64(0x85EBCA6B)) & low
    h = h ^ (h >> np.uint64(13))
    h = (h * np.uint64(0xC2B2AE35)) & low
    return h ^ (h >> np.uint64(16))


def lattice_noise(
    seed: int, salt: int, col: int, row: int, shape: tuple[int, int], spacing_px: int
) -> Floats32:
    """A window of smooth noise of about [-1, 1]: hashed values every spacing_px pixels, cubic between.

    Args: col, row: the window's first pixel on the endless plane; shape: rows and cols.
    """
    if spacing_px == 1:
        cols, rows = np.arange(col, col + shape[1]), np.arange(row, row + shape[0])
        return (hashed(seed, salt, cols[None, :], rows[:, None]) * 2.0 - 1.0).astype(np.float32)
    cols, first_col, col_weights = _cubic_weights(col, shape[1], spacing_px)
    rows, first_row, row_weights = _cubic_weights(row, shape[0], spacing_px)
    lattice = (hashed(seed, salt, cols[None, :], rows[:, None]) * 2.0 - 1.0).astype(np.float32)
    tall = np.zeros((shape[0], cols.size), dtype=np.float32)
    for k in range(4):
        tall += row_weights[k][:, None] * lattice[first_row + k]
    noise = np.zeros(shape, dtype=np.float32)
    for k in range(4):
        noise += col_weights[k] * tall[:, first_col + k]
    return noise


@lru_cache(maxsize=256)
def _cubic_weights(start: int, count: int, spacing_px: int) -> tuple[Ints64, Ints64, Floats32]:
    """Lattice indices that pixels start ... start + count need, and each pixel's first and four weights.

    The cubic convolution kernel of Keys 1981 with a = -0.5, at the pixels' centres. Not as a product of
    matrices: BLAS would keep every core busy with waiting.
    """
    first = start // spacing_px - 2
    indices = np.arange(first, (start + count) // spacing_px + 3)
    at = (np.arange(start, start + count) + 0.5) / spacing_px - 0.5
    left = np.floor(at).astype(np.int64) - 1
    d = np.abs(at - (left + np.arange(4)[:, None]))
    near = (1.5 * d - 2.5) * d * d + 1.0
    far = ((-0.5 * d + 2.5) * d - 4.0) * d + 2.0
    return indices, left - first, np.where(d < 1.0, near, np.where(d < 2.0, far, 0.0)).astype(np.float32)


def fractal_noise(
    seed: int, salt: int, col: int, row: int, shape: tuple[int, int], spacings_px: tuple[int, ...]
) -> Floats32:
    """Noise with equal power at each of the given scales, standard deviation about one."""
    total = np.zeros(shape, dtype=np.float32)
    for k, spacing in enumerate(spacings_px):
        total += lattice_noise(seed, salt * 64 + k, col, row, shape, spacing)
    return np.asarray(total * np.float32(2.1 / np.sqrt(len(spacings_px))), dtype=np.float32)


def spline_noise(seed: int, salt: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """Noise in (0, 1) at any points: uniform values at the integers, a cubic B-spline between (C2)."""
    x_at, y_at = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    x_0, y_0 = int(np.floor(x_at.min())) - 2, int(np.floor(y_at.min())) - 2
    xs, ys = np.arange(x_0, np.floor(x_at.max()) + 4), np.arange(y_0, np.floor(y_at.max()) + 4)
    lattice = hashed(seed, salt, xs[None, :], ys[:, None])
    at = np.stack([y_at.ravel() - y_0, x_at.ravel() - x_0])
    return np.asarray(map_coordinates(lattice, at, order=3, prefilter=False, mode="nearest")).reshape(
        x_at.shape
    )
