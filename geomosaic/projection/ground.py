"""The ground: one surface type for flat land, a DEM, and the surface of tie points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from geomosaic.geodesy.local import LocalFrame

Floats = NDArray[np.float64]
_RAY_SAMPLES = 48
_REFINEMENTS = 30


@dataclass(frozen=True)
class GroundSurface:
    """Up as a function of east and north in the work frame: a regular grid, bilinear between nodes.

    `up_m[i, j]` is the height at east `east_0_m + j * spacing_m`, north `north_0_m + i * spacing_m`.
    Outside the grid the nearest edge goes on. `kind` is `flat`, `dem` or `tie_surface`.
    """

    kind: str
    east_0_m: float
    north_0_m: float
    spacing_m: float
    up_m: Floats

    def up_at(self, east_m: ArrayLike, north_m: ArrayLike) -> Floats:
        """Up (m) under points of any shape."""
        east = np.asarray(east_m, dtype=np.float64)
        north = np.asarray(north_m, dtype=np.float64)
        if self.up_m.size == 1:
            return np.full(np.broadcast(east, north).shape, self.up_m.item())
        at = [(north - self.north_0_m) / self.spacing_m, (east - self.east_0_m) / self.spacing_m]
        shape = np.broadcast(*at).shape
        flat = np.stack([np.broadcast_to(a, shape).ravel() for a in at])
        return np.asarray(map_coordinates(self.up_m, flat, order=1, mode="nearest")).reshape(shape)

    def intersect(self, origin_m: ArrayLike, ray: ArrayLike) -> Floats:
        """Where rays first meet the ground, shape (..., 3); NaN where a ray doesn't come down to it.

        Each ray is sampled between the surface's highest and lowest level; the first crossing is
        refined by the Illinois variant of the secant method, so that slopes steeper than the ray
        can't make it diverge.

        Args: origin_m (..., 3) or (3,), ray (..., 3) directions of any length.
        """
        ray = np.asarray(ray, dtype=np.float64)
        origin = np.broadcast_to(np.asarray(origin_m, dtype=np.float64), ray.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            per_drop = np.where(ray[..., 2:] < -1e-9, ray / -ray[..., 2:], np.nan)
        high, low = float(self.up_m.max()), float(self.up_m.min())
        top = np.maximum(origin[..., 2] - high - 1e-3, 0.0)
        bottom = origin[..., 2] - low + 1e-3
        at = self._clearance(origin, per_drop)
        if high - low > 1e-2:
            drops = top + (bottom - top) * np.linspace(0.0, 1.0, _RAY_SAMPLES).reshape(-1, *[1] * top.ndim)
            below = at(drops) <= 0.0
            first = np.maximum(below.argmax(axis=0), 1)
            top = np.take_along_axis(drops, (first - 1)[None], axis=0)[0]
            bottom = np.take_along_axis(drops, first[None], axis=0)[0]
        f_top, f_bottom = at(top), at(bottom)
        for _ in range(_REFINEMENTS):
            with np.errstate(divide="ignore", invalid="ignore"):
                drop = (top * f_bottom - bottom * f_top) / (f_bottom - f_top)
            drop = np.where(np.isfinite(drop), drop, (top + bottom) / 2.0)
            f = at(drop)
            above = f > 0.0
            f_bottom = np.where(above, f_bottom / 2.0, f)
            f_top = np.where(above, f, f_top / 2.0)
            top, bottom = np.where(above, drop, top), np.where(above, bottom, drop)
            if np.nanmax(np.abs(f), initial=0.0) < 1e-6:
                break
        hit = np.asarray(origin + per_drop * drop[..., None])
        hit[np.abs(f) > 1e-2] = np.nan
        return hit

    def _clearance(self, origin: Floats, per_drop: Floats) -> Callable[[Floats], Floats]:
        def at(drop: Floats) -> Floats:
            east = origin[..., 0] + per_drop[..., 0] * drop
            north = origin[..., 1] + per_drop[..., 1] * drop
            return np.asarray(origin[..., 2] - drop - self.up_at(east, north))

        return at


def flat_ground(
    work_frame: LocalFrame, height_ellipsoidal_m: float, reach_m: float, spacing_m: float = 100.0
) -> GroundSurface:
    """The surface of one ellipsoidal height around the work frame's origin, out to reach_m.

    It bends with the Earth; at 100 m between nodes the chord is off by 0.2 mm.
    """
    n = int(np.ceil(reach_m / spacing_m)) + 1
    axis = np.arange(-n, n + 1) * spacing_m
    east, north = np.meshgrid(axis, axis)
    up = np.zeros_like(east)
    for _ in range(3):
        height = work_frame.geodetic_from_enu(np.stack([east, north, up], axis=-1))[..., 2]
        up += height_ellipsoidal_m - height
    return GroundSurface("flat", float(axis[0]), float(axis[0]), spacing_m, up)
