"""The heights that a surface is judged by, of a raster or a point cloud, in the surface's map and datum."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from geomosaic.arrays import Bytes, Floats
from geomosaic.composition.tiles import TILE_PX
from geomosaic.constants import tuned
from geomosaic.doors.points import is_point_cloud, open_points
from geomosaic.doors.raster import Raster
from geomosaic.errors import FileError, InputError
from geomosaic.geodesy.heights import ellipsoidal_offset_m, unit_m, vertical_crs
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.quality.heights import NOISE
from geomosaic.quality.rasters import blocks
from geomosaic.survey.dem import read_heights
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.model import ElevationModel

_MOST_POINTS = tuned(5_000_000, "points", "of a point cloud, 200 MB: more take memory and are no better")


@dataclass(frozen=True)
class ReferenceHeights:
    """Points (n,) of a reference: easting and northing in the surface's CRS, height as the surface counts
    it, class; datum says how heights were brought together."""

    east_m: Floats
    north_m: Floats
    height_m: Floats
    kind: Bytes
    datum: str


def check_reference(path: Path) -> None:
    """Raises: `InputError` for what is no elevation model and no point cloud on the map."""
    if is_point_cloud(path):
        with open_points(path) as cloud:
            _crs_of(path, cloud.crs)
    else:
        check_dem(path)


def read_reference(
    path: Path, surface: Raster, offset_m: float | None, warn: Callable[[str], None]
) -> ReferenceHeights:
    """What a reference has where a surface lies: of a raster the heights at the middles of its pixels.

    offset_m: what to add to its heights, None to go by the datums; where it states none it is taken to share
    the surface's, and `warn` hears of it.
    Raises: `InputError` as `check_reference`, and for a geoid whose grid isn't installed.
    """
    there = _crs_on_map(surface)
    if not is_point_cloud(path):
        crs, _ = check_dem(path)
        added_m, datum = _datum(path, crs, surface, offset_m, warn)
        east, north, height = _of_raster(path, crs, surface, there)
        return ReferenceHeights(east, north, height + added_m, np.zeros(len(east), dtype=np.uint8), datum)
    with open_points(path) as cloud:
        crs = _crs_of(path, cloud.crs)
        added_m, datum = _datum(path, crs, surface, offset_m, warn)
        east, north, height, kind = _of_points(cloud, crs, surface, there)
        return ReferenceHeights(east, north, height + added_m, kind, datum)


def _crs_on_map(surface: Raster) -> CRS:
    return CRS.from_wkt(surface.crs.to_wkt(version="WKT2_2019"))


def _crs_of(path: Path, crs: CRS | None) -> CRS:
    if crs is None:
        fix = "assign its coordinate reference system (pdal translate --writers.las.a_srs=EPSG:n)"
        raise FileError("the point cloud has no coordinate reference system", file=path, fix=fix)
    level = crs.sub_crs_list[0] if crs.is_compound else crs
    if not level.is_projected or any(axis.unit_conversion_factor != 1.0 for axis in level.axis_info):
        problem = f"the point cloud's coordinate reference system '{level.name}' is no map in metres"
        raise FileError(problem, file=path, fix="reproject it to a map projection in metres")
    return crs


def _datum(
    path: Path, crs: CRS, surface: Raster, offset_m: float | None, warn: Callable[[str], None]
) -> tuple[float, str]:
    """What to add to a reference's heights, and in words why."""
    if offset_m is not None:
        return offset_m, f"offset {offset_m:+g} m as given"
    there = _crs_on_map(surface)
    theirs, ours = vertical_crs(crs), vertical_crs(there)
    if theirs is None:
        warn(
            f"{path.name}: no vertical datum, so its heights are taken in the surface's: a constant "
            "difference may be that of the datums; give it with --set quality.surface.offset_m=METRES"
        )
        return 0.0, "assumed to share the surface's datum"
    if ours is not None and theirs == ours:
        return 0.0, theirs.name
    west, south, east, north = surface.bounds
    lonlat = MapProjection(there.to_wkt()).geodetic_from_map((west + east) / 2.0, (south + north) / 2.0)
    try:
        added_m = ellipsoidal_offset_m(theirs, *lonlat)
        added_m -= 0.0 if ours is None else ellipsoidal_offset_m(ours, *lonlat)
    except InputError as error:
        fix = f"give what to add to its heights with --set quality.surface.offset_m=METRES, or {error.fix}"
        raise InputError(error.problem, file=path, fix=fix) from error
    return added_m, f"{theirs.name}, offset {added_m:+.2f} m"


def _of_raster(path: Path, crs: CRS, surface: Raster, there: CRS) -> tuple[Floats, Floats, Floats]:
    model, t = ElevationModel(str(path), 0.0, ""), surface.transform
    found: list[tuple[Floats, Floats, Floats]] = [(np.zeros(0), np.zeros(0), np.zeros(0))]
    for window in blocks(surface.height, surface.width, TILE_PX):
        rows, cols = np.nonzero(surface.read_masks(1, window=window))
        if not len(rows):
            continue
        east = t.c + (cols + window.col_off + 0.5) * t.a
        north = t.f + (rows + window.row_off + 0.5) * t.e
        lonlat = MapProjection(there.to_wkt()).geodetic_from_map(east, north)
        x, y = MapProjection(crs.to_wkt()).map_from_geodetic(lonlat[:, 0], lonlat[:, 1]).T
        if not np.isfinite([x, y]).all():
            continue
        try:
            heights = read_heights(model, (x.min(), y.min(), x.max(), y.max())).at(x, y)
        except FileError as error:
            if "does not cover" in error.problem:
                continue
            raise
        found.append((east, north, heights))
    east, north, height = (np.concatenate(part) for part in zip(*found, strict=True))
    known = np.isfinite(height)
    return east[known], north[known], height[known]


def _of_points(cloud: Any, crs: CRS, surface: Raster, there: CRS) -> tuple[Floats, Floats, Floats, Bytes]:
    bounds, same, vertical = surface.bounds, crs.to_2d() == there.to_2d(), vertical_crs(crs)
    to_m = np.array([1.0, 1.0, 1.0 if vertical is None else unit_m(vertical)])
    found = [(np.zeros((0, 3)), np.zeros(0, dtype=np.uint8))]
    for points in cloud.some(_MOST_POINTS):
        xyz = points.xyz * to_m
        if not same:
            lonlat = MapProjection(crs.to_wkt()).geodetic_from_map(xyz[:, 0], xyz[:, 1])
            at = MapProjection(there.to_wkt()).map_from_geodetic(lonlat[:, 0], lonlat[:, 1])
            xyz = np.column_stack([at, xyz[:, 2]])
        inside = (xyz[:, 0] >= bounds.left) & (xyz[:, 0] <= bounds.right)
        inside &= (xyz[:, 1] >= bounds.bottom) & (xyz[:, 1] <= bounds.top) & ~np.isin(points.kind, NOISE)
        found.append((xyz[inside], points.kind[inside]))
    xyz, kind = (np.concatenate(part) for part in zip(*found, strict=True))
    return xyz[:, 0], xyz[:, 1], xyz[:, 2], kind
