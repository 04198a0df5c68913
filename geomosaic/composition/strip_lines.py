"""A strip's lines in their order: each read once, what the next block needs carried over."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window

from geomosaic.arrays import Bools, Floats32
from geomosaic.errors import FileError


@dataclass(frozen=True, eq=False)
class LineBlock:
    """Lines of a strip from line `first` on, ready to be resampled.

    pixels: (n, width) on the scale all CCDs share; invalid ones near valid ones hold the mean of those, so
    that no kernel brings nodata in. valid: (n, width), None where all are.
    """

    first: int
    pixels: Floats32
    valid: Bools | None


@dataclass(frozen=True)
class StripGreys:
    """What a strip's counts mean: `gain * counts + offset` are greys. nodata: the counts of an invalid pixel,
    if any; highest: of a saturated one, which stays saturated."""

    nodata: float | None
    highest: int
    gain: float = 1.0
    offset: float = 0.0


class StripLines:
    """An open strip (a rasterio dataset). radius_px: of the kernel to come. lines_read: how many lines came
    off the disk.
    """

    def __init__(self, strip: Any, path: Path, greys: StripGreys, radius_px: int) -> None:
        self.count: int = strip.height
        self.width_px: int = strip.width
        self.lines_read = 0
        self._strip, self._path = strip, path
        self._greys, self._radius = greys, radius_px
        self._first = 0
        self._kept: NDArray[Any] = np.empty((0, strip.width), dtype=strip.dtypes[0])

    def between(self, first: float, last: float) -> LineBlock | None:
        """The lines that kernels at lines `first` to `last` need, those before them forgotten; None if none.

        Raises: `FileError` if the strip can't be read.
        """
        reach = 2 * self._radius + 1
        start = int(np.clip(np.floor(first) - reach, 0, self.count))
        stop = int(np.clip(np.ceil(last) + reach, 0, self.count))
        if start >= stop:
            return None
        end = self._first + len(self._kept)
        if not self._first <= start <= end:
            self._kept, end = self._kept[:0], start
        else:
            self._kept = self._kept[start - self._first :]
        self._first = start
        if stop > end:
            self._kept = np.concatenate([self._kept, self._read(end, stop)])
        return self._ready(start, self._kept[: stop - start])

    def _read(self, start: int, stop: int) -> NDArray[Any]:
        try:
            found = self._strip.read(1, window=Window(0, start, self.width_px, stop - start))
        except (RasterioError, ValueError, OSError) as error:
            raise FileError(
                f"can't be read: {error}", file=self._path, fix="copy it again, then run once more"
            ) from error
        self.lines_read += stop - start
        return np.asarray(found)

    def _ready(self, first: int, counts: NDArray[Any]) -> LineBlock:
        pixels, greys = counts.astype(np.float32), self._greys
        valid = None
        if greys.nodata is not None:
            valid = counts != greys.nodata
            if valid.all():
                valid = None
            else:
                _fill(pixels, valid, self._radius)
        if (greys.gain, greys.offset) != (1.0, 0.0):
            pixels *= np.float32(greys.gain)
            pixels += np.float32(greys.offset)
            saturated = counts >= greys.highest
            if saturated.any():
                pixels[saturated if valid is None else saturated & valid] = greys.highest
        return LineBlock(first, pixels, valid)


def _fill(pixels: Floats32, valid: Bools, radius_px: int) -> None:
    """Invalid pixels get the mean of the valid ones within radius_px."""
    size = (2 * radius_px + 1, 2 * radius_px + 1)
    pixels[~valid] = 0.0
    border = cv2.BORDER_CONSTANT
    total = cv2.boxFilter(pixels, cv2.CV_32F, size, normalize=False, borderType=border)
    seen = cv2.boxFilter(valid.astype(np.float32), cv2.CV_32F, size, normalize=False, borderType=border)
    np.divide(total, seen, out=pixels, where=~valid & (seen > 0.5))
