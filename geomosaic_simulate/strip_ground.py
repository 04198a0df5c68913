"""What strips look at: the ground's brightness and the clouds, in any window of the scene's map.

World columns are x / pixel and world rows -y / pixel of the map, so that they run as columns and lines do.
Brightness is a cubic B-spline over one coefficient a pixel, the coefficient of pixel i standing at i + 0.5:
a continuous surface that every CCD samples without further interpolation. The spline's kernel (sd 0.58 px)
is the camera's point spread. Relative brightness 1 is the plan's mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rasterio.enums import Resampling
from scipy.ndimage import map_coordinates

from geomosaic.arrays import Floats, Floats32, Ints64
from geomosaic.doors.raster import REFERENCE, open_raster, reading
from geomosaic_simulate.noise import fractal_noise, hashed, lattice_noise, spline_noise
from geomosaic_simulate.strip_plan import StripPlan

CLOUD_CELL_PX = 4
_MARGIN_PX = 4
_STEP_PX = 16
_SCALES_PX = (1, 2, 5, 14, 50, 180)
_FIELD_PX = 48.0
_WAY_PX = 2.5
_FAINTEST = 0.02
_MOST_PX = 12000
_PATCH_PX = (3000.0, 900.0)  # stretches of low contrast or glare, across and along
_TARGET_SD_PX = 1.0
_TARGET_BRIGHTNESS = 1.5


@dataclass(frozen=True, eq=False)
class PatternWindow:
    """Coefficients of a window of the world whose first one is (col, row)."""

    values: Floats32
    col: int
    row: int
    cell_px: int = 1

    def at(self, places: Floats) -> Floats32:
        """The spline at world columns and rows (2, ...), corner origin, all inside the window."""
        col, row = places.reshape(2, -1) / self.cell_px
        at = np.stack([row - (self.row + 0.5), col - (self.col + 0.5)])
        found = map_coordinates(self.values, at, order=3, prefilter=False, output=np.float32)
        return np.asarray(found.reshape(places.shape[1:]))


def window_of(*places: Floats, cell_px: int = 1) -> tuple[int, int, tuple[int, int]]:
    """First column and row, and the shape, of the cells that a spline at places (2, ...) needs."""
    low = np.min([p.reshape(2, -1).min(axis=1) for p in places], axis=0) / cell_px
    high = np.max([p.reshape(2, -1).max(axis=1) for p in places], axis=0) / cell_px
    col, row = (int(v) for v in np.floor(low) - _MARGIN_PX)
    last_col, last_row = (int(v) for v in np.ceil(high) + _MARGIN_PX)
    return col, row, (last_row - row, last_col - col)


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of the world that together cover a share of some places of it."""

    seed: int
    salt: int
    threshold: float

    @classmethod
    def covering(cls, seed: int, salt: int, share: float, cols: Floats, rows: Floats) -> Patches:
        """Patches over a share of the places (n,)."""
        field = spline_noise(seed, salt, cols / _PATCH_PX[0], rows / _PATCH_PX[1])
        return cls(seed, salt, float(np.quantile(field, share)) if share > 0.0 else -1.0)

    def amount(self, col: int, row: int, shape: tuple[int, int]) -> Floats32:
        """1 inside, 0 outside, in a window; soft edges of some tens of pixels."""
        if self.threshold < 0.0:
            return np.zeros(shape, dtype=np.float32)
        col_0, row_0 = col // _STEP_PX, row // _STEP_PX
        cols = (np.arange(shape[1] // _STEP_PX + 3) + col_0) * _STEP_PX
        rows = (np.arange(shape[0] // _STEP_PX + 3) + row_0) * _STEP_PX
        field = spline_noise(self.seed, self.salt, cols[None, :] / _PATCH_PX[0], rows[:, None] / _PATCH_PX[1])
        inside = 1.0 / (1.0 + np.exp(np.clip((field - self.threshold) / 0.004, -40.0, 40.0)))
        for axis, first in ((0, row - row_0 * _STEP_PX), (1, col - col_0 * _STEP_PX)):
            step, part = np.divmod(np.arange(shape[axis]) + first, _STEP_PX)
            weight = np.expand_dims(part / _STEP_PX, 1 - axis)
            inside = np.take(inside, step, axis) * (1.0 - weight) + np.take(inside, step + 1, axis) * weight
        return np.asarray(inside, dtype=np.float32)


class StripGround:
    """The ground's relative brightness: its pattern times the contrast, glare, and point targets.

    overlap_cols, overlap_rows (n,): places on the overlaps, of which the plan's shares are meant.
    targets: (n, 2) world columns and rows.
    """

    def __init__(
        self, plan: StripPlan, overlap_cols: Floats, overlap_rows: Floats, targets: Floats | None = None
    ) -> None:
        self._plan = plan
        places = overlap_cols, overlap_rows
        self._faint = Patches.covering(plan.seed, 71, plan.low_contrast_share, *places)
        self._glare = Patches.covering(plan.seed, 72, plan.saturated_share, *places)
        self._targets = np.empty((0, 2)) if targets is None else targets
        self._image = None if plan.texture is None else _read_image(plan.texture)
        sample = PatternWindow(self._pattern(0, 0, (600, 600)), 0, 0)
        seen = sample.at(np.mgrid[8:590, 8:590] + 0.5)
        self._mean, self._per_sd = float(seen.mean()), 1.0 / max(float(seen.std()), 1e-6)
        if self._image is None:
            self._mean = 0.0

    def window(self, col: int, row: int, shape: tuple[int, int]) -> PatternWindow:
        """Coefficients of a window of the world."""
        plan = self._plan
        contrast = np.full((1, 1), plan.contrast, dtype=np.float32)
        if plan.low_contrast_share > 0.0:
            ratio = np.float32(max(plan.low_contrast, 1e-6) / max(plan.contrast, 1e-6))
            contrast = contrast * ratio ** self._faint.amount(col, row, shape)
        tone = (self._pattern(col, row, shape) - np.float32(self._mean)) * np.float32(self._per_sd)
        values = np.maximum(np.float32(1.0) + contrast * tone, np.float32(_FAINTEST))
        if plan.saturated_share > 0.0:
            values *= 1.0 + np.float32(4.0) * self._glare.amount(col, row, shape)
        for at_col, at_row in self._targets:
            _add_target(values, at_col - col - 0.5, at_row - row - 0.5)
        return PatternWindow(values, col, row)

    def _pattern(self, col: int, row: int, shape: tuple[int, int]) -> Floats32:
        if self._image is not None:
            cols, rows = (
                _mirrored(np.arange(first, first + n), size)
                for first, n, size in zip((col, row), shape[::-1], self._image.shape[::-1], strict=True)
            )
            return np.asarray(self._image[np.ix_(rows, cols)])
        seed = self._plan.seed
        tone = fractal_noise(seed, 60, col, row, shape, _SCALES_PX)
        tone += 0.9 * _fields(seed, col, row, shape)
        return tone


def _fields(seed: int, col: int, row: int, shape: tuple[int, int]) -> Floats32:
    """Parcels of one tone each, with lighter ways between some of them."""
    bend_u = lattice_noise(seed, 61, col, row, shape, 120)
    bend_v = lattice_noise(seed, 62, col, row, shape, 120)
    x, y = np.arange(col, col + shape[1]) + 0.5, (np.arange(row, row + shape[0]) + 0.5)[:, None]
    u = ((0.94 * x + 0.34 * y) / _FIELD_PX).astype(np.float32) + np.float32(0.5) * bend_u
    v = ((0.94 * y - 0.34 * x) / (1.7 * _FIELD_PX)).astype(np.float32) + np.float32(0.4) * bend_v
    cell_u, cell_v = np.floor(u).astype(np.int32), np.floor(v).astype(np.int32)
    first_u, first_v = int(cell_u.min()), int(cell_v.min())
    cells_u, cells_v = np.arange(first_u, cell_u.max() + 1), np.arange(first_v, cell_v.max() + 1)
    tones = (hashed(seed, 63, cells_u[None, :], cells_v[:, None]) * 3.4 - 1.7).astype(np.float32)
    tone = tones[cell_v - first_v, cell_u - first_u]
    tone[(u - cell_u < _WAY_PX / _FIELD_PX) & (cell_u & 1 == 0)] = 1.9
    return np.asarray(tone)


def _mirrored(index: Ints64, size: int) -> Ints64:
    folded = index % (2 * size)
    return np.asarray(np.where(folded < size, folded, 2 * size - 1 - folded))


def _read_image(path: Path) -> Floats32:
    """A raster's mean over bands; it is placed on the world pixel on pixel, mirrored at its edges."""
    with open_raster(path, REFERENCE) as source, reading(path):
        step = max(1.0, max(source.width, source.height) / _MOST_PX)
        shape = (source.count, max(int(source.height / step), 1), max(int(source.width / step), 1))
        bands = source.read(out_shape=shape, resampling=Resampling.average)
    return np.asarray(bands.mean(axis=0), dtype=np.float32)


def _add_target(values: Floats32, col: float, row: float) -> None:
    """A bright point at (col, row) of the coefficients' own grid (in place)."""
    reach = int(6 * _TARGET_SD_PX) + 1
    c_0, r_0 = max(int(col) - reach, 0), max(int(row) - reach, 0)
    part = values[r_0 : max(int(row) + reach + 1, 0), c_0 : max(int(col) + reach + 1, 0)]
    rows, cols = np.ogrid[r_0 : r_0 + part.shape[0], c_0 : c_0 + part.shape[1]]
    away = (rows - row) ** 2 + (cols - col) ** 2
    part += (_TARGET_BRIGHTNESS * np.exp(-away / (2.0 * _TARGET_SD_PX**2))).astype(np.float32)


class Clouds:
    """One deck of clouds at one height: how thick it is, in any window of its own plane.

    Thickness below 0 is clear; cells of CLOUD_CELL_PX pixels; overlap places as in `StripGround`, on each of
    which a cell is asked whether it is cloudy.
    """

    def __init__(self, plan: StripPlan, overlap_cols: Floats, overlap_rows: Floats) -> None:
        self._seed = plan.seed
        largest = max(int(plan.cloud_size_m / plan.ground_pixel_m / CLOUD_CELL_PX / 2.0), 2)
        self._scales = tuple(max(int(largest / 2.0**k), 1) for k in range(9) if largest / 2.0**k >= 1.0)
        cells = np.unique(
            np.floor(np.stack([overlap_cols, overlap_rows]) / CLOUD_CELL_PX).astype(int), axis=1
        )
        field = []
        for col in np.unique(cells[0]):
            rows = cells[1, cells[0] == col]
            column = self._field(int(col), int(rows.min()), (int(np.ptp(rows)) + 1, 1))
            field.append(column[rows - rows.min(), 0])
        self._threshold = float(np.quantile(np.concatenate(field), 1.0 - plan.cloud_cover))

    def _field(self, col: int, row: int, shape: tuple[int, int]) -> Floats32:
        total = np.zeros(shape, dtype=np.float32)
        for k, spacing in enumerate(self._scales):
            share = np.float32((spacing / self._scales[0]) ** 0.7)
            total += share * lattice_noise(self._seed, 80 + k, col, row, shape, spacing)
        return total

    def window(self, col: int, row: int, shape: tuple[int, int]) -> PatternWindow:
        """Thickness coefficients of a window of cells of the deck's plane."""
        return PatternWindow(
            self._field(col, row, shape) - np.float32(self._threshold), col, row, CLOUD_CELL_PX
        )


def cloud_cover(thickness: Floats32) -> Floats32:
    """How much of the ground's light a cloud keeps off, 0 to 1; half at its edge."""
    part = np.clip(0.5 + thickness / np.float32(0.12), 0.0, 1.0)
    return np.asarray(part * part * (3.0 - 2.0 * part), dtype=np.float32)


def cloud_brightness(thickness: Floats32) -> Floats32:
    """Brightness of a cloud, of full scale."""
    return np.asarray(0.9 - 0.35 * np.exp(-np.maximum(thickness, 0.0) / np.float32(0.4)), dtype=np.float32)
