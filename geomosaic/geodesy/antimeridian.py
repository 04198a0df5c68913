"""Areas across 180 degrees of longitude, as GeoJSON has them (RFC 7946, section 3.1.9 and 5.2)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import shapely
from rasterio.crs import CRS
from rasterio.warp import transform_bounds

from geomosaic.arrays import Floats

Bounds = tuple[float, float, float, float]
"""West, south, east, north in degrees."""


def geographic_bounds(crs: CRS, bounds: Bounds) -> Bounds:
    """Of a rectangle on a map; east is above 180 degrees where it crosses them."""
    west, south, east, north = transform_bounds(crs, "OGC:CRS84", *bounds)
    return west, south, east + 360.0 * (east < west), north


def mercator_bounds(bounds: Bounds, equator_m: float) -> Bounds:
    """Geographic bounds in Web Mercator, m; east is beyond the map's edge where they cross 180 degrees."""
    west, south, east, north = bounds
    down, up = (equator_m / math.tau * math.asinh(math.tan(math.radians(lat))) for lat in (south, north))
    return west / 360.0 * equator_m, down, east / 360.0 * equator_m, up


def within_the_map(bounds: Bounds) -> Bounds:
    """The same for formats whose bounds must not wrap: all longitudes where they cross 180 degrees."""
    _, south, east, north = bounds
    return (-180.0, south, 180.0, north) if east > 180.0 else bounds


def wrapped(lon_deg: float) -> float:
    """A longitude from -180 to 180 degrees."""
    return (lon_deg + 180.0) % 360.0 - 180.0


def split_area(area: Any) -> tuple[Any, list[float]]:
    """An area in longitude and latitude cut at 180 degrees, and its bounding box.

    West is above east where it crosses them. Longitudes may jump there or go on beyond.
    """

    def unwrapped(lonlat: Floats) -> Floats:
        return np.column_stack([lonlat[:, 0] % 360.0, lonlat[:, 1]])

    west, _, east, _ = area.bounds
    if west >= -180.0 and east <= min(180.0, west + 180.0):
        return area, list(area.bounds)
    whole = shapely.transform(area, unwrapped)
    west, south, east, north = whole.bounds
    parts = [whole & shapely.box(0.0, -90.0, 180.0, 90.0), whole & shapely.box(180.0, -90.0, 360.0, 90.0)]
    parts[1] = shapely.transform(parts[1], lambda lonlat: lonlat - [360.0, 0.0])
    polygons = [p for part in parts for p in shapely.get_parts(part) if p.geom_type == "Polygon" and p.area]
    box = [west - 360.0 * (west >= 180.0), south, east - 360.0 * (east > 180.0), north]
    return shapely.MultiPolygon(polygons), box
