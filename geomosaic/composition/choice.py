"""Which of two grounds frames agree on: how alike neighbours show places where the grounds differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from geomosaic.arrays import Floats, Floats32
from geomosaic.composition.occlusion import occluded
from geomosaic.composition.views import FrameView
from geomosaic.constants import tuned
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.horizon import hidden_m
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.resample import seen_on
from geomosaic.projection.warp import ground_window
from geomosaic.spread import Spread
from geomosaic.survey.model import Frame, Survey
from geomosaic.survey.pixels import read_pixels

_PLACE_PX = tuned(192, "frame px", "side of a tested place: larger dilutes houses; smaller lacks context")
_BLOCK_PX = tuned(32, "frame px", "compared square: larger is alike by land forms; smaller by chance")
MOST_PLACES = tuned(60, "places", "tested in two frames each: the median is good to 0.01; more take time")
_NEIGHBOURS = tuned(4, "frames", "nearest to a frame, one a side: fewer leave seams untested")
_APART_M = tuned(1.0, "m", "the grounds' difference where they are tested: less moves frames by 1 or 2 px")
_LEAST_LESS = tuned(0.03, "1 - correlation", "gain on what stands: less is noise; more misses small towns")
_NOTHING_ALIKE = tuned(0.9, "1 - correlation", "where frames say nothing: woods in wind leave 0.98")


@dataclass(frozen=True)
class Agreement:
    """How well frames agree on each of two grounds.

    disagreement: of each ground the median of 1 - correlation between two frames, over squares where the
    grounds differ. squares: how many. places: how many they lie in.
    """

    disagreement: tuple[float, float]
    squares: int
    places: int

    @property
    def best(self) -> int:
        """The first ground, of all that stands, if frames agree on it, and more than on the second, the land
        below, which tears nothing; and if both are the same."""
        if not self.squares:
            return 0
        surface, terrain = self.disagreement
        return int(not (surface < _NOTHING_ALIKE and surface < terrain - _LEAST_LESS))


@dataclass(frozen=True)
class _Land:
    """Where places lie: the work frame, the map, their pixel, and the grounds."""

    work_frame: LocalFrame
    crs: str
    gsd_m: float
    grounds: tuple[GroundSurface, ...]


@dataclass(frozen=True)
class _FramePlaces:
    """A frame, and the corners (k, 2) of the places that are to be seen in it, easting and northing."""

    frame: Frame
    view: FrameView
    corners_m: Floats


def agreement(
    survey: Survey,
    views: Sequence[FrameView],
    grounds: tuple[GroundSurface, GroundSurface],
    spread: Spread,
) -> Agreement:
    """Of places halfway between neighbours, where seams may run; each frame is decoded once."""
    gsd_m = float(np.median([view.gsd_m for view in views]))
    land = _Land(survey.work_frame, survey.map_crs, gsd_m, grounds)
    pairs, corners_m = _places(land, views)
    of: dict[int, list[int]] = {}
    for k, pair in enumerate(pairs):
        for i in pair:
            of.setdefault(i, []).append(k)
    looks = [_FramePlaces(survey.frames[views[i].frame], views[i], corners_m[ks]) for i, ks in of.items()]
    found = spread.map("grounds", partial(_looked, land), looks, [views[i].frame for i in of])
    shown = {
        (i, k): one
        for (i, ks), all_ in zip(of.items(), found, strict=True)
        for k, one in zip(ks, all_, strict=True)
    }
    unlike: list[list[Floats32]] = [[] for _ in grounds]
    for k, (i, j) in enumerate(pairs):
        apart = (_squares(_apart_m(land, corners_m[k])) > _APART_M).any(axis=(1, 3))
        both = [_unlike(a, b)[apart] for a, b in zip(shown[i, k], shown[j, k], strict=True)]
        whole = np.isfinite(both).all(axis=0)
        for kept, values in zip(unlike, both, strict=True):
            kept.append(values[whole])
    of_all = [np.concatenate(kept) if kept else np.zeros(0, np.float32) for kept in unlike]
    surface, terrain = (float(np.median(values)) if values.size else np.nan for values in of_all)
    return Agreement((surface, terrain), of_all[0].size, len(pairs))


def _places(land: _Land, views: Sequence[FrameView]) -> tuple[list[tuple[int, int]], Floats]:
    """Pairs of neighbours and the corner of a place that both are as near to, where the grounds differ."""
    nadirs = np.array([view.nadir_m for view in views]).reshape(-1, 2)
    count = min(_NEIGHBOURS + 1, len(nadirs))
    near = cKDTree(nadirs).query(nadirs, range(1, count + 1))[1][:, 1:]
    pairs = sorted({(min(i, j), max(i, j)) for i, row in enumerate(near.tolist()) for j in row})
    half_m = np.array([-0.5, 0.5]) * _PLACE_PX * land.gsd_m
    found, corners = [], []
    for i, j in pairs:
        middle, across = (nadirs[i] + nadirs[j]) / 2.0, (nadirs[j] - nadirs[i])[::-1] * [-1.0, 1.0]
        for aside in (-0.25, 0.0, 0.25):
            corner = middle + aside * across + half_m
            if (_apart_m(land, corner, _BLOCK_PX) > _APART_M).any():
                found.append((i, j))
                corners.append(corner)
    some = np.unique(np.linspace(0, len(found) - 1, min(MOST_PLACES, len(found))).astype(int))
    return [found[k] for k in some], np.array([corners[k] for k in some]).reshape(-1, 2)


def _apart_m(land: _Land, corner_m: Floats, step_px: int = 1) -> Floats32:
    """How far the grounds are apart at a place, (h, w) by step_px."""
    side = _PLACE_PX // step_px
    col, row = np.meshgrid(*[(np.arange(side) + 0.5) * step_px * land.gsd_m] * 2)
    at = MapProjection(land.crs).geodetic_from_map(corner_m[0] + col, corner_m[1] - row)
    enu = land.work_frame.enu_from_geodetic(at[..., 0], at[..., 1], land.work_frame.height_ellipsoidal_m)
    up = [ground.up_at(enu[..., 0], enu[..., 1]) for ground in land.grounds]
    return np.asarray(np.ptp(up, axis=0), dtype=np.float32)


def _looked(land: _Land, look: _FramePlaces) -> list[list[Floats32]]:
    """Of each place, how the frame shows it on each ground, NaN where it doesn't or something hides it."""
    pixels, mask = read_pixels(look.frame, luma=True)
    grey = pixels[..., 0].astype(np.float32) if pixels.ndim == 3 else pixels.astype(np.float32)
    found = []
    for corner in look.corners_m:
        shown = []
        for ground in land.grounds:
            west_m, north_m = corner.tolist()
            grid = MapGrid(land.crs, west_m, north_m, land.gsd_m, _PLACE_PX, _PLACE_PX)
            window = ground_window(grid, land.work_frame, ground)
            image, valid = seen_on(window, look.view.pose, look.view.camera, grey, mask)
            if ground.has_walls:
                below_m = hidden_m(ground, look.view.pose.position_m, window.points_m())
                valid &= ~occluded(below_m, land.gsd_m)
            shown.append(np.where(valid, image, np.float32(np.nan)))
        found.append(shown)
    return found


def _unlike(one: Floats32, other: Floats32) -> Floats32:
    """1 - correlation by squares; NaN where one of both isn't whole or shows nothing."""
    a, b = _contrast(one), _contrast(other)
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = (a * b).sum(axis=(1, 3)) / np.sqrt((a * a).sum(axis=(1, 3)) * (b * b).sum(axis=(1, 3)))
    return np.asarray(1.0 - alike, dtype=np.float32)


def _contrast(values: Floats32) -> Floats:
    """Squares less their means; 0 where that is no more than resampling rounds off in single precision."""
    of = _squares(values)
    mean = of.mean(axis=(1, 3), keepdims=True)
    return np.where(np.abs(of - mean) <= 4.0 * np.finfo(np.float32).eps * np.abs(mean), 0.0, of - mean)


def _squares(values: Floats32) -> Floats:
    """Values (h, w) by squares, (down, rows, across, cols) with as many rows and cols as a square has."""
    side = _PLACE_PX // _BLOCK_PX
    return values.reshape(side, _BLOCK_PX, side, _BLOCK_PX).astype(np.float64)
