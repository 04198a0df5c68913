"""A simulated scene: what each CCD sees, line by line, and the true offsets of every pair."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats, Floats32, Ints64
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic_simulate.relief import RasterRelief, Relief, hills, raster_height_m, raster_relief
from geomosaic_simulate.strip_ground import (
    CLOUD_CELL_PX,
    Clouds,
    PatternWindow,
    StripGround,
    cloud_brightness,
    cloud_cover,
    window_of,
)
from geomosaic_simulate.strip_motion import cameras_of, scene_crs
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_seen import CcdView, Heights, Rays

_COARSE_PX = 8
_OFFSET_ROUNDS = 8
_MARGIN_PX = 400
IDEAL = -1
"""The number of the ideal unbroken line of CCDs."""


@dataclass(frozen=True, eq=False)
class PairTruth:
    """True offsets of a pair at each line of the left strip's file, by the ground under the overlap's middle.

    dcol_px, dline_px: (n,), the convention of `StripGeometry`. cloud_left, cloud_right: (n,) the share of
    the overlap's columns under cloud in that line, and in the right strip's line that sees the same ground.
    """

    pair: int
    dcol_px: Floats
    dline_px: Floats
    cloud_left: Floats
    cloud_right: Floats


@dataclass(frozen=True, eq=False)
class SightLines:
    """World columns and rows (2, n, m) of pixels on the ground, and on the clouds' own plane (None: none)."""

    ground: Floats
    cloud: Floats | None


@dataclass(frozen=True, eq=False)
class Light:
    """Brightness (n, m) of full scale at gain 1, and the part of it that clouds hide (None: none)."""

    brightness: Floats32
    cloud: Floats32 | None


