"""The one place where a file of outlines is opened: a regular local file of a listed driver, its polygons."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import shapely

from geomosaic.doors import raster  # noqa: F401 - takes the drivers that connect out of GDAL
from geomosaic.doors.bindings import gdal, ogr
from geomosaic.doors.files import check_regular, printable
from geomosaic.doors.references import check_sidecars
from geomosaic.errors import FileError

DRIVERS: Final = ("GPKG", "GeoJSON", "ESRI Shapefile", "FlatGeobuf", "KML")
"""None of them follows a link to another place."""
_MOST_VERTICES: Final = 2_000_000
_MOST_FEATURES: Final = 1_000_000
_TEXTS: Final = ("GeoJSON", "KML")
_MOST_TEXT_BYTES: Final = 256 << 20  # GDAL reads them whole
_NOT_THIS: Final = "give a GeoPackage, GeoJSON, Shapefile, FlatGeobuf or KML of polygons"
_POLYGONS: Final = (ogr.wkbPolygon, ogr.wkbMultiPolygon)
_MAY_HOLD_POLYGONS: Final = (
    *(ogr.wkbUnknown, ogr.wkbGeometryCollection, *_POLYGONS),
    *(ogr.wkbCurvePolygon, ogr.wkbMultiSurface, ogr.wkbSurface),
)


@dataclass(frozen=True)
class Polygons:
    """The polygons of a file's one layer that has some, and their CRS as WKT.

    geometries: shapely's, x before y, of straight edges, as valid as the file has them.
    """

    geometries: tuple[Any, ...]
    crs: str


def read_polygons(path: Path) -> Polygons:
    """All polygons of a file, those within collections too; points and lines are passed over.

    Raises: `FileError` for what is no regular local file or of none of `DRIVERS`, has no polygon or several
    layers with some, no CRS, more than 2 million vertices, or can't be read.
    """
    if str(path).startswith("/vsi"):
        raise FileError("is no path of a file on this machine", file=path, mend=_NOT_THIS)
    check_regular(path, _NOT_THIS)
    path = path.absolute()
    check_sidecars(path)
    with _said(path):
        dataset = open_vector(path)
        layers = [dataset.GetLayerByIndex(i) for i in range(dataset.GetLayerCount())]
        found = {layer.GetName(): (layer, _polygons(layer, path)) for layer in layers}
        found = {name: of for name, of in found.items() if of[1]}
        if not found:
            raise FileError("has no polygon", file=path, mend=_NOT_THIS)
        if len(found) > 1:
            names = printable(", ".join(found))[:200]
            mend = "write the layer that is meant to a file of its own (ogr2ogr area.gpkg FILE LAYER)"
            raise FileError(f"has polygons in {len(found)} layers ({names})", file=path, mend=mend)
        ((layer, polygons),) = found.values()
        reference = layer.GetSpatialRef()
        if reference is None or (reference.GetName() or "").lower().startswith(("undefined", "unknown")):
            mend = "say which its coordinates are (ogr2ogr -a_srs EPSG:n area.gpkg FILE)"
            raise FileError("has no coordinate reference system", file=path, mend=mend)
        return Polygons(tuple(polygons), str(reference.ExportToWkt(["FORMAT=WKT2_2019"])))


@contextmanager
def _said(path: Path) -> Iterator[None]:
    """Puts `FileError` in the place of what GDAL says, and keeps its warnings off the screen."""
    gdal.PushErrorHandler("CPLQuietErrorHandler")
    try:
        yield
    except (RuntimeError, shapely.errors.ShapelyError) as error:
        raise FileError("can't be read as a file of polygons", file=path, mend=_NOT_THIS) from error
    finally:
        gdal.PopErrorHandler()


def open_vector(path: Path) -> Any:
    """Polygons, or a run's own layers, as osgeo's dataset. Raises `FileError` for none of `DRIVERS`."""
    driver = gdal.IdentifyDriverEx(str(path), gdal.OF_VECTOR, list(DRIVERS))
    if driver is None:
        raise FileError("is no file of polygons that is read", file=path, mend=_NOT_THIS)
    if driver.ShortName in _TEXTS and path.stat().st_size > _MOST_TEXT_BYTES:
        raise FileError(f"is over {_MOST_TEXT_BYTES >> 20} MB", file=path, mend="write it as a GeoPackage")
    options = []
    if driver.ShortName == "GPKG":  # read as it lies there: SQLite would put files beside it
        log = path.with_name(f"{path.name}-wal")
        if log.exists() and log.stat().st_size:
            raise FileError("is being written by another program", file=path, mend="close it there first")
        options = ["IMMUTABLE=YES"]
    return gdal.OpenEx(str(path), gdal.OF_VECTOR, allowed_drivers=[driver.ShortName], open_options=options)


def _polygons(layer: Any, path: Path) -> list[Any]:
    if ogr.GT_Flatten(layer.GetGeomType()) not in _MAY_HOLD_POLYGONS:
        return []
    found: list[Any] = []
    vertices = 0
    for number, feature in enumerate(layer):
        geometry = feature.GetGeometryRef()
        for part in () if geometry is None else _parts(geometry.GetLinearGeometry()):
            part.FlattenTo2D()
            found.append(shapely.from_wkb(bytes(part.ExportToWkb())))
            vertices += int(shapely.get_num_coordinates(found[-1]))
        if number >= _MOST_FEATURES or vertices > _MOST_VERTICES:
            problem = f"has more than {_MOST_FEATURES:,} features or {_MOST_VERTICES:,} vertices"
            raise FileError(problem, file=path, mend="simplify it, or take the part that is meant")
    return found


def _parts(geometry: Any) -> Iterator[Any]:
    """The polygons in a geometry, however deep."""
    kind = ogr.GT_Flatten(geometry.GetGeometryType())
    if kind == ogr.wkbPolygon:
        if not geometry.IsEmpty():
            yield geometry
    else:
        for i in range(geometry.GetGeometryCount() if kind >= ogr.wkbMultiPoint else 0):
            yield from _parts(geometry.GetGeometryRef(i))
