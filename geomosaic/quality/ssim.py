"""Structural similarity with its three terms (Wang, Bovik, Sheikh, Simoncelli 2004)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.constants import sourced

WINDOW_PX = sourced(11, "px", "side of its window; another gives other figures", "Wang et al. 2004")
_SIGMA_PX = sourced(1.5, "px", "deviation of its Gaussian weights", "Wang et al. 2004, section III")
_K = sourced((0.01, 0.03), "range", "of means and deviations: no division by 0", "Wang et al. 2004")


@dataclass(frozen=True)
class SsimMaps:
    """Per pixel, NaN where the window isn't wholly valid; ssim = luminance * contrast * structure."""

    ssim: Floats
    luminance: Floats
    contrast: Floats
    structure: Floats

    def cut(self, window: tuple[slice, slice]) -> SsimMaps:
        """The same maps of a part."""
        return SsimMaps(
            self.ssim[window], self.luminance[window], self.contrast[window], self.structure[window]
        )


@dataclass(frozen=True)
class SsimTerms:
    """Means of the maps over the pixels with a wholly valid window, `pixels` of them.

    gain and offset were applied to the image under test before; 1 and 0 where nothing was.
    """

    ssim: float
    luminance: float
    contrast: float
    structure: float
    pixels: int
    gain: float = 1.0
    offset: float = 0.0


def luma(bands: ArrayLike) -> Floats32:
    """One band of (bands, rows, cols): ITU-R BT.601 luma of the first three, or the first alone."""
    image = np.asarray(bands, dtype=np.float32)
    if len(image) < 3:
        return np.asarray(image[0])
    weights = np.array([0.299, 0.587, 0.114], dtype=np.float32)
    return np.asarray(np.tensordot(weights, image[:3], axes=1), dtype=np.float32)


def ssim_maps(image: ArrayLike, reference: ArrayLike, valid: Bools, data_range: float) -> SsimMaps:
    """SSIM of two single-band images on one grid.

    Window 11 x 11, Gaussian with sigma 1.5; K1 = 0.01, K2 = 0.03; C3 = C2 / 2, so that with variances
    `SSIM = (2 mx my + C1)(2 sxy + C2) / ((mx^2 + my^2 + C1)(sx^2 + sy^2 + C2))`.
    Equation 7 of Yue et al. 2021 prints sx + sy in the last factor, standard deviations unsquared, which
    would mix units; this is the standard form.

    Args: data_range is the span of possible values, 255 for 8 bits.
    """
    x, y = (np.where(valid, np.asarray(p, dtype=np.float64), 0.0) for p in (image, reference))
    c1, c2 = ((k * data_range) ** 2 for k in _K)
    mx, my = _window_mean(x), _window_mean(y)
    vx = np.maximum(_window_mean(x * x) - mx * mx, 0.0)
    vy = np.maximum(_window_mean(y * y) - my * my, 0.0)
    covariance = _window_mean(x * y) - mx * my
    spread = np.sqrt(vx * vy)
    luminance = (2.0 * mx * my + c1) / (mx * mx + my * my + c1)
    contrast = (2.0 * spread + c2) / (vx + vy + c2)
    structure = (covariance + c2 / 2.0) / (spread + c2 / 2.0)
    whole = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    inner = cv2.erode(valid.astype(np.uint8), whole, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    for term in (luminance, contrast, structure):
        term[inner == 0] = np.nan
    return SsimMaps(luminance * contrast * structure, luminance, contrast, structure)


def mean_terms(maps: SsimMaps, gain: float = 1.0, offset: float = 0.0) -> SsimTerms:
    """Means over the valid pixels; NaN where there are none."""
    good = np.isfinite(maps.ssim)
    count = int(good.sum())
    terms = (maps.ssim, maps.luminance, maps.contrast, maps.structure)
    ssim, light, contrast, structure = (float(t[good].mean()) if count else float("nan") for t in terms)
    return SsimTerms(ssim, light, contrast, structure, count, gain, offset)


def pooled(parts: list[SsimTerms]) -> SsimTerms:
    """The terms of several parts as one, weighted by their pixels."""
    parts = [p for p in parts if p.pixels]
    if not parts:
        nan = float("nan")
        return SsimTerms(nan, nan, nan, nan, 0)
    weights = [p.pixels for p in parts]
    rows = np.array([[p.ssim, p.luminance, p.contrast, p.structure] for p in parts])
    ssim, light, contrast, structure = map(float, np.average(rows, axis=0, weights=weights))
    return SsimTerms(ssim, light, contrast, structure, sum(weights), parts[0].gain, parts[0].offset)


def gain_and_offset(image: Floats, reference: Floats) -> tuple[float, float]:
    """What brings the image's mean and standard deviation to the reference's; arrays of valid pixels."""
    spread = float(image.std())
    gain = float(reference.std()) / spread if spread > 0.0 else 1.0
    return gain, float(reference.mean()) - gain * float(image.mean())


def _window_mean(image: Floats) -> Floats:
    return np.asarray(
        cv2.GaussianBlur(image, (WINDOW_PX, WINDOW_PX), _SIGMA_PX, borderType=cv2.BORDER_REFLECT_101)
    )