class StripWorld:
    """All that a plan makes: cameras, ground, clouds, on the scene's map.

    Signs are for a left strip in the leading row (side +1); the offsets turn round with the side. Ground h
    higher than the plan's mean is seen by the leading row later and by the trailing row earlier. So dline
    falls by h / parallax_m_per_line. Let the camera look a(t) lines ahead and b(t) columns to the image's
    right of where it should, and T be the time between the rows. Then dline is a(t) - a(t + T) and dcol is
    b(t) - b(t + T); with side -1 it is a(t) - a(t - T). Yaw turns ahead to the flight's right, which is the
    image's left: dcol falls by yaw times the rows' separation.
    """

    def __init__(self, plan: StripPlan) -> None:
        if plan.dem is not None:
            height_m = raster_height_m(plan.dem, plan.lon_deg, plan.lat_deg)
            plan = replace(plan, ground_height_m=height_m)
        self.plan = plan
        self.cameras = cameras_of(plan)
        self.projection = MapProjection(scene_crs(plan))
        self.scene_width_px = plan.geometry().scene_width_px
        self.relief = self._relief()
        self._heights: Heights | None = None if self.relief.amplitude_m == 0.0 else self.relief.height_at
        places = self._overlap_places()
        self.targets_m = self._targets()
        self.ground = StripGround(plan, *places, self._world(self.targets_m.T).T)
        self.clouds = Clouds(plan, *places) if plan.cloud_cover > 0.0 else None
        self._seen = {ccd: self._seen_by(ccd) for ccd in (IDEAL, *range(plan.ccds))}

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """West, south, east, north of what any CCD may see, on the scene's map."""
        plan = self.plan
        half_x = (self.scene_width_px / 2.0 + _MARGIN_PX) * plan.ground_pixel_m
        along = plan.lines / 2.0 + plan.row_separation_lines / 2.0 + _MARGIN_PX
        return -half_x, -along * plan.ground_pixel_m, half_x, along * plan.ground_pixel_m

    def look(self, ccd: int, cols: tuple[int, int], lines: Ints64) -> SightLines:
        """Where the middles of columns first to last (exclusive) look at camera lines (n,), whole numbers."""
        first, last = cols
        coarse = first + np.arange(0.0, last - first + _COARSE_PX, _COARSE_PX) + 0.5
        rays = self._seen[ccd].rays(np.asarray(coarse), np.asarray(lines + 0.5))
        ground = _between(self._world(rays.on(self._heights)[0]), last - first)
        cloud = None if self.clouds is None else _between(self._on_clouds(rays, lines), last - first)
        return SightLines(ground, cloud)

    def light(self, look: SightLines, window: PatternWindow | None = None) -> Light:
        """What is seen there; `window` is one of the ground that covers it, where there is one already."""
        window = window or self.ground.window(*window_of(look.ground))
        brightness = window.at(look.ground) * np.float32(self.plan.brightness)
        if self.clouds is None or look.cloud is None:
            return Light(brightness, None)
        deck = self.clouds.window(*window_of(look.cloud, cell_px=CLOUD_CELL_PX))
        if not cloud_cover(deck.values).any():
            return Light(brightness, np.zeros_like(brightness))
        thickness = deck.at(look.cloud)
        cover = cloud_cover(thickness)
        return Light(brightness + cover * (cloud_brightness(thickness) - brightness), cover)

    def truth(self, pair: int) -> PairTruth:
        """The true offsets of a pair, and where clouds hide the ground."""
        plan = self.plan
        left, right = plan.acquired(pair), plan.acquired(pair + 1)
        if not left.size:
            return PairTruth(pair, *(np.zeros(0) for _ in range(4)))
        apart = plan.geometry().side(pair) * plan.row_separation_lines
        at = np.asarray(left + 0.5)
        first_col, middle = plan.width_px - plan.overlap_px, plan.overlap_px / 2.0
        xy, height = self._seen[pair].rays(np.full((left.size, 1), first_col + middle), at).on(self._heights)
        col: Floats = np.full((left.size, 1), middle)
        line: Floats = np.asarray(at + apart)
        for _ in range(_OFFSET_ROUNDS):
            away = self._world(xy - self._seen[pair + 1].rays(col, line).at_height(height))
            col, line = col + away[0], line + away[1, :, 0]
        own = np.arange(left.size) + 0.5
        dline = _file_line(right, line) - own - apart
        spare = plan.row_separation_lines
        seen_at = np.clip(np.floor(line), -spare, plan.lines + spare).astype(np.int64)
        return PairTruth(
            pair,
            np.asarray(col[:, 0] - middle),
            dline,
            self._hidden(pair, (first_col, plan.width_px), left),
            self._hidden(pair + 1, (0, plan.overlap_px), seen_at),
        )

    def _seen_by(self, ccd: int) -> CcdView:
        plan, ideal = self.plan, ccd == IDEAL
        spare = plan.row_separation_lines + 100.0
        return CcdView(
            self.cameras.ideal if ideal else self.cameras.true,
            0 if ideal else ccd,
            self.projection,
            None if ideal else self.cameras.slow_rad,
            plan.ground_height_m,
            plan.altitude_m,
            self.scene_width_px if ideal else plan.width_px,
            (-spare, plan.lines + spare),
        )

    def _hidden(self, ccd: int, cols: tuple[int, int], lines: Ints64) -> Floats:
        if self.clouds is None or not lines.size:
            return np.zeros(lines.size)
        cells = np.asarray(np.arange(cols[0], cols[1], CLOUD_CELL_PX) + 0.5 * CLOUD_CELL_PX)
        places = self._on_clouds(self._seen[ccd].rays(cells, np.asarray(lines + 0.5)), lines)
        deck = self.clouds.window(*window_of(places, cell_px=CLOUD_CELL_PX))
        return np.asarray((deck.at(places) > 0.0).mean(axis=1))

    def _world(self, xy_m: ArrayLike) -> Floats:
        """World columns and rows of map coordinates (2, ...)."""
        x, y = np.asarray(xy_m, dtype=np.float64) / self.plan.ground_pixel_m
        return np.stack([x, -y])

    def _on_clouds(self, rays: Rays, lines: Ints64) -> Floats:
        """World columns and rows (2, n, m) of the cloud deck's own plane, which the wind moves."""
        plan = self.plan
        there = self._world(rays.at_height(plan.ground_height_m + plan.cloud_height_m))
        time_s = (lines + 0.5 - plan.lines / 2.0) / plan.line_rate_hz
        towards, speed = np.radians(plan.wind_deg), plan.wind_m_per_s / plan.ground_pixel_m
        wind = np.array([np.sin(towards), np.cos(towards)]) * speed
        return np.asarray(there - wind[:, None, None] * time_s[:, None])

    def _relief(self) -> Relief | RasterRelief:
        plan = self.plan
        if plan.dem is not None:
            middle = plan.lon_deg, plan.lat_deg
            return raster_relief(plan.dem, middle, self.projection, self.bounds_m, plan.ground_pixel_m)
        west, south, east, north = self.bounds_m
        x, y = np.meshgrid(np.linspace(west, east, 60), np.linspace(south, north, 200))
        at = np.stack([x, y], axis=-1)
        return hills(plan.seed, plan.ground_height_m, plan.relief_m, plan.relief_wavelength_m, at)

    def _overlap_places(self) -> tuple[Floats, Floats]:
        """World columns and rows that the left strips' lines see in the overlaps' middles, nominally."""
        plan = self.plan
        pair = np.arange(plan.ccds - 1)
        middles = (pair + 1) * (plan.width_px - plan.overlap_px) + plan.overlap_px / 2.0
        ahead = [plan.row_separation_lines / 2.0 * plan.geometry().side(int(k)) for k in pair]
        lines = np.arange(0.0, plan.lines, 8.0) - plan.lines / 2.0
        row = lines[:, None] + np.array(ahead)
        col = np.broadcast_to(middles - self.scene_width_px / 2.0, row.shape)
        return col.ravel(), row.ravel()

    def _targets(self) -> Floats:
        """Map coordinates (n, 2) of point targets, spread over the overlaps."""
        plan = self.plan
        rng = np.random.default_rng([plan.seed, 45])
        pair = 1 + np.arange(plan.targets) % (plan.ccds - 1)
        inside = plan.overlap_px * rng.uniform(0.3, 0.7, plan.targets)
        col = pair * (plan.width_px - plan.overlap_px) + inside - self.scene_width_px / 2.0
        share = (np.arange(plan.targets) + rng.uniform(0.2, 0.8, plan.targets)) / max(plan.targets, 1) - 0.5
        row = share * max(plan.lines - plan.row_separation_lines - 200.0, 100.0)
        return np.stack([col, -row], axis=-1) * plan.ground_pixel_m


def _between(places: Floats, count: int) -> Floats:
    """Places (2, n, count) at every column out of (2, n, m) at every _COARSE_PX-th."""
    step, part = np.divmod(np.arange(count), _COARSE_PX)
    weight = part / _COARSE_PX
    before, after = np.take(places, step, axis=-1), np.take(places, step + 1, axis=-1)
    return np.asarray(before + (after - before) * weight)


def _file_line(acquired: Ints64, line: Floats) -> Floats:
    """The line (corner origin) of a file that holds camera lines, given what camera line each of its is.

    Between two lines of the file straight on; beyond its ends as if it went on.
    """
    if acquired.size == 0:
        return line
    camera, own = np.unique(acquired, return_index=True)
    inside = np.interp(line - 0.5, camera, own)
    before, after = np.minimum(line - 0.5 - camera[0], 0.0), np.maximum(line - 0.5 - camera[-1], 0.0)
    return np.asarray(inside + before + after + 0.5)
