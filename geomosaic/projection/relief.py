"""The ground from a DEM: the raster brought into the work frame once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import TOGETHER, tuned
from geomosaic.errors import InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import GroundSurface, node_spacing_m
from geomosaic.survey.dem import HeightRaster

Places = Callable[[Floats, Floats, Floats], tuple[Floats, Floats, Floats]]
_KNOTS = tuned(17, "knots a side", "of the map projection's spline: 17 are 8e-5 m off over 300 km, 9 1e-3 m")
_LIFT_M = tuned(100.0, "m", "for the slope with height: 1 m drowns in rounding; 10 km is 1.6e-3 m off")


def relief(
    work_frame: LocalFrame, raster: HeightRaster, low_en_m: Floats, high_en_m: Floats, spacing_m: float
) -> GroundSurface:
    """The surface over the rectangle low_en_m to high_en_m (2,), nodes every spacing_m or a little more.

    A node's height is found by fixed-point iteration, since going up in the work frame moves the point
    over the map by the change of the vertical. Nodes without a height take the nearest known one.

    Raises: InputError if the DEM knows no height in the rectangle.
    """
    spacing_m = node_spacing_m(low_en_m, high_en_m, spacing_m)
    east = np.arange(low_en_m[0], high_en_m[0] + spacing_m, spacing_m)
    north = np.arange(low_en_m[1], high_en_m[1] + spacing_m, spacing_m)
    known = raster.filled()
    if known is None:
        raise InputError(
            ("the DEM has no heights where the frames lie"), fix="give a --dem of the survey's area"
        )
    places = _places(work_frame, raster, east, north)
    up_m = np.zeros((north.size, east.size))
    for top in range(0, north.size, TOGETHER):
        rows = north[top : top + TOGETHER]
        up = up_m[top : top + TOGETHER]
        for _ in range(3):
            x, y, height = places(rows, east, up)
            up += known.nearest(x, y) - height
    return GroundSurface("dem", float(east[0]), float(north[0]), spacing_m, up_m)


def _places(work_frame: LocalFrame, raster: HeightRaster, east: Floats, north: Floats) -> Places:
    """Map coordinates and height of nodes at (norths, easts, ups): exact at some knots, splines between."""
    from scipy.interpolate import RectBivariateSpline

    projection = MapProjection(raster.crs)
    knots = [np.linspace(axis[0], max(axis[-1], axis[0] + 1.0), _KNOTS) for axis in (north, east)]
    n, e = np.meshgrid(*knots, indexing="ij")
    levels = []
    for up in (0.0, _LIFT_M):
        geodetic = work_frame.geodetic_from_enu(np.stack([e, n, np.full_like(e, up)], axis=-1))
        xy = projection.map_from_geodetic(geodetic[..., 0], geodetic[..., 1])
        xy[..., 0] = projection.unwrapped(xy[..., 0], raster.middle_x)
        levels.append(np.concatenate([xy, geodetic[..., 2:]], axis=-1))
    base, slope = levels[0], (levels[1] - levels[0]) / _LIFT_M
    if not np.isfinite(levels).all():
        raise InputError(
            ("the DEM's map projection does not reach the survey"), fix="give a --dem of the survey's area"
        )
    splines = [[RectBivariateSpline(*knots, values[..., i]) for i in range(3)] for values in (base, slope)]

    def at(norths: Floats, easts: Floats, up: Floats) -> tuple[Floats, Floats, Floats]:
        x, y, height = (b(norths, easts) + up * s(norths, easts) for b, s in zip(*splines, strict=True))
        return x, y, height

    return at
