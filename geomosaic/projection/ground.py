"""The ground: one surface type for flat land, a DEM, and the surface of tie points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from geomosaic.arrays import Floats, Floats32
from geomosaic.constants import HEIGHT_ROUNDS, MOST_ROUNDS, sourced, tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.walk import GridRays, first_drops
from geomosaic.survey.dem import MOST_PIXELS

Grid = NDArray[np.floating[Any]]
MOST_NODES: Final = MOST_PIXELS**2
"""Of a ground, 32 MB a worker."""
_MOST_FLAT_NODES = tuned(250_000, "nodes", "of flat ground, 2 MB: 7 mm off over 150 km; more gain nothing")
_FLAT_SPACING_M = sourced(100.0, "m", "on flat ground: 0.2 mm below the Earth's curvature", "s^2 / (8 R)")
_RAY_SAMPLES = tuned(48, "samples", "of an oblique ray: 24 miss 6 % of first crossings, 48 3 %, 96 1 %")
_CLOSE_M = tuned(1e-6, "m", "of a ray's end from the ground: more shows in deviations; less takes rounds")
FLAT: Final = "flat"
"""The kind of ground of one ellipsoidal height."""
WALLED: Final = "dense"
"""The kind of ground that shows what stands on it."""


@dataclass(frozen=True)
class RaisedObject:
    """An object that stands on the ground: `up_m` (rows, cols) at nodes, from the south up, as of
    `GroundSurface`; NaN beyond its outline, which lies halfway between nodes."""

    east_0_m: float
    north_0_m: float
    spacing_m: float
    up_m: Floats32

    @property
    def ends_m(self) -> Floats:
        """East and north of the first and of the last node, (2, 2)."""
        first_m = np.array([self.east_0_m, self.north_0_m])
        return np.array([first_m, first_m + self.spacing_m * (np.array(self.up_m.shape[::-1]) - 1)])

    def put(self, east_m: Floats, north_m: Floats, up_m: Grid) -> None:
        """Its height in place of up_m at points of one shape that lie within its outline."""
        rows, cols = self.up_m.shape
        col = np.rint((east_m - self.east_0_m) / self.spacing_m)
        row = np.rint((north_m - self.north_0_m) / self.spacing_m)
        at = np.nonzero((row >= 0) & (row < rows) & (col >= 0) & (col < cols))
        if at[0].size:
            own = self.up_m[row[at].astype(np.intp), col[at].astype(np.intp)]
            up_m[at] = np.where(np.isnan(own), up_m[at], own)


@dataclass(frozen=True)
class GroundSurface:
    """Up as a function of east and north in the work frame: a regular grid, bilinear between nodes.

    `up_m[i, j]` is the height at east `east_0_m + j * spacing_m`, north `north_0_m + i * spacing_m`.
    Outside the grid the nearest edge goes on. `kind` is `flat`, `dem`, `tie_surface`, `dense` (matched, with
    all that stands on the ground) or `terrain` (the ground below that). `sd_m`, of the shape
    of `up_m`: deviations of the heights, where they are known. Of many nodes both may have 32 bits.
    `raised`: objects that stand on it, which frames are rectified on; all else looks at the ground alone.
    """

    kind: str
    east_0_m: float
    north_0_m: float
    spacing_m: float
    up_m: Grid
    sd_m: Grid | None = None
    raised: tuple[RaisedObject, ...] = ()

    def __post_init__(self) -> None:
        """Raises ValueError for endless heights; NaN is a height that isn't known."""
        if np.isinf(self.up_m).any():
            raise ValueError("endless heights of the ground")

    @property
    def has_walls(self) -> bool:
        """Whether it shows what stands on the ground, so that one place hides another."""
        return self.kind == WALLED

    @property
    def has_relief(self) -> bool:
        """Whether heights differ beyond the Earth's curvature: False for flat ground without objects."""
        return self.kind != FLAT or bool(self.raised)

    def nodes_m(self) -> Floats:
        """East and north of the nodes, (rows, cols, 2)."""
        rows, cols = self.up_m.shape
        east = self.east_0_m + self.spacing_m * np.arange(cols)
        north = self.north_0_m + self.spacing_m * np.arange(rows)
        return np.stack(np.meshgrid(east, north), axis=-1)

    @cached_property
    def steepest(self) -> float:
        """No slope of the ground is greater, m a m."""
        rise = (np.abs(np.diff(self.up_m, axis=axis)).max(initial=0.0) for axis in (0, 1))
        return float(np.hypot(*rise)) / self.spacing_m

    @cached_property
    def _range_m(self) -> tuple[float, float]:
        """The lowest node and the highest."""
        return float(self.up_m.min()), float(self.up_m.max())

    def about(self, places_m: Floats, nodes: int) -> GroundSurface:
        """The part under places (..., 2 or 3), with so many nodes more on every side: views of its arrays."""
        corner, size = np.array([self.east_0_m, self.north_0_m]), np.array(self.up_m.shape[::-1])
        ends = np.array([f(places_m[..., :2].reshape(-1, 2), axis=0) for f in (np.min, np.max)])
        low, high = (ends - corner) / self.spacing_m
        first = np.clip(np.floor(low).astype(np.intp) - nodes, 0, size - 1)
        last = np.clip(np.ceil(high).astype(np.intp) + nodes, first, size - 1)
        at = slice(first[1], last[1] + 1), slice(first[0], last[0] + 1)
        east_m, north_m = (corner + first * self.spacing_m).tolist()
        sd_m = None if self.sd_m is None else self.sd_m[at]
        return replace(self, east_0_m=east_m, north_0_m=north_m, up_m=self.up_m[at], sd_m=sd_m)

    def up_at(self, east_m: ArrayLike, north_m: ArrayLike) -> Floats:
        """Up (m) under points of any shape."""
        return self._between_nodes(self.up_m, east_m, north_m)

    def raise_objects(self, east_m: Floats, north_m: Floats, up_m: Floats) -> None:
        """Heights of the objects in place of up_m at points of one shape within their outlines."""
        if not self.raised or not east_m.size:
            return
        west, east, south, north = east_m.min(), east_m.max(), north_m.min(), north_m.max()
        for one in self.raised:
            (rows, cols), side = one.up_m.shape, one.spacing_m
            beyond = one.east_0_m > east + side or one.north_0_m > north + side
            before = one.east_0_m + cols * side < west or one.north_0_m + rows * side < south
            if not (beyond or before):
                one.put(east_m, north_m, up_m)

    def sd_at(self, east_m: ArrayLike, north_m: ArrayLike) -> Floats:
        """Deviation (m) of the height under points of any shape; NaN where none is known."""
        sd_m = np.full((1, 1), np.nan) if self.sd_m is None else self.sd_m
        return self._between_nodes(sd_m, east_m, north_m)

    def _between_nodes(self, values: Grid, east_m: ArrayLike, north_m: ArrayLike) -> Floats:
        east = np.asarray(east_m, dtype=np.float64)
        north = np.asarray(north_m, dtype=np.float64)
        if values.size == 1:
            return np.full(np.broadcast(east, north).shape, values.item())
        at = [(north - self.north_0_m) / self.spacing_m, (east - self.east_0_m) / self.spacing_m]
        shape = np.broadcast(*at).shape
        flat = np.stack([np.broadcast_to(a, shape).ravel() for a in at])
        return np.asarray(map_coordinates(values, flat, np.float64, order=1, mode="nearest")).reshape(shape)

    def intersect(self, origin_m: ArrayLike, ray: ArrayLike) -> Floats:
        """Where rays first meet the ground, shape (..., 3); NaN where a ray doesn't come down to it.

        Over a ground with walls a ray is walked cell by cell, as far as it lies within the grid. Elsewhere
        the first crossing between the surface's highest and lowest level is found by the secant method, by
        bisection where that leaves the interval. Rays that could cross it more than once, since some slope is
        steeper than they are, are sampled before.

        Args: origin_m (..., 3) or (3,), ray (..., 3) directions of any length.
        """
        ray = np.asarray(ray, dtype=np.float64)
        origin = np.broadcast_to(np.asarray(origin_m, dtype=np.float64), ray.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            per_drop = np.where(ray[..., 2:] < -1e-9, ray / -ray[..., 2:], np.nan)
        if not self.has_walls or min(self.up_m.shape) < 2:
            return self._sampled(origin, per_drop)
        hit, down = np.full((per_drop[..., 0].size, 3), np.nan), per_drop.reshape(-1, 3)
        start = origin.reshape(-1, 3)
        corner = np.array([self.north_0_m, self.east_0_m])
        at = (start[:, 1::-1] - corner) / self.spacing_m
        slope = down[:, 1::-1] / self.spacing_m
        first = np.maximum(start[:, 2] - self._range_m[1] - 1e-3, 0.0)
        last = start[:, 2] - self._range_m[0] + 1e-3
        ends = np.stack([at + slope * drop[:, None] for drop in (first, last)])
        within = ((ends >= 0.0) & (ends <= np.array(self.up_m.shape) - 1.0)).all(axis=(0, 2))
        rays = GridRays(at[within], slope[within], start[within, 2], first[within], last[within])
        drop = first_drops(self.up_m, rays)
        hit[within] = start[within] + down[within] * drop[:, None]
        hit[~within] = self._sampled(start[~within], down[~within])
        return hit.reshape(ray.shape)

    def _sampled(self, origin: Floats, per_drop: Floats) -> Floats:
        low, high = self._range_m
        top = np.asarray(np.maximum(origin[..., 2] - high - 1e-3, 0.0))
        bottom = np.asarray(origin[..., 2] - low + 1e-3)
        at = self._clearance(origin, per_drop)
        again = ~(np.hypot(per_drop[..., 0], per_drop[..., 1]) * self.steepest < 1.0)
        if high - low > 1e-2 and again.any():
            its = self._clearance(origin[again], per_drop[again])
            samples = np.linspace(0.0, 1.0, _RAY_SAMPLES)[:, None]
            drops = top[again] + (bottom[again] - top[again]) * samples
            first = np.maximum((its(drops) <= 0.0).argmax(axis=0), 1)[None]
            top[again], bottom[again] = (np.take_along_axis(drops, k, axis=0)[0] for k in (first - 1, first))
        drop = (top + bottom) / 2.0
        f, before, f_before = at(drop), top, np.full(top.shape, np.nan)
        for _ in range(MOST_ROUNDS):
            if not ((np.abs(f) >= _CLOSE_M) & (top < bottom)).any():
                break
            top, bottom = np.where(f > 0.0, drop, top), np.where(f > 0.0, bottom, drop)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = f * (drop - before) / (f_before - f)
            tried = drop + np.where(np.isfinite(step), step, f)  # first as over level ground
            inside = (tried >= top) & (tried <= bottom)
            before, f_before = drop, f
            drop = np.where(np.abs(f) < _CLOSE_M, drop, np.where(inside, tried, (top + bottom) / 2.0))
            f = at(drop)
        hit = np.asarray(origin + per_drop * drop[..., None])
        hit[np.abs(f) > 1e-2] = np.nan
        return hit

    def _clearance(self, origin: Floats, per_drop: Floats) -> Callable[[Floats], Floats]:
        def at(drop: Floats) -> Floats:
            east = origin[..., 0] + per_drop[..., 0] * drop
            north = origin[..., 1] + per_drop[..., 1] * drop
            return np.asarray(origin[..., 2] - drop - self.up_at(east, north))

        return at


def node_spacing_m(
    low_m: ArrayLike, high_m: ArrayLike, wanted_m: float, most_nodes: int = MOST_NODES
) -> float:
    """The distance between nodes over a rectangle: as wanted, or as much more as keeps their number down.

    So no ground takes more than most_nodes, however far it has to reach.

    Args: low_m, high_m (2,) corners. Raises: `InputError` where one of them is unknown.
    """
    width, height = (np.asarray(high_m, dtype=np.float64) - np.asarray(low_m, dtype=np.float64)).tolist()
    if not (np.isfinite(width) and np.isfinite(height) and min(width, height) >= 0.0):
        raise InputError(
            ("the ground's extent is unknown"),
            fix="correct positions and heights (--pos) and focal lengths (--camera)",
        )
    # (width / s + 2) (height / s + 2) = most_nodes, solved for s: ends and rounding take up to two nodes
    room, border = most_nodes - 4.0, 2.0 * (width + height)
    least = (border + np.sqrt(border**2 + 4.0 * room * width * height)) / (2.0 * room)
    return max(wanted_m, float(least))


def flat_ground(work_frame: LocalFrame, height_ellipsoidal_m: float, reach_m: float) -> GroundSurface:
    """The surface of one ellipsoidal height around the work frame's origin, out to reach_m.

    It bends with the Earth. Nodes are 100 m apart out to 25 km, where the chord between them is off by 0.2
    mm. Where the survey reaches 150 km it is off by 7 mm.
    """
    spacing_m = node_spacing_m([-reach_m] * 2, [reach_m] * 2, _FLAT_SPACING_M, _MOST_FLAT_NODES)
    n = int(np.ceil(reach_m / spacing_m)) + 1
    axis = np.arange(-n, n + 1) * spacing_m
    east, north = np.meshgrid(axis, axis)
    up = np.zeros_like(east)
    for _ in range(HEIGHT_ROUNDS):
        height = work_frame.geodetic_from_enu(np.stack([east, north, up], axis=-1))[..., 2]
        up += height_ellipsoidal_m - height
    return GroundSurface(FLAT, float(axis[0]), float(axis[0]), spacing_m, up)
