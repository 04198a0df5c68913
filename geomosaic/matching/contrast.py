"""Local contrast of faint images, raised for matching only: the mosaic's pixels stay as they are."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Bytes, Floats, Floats32
from geomosaic.constants import FEW, sourced, tuned
from geomosaic.matching.features import SIFT_CONTRAST, away_from_invalid, shrunk

_LOWE_SIGMA_PX = sourced(1.6, "px", "scale of the first layer with keypoints", "Lowe 2004, section 3.3")
_TILES = tuned(4, "tiles", "per side, judged singly: fewer hide faint parts; more lack extrema")
_WINDOW_SHARE = tuned(0.05, "share", "of the side, local statistics: half and twice tie no more pairs")
_TARGET_SD = tuned(40.0, "grey levels", "local deviation to reach: more is clipped at black and white")
_MOST_NOISE = tuned(4.0, "grey levels", "amplified noise: 1 loses half of the tie points; more adds JPEG's")
_LEAST_NOISE: float = sourced(12.0**-0.5, "grey levels", "deviation of rounding to levels", "1 / sqrt(12)")
_NOISE_PER_MEAN = sourced(math.sqrt(math.pi / 2.0) / 6.0, "1", "noise per mean difference", "Immerkaer 1996")


def raised(
    image: Bytes, valid: Bytes | None, longest_px: int, levels: float | None = 1.0
) -> tuple[Bytes, float]:
    """An image with its faint tiles brought to a common local mean and deviation (Wallis 1976), and their
    share of all tiles.

    An image without a faint tile is returned as it is. Between faint tiles and others the change is gradual.

    Args: image (rows, cols); valid (rows, cols) is 0 where a pixel is not; longest_px: of the smaller image
        that keypoints are sought in and contrast is judged by; levels: as `stretched` gives them. Where they
        are not known, noise in the quietest tile tells: a camera's 8 bits hold about one level of it.
    """
    small, inside = shrunk(image, valid, longest_px)
    if levels is None:
        levels = max(1.0, _least_noise_sd(small, inside))
    faint = faint_tiles(small, inside, levels)
    if not faint.any():
        return image, 0.0
    share = cv2.resize(faint.astype(np.float32), small.shape[::-1], interpolation=cv2.INTER_LINEAR)
    mean, sd = _local(small.astype(np.float32), inside)
    gain = np.minimum(_TARGET_SD / np.maximum(sd, _LEAST_NOISE), _MOST_NOISE / noise_sd(small, inside))
    gain = 1.0 + share * (np.maximum(gain, 1.0) - 1.0)
    offset = share * 128.0 - (gain + share - 1.0) * mean
    size = image.shape[::-1]
    out = image * cv2.resize(gain, size) + cv2.resize(offset, size)
    return np.asarray(np.clip(np.rint(out), 0, 255).astype(np.uint8)), float(faint.mean())


def faint_tiles(image: Bytes, valid: Bytes | None, levels: float) -> Bools:
    """Which tiles (_TILES, _TILES) of an image are faint: hardly one of their local extremes reaches SIFT's
    contrast.

    Args: levels: of the image, that one of the picture's 8 bits was stretched to.
    """
    step = 2.0 ** (1.0 / 3.0)
    fine = cv2.GaussianBlur(image.astype(np.float32), (0, 0), _LOWE_SIGMA_PX)
    layer = cv2.GaussianBlur(fine, (0, 0), _LOWE_SIGMA_PX * (step**2 - 1.0) ** 0.5) - fine
    around = np.ones((3, 3), np.uint8)
    extreme = ((layer > 0) & (layer == cv2.dilate(layer, around))) | (
        (layer < 0) & (layer == cv2.erode(layer, around))
    )
    if valid is not None:
        extreme &= away_from_invalid(valid) > 0
    reached = extreme & (np.abs(layer) >= SIFT_CONTRAST / 3.0 * 255.0 * levels)
    return _tile_sums(reached) < FEW * _tile_sums(extreme)


def noise_sd(image: Bytes, valid: Bytes | None) -> float:
    """Standard deviation of an image's noise in grey levels (Immerkaer 1996); at least that of rounding."""
    size, inside = _second_differences(image, valid)
    return max(_LEAST_NOISE, _NOISE_PER_MEAN * float(size.sum()) / max(1, int(inside.sum())))


def _least_noise_sd(image: Bytes, valid: Bytes | None) -> float:
    """As `noise_sd`, of the tile with the least of it."""
    size, inside = _second_differences(image, valid)
    count = _tile_sums(inside)
    return _NOISE_PER_MEAN * float((_tile_sums(size)[count > 0] / count[count > 0]).min(initial=np.inf))


def _second_differences(image: Bytes, valid: Bytes | None) -> tuple[Floats32, Bools]:
    """Their size (rows, cols), 0 next to invalid pixels, and where it is known."""
    second = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    size = np.abs(cv2.filter2D(image.astype(np.float32), -1, second))
    inside = np.ones(image.shape, np.bool_) if valid is None else away_from_invalid(valid) > 0
    return (size * inside).astype(np.float32), inside


def _tile_sums(values: NDArray[Any]) -> Floats:
    rows, cols = (np.arange(_TILES) * side // _TILES for side in values.shape)
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0, dtype=np.float64), cols, axis=1)


def window_px(shape: tuple[int, ...]) -> int:
    """Side of the window of an image's local statistics, odd."""
    return 2 * max(1, round(0.5 * _WINDOW_SHARE * max(shape))) + 1


def _local(values: Floats32, valid: Bytes | None) -> tuple[Floats32, Floats32]:
    """Mean and standard deviation of the valid pixels about each pixel."""
    side = window_px(values.shape)
    weight = np.ones_like(values) if valid is None else (valid > 0).astype(np.float32)
    first, second, whole = (
        cv2.blur(v, (side, side), borderType=cv2.BORDER_REFLECT)
        for v in (values * weight, values * values * weight, weight)
    )
    mean = first / np.maximum(whole, 1e-6)
    sd = np.sqrt(np.maximum(second / np.maximum(whole, 1e-6) - mean * mean, 0.0))
    return mean.astype(np.float32), sd.astype(np.float32)
