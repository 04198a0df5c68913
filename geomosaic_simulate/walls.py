"""Buildings that stand up: convex bodies cut by each ray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats, Ints
from geomosaic_simulate.buildings import Building

if TYPE_CHECKING:
    from geomosaic_simulate.render import Sight

_WALL = np.array([176.0, 168.0, 154.0])
_UNDERNEATH = np.array([58, 57, 52], dtype=np.uint8)


@dataclass(frozen=True)
class Standing:
    """A building as a frame sees it: the ellipsoidal height that it stands on, the image box (col, row) it
    fills."""

    building: Building
    base_m: float
    low_px: Floats
    high_px: Floats


Wall = tuple[tuple[slice, slice], Bools, Bytes]
"""A window of samples, which of them are painted, and their colours."""


def raise_buildings(
    standing: Sequence[Standing],
    sight: Sight,
    rows: Floats,
    cols: Floats,
    east: Floats,
    north: Floats,
    top_m: Floats,
) -> list[Wall]:
    """Stand the buildings up in a strip of samples: each ray is cut with each body in its box.

    Where a ray meets a roof first, east and north are moved there in place. Where it meets a wall, a patch of
    wall colour is returned; where it meets the ground beneath a deck, a patch of shade. Later buildings hide
    earlier ones. top_m gets the heights where rays end on them, if it has the samples' shape.
    """
    walls: list[Wall] = []
    for s in standing:
        r_0, r_1 = np.searchsorted(rows, [s.low_px[1], s.high_px[1]])
        c_0, c_1 = np.searchsorted(cols, [s.low_px[0], s.high_px[0]])
        if r_0 == r_1 or c_0 == c_1:
            continue
        window = np.s_[r_0:r_1, c_0:c_1]
        r, c = rows[r_0:r_1], cols[c_0:c_1]
        ground = np.stack([sight.easting(r, c), sight.northing(r, c)], axis=-1)
        rise = np.stack([sight.east_per_m(r, c), sight.north_per_m(r, c)], axis=-1)
        b = s.building
        drop = s.base_m + b.top_m - sight.height(r, c)
        highest = ground + rise * drop[..., None]
        centre = np.array([b.easting_m, b.northing_m])
        from_top, to_ground = ((p - centre) @ b.axes.T for p in (highest, ground))
        step = to_ground - from_top
        enters, leave = _cut(b, from_top, step, drop)
        face = enters.argmax(axis=0)
        enter = np.take_along_axis(enters, face[None], axis=0)[0]
        hit = (enter <= leave) & (leave >= 0.0) & (enter <= 1.0) & (drop > 0.0)
        on_roof, on_wall = hit & (face >= 4), hit & (face < 4)
        met = highest - (rise * (drop * np.maximum(enter, 0.0))[..., None])
        for name, plane in ((0, east), (1, north)):
            plane[window] = np.where(on_roof, met[..., name], plane[window])
        if top_m.shape == east.shape:
            top_m[window] = np.where(hit, s.base_m + b.top_m - np.maximum(enter, 0.0) * drop, top_m[window])
        hide(walls, window, on_roof)
        if on_wall.any():
            walls.append(
                (window, on_wall, _wall_colour(b, from_top + step * enter[..., None], enter * drop, face))
            )
        if b.open_m:
            under = ~hit & (np.abs(to_ground) <= [b.half_length_m, b.half_width_m]).all(axis=-1)
            walls.append((window, under, np.broadcast_to(_UNDERNEATH, (*under.shape, 3))))
    return walls


def _cut(b: Building, from_top: Floats, step: Floats, drop: Floats) -> tuple[Floats, Floats]:
    """Where rays enter each face of a building, (n, h, w), -inf where they never do, and where they leave it,
    (h, w). Both are shares of the rays' ways from the building's top to the ground."""
    enters, leave = [], np.full(drop.shape, np.inf)
    for along, across, up, limit in b.faces():
        # f < 0 inside
        f = from_top[..., 0] * along + from_top[..., 1] * across + (up * b.top_m - limit)
        slope = step[..., 0] * along + step[..., 1] * across - up * drop
        slope = np.where(np.abs(slope) < 1e-9, 1e-9, slope)
        at = -f / slope
        enters.append(np.where(slope < 0.0, at, -np.inf))
        leave = np.where(slope > 0.0, np.minimum(leave, at), leave)
    return np.stack(enters), leave


def hide(walls: list[Wall], window: tuple[slice, slice], hidden: Bools) -> None:
    """Take what a nearer roof hides away from earlier walls (in place)."""
    rows, cols = window
    for (rs, cs), hit, _ in walls:
        top, bottom = max(rs.start, rows.start), min(rs.stop, rows.stop)
        left, right = max(cs.start, cols.start), min(cs.stop, cols.stop)
        if top < bottom and left < right:
            mine = np.s_[top - rs.start : bottom - rs.start, left - cs.start : right - cs.start]
            nearer = np.s_[top - rows.start : bottom - rows.start, left - cols.start : right - cols.start]
            hit[mine] &= ~hidden[nearer]


def _wall_colour(b: Building, at: Floats, below_top: Floats, face: Ints) -> Bytes:
    """Walls: one brightness a side, a row of windows a storey; none in a bridge."""
    long_side = face >= 2
    along = np.where(long_side, at[..., 0], at[..., 1])
    below_eaves = below_top - b.ridge_m
    window = (np.abs((along % 2.4) - 1.2) < 0.55) & (np.abs((below_eaves % 2.8) - 1.5) < 0.6)
    light = np.where(long_side, 0.95, 0.78) * np.where(window & (not b.road), 0.35, 1.0)
    return np.asarray(np.clip(_WALL * light[..., None] * (b.roof[0] / 400.0 + 0.7), 0, 255), dtype=np.uint8)
