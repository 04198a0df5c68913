"""The strips' object space: the rigorous model and the ground's heights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.ccd.line_poses import LinePoses, on_height
from geomosaic.constants import HEIGHT_ROUNDS, tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.local import geodetic_from_ecef
from geomosaic.survey.model import Warn
from geomosaic.survey.strip_companions import checked_model, read_rpc
from geomosaic.survey.strip_heights import read_dem_heights
from geomosaic.survey.strips import StripGeometry

Heights = Callable[[Floats, Floats], Floats]
"""Ellipsoidal heights (m) of longitudes and latitudes (degrees)."""

_DEM_SD_M = tuned(10.0, "m", "0.04 px of TH-1's: less makes virtual_line claim too much; more too little")
_NO_DEM_SD_M = tuned(200.0, "m", "of ground without a DEM: less calls hills reliable; more hardly any line")
SAMPLE_LINES = tuned(129, "lines", "of a scene, to sample the DEM: fewer miss hills; more read more of it")


@dataclass(frozen=True, eq=False)
class ObjectSpace:
    """Where the CCDs look, and how high the ground is there.

    Convention: the model's line l is line l of every strip. mean_m, span_m: the ground's mean height, the
    lowest and the highest (ellipsoidal). height_sd_m: how well heights are known.
    """

    model: Pushbroom
    height_at: Heights
    mean_m: float = 0.0
    span_m: tuple[float, float] = (0.0, 0.0)
    height_sd_m: float = _DEM_SD_M
    warnings: tuple[Warn, ...] = ()

    def ground(self, poses: LinePoses, ccd: int, col: ArrayLike, line: ArrayLike) -> Floats:
        """Earth-fixed places (..., 3) where pixels of a camera see the ground."""
        origin, ray = poses.rays(ccd, col, line)
        height = np.full(origin.shape[:-1], self.mean_m)
        for _ in range(HEIGHT_ROUNDS):
            lonlath = geodetic_from_ecef(on_height(origin, ray, height))
            height = self.height_at(lonlath[..., 0], lonlath[..., 1])
        return on_height(origin, ray, height)


def level_ground(model: Pushbroom, height_m: float) -> ObjectSpace:
    """A model over level ground."""

    def height_at(lon_deg: Floats, _: Floats) -> Floats:
        return np.full(np.shape(lon_deg), height_m)

    return ObjectSpace(model, height_at, height_m, (height_m, height_m), _NO_DEM_SD_M)


def read_object_space(geometry: StripGeometry) -> ObjectSpace | None:
    """The object space of strips, or None without a model.

    Heights are the DEM's; without one level at the RPC's height, or at 0.
    Raises: `InputError` or `FileError` where model, DEM or RPC can't serve.
    """
    g = geometry
    if g.model is None:
        return None
    model = checked_model(g.model, len(g.ccds), g.line_rate_hz)
    duration_s = max(g.lines) / g.line_rate_hz
    for what, time_s in (("orbit", model.orbit_time_s), ("attitude", model.attitude_time_s)):
        if time_s[0] > 0.0 or time_s[-1] < duration_s:
            raise InputError(
                f"has {what} of {time_s[0]:.3f} to {time_s[-1]:.3f} s, but strips of {duration_s:.3f} s",
                file=g.model,
                fix="give the tables of the whole scene; time 0 is the first line's upper edge",
            )
    level_m = 0.0 if g.rpc is None else float(read_rpc(g.rpc).offset[4])
    lines = np.linspace(0.0, max(g.lines), SAMPLE_LINES)[:, None]
    cols = np.linspace(0.0, g.width_px, 3)
    sampled = [model.ground_from_image(k, cols, lines, level_m) for k in range(len(g.ccds))]
    lonlat = np.concatenate([ground[..., :2].reshape(-1, 2) for ground in sampled])
    if not np.isfinite(lonlat).all():
        raise InputError(
            "looks past the Earth", file=g.model, fix="check the attitude's and the looks' signs"
        )
    if g.dem is None:
        return level_ground(model, level_m)
    heights = read_dem_heights(g.dem, lonlat)
    return ObjectSpace(model, heights, heights.mean_m, heights.span_m, _DEM_SD_M, heights.warnings)
