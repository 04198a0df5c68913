"""A STAC item of a finished run: what, where, when, and the files that belong to it (STAC 1.1, by pystac)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from pyproj import CRS

from geomosaic.arrays import Floats
from geomosaic.composition.model import Mosaic
from geomosaic.doors.raster import OWN, Raster, open_raster
from geomosaic.geodesy.antimeridian import split_area
from geomosaic.geodesy.mapcrs import MapProjection, check_on_earth

_COG: Final = "image/tiff; application=geotiff; profile=cloud-optimized"
ASSETS: Final[dict[str, tuple[str, str, tuple[str, ...]]]] = {
    "mosaic.tif": ("Mosaic", _COG, ("data", "visual")),
    "mosaic_map.tif": ("Scene on the map", _COG, ("data", "visual")),
    "mosaic_RPC.TXT": ("Rational polynomials of the scene", "text/plain", ("metadata",)),
    "surface.tif": ("Surface", _COG, ("data",)),
    "terrain.tif": ("Terrain", _COG, ("data",)),
    "surface_confidence.tif": ("Deviation and views of the surface", _COG, ("metadata",)),
    "surface_hillshade.tif": ("Shading of the surface", _COG, ("visual",)),
    "terrain_contours.gpkg": ("Contours of the terrain", "application/geopackage+sqlite3", ("data",)),
    "point_cloud.laz": ("Point cloud", "application/vnd.laszip", ("data",)),
    "layers.gpkg": ("Frames, tie points, seamlines", "application/geopackage+sqlite3", ("metadata",)),
    "positions.csv": ("Exterior orientation", "text/csv", ("metadata",)),
    "offsets.csv": ("Offsets between CCDs", "text/csv", ("metadata",)),
    "accuracy.tif": ("Standard deviations of places", _COG, ("metadata",)),
    "sources.tif": ("Which frame made each pixel", _COG, ("metadata",)),
    "mosaic.pmtiles": ("Web map tiles", "application/vnd.pmtiles", ("visual",)),
    "report.html": ("Report", "text/html", ("metadata",)),
}
"""What a run folder may hold: title, media type, roles."""
_SIMPLIFY_PX = 4.0
_NO_TIME: Final = "The images' times are unknown: datetime is when the mosaic was written."


@dataclass(frozen=True)
class Coverage:
    """Where a raster lies. area: in longitude and latitude of WGS 84, None where that is unknown. crs,
    transform (six numbers, row by row) and bbox: of its map, if it has one. shape: rows, cols."""

    area: Any
    gsd_m: float
    shape: tuple[int, int]
    crs: str | None = None
    transform: tuple[float, ...] = ()
    bbox: tuple[float, ...] = ()


def coverage_of_mosaic(mosaic: Mosaic) -> Coverage:
    """Its valid area, a little simplified. Raises `InputError` in a local frame."""
    grid = mosaic.grid
    check_on_earth(grid.crs, "STAC item")
    faces = [shapely.Polygon(p[0], list(p[1:])) for s in mosaic.seamlines for p in s.polygons]
    whole = shapely.box(grid.west_m, grid.south_m, grid.east_m, grid.north_m)
    area = shapely.simplify(shapely.unary_union(faces) if faces else whole, _SIMPLIFY_PX * grid.gsd_m)
    projection = MapProjection(grid.crs)
    return Coverage(
        shapely.transform(area, lambda xy: projection.geodetic_from_map(xy[:, 0], xy[:, 1])),
        grid.gsd_m,
        (grid.height_px, grid.width_px),
        grid.crs,
        (grid.gsd_m, 0.0, grid.west_m, 0.0, -grid.gsd_m, grid.north_m),
        (grid.west_m, grid.south_m, grid.east_m, grid.north_m),
    )


def coverage_of_scene(ring_deg: Floats, gsd_m: float, height_px: int, width_px: int) -> Coverage:
    """A scene of strips without a map, by its outline (n, 2) of longitude and latitude, if known."""
    area = shapely.Polygon(ring_deg) if len(ring_deg) else None
    return Coverage(area, gsd_m, (height_px, width_px))


def stac_item(
    name: str, coverage: Coverage, times_s: Sequence[float], made_s: float, folder: Path
) -> dict[str, Any]:
    """The item as plain values.

    Args: times_s: of the images, seconds since 1970 UTC; without any, `datetime` is made_s, when the mosaic
    was written, and the description says so. folder: holds the item and, by now, some of `ASSETS`, which are
    referred to relative to the item.
    """
    import pystac
    from pystac.extensions.projection import ProjectionExtension

    area, bbox = (None, None) if coverage.area is None else split_area(coverage.area)
    start, end = (_utc(of(times_s)) if times_s else None for of in (min, max))
    item = pystac.Item(
        id=name,
        geometry=None if area is None else shapely.geometry.mapping(area),
        bbox=bbox,
        datetime=start or _utc(made_s),
        start_datetime=start,
        end_datetime=end,
        properties={
            "gsd": coverage.gsd_m,
            "created": pystac.utils.datetime_to_str(_utc(made_s)),
            **({} if times_s else {"description": _NO_TIME}),
        },
    )
    ProjectionExtension.ext(item, add_if_missing=True).apply(
        bbox=list(coverage.bbox) or None,
        shape=list(coverage.shape),
        transform=list(coverage.transform) or None,
        **_reference(coverage.crs),
    )
    item.properties.setdefault("proj:code", None)
    for file in ASSETS:
        if (path := folder / file).is_file():
            title, media, roles = ASSETS[file]
            asset = pystac.Asset(f"./{file}", title=title, media_type=media, roles=list(roles))
            item.add_asset(path.stem if path.stem not in item.assets else file.replace(".", "_"), asset)
            if path.suffix == ".tif":
                _describe(asset, path)
    return dict(item.to_dict(include_self_link=False, transform_hrefs=False))


def _reference(crs: str | None) -> dict[str, Any]:
    """A CRS by its code where it has one, else by its WKT."""
    known = None if crs is None else CRS.from_user_input(crs)
    authority = None if known is None else known.to_authority()
    return {
        "code": ":".join(authority) if authority else None,
        "wkt2": None if known is None or authority else known.to_wkt(),
    }


def _describe(asset: Any, path: Path) -> None:
    """Where a raster's pixels lie, and what stands in each of its bands."""
    from pystac.extensions.projection import ProjectionExtension

    with open_raster(path, OWN) as tiff:
        placed = tiff.crs is not None
        ProjectionExtension.ext(asset).apply(
            shape=[tiff.height, tiff.width],
            transform=list(tiff.transform[:6]) if placed else None,
            bbox=list(tiff.bounds) if placed else None,
            **_reference(tiff.crs.to_wkt() if placed else None),
        )
        if placed:
            asset.extra_fields["gsd"] = tiff.res[0]
        if heights := tiff.tags().get("HEIGHTS"):
            asset.description = f"Heights are {heights}."
        asset.extra_fields["bands"] = [_band(tiff, number) for number in tiff.indexes]


def _band(tiff: Raster, number: int) -> dict[str, Any]:
    k = number - 1
    band_fields = {
        "name": tiff.descriptions[k] or tiff.colorinterp[k].name,
        "data_type": tiff.dtypes[k],
        "nodata": _nodata(tiff.nodatavals[k]),
        "unit": tiff.units[k],
    }
    statistics = {
        name: float(text)
        for name in ("minimum", "maximum", "mean", "stddev")
        if (text := tiff.tags(number).get(f"STATISTICS_{name.upper()}")) is not None
    }
    return {k: v for k, v in {**band_fields, "statistics": statistics}.items() if v not in (None, "", {})}


def _nodata(value: float | None) -> float | str | None:
    """As STAC has it: JSON has no number for NaN and infinity."""
    return value if value is None or np.isfinite(value) else str(value)


def write_stac(path: Path, item: dict[str, Any]) -> None:
    """The item as JSON."""
    path.write_text(json.dumps(item, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def _utc(time_s: float) -> datetime:
    return datetime.fromtimestamp(round(time_s, 3), UTC)
