"""Two surfaces of one place on one grid: by how much the one is higher, and what both differ by in common."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rasterio import Affine
from rasterio.enums import Resampling
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from geomosaic.arrays import Floats
from geomosaic.constants import NORMAL_PER_MAD, ROUNDS, SLIGHT, tuned
from geomosaic.doors.raster import OWN, Raster, open_raster, reading
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.quality.rasters import grown, within

_SAMPLE = tuned(250_000, "cells", "of a sample, 20 MB: fewer are less certain; more take memory")


@dataclass(frozen=True)
class CommonRise:
    """What two surfaces differ by in common. plane: offset and tilt (3,), see `SurfacePair`. scale: by which
    the deviations of the rest are multiplied. middle_m: the rise in the middle of the map."""

    plane: Floats
    scale: float
    middle_m: float


@dataclass(frozen=True)
class SurfacePair:
    """The new and the old surface and the deviations of both, on one grid, read by windows.

    A plane is an offset and two tilts (3,) in m, from the first row to the last and from the first column to
    the last. off_m: by which the maps lie apart, per axis.
    """

    rasters: tuple[Any, ...]
    cell_m: float
    off_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return self.rasters[0].height, self.rasters[0].width

    def beyond(self, common: CommonRise, window: Window) -> tuple[Floats, Floats]:
        """The rise (rows, cols) in m without the common one, and the same in deviations; NaN unknown."""
        rise_m, sd_m = self._rise_and_sd(window)
        left_m = rise_m - self._design(window) @ common.plane
        return left_m, left_m / np.maximum(sd_m, SLIGHT) / common.scale

    def common_rise(self, windows: Sequence[Window]) -> CommonRise | None:
        """What most cells of a thinned sample differ by; None where nothing is known. windows: all."""
        step = max(1, math.ceil(math.sqrt(math.prod(self.shape) / _SAMPLE)))
        parts = []
        for window in windows:
            thin = tuple(slice(-first % step, None, step) for first in (window.row_off, window.col_off))
            rise_m, sd_m = (of[thin].ravel() for of in self._rise_and_sd(window))
            known = np.isfinite(rise_m)
            parts.append((self._design(window)[thin].reshape(-1, 3)[known], rise_m[known], sd_m[known]))
        design, rise_m, sd_m = (np.concatenate(of) for of in zip(*parts, strict=True))
        if not np.isfinite(sd_m).any():
            return None
        plane = _plane(design, rise_m)
        z = np.abs(rise_m - design @ plane) / np.maximum(sd_m, SLIGHT)
        scale = max(1.0, NORMAL_PER_MAD * float(np.nanmedian(z)))
        return CommonRise(plane, scale, float(plane @ [1.0, *(-0.5 / n for n in self.shape)]))

    def _rise_and_sd(self, window: Window) -> tuple[Floats, Floats]:
        """The new height minus the old one (rows, cols), and the deviation of that, in m; NaN unknown."""
        outer = grown(window, 1, *self.shape)
        after, before, *sd = (_read(raster, outer) for raster in self.rasters)
        slope = np.maximum(*(np.hypot(*np.gradient(h, self.cell_m)) for h in (after, before)))
        sd_m = np.sqrt(np.square(sd[0]) + np.square(sd[1]) + np.square(np.nan_to_num(slope) * self.off_m))
        inner = within(window, outer)
        return (after - before)[inner], sd_m[inner]

    def _design(self, window: Window) -> Floats:
        """What a plane is multiplied by (rows, cols, 3)."""
        rows, cols = (
            (first + np.arange(size)) / of - 0.5
            for first, size, of in zip(
                (window.row_off, window.col_off), (window.height, window.width), self.shape, strict=True
            )
        )
        return np.stack(np.broadcast_arrays(1.0, rows[:, None], cols), axis=-1)


@contextmanager
def on_surface(surface: Raster, path: Path, transform: Affine) -> Iterator[WarpedVRT]:
    """Another raster (bilinear) on a surface's grid, or another of its size."""
    with open_raster(path, OWN) as other, WarpedVRT(
        other, crs=surface.crs, transform=transform, width=surface.width, height=surface.height,
        resampling=Resampling.bilinear, nodata=other.nodata,
    ) as there:  # fmt: skip
        yield there


def _read(raster: Any, window: Window) -> Floats:
    with reading(Path(raster.name)):
        values = raster.read(1, window=window, masked=True)
    return np.asarray(values.filled(np.nan), dtype=np.float64)


def _plane(design: Floats, rise_m: Floats) -> Floats:
    """The plane (3,) of most of the rises (n,), of which there is one at least."""
    found = np.array([float(np.median(rise_m)), 0.0, 0.0])
    for _ in range(ROUNDS):
        left = np.abs(rise_m - design @ found)
        kept = left <= THREE_SIGMA * max(NORMAL_PER_MAD * float(np.median(left)), SLIGHT)
        if kept.sum() < len(found):
            break
        found = least_squares(design[kept], rise_m[kept])
    return found
