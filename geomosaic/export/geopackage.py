"""A GeoPackage of vector layers: OGR makes the tables, SQLite takes rows and spatial indexes in bulk.

Through OGR's features a row costs 20 microseconds in Python, and a survey has hundreds of thousands of tie
points. A GeoPackage's row is one of plain SQLite, but for the short header of its geometry.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from osgeo import gdal, ogr, osr

from geomosaic.doors.gdal_failures import gdal_failures, gdal_options
from geomosaic.export.rtree import fill_rtree

_TYPES = {"i": ogr.OFTInteger64, "u": ogr.OFTInteger64, "f": ogr.OFTReal, "U": ogr.OFTString}
_GEOMETRIES = {
    "Point": ogr.wkbPoint,
    "PointZ": ogr.wkbPoint25D,
    "LineString": ogr.wkbLineString,
    "Polygon": ogr.wkbPolygon,
    "MultiPolygon": ogr.wkbMultiPolygon,
}
_COLUMN = "geom"


@dataclass(frozen=True)
class _Layer:
    name: str
    text: str
    geometry_type: str
    geometries: NDArray[np.object_]
    fields: dict[str, NDArray[Any]]


class GeoPackage:
    """The layers that go into a GeoPackage."""

    def __init__(self) -> None:
        self._layers: list[_Layer] = []

    def add_layer(
        self,
        name: str,
        text: str,
        geometry_type: str,
        geometries: Sequence[Any] | NDArray[np.object_],
        fields: dict[str, Any],
    ) -> None:
        """A layer of shapely geometries; `fields` are columns of the same length (numbers or text).

        NaN and None become NULL. Names and texts are data: they are bound or quoted.
        """
        columns = {field: np.asarray(values) for field, values in fields.items()}
        shapes = np.array([*geometries], dtype=object)
        self._layers.append(_Layer(name, text, geometry_type, shapes, columns))

    def write(self, path: Path, crs: str) -> None:
        """Tables, rows, indexes. Raises: `RuntimeError` (OGR's) or `OSError`."""
        reference = osr.SpatialReference()
        reference.SetFromUserInput(crs)
        reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
        dataset = gdal.GetDriverByName("GPKG").Create(str(path), 0, 0, 0, gdal.GDT_Unknown)
        for layer in self._layers:
            options = ["SPATIAL_INDEX=YES", f"GEOMETRY_NAME={_COLUMN}", f"DESCRIPTION={layer.text}"]
            made = dataset.CreateLayer(layer.name, reference, _GEOMETRIES[layer.geometry_type], options)
            for field, values in layer.fields.items():
                made.CreateField(ogr.FieldDefn(field, _TYPES[values.dtype.kind]))
        dataset.FlushCache()
        del made, dataset
        _fill(path, self._layers)


def _fill(path: Path, layers: Sequence[_Layer]) -> None:
    """The rows of every layer, and what OGR's triggers would have noted of them."""
    try:
        with closing(sqlite3.connect(path, isolation_level=None)) as database:
            database.execute("PRAGMA journal_mode = OFF")
            database.execute("PRAGMA synchronous = OFF")
            database.execute("BEGIN")
            for layer in layers:
                _fill_layer(database, layer)
            database.execute("COMMIT")
    except sqlite3.Error as error:
        full = getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL
        raise OSError(errno.ENOSPC if full else errno.EIO, str(error)) from error


def _fill_layer(database: sqlite3.Connection, layer: _Layer) -> None:
    name = (layer.name,)
    (srs_id,) = database.execute(
        "SELECT srs_id FROM gpkg_geometry_columns WHERE table_name = ?", name
    ).fetchone()
    columns = ", ".join(_quoted(column) for column in (_COLUMN, *layer.fields))
    marks = ", ".join("?" * (1 + len(layer.fields)))
    rows = zip(_blobs(layer, srs_id), *(_values(v) for v in layer.fields.values()), strict=True)
    with _without_insert_triggers(database, layer.name):
        database.executemany(f"INSERT INTO {_quoted(layer.name)} ({columns}) VALUES ({marks})", rows)  # noqa: S608
    count = len(layer.geometries)
    database.execute("UPDATE gpkg_ogr_contents SET feature_count = ? WHERE table_name = ?", (count, *name))
    boxes = shapely.bounds(layer.geometries).reshape(-1, 4)
    there = np.isfinite(boxes).all(axis=1)
    if not there.any():
        return
    fill_rtree(
        database, f"rtree_{layer.name}_{_COLUMN}", np.flatnonzero(there) + 1, boxes[there][:, [0, 2, 1, 3]]
    )
    whole = (*boxes[there][:, :2].min(axis=0).tolist(), *boxes[there][:, 2:].max(axis=0).tolist())
    database.execute(
        "UPDATE gpkg_contents SET min_x = ?, min_y = ?, max_x = ?, max_y = ? WHERE table_name = ?",
        (*whole, *name),
    )


@contextmanager
def _without_insert_triggers(database: sqlite3.Connection, table: str) -> Iterator[None]:
    """They count rows and index boxes one by one, by functions that only OGR has."""
    triggers = database.execute(
        "SELECT name, sql FROM sqlite_master "
        "WHERE type = 'trigger' AND tbl_name = ? AND name LIKE '%insert%' ORDER BY rowid",
        (table,),
    ).fetchall()
    for name, _ in triggers:
        database.execute(f"DROP TRIGGER {_quoted(name)}")
    yield
    for _, made in triggers:
        database.execute(made)


def _blobs(layer: _Layer, srs_id: int) -> Iterator[bytes | None]:
    """Geometries as GeoPackages hold them: `GP`, version, flags, CRS, bounds but of points, ISO WKB."""
    bounded = not layer.geometry_type.startswith("Point")
    head = b"GP\x00" + (b"\x03" if bounded else b"\x01") + srs_id.to_bytes(4, "little", signed=True)
    bounds = shapely.bounds(layer.geometries)[:, [0, 2, 1, 3]].astype("<f8")
    for k, wkb in enumerate(shapely.to_wkb(layer.geometries, flavor="iso", byte_order=1)):
        yield None if wkb is None else head + (bounds[k].tobytes() if bounded else b"") + wkb


def _values(column: NDArray[Any]) -> list[Any]:
    values: list[Any] = column.tolist()
    if column.dtype.kind == "f":
        for k in np.flatnonzero(np.isnan(column)):
            values[k] = None
    return values


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


@contextmanager
def writing_geopackage(path: Path, crs: str, time_s: float | None) -> Iterator[GeoPackage]:
    """A new GeoPackage at `path`, whole when the block ends.

    time_s: seconds since 1970 UTC that stand as its time of change, so that equal data give equal bytes.
    """
    stamp = datetime.fromtimestamp(time_s or 0.0, UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    settings = {"OGR_CURRENT_DATE": stamp, "OGR_SQLITE_SYNCHRONOUS": "OFF"}
    package = GeoPackage()
    yield package
    with gdal_failures(path), gdal_options(settings):
        package.write(path, crs)
