"""Which bands of a mosaic other programs show as colours, and what becomes black and white in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.quality.rasters import colour_bands

_PERCENTILES: Final = (1.0, 99.0)


@dataclass(frozen=True)
class ShownBands:
    """bands: red, green, blue, or one grey. limits: of each band what becomes 0 and 255; none of 8 bits."""

    bands: list[int]
    limits: tuple[tuple[float, float], ...] = ()

    def eight_bits(self, values: NDArray[Any]) -> Bytes:
        """Values (bands, rows, cols) as they are shown."""
        if not self.limits:
            return np.asarray(values, np.uint8)
        low, high = (np.array(of, np.float32)[:, None, None] for of in zip(*self.limits, strict=True))
        grey = (values - low) * (255.0 / (high - low))
        return np.nan_to_num(np.clip(np.round(grey), 0.0, 255.0)).astype(np.uint8)


def shown_bands(mosaic_file: Path) -> ShownBands:
    """Red, green and blue, or the only band; more than 8 bits from the 1st to the 99th percentile."""
    with open_raster(mosaic_file, OWN) as tiff:
        bands = colour_bands(tiff)
        if tiff.dtypes[0] == "uint8":
            return ShownBands(bands)
        reduction = max(1, max(tiff.shape) // 1000)
        shape = (len(bands), -(-tiff.height // reduction), -(-tiff.width // reduction))
        seen = tiff.read(bands, out_shape=shape, masked=True)
    limits = []
    for band in seen:
        valid = band.compressed()
        low, high = (float(v) for v in np.percentile(valid, _PERCENTILES)) if valid.size else (0.0, 1.0)
        next_float = float(np.nextafter(np.float32(low), np.float32(np.inf)))
        limits.append((low, max(high, low + 1e-9, next_float)))
    return ShownBands(bands, tuple(limits))
