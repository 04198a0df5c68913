"""Pixels of strips: whole numbers as they are, calibrated or negative ones as greys by one straight line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools
from geomosaic.constants import sourced, tuned
from geomosaic.doors.raster import STRIP, Raster, open_raster
from geomosaic.errors import InputError

_PERCENTILES = tuned((0.01, 99.99), "%", "of values, in the greys' middle half; wider: hot pixels decide")
_MARGIN = tuned(0.5, "ratio", "of their range, on each side: less cuts highlights; more coarsens the greys")
_SPECIAL = sourced(1e30, "any unit", "larger values are flags", "ISIS, special pixels: 3.4e38")


@dataclass(frozen=True)
class GreyScale:
    """Grey g stands for the value `offset + scale * g`; grey 0 is a missing value.

    nodata: of the file, None where only values that are no measurements are missing. highest: grey; values
    beyond it are cut off.
    """

    offset: float
    scale: float
    nodata: float | None
    highest: int

    def greys(self, values: NDArray[Any]) -> NDArray[np.uint16]:
        """Values in greys from 1 to `highest`, 0 where missing."""
        with np.errstate(invalid="ignore", over="ignore"):
            scaled = np.rint((values.astype(np.float64) - self.offset) / self.scale)
            cut = np.clip(scaled, 1.0, self.highest)
        return np.where(measured(values, self.nodata), cut, 0.0).astype(np.uint16)


def grey_scale(samples: Sequence[NDArray[Any]], nodata: float | None, bit_depth: int) -> GreyScale:
    """The scale common to strips by samples of their values.

    The range from the 0.01st to the 99.99th percentile takes half of the greys, in their middle.
    Raises: `InputError` where the samples hold no value, or one alone.
    """
    values = np.concatenate([of[measured(of, nodata)] for of in samples]).astype(np.float64)
    low, high = np.percentile(values, _PERCENTILES) if values.size else (0.0, 0.0)
    if not low < high:
        problem = "the strips hold no values" if not values.size else f"all values of the strips are {low:g}"
        raise InputError(problem, fix="give strips with images, or correct 'nodata' in the geometry file")
    highest, margin = 2**bit_depth - 1, _MARGIN * (high - low)
    scale = (high - low + 2.0 * margin) / (highest - 1)
    return GreyScale(float(low - margin - scale), float(scale), nodata, highest)


def signed_scale(nodata: float | None, bit_depth: int) -> GreyScale:
    """The scale of int16 strips with negative values: from -2^bit_depth on, a grey for each value."""
    return GreyScale(-(2.0**bit_depth), 1.0, nodata, 2 ** (bit_depth + 1) - 1)


def measured(values: NDArray[Any], nodata: float | None) -> Bools:
    """Which values are measurements: finite, no flags, not the file's nodata."""
    with np.errstate(invalid="ignore"):
        found = np.asarray(np.abs(values) < _SPECIAL)
    return found if nodata is None else found & (values != np.float32(nodata))


class ScaledStrip:
    """A strip of float32 or int16 that reads as greys: the part of rasterio's dataset that is used."""

    dtypes = ("uint16",)

    def __init__(self, raster: Raster, scale: GreyScale) -> None:
        self._raster, self._scale = raster, scale
        self.width, self.height = raster.width, raster.height

    def read(self, band: int, **where: Any) -> NDArray[np.uint16]:
        """As rasterio's, in greys."""
        return self._scale.greys(self._raster.read(band, **where))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._raster.close()


def open_strip(path: Path, scale: GreyScale | None) -> Raster | ScaledStrip:
    """A strip to read greys from. Raises: `FileError` as `open_raster` does."""
    raster = open_raster(path, STRIP)
    return raster if scale is None else ScaledStrip(raster, scale)
