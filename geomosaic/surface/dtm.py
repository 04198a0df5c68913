"""The land under houses and trees: a ground model of a surface that shows their tops.

This is the progressive morphological filter (Zhang et al. 2003, A progressive morphological filter for
removing nonground measurements from airborne lidar data, IEEE TGRS 41, 4). The surface is opened by ever
larger windows, and what falls by more than a slope allows from one to the next stands on the ground. As in
the simple morphological filter (Pingel, Clarke and McBride 2013, ISPRS Journal 77) it works on low squares of
a metre. Cells are judged by the ground between those. The filter runs twice: first with what the steepest
land allows, then strictly, with the hills of the first time taken off.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from geomosaic.arrays import Bools, Floats32
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.model import DenseSurface

TERRAIN: Final = "terrain"
"""The kind of ground that such a model is."""
WIDEST_M = sourced(50.0, "m", "widest object; more cuts hilltops", "Pingel et al. 2013, 3.1: 36; halls: more")
_SQUARE_M = sourced(1.0, "m", "larger loses lanes; smaller shows noise and rims", "Pingel et al. 2013, 3.1")
_LOW = tuned(0.25, "share", "quantile that stands for a square: lower takes blunders for ground; 0.5 shrubs")
_SLOPES = tuned((0.5, 0.2), "m per m", "by pass: 0.2 alone cuts steep hills, 0.5 alone keeps leaves in woods")
_STEP_M = sourced(0.2, "m", "rise besides slope: less loses rough land", "Zhang et al. 2003, table 2")
_MOST_NOISE_CELLS = tuned(0.3, "cells", "most noise of heights: more keeps crowns in woods; less loses land")
_HILLS_M = tuned(10.0, "m", "Gaussian that makes hills: narrower keeps objects; wider leaves hillsides")
_EVENED = tuned(30, "rounds", "smoothing passes a level: fewer show coarse squares; more change nothing")
_BEND = tuned(0.008, "1 / m", "curvature of unseen land: 68 % within 0.08 m at 5 to 8 m, 0.28 at 12 to 20")
_CROSS: Final = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
_SQUARE: Final = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
_NEIGHBOURS: Final = _CROSS.astype(np.float32) / _CROSS.sum()


@dataclass(frozen=True)
class TerrainModel:
    """The ground, (rows, cols) each, from the south up, on the cells of a surface: up_m in the work frame;
    sd_m, its deviation (m), NaN where none is known; seen: where the surface showed it, elsewhere it is
    interpolated."""

    cells: Cells
    up_m: Floats32
    sd_m: Floats32
    seen: Bools

    def share_of(self, surface: DenseSurface) -> float:
        """Of a surface's matched cells, those that show the ground."""
        matched = surface.views > 0
        return float(self.seen[matched].mean()) if matched.any() else 0.0

    def ground(self) -> GroundSurface:
        """As what rays are projected on: a node in each cell's middle."""
        east, north = self.cells.axes_m()
        return GroundSurface(
            TERRAIN, float(east[0]), float(north[0]), self.cells.cell_m, self.up_m, self.sd_m
        )


def terrain_model(surface: DenseSurface, widest_m: float = WIDEST_M) -> TerrainModel:
    """The ground below what is up to widest_m wide, as far as what was matched shows it; the surface's own
    heights where no cell is ground.

    Half a second and 35 MB a million cells.
    """
    cell_m = surface.cells.cell_m
    matched = surface.views > 0
    squares = _Squares(surface.up_m.shape, max(1, round(_SQUARE_M / cell_m)))
    noise_m = THREE_SIGMA * min(_noise_m(surface.up_m, matched, squares.by), _MOST_NOISE_CELLS * cell_m)
    low_m, square_m = squares.low(surface.up_m), cell_m * squares.by
    hills_m = np.zeros_like(low_m)
    for slope in _SLOPES:
        standing = _standing(low_m - hills_m, square_m, widest_m / 2.0, slope, noise_m / squares.by)
        known = ~_dilated(standing, 1)
        ground_m = hills_m + filled(low_m - hills_m, known)
        hills_m = _smoothed(ground_m, _HILLS_M / square_m)
    ground = _is_ground(surface.up_m, squares.between(_continued(ground_m, 1), 1), cell_m, noise_m)
    ground &= known.any()
    return _interpolated(surface, ground, ground & matched)


