"""What a finished run's rasters say of lines and polygons: their measures and deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.windows import Window

from geomosaic.arrays import Floats
from geomosaic.composition.tiles import TILE_PX
from geomosaic.constants import MEDIAN_LENGTH
from geomosaic.doors.raster import OWN, Raster, open_raster, reading
from geomosaic.doors.vector import Shapes
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import check_on_earth
from geomosaic.quality.measured import Figure, Volume, area_of, length_of, rings_of_polygon, volume_of

ASSUMED: Final = (
    "errors that the whole map has in common cancel; what a vertex's deviation exceeds the map's least by, "
    "the mismatch at seams and a pixel's rounding count as independent from vertex to vertex; the scale's "
    "deviation is added"
)
VOLUMES_ASSUMED: Final = (
    "a volume counts from the plane that fits the rim best; heights inside count as off by one error in "
    "common, those of the rim by another: the safe side"
)


@dataclass(frozen=True)
class RunRasters:
    """A run's rasters: accuracy.tif, and where there is a surface its surface.tif and surface_confidence.tif.

    summary: run.json.
    """

    accuracy: Path
    summary: Mapping[str, Any]
    surface: Path | None = None
    confidence: Path | None = None


@dataclass(frozen=True)
class MeasuredPolygon:
    """Its area; its volume, None without a surface under all of it."""

    area: Figure
    volume: Volume | None


def measure_lines(rasters: RunRasters, lines: Shapes, file: Path) -> tuple[str, list[Figure]]:
    """The map's CRS and the lengths of lines.

    Raises: `InputError` naming `file` where they can't be brought to the map.
    """
    with open_raster(rasters.accuracy, OWN) as accuracy:
        crs = CRS.from_user_input(accuracy.crs.to_wkt())
        scale = scale_sd_of(rasters.summary)
        found = []
        for line in on_map(lines, crs, file):
            sd_m = relative_sd_m(accuracy, rasters.summary, shapely.get_coordinates(line))
            found.append(length_of(line, sd_m, scale, crs))
    return crs.name, found


def measure_polygons(rasters: RunRasters, polygons: Shapes, file: Path) -> tuple[str, list[MeasuredPolygon]]:
    """The map's CRS and the areas and volumes of polygons.

    Raises: `InputError` naming `file` where they can't be brought to the map or cross themselves.
    """
    with open_raster(rasters.accuracy, OWN) as accuracy:
        crs = CRS.from_user_input(accuracy.crs.to_wkt())
        scale = scale_sd_of(rasters.summary)
        found = []
        for number, polygon in enumerate(on_map(polygons, crs, file), start=1):
            if not polygon.is_valid or polygon.area == 0.0:
                fix = "correct it in a GIS (QGIS: Fix geometries)"
                raise InputError(f"polygon {number} crosses itself or is empty", file=file, fix=fix)
            sd_m = relative_sd_m(accuracy, rasters.summary, shapely.get_coordinates(polygon))
            area = area_of(polygon, sd_m, scale, crs)
            share = 1.0 if area.ellipsoidal is None else area.ellipsoidal / area.value
            found.append(MeasuredPolygon(area, _volume(rasters, polygon, share)))
    return crs.name, found


def on_map(shapes: Shapes, crs: CRS, file: Path) -> list[Any]:
    """Shapes in a map's CRS, vertex by vertex: edges are straight there. Raises: `InputError`."""
    check_on_earth(crs.to_wkt(), "measurement")
    try:
        way = Transformer.from_crs(shapes.crs, crs.to_2d(), always_xy=True)
    except ProjError as error:
        problem = f"PROJ knows no way from its coordinate reference system to the map's ({error})"
        raise InputError(problem, file=file, fix="write it in one with an EPSG code") from error

    def there(at: Floats) -> Floats:
        return np.column_stack(way.transform(at[:, 0], at[:, 1]))

    found = [shapely.transform(shape, there) for shape in shapes.geometries]
    if not all(np.isfinite(shapely.get_coordinates(shape)).all() for shape in found):
        fix = "check its coordinate reference system"
        raise InputError("has coordinates that are nowhere on the run's map", file=file, fix=fix)
    return found


