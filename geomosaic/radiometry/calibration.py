"""Recorded values into reflectance: the makers' sensor models in one linear form."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats32
from geomosaic.constants import sourced, tuned

REFLECTANCE_ONE = sourced(32768.0, "digital numbers", "that mean 1", "MicaSense, reflectance in 16 bits")
_MAPS_KEPT = tuned(4, "maps", "of vignetting in memory, 20 MB each; fewer compute again band by band")


@dataclass(frozen=True)
class Vignetting:
    """The fall of light towards a frame's corners.

    Without exponents it is 1 + c1 r + c2 r² + ..., r in px from `centre_px` (column and row, 0 is the first
    pixel's middle). With exponents (i, j), one for each coefficient, it is the sum of c (column / width)^i
    (row / height)^j. divides: whether values are divided by it (MicaSense, Parrot) or multiplied (DJI).
    """

    coefficients: tuple[float, ...]
    centre_px: tuple[float, float] = (0.0, 0.0)
    exponents: tuple[tuple[float, float], ...] = ()
    divides: bool = True

    def correction(self, width_px: int, height_px: int) -> Floats32:
        """What values (rows, cols) are multiplied by."""
        col, row = np.arange(width_px, dtype=np.float64), np.arange(height_px, dtype=np.float64)[:, None]
        if self.exponents:
            terms = zip(self.coefficients, self.exponents, strict=True)
            parts = [c * (col / width_px) ** i * (row / height_px) ** j for c, (i, j) in terms]
            light = np.sum(np.broadcast_arrays(*parts), axis=0)
        else:
            r = np.hypot(col - self.centre_px[0], row - self.centre_px[1])
            light = np.polyval([*self.coefficients[::-1], 1.0], r)
        light = np.broadcast_to(light, (height_px, width_px))
        return (1.0 / light if self.divides else light).astype(np.float32)


_correction = lru_cache(maxsize=_MAPS_KEPT)(Vignetting.correction)


@dataclass(frozen=True)
class Calibration:
    """reflectance = gain * V(column, row) * (value - black_level) / (1 + row_gradient_per_px * row).

    gain holds exposure, sensor gain, irradiance and what panels say; V is the vignetting's correction.
    """

    gain: float
    black_level: float
    row_gradient_per_px: float = 0.0
    vignetting: Vignetting | None = None

    def reflectance(self, values: NDArray[Any]) -> Floats32:
        """Of a frame's recorded values (rows, cols, bands)."""
        rows, cols = values.shape[:2]
        by_row = self.gain / (1.0 + self.row_gradient_per_px * np.arange(rows, dtype=np.float64))
        found = values.astype(np.float32)
        found -= np.float32(self.black_level)
        found *= by_row.astype(np.float32)[:, None, None]
        if self.vignetting is not None:
            found *= _correction(self.vignetting, cols, rows)[..., None]
        return found

    def digital(self, values: NDArray[Any]) -> NDArray[np.uint16]:
        """Reflectance as the mosaic keeps it: `REFLECTANCE_ONE` is 1, 0 to 2 can be written."""
        scaled = self.reflectance(values)
        scaled *= np.float32(REFLECTANCE_ONE)
        return np.rint(scaled.clip(0.0, np.iinfo(np.uint16).max, out=scaled)).astype(np.uint16)