def _noise_m(up_m: Floats32, matched: Bools, apart: int) -> float:
    """The deviation of matched heights from even land, 0 where none are known. It is by the median second
    difference of cells that lie so many cells apart: slopes do not count, edges are outliers."""
    bends = []
    for heights, known in ((up_m, matched), (up_m.T, matched.T)):
        low, middle, high = (slice(k * apart, len(heights) - (2 - k) * apart) for k in range(3))
        bend = heights[low] + heights[high] - 2.0 * heights[middle]
        bends.append(np.abs(bend[known[low] & known[middle] & known[high]]))
    bend = np.concatenate(bends)
    return float(NORMAL_PER_MAD * np.median(bend) / np.sqrt(6.0)) if bend.size else 0.0


def _is_ground(up_m: Floats32, about_m: Floats32, cell_m: float, noise_m: float) -> Bools:
    """Where heights are those of the ground around squares, and no rim of what stands."""
    slope_of = np.hypot(*np.gradient(about_m, cell_m)) if min(about_m.shape) > 1 else np.zeros_like(about_m)
    may_miss_m = max(_STEP_M, noise_m) + _SQUARE_M / 2.0 * slope_of
    del slope_of
    over_m = up_m - about_m
    high = cv2.morphologyEx((over_m > may_miss_m).astype(np.uint8), cv2.MORPH_OPEN, _SQUARE) > 0
    return np.asarray((np.abs(over_m) <= may_miss_m) & ~_dilated(high, round(_SQUARE_M / cell_m)))


def filled(values: Floats32, known: Bools) -> Floats32:
    """Values (rows, cols) where they are known, and between them what is as even as can be: Laplace's
    equation, from coarse to fine. The values themselves where nothing is known."""
    if known.all() or not known.any():
        return values.copy()
    found = _halved_and_filled(values, known) if min(values.shape) > 1 else _mean(values, known)
    for _ in range(_EVENED):
        around = cv2.filter2D(found, -1, _NEIGHBOURS, borderType=cv2.BORDER_REPLICATE)
        found = np.where(known, values, np.asarray(around, dtype=np.float32))
    return found


def _mean(values: Floats32, known: Bools) -> Floats32:
    return np.where(known, values, values[known].mean())


def _halved_and_filled(values: Floats32, known: Bools) -> Floats32:
    halves = _Squares(values.shape, 2)
    number = halves.apart(known).sum(axis=-1, dtype=np.float32)
    sums = halves.apart(np.where(known, values, np.float32(0.0))).sum(axis=-1)
    coarse = filled(np.asarray(sums / np.maximum(number, 1.0), dtype=np.float32), number > 0.0)
    return np.where(known, values, halves.between(coarse))