def relative_sd_m(accuracy: Raster, summary: Mapping[str, Any], at_m: Floats) -> Floats:
    """Deviations (n,) in m, along an axis, of places (n, 2) against the rest of the map; NaN outside it.

    The least deviation of accuracy.tif is what the whole map has in common.
    """
    stated = sampled(accuracy, 1, at_m)
    common_m = float(accuracy.tags(1).get("STATISTICS_MINIMUM", "nan"))
    gsd_m = float(summary.get("mosaic", {}).get("gsd_m", 0.0))
    seams_px = summary.get("metrics", {}).get("seams", {}).get("median_px") or 0.0
    mismatch_px, rounding_px = float(seams_px) / (np.sqrt(2.0) * MEDIAN_LENGTH), 1.0 / np.sqrt(12.0)
    own_m = np.hypot(mismatch_px, rounding_px) * gsd_m
    return np.asarray(np.sqrt(np.maximum(stated**2 - common_m**2, 0.0) + own_m**2))


def scale_sd_of(summary: Mapping[str, Any]) -> float:
    """Of the map's scale, as a share, as far as run.json states it."""
    stated = summary.get("accuracy", {}).get("relative", {}).get("scale_permille")
    return 1e-3 * float(stated) if isinstance(stated, int | float) and np.isfinite(stated) else 0.0


def _volume(rasters: RunRasters, polygon: Any, share: float) -> Volume | None:
    """Over the run's surface, None where that does not lie under all of the polygon.

    Args: share: of the polygon's area on the ellipsoid in that on the map. Heights are the same on both.
    """
    if rasters.surface is None or rasters.confidence is None:
        return None
    with open_raster(rasters.surface, OWN) as surface, open_raster(rasters.confidence, OWN) as confidence:
        window = _window(surface, shapely.get_coordinates(polygon))
        if not (window.width and window.height):
            return None
        of = surface.transform
        east = of.c + of.a * (window.col_off + np.arange(int(window.width)) + 0.5)
        north = of.f + of.e * (window.row_off + np.arange(int(window.height)) + 0.5)
        middles = np.stack(np.meshgrid(east, north), axis=-1)
        shapely.prepare(polygon)
        inside = middles[shapely.contains_xy(polygon, middles[..., 0], middles[..., 1])]
        rings = [shapely.segmentize(shapely.LinearRing(r), of.a) for r in rings_of_polygon(polygon)]
        rim = np.concatenate([shapely.get_coordinates(ring)[:-1] for ring in rings])
        heights = [np.column_stack([at, sampled(surface, 1, at)]) for at in (inside, rim)]
        sds = [sampled(confidence, 1, at) for at in (inside, rim)]
    if not len(inside) or not all(np.isfinite(height).all() for height in heights):
        return None
    return volume_of(heights[0], heights[1], sds[0], sds[1], abs(of.a * of.e) * share)


def _window(raster: Raster, at_m: Floats) -> Window:
    """The pixels about places, as far as the raster goes."""
    cols, rows = _pixels(raster, at_m)
    first_col, first_row = max(int(np.floor(cols.min())), 0), max(int(np.floor(rows.min())), 0)
    width = max(min(int(np.floor(cols.max())) + 1, raster.width) - first_col, 0)
    height = max(min(int(np.floor(rows.max())) + 1, raster.height) - first_row, 0)
    return Window(first_col, first_row, width, height)


def _pixels(raster: Raster, at_m: Floats) -> tuple[Floats, Floats]:
    """Cols and rows (n,) of places (n, 2) in a north-up raster."""
    to_map = raster.transform
    return (at_m[:, 0] - to_map.c) / to_map.a, (at_m[:, 1] - to_map.f) / to_map.e


def sampled(raster: Raster, band: int, at_m: Floats) -> Floats:
    """A band's values (n,) at places (n, 2) of the map, NaN where there are none. Only tiles with places are
    read."""
    out = np.full(len(at_m), np.nan)
    col, row = (np.floor(px).astype(np.intp) for px in _pixels(raster, at_m))
    within = np.flatnonzero((col >= 0) & (col < raster.width) & (row >= 0) & (row < raster.height))
    tiles = np.column_stack([row[within], col[within]]) // TILE_PX
    for top, left in np.unique(tiles, axis=0).tolist():
        mine = within[(tiles == (top, left)).all(axis=1)]
        size = min(TILE_PX, raster.width - left * TILE_PX), min(TILE_PX, raster.height - top * TILE_PX)
        window = Window(left * TILE_PX, top * TILE_PX, *size)
        with reading(Path(raster.name), OWN.problem, OWN.fix):
            values = raster.read(band, window=window, masked=True).astype(np.float64).filled(np.nan)
        out[mine] = values[row[mine] - top * TILE_PX, col[mine] - left * TILE_PX]
    return out
