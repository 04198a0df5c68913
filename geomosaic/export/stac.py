"""A STAC item of a finished run: what, where, when, and the files that belong to it (STAC 1.0)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import shapely
from pyproj import CRS

from geomosaic.geodesy.mapcrs import MapProjection, check_on_earth
from geomosaic.mosaic.model import Mosaic

_PROJECTION: Final = "https://stac-extensions.github.io/projection/v1.1.0/schema.json"
_COG: Final = "image/tiff; application=geotiff; profile=cloud-optimized"
ASSETS: Final[dict[str, tuple[str, str, tuple[str, ...]]]] = {
    "mosaic.tif": ("Mosaic", _COG, ("data", "visual")),
    "layers.gpkg": ("Frames, tie points, seamlines", "application/geopackage+sqlite3", ("metadata",)),
    "positions.csv": ("Exterior orientation", "text/csv", ("metadata",)),
    "sources.tif": ("Which frame made each pixel", "image/tiff; application=geotiff", ("metadata",)),
    "report.html": ("Report", "text/html", ("metadata",)),
}
"""What a run folder may hold: title, media type, roles."""
_SIMPLIFY_PX = 4.0


def stac_item(name: str, mosaic: Mosaic, times_s: Sequence[float], files: Sequence[str]) -> dict[str, Any]:
    """The item as plain values.

    The geometry is the mosaic's valid area in WGS 84, a little simplified; if the frames' times are unknown
    `datetime` is null and, as STAC then wants, start and end are the epoch's.

    Args: files: names of those of `ASSETS` that exist; they are referred to relative to the item.
    """
    grid = mosaic.grid
    check_on_earth(grid.crs, "STAC item")
    area = _valid_area(mosaic)
    code = CRS.from_user_input(grid.crs).to_epsg()
    start, end = (_utc(t) for t in (min(times_s, default=0.0), max(times_s, default=0.0)))
    return {
        "type": "Feature",
        "stac_version": "1.0.0",
        "stac_extensions": [_PROJECTION],
        "id": name,
        "geometry": shapely.geometry.mapping(area),
        "bbox": list(area.bounds),
        "properties": {
            "datetime": start if times_s else None,
            "start_datetime": start,
            "end_datetime": end,
            "gsd": grid.gsd_m,
            "proj:epsg": code,
            **({} if code else {"proj:wkt2": CRS.from_user_input(grid.crs).to_wkt()}),
            "proj:shape": [grid.height_px, grid.width_px],
            "proj:transform": [grid.gsd_m, 0.0, grid.west_m, 0.0, -grid.gsd_m, grid.north_m],
            "proj:bbox": [grid.west_m, grid.south_m, grid.east_m, grid.north_m],
        },
        "links": [],
        "assets": {
            Path(file).stem: {
                "href": f"./{file}",
                "title": ASSETS[file][0],
                "type": ASSETS[file][1],
                "roles": list(ASSETS[file][2]),
            }
            for file in files
        },
    }


def write_stac(path: Path, item: dict[str, Any]) -> None:
    """The item as JSON."""
    path.write_text(json.dumps(item, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def _valid_area(mosaic: Mosaic) -> Any:
    grid = mosaic.grid
    faces = [shapely.Polygon(p[0], list(p[1:])) for s in mosaic.seamlines for p in s.polygons]
    whole = shapely.box(grid.west_m, grid.south_m, grid.east_m, grid.north_m)
    area = shapely.simplify(shapely.unary_union(faces) if faces else whole, _SIMPLIFY_PX * grid.gsd_m)
    projection = MapProjection(grid.crs)
    return shapely.transform(area, lambda xy: projection.geodetic_from_map(xy[:, 0], xy[:, 1]))


def _utc(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