class _Squares:
    """Cells (rows, cols) by squares of by x by; those past the last row and col are as the last."""

    def __init__(self, shape: tuple[int, ...], by: int) -> None:
        self.by = by
        self._shape = shape
        self._sides = tuple(-(-n // by) for n in shape)

    def apart(self, values: NDArray[Any]) -> NDArray[Any]:
        """(rows, cols) of squares and their cells."""
        wider = [(0, n * self.by - m) for n, m in zip(self._sides, self._shape, strict=True)]
        rows, cols = self._sides
        parts = np.pad(values, wider, mode="edge").reshape(rows, self.by, cols, self.by)
        return np.asarray(parts.transpose(0, 2, 1, 3).reshape(rows, cols, -1))

    def low(self, values: Floats32) -> Floats32:
        """What stands for each square."""
        parts = self.apart(values)
        place = int(_LOW * (parts.shape[-1] - 1))
        return np.ascontiguousarray(np.partition(parts, place, axis=-1)[..., place])

    def between(self, values: Floats32, margin: int = 0) -> Floats32:
        """Values of squares, and of so many more on every side, at the cells, bilinear."""
        rows, cols = (self.by * n for n in values.shape)
        wide = cv2.resize(values, (cols, rows), interpolation=cv2.INTER_LINEAR)
        at = (slice(margin * self.by, margin * self.by + n) for n in self._shape)
        return np.asarray(wide, dtype=np.float32)[tuple(at)]


def _standing(low_m: Floats32, square_m: float, reach_m: float, slope: float, noise_m: float) -> Bools:
    """What falls by more than a slope allows when windows grow up to a radius, and pits."""
    margin = int(np.ceil(reach_m / square_m))
    wide = _continued(low_m, margin)
    step_m, found = max(_STEP_M, noise_m), -_morphological_opening(-wide, 1) - wide > max(_SQUARE_M, noise_m)
    last, radius = filled(wide, ~found), 0
    while radius < margin:
        by = min(max(1, radius // 8), margin - radius)
        radius += by
        opened = _morphological_opening(last, radius)
        found |= last - opened > slope * by * square_m + step_m
        last = opened
    return found[margin : margin + low_m.shape[0], margin : margin + low_m.shape[1]]


def _smoothed(heights: Floats32, sigma: float) -> Floats32:
    """Gaussian of a deviation in cells; even slopes stay as they are up to the border."""
    margin = int(np.ceil(THREE_SIGMA * sigma))
    wide = cv2.GaussianBlur(_continued(heights, margin), (0, 0), sigma)
    return np.ascontiguousarray(wide[margin:-margin, margin:-margin], dtype=np.float32)


def _continued(heights: Floats32, margin: int) -> Floats32:
    """Heights with a margin of cells on every side: reflected, and raised by the usual slope at the border.

    What the border cuts stands as wide again beyond it, and an even slope goes on.
    """
    wide = np.pad(heights, margin, mode="reflect")
    for axis, n in enumerate(heights.shape):
        if n < 2:
            continue
        moved = np.arange(-margin, n + margin) - np.pad(np.arange(n), margin, mode="reflect")
        rises = np.gradient(np.moveaxis(heights, axis, 0), axis=0)
        beyond = np.moveaxis(wide, axis, 0)
        for of, near in ((moved < 0, rises[:margin]), (moved > 0, rises[-margin:])):
            slope = median_filter(np.median(near, axis=0), 2 * margin + 1)
            beyond[of] += moved[of, None].astype(np.float32) * np.pad(slope, margin, mode="edge")
    return wide


def _morphological_opening(heights: Floats32, radius: int) -> Floats32:
    """Without what is narrower than an octagon of a radius."""
    return _repeated(cv2.dilate, _repeated(cv2.erode, heights, radius), radius)


def _repeated(change: Callable[..., Any], heights: Floats32, times: int) -> Floats32:
    for k in range(times):
        heights = change(heights, _SQUARE if k % 2 else _CROSS)
    return heights


def _dilated(places: Bools, by: int) -> Bools:
    """And what lies up to so many cells away."""
    if by < 1:
        return places
    return np.asarray(cv2.distanceTransform((~places).astype(np.uint8), cv2.DIST_L2, 5)) <= by


def _interpolated(surface: DenseSurface, ground: Bools, seen: Bools) -> TerrainModel:
    """Through the ground that was seen. Beyond, the farther away, the less that says: what was known of the
    ground before counts by its deviation there, where it isn't what stands."""
    known = seen if seen.any() else ground
    up_m, sd_m = filled(surface.up_m, known), _deviation(surface, known)
    has_prior = ground & ~known & np.isfinite(surface.sd_m)
    both_m = np.where(has_prior, np.hypot(sd_m, surface.sd_m), np.float32(1.0))
    share = np.where(has_prior, (sd_m / both_m) ** 2, np.float32(0.0))
    sd_m = np.where(has_prior, sd_m * surface.sd_m / both_m, sd_m)
    up_m = up_m + share * (surface.up_m - up_m)
    return TerrainModel(surface.cells, up_m.astype(np.float32), sd_m.astype(np.float32), seen)


def _deviation(surface: DenseSurface, ground: Bools) -> Floats32:
    """That of the surface on the ground; elsewhere that of the ground around, and more the farther away
    that is."""
    known = ground & np.isfinite(surface.sd_m)
    if not known.any():
        return np.full(surface.sd_m.shape, np.nan, dtype=np.float32)
    away_m = cv2.distanceTransform((~ground).astype(np.uint8), cv2.DIST_L2, 5) * surface.cells.cell_m
    around = filled(np.where(known, surface.sd_m, np.float32(0.0)), known)
    return np.asarray(np.hypot(around, np.float32(_BEND / 2.0) * away_m**2), dtype=np.float32)
