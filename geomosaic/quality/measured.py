"""Lengths, areas and volumes on a map, with the standard deviations that those of their points give them.

Errors of points count as independent of each other, equal east and north; what all points share is taken off
before and cancels. A length's derivative by a vertex is the difference of the directions of its two segments,
an area's half the way between its neighbours, turned by a right angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from pyproj import CRS, Transformer

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares

_DISTORTED = tuned(1e-4, "share", "by which a map may differ from the ellipsoid before both are stated")


@dataclass(frozen=True)
class Figure:
    """A length (m) or an area (m²) on the map and its standard deviation, NaN where that is unknown.

    ellipsoidal: the same on the ellipsoid, None where both agree within 1e-4 or the map is a local frame.
    """

    value: float
    sd: float
    ellipsoidal: float | None = None


@dataclass(frozen=True)
class Volume:
    """Volumes in m³ above and below the plane through a polygon's rim, and the standard deviation of each."""

    above: float
    below: float
    sd: float


def length_of(line: Any, sd_m: Floats, scale_sd: float, crs: CRS | None) -> Figure:
    """The length of a line on the map; sd_m (n,): of its vertices; scale_sd: of the map's scale."""
    at_m = shapely.get_coordinates(line)
    ways = np.diff(at_m, axis=0)
    lengths = np.hypot(*ways.T)
    units = ways / np.maximum(lengths, np.finfo(float).tiny)[:, None]
    nothing = np.zeros((1, 2))
    gradient = np.concatenate([nothing, units]) - np.concatenate([units, nothing])
    if (at_m[0] == at_m[-1]).all():  # one vertex, not two
        gradient[0] += gradient[-1]
        gradient[-1] = 0.0
    length = float(lengths.sum())
    variance = (np.square(gradient).sum(axis=1) * sd_m**2).sum() + (scale_sd * length) ** 2
    return Figure(length, float(np.sqrt(variance)), _differing(length, _on_ellipsoid(line, crs)))


def area_of(polygon: Any, sd_m: Floats, scale_sd: float, crs: CRS | None) -> Figure:
    """The area of a polygon on the map; sd_m (n,): of all its coordinates; scale_sd: of the map's scale."""
    variance, first = 0.0, 0
    for ring in rings_of_polygon(polygon):
        sd = sd_m[first : first + len(ring) - 1]
        diagonal = np.roll(ring[:-1], -1, axis=0) - np.roll(ring[:-1], 1, axis=0)
        variance += float((np.square(diagonal).sum(axis=1) * sd**2).sum() / 4.0)
        first += len(ring)
    area = float(polygon.area)
    sd_of_all = float(np.sqrt(variance + (2.0 * scale_sd * area) ** 2))
    return Figure(area, sd_of_all, _differing(area, _on_ellipsoid(polygon, crs)))


def volume_of(
    inside_m: Floats, rim_m: Floats, inside_sd_m: Floats, rim_sd_m: Floats, cell_m2: float
) -> Volume:
    """The volume of heights above and below the plane that fits a rim best.

    Its deviation is the area times that of the mean height above the plane. Heights inside are taken to have
    one error in common, and those of the rim another one. This errs on the safe side.

    Args: inside_m, rim_m (n, 3): easting, northing and height of cells and of places on the rim; inside_sd_m,
        rim_sd_m (n,): deviations of the heights; cell_m2: area of a cell.
    """
    origin = rim_m.mean(axis=0)
    away = rim_m - origin
    plane = least_squares(np.column_stack([np.ones(len(away)), away[:, :2]]), away[:, 2])
    rise = inside_m[:, 2] - origin[2] - plane[0] - (inside_m[:, :2] - origin[:2]) @ plane[1:]
    sd_m = np.sqrt(np.square(inside_sd_m).mean() + np.square(rim_sd_m).mean())
    above, below = (float(np.maximum(sign * rise, 0.0).sum()) * cell_m2 for sign in (1.0, -1.0))
    return Volume(above, below, float(sd_m) * cell_m2 * len(rise))


def rings_of_polygon(polygon: Any) -> Sequence[Floats]:
    """The closed rings (n, 2) of a polygon of shapely's, the outer one first."""
    return [np.asarray(ring.coords)[:, :2] for ring in (polygon.exterior, *polygon.interiors)]


def _on_ellipsoid(geometry: Any, crs: CRS | None) -> float | None:
    """The length of a line or the area of a polygon on the CRS's ellipsoid, along geodesics."""
    geod, geodetic = (None, None) if crs is None else (crs.get_geod(), crs.geodetic_crs)
    if geod is None or geodetic is None:
        return None
    way = Transformer.from_crs(crs, geodetic, always_xy=True)
    unit_deg = np.degrees(geodetic.axis_info[0].unit_conversion_factor)  # some count in grads
    there = shapely.transform(
        geometry, lambda at: unit_deg * np.column_stack(way.transform(at[:, 0], at[:, 1]))
    )
    if there.geom_type == "Polygon":
        return float(geod.geometry_area_perimeter(shapely.geometry.polygon.orient(there))[0])
    return float(geod.geometry_length(there))


def _differing(on_map: float, on_ellipsoid: float | None) -> float | None:
    if on_ellipsoid is None or abs(on_ellipsoid - on_map) <= _DISTORTED * on_map:
        return None
    return on_ellipsoid
