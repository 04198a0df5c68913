"""The ground from a DEM: the raster brought into the work frame once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from geomosaic.errors import InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import GroundSurface, node_spacing_m
from geomosaic.survey.dem import HeightRaster

Floats = NDArray[np.float64]


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
    e, n = np.meshgrid(east, north)
    projection = MapProjection(raster.crs)
    up = np.zeros_like(e)
    for _ in range(3):
        geodetic = work_frame.geodetic_from_enu(np.stack([e, n, up], axis=-1))
        en = projection.map_from_geodetic(geodetic[..., 0], geodetic[..., 1])
        up = up + raster.at(en[..., 0], en[..., 1]) - geodetic[..., 2]
        if not np.isfinite(up).any():
            raise InputError(
                "the DEM has no heights where the frames lie", mend="give one of the survey's area"
            )
        up = _filled(up)
    return GroundSurface("dem", float(east[0]), float(north[0]), spacing_m, up)


def _filled(heights: Floats) -> Floats:
    unknown = np.isnan(heights)
    if not unknown.any():
        return heights

    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])
