"""The one place where a file of shapes is opened: a local file of a listed driver; polygons or lines."""

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
_FORMATS: Final = "give a GeoPackage, GeoJSON, Shapefile, FlatGeobuf or KML"


@dataclass(frozen=True)
class GeometryKind:
    """What is looked for in a file: its name, OGR's type of one, and those of layers that may hold some."""

    name: str
    single: int
    layers: tuple[int, ...]

    @property
    def wanted(self) -> str:
        """What a user is asked for."""
        return f"{_FORMATS} of {self.name}s"


_ANY: Final = (ogr.wkbUnknown, ogr.wkbGeometryCollection)
POLYGON: Final = GeometryKind(
    "polygon",
    ogr.wkbPolygon,
    (*_ANY, ogr.wkbPolygon, ogr.wkbMultiPolygon, ogr.wkbCurvePolygon, ogr.wkbMultiSurface, ogr.wkbSurface),
)
LINE: Final = GeometryKind(
    "line",
    ogr.wkbLineString,
    (*_ANY, ogr.wkbLineString, ogr.wkbMultiLineString, ogr.wkbCompoundCurve, ogr.wkbMultiCurve, ogr.wkbCurve),
)


@dataclass(frozen=True)
class Shapes:
    """The polygons or lines of a file's one layer that has some, and their CRS as WKT.

    geometries: shapely's, x before y, of straight edges, as valid as the file has them.
    """

    geometries: tuple[Any, ...]
    crs: str


def read_shapes(path: Path, kind: GeometryKind = POLYGON) -> Shapes:
    """All polygons, or lines, of a file, those within collections too; other geometries are ignored.

    Raises: `FileError` for what is no regular local file or of none of `DRIVERS`. The same for a file that
    has none of that kind or several layers with some, no CRS, more than 2 million vertices, or can't be read.
    """
    if str(path).startswith("/vsi"):
        raise FileError("is no file on this machine", file=path, fix=kind.wanted)
    check_regular(path, kind.wanted)
    path = path.absolute()
    check_sidecars(path)
    with _said(path, kind):
        dataset = open_vector(path, kind)
        layers = [dataset.GetLayerByIndex(i) for i in range(dataset.GetLayerCount())]
        found = {layer.GetName(): (layer, _of_kind(layer, path, kind)) for layer in layers}
        found = {name: of for name, of in found.items() if of[1]}
        if not found:
            raise FileError(f"has no {kind.name}", file=path, fix=kind.wanted)
        if len(found) > 1:
            names = printable(", ".join(found))[:200]
            fix = "write the layer that is meant to a file of its own (ogr2ogr area.gpkg FILE LAYER)"
            raise FileError(f"has {kind.name}s in {len(found)} layers ({names})", file=path, fix=fix)
        ((layer, shapes),) = found.values()
        reference = layer.GetSpatialRef()
        if reference is None or (reference.GetName() or "").lower().startswith(("undefined", "unknown")):
            fix = "say which its coordinates are (ogr2ogr -a_srs EPSG:n area.gpkg FILE)"
            raise FileError("has no coordinate reference system", file=path, fix=fix)
        return Shapes(tuple(shapes), str(reference.ExportToWkt(["FORMAT=WKT2_2019"])))


@contextmanager
def _said(path: Path, kind: GeometryKind) -> Iterator[None]:
    """Puts `FileError` in the place of what GDAL says, and keeps its warnings off the screen."""
    gdal.PushErrorHandler("CPLQuietErrorHandler")
    try:
        yield
    except (RuntimeError, shapely.errors.ShapelyError) as error:
        raise FileError(f"can't be read as a file of {kind.name}s", file=path, fix=kind.wanted) from error
    finally:
        gdal.PopErrorHandler()


def open_vector(path: Path, kind: GeometryKind = POLYGON) -> Any:
    """Polygons or lines, or a run's own layers, as osgeo's dataset; `FileError` for none of `DRIVERS`."""
    driver = gdal.IdentifyDriverEx(str(path), gdal.OF_VECTOR, list(DRIVERS))
    if driver is None:
        raise FileError(f"is no file of {kind.name}s that is read", file=path, fix=kind.wanted)
    if driver.ShortName in _TEXTS and path.stat().st_size > _MOST_TEXT_BYTES:
        raise FileError(f"is over {_MOST_TEXT_BYTES >> 20} MB", file=path, fix="write it as a GeoPackage")
    options = []
    if driver.ShortName == "GPKG":  # read as it lies there: SQLite would put files next to it
        log = path.with_name(f"{path.name}-wal")
        if log.exists() and log.stat().st_size:
            raise FileError("is being written by another program", file=path, fix="close it there first")
        options = ["IMMUTABLE=YES"]
    return gdal.OpenEx(str(path), gdal.OF_VECTOR, allowed_drivers=[driver.ShortName], open_options=options)


def _of_kind(layer: Any, path: Path, kind: GeometryKind) -> list[Any]:
    if ogr.GT_Flatten(layer.GetGeomType()) not in kind.layers:
        return []
    found: list[Any] = []
    vertices = 0
    for number, feature in enumerate(layer):
        geometry = feature.GetGeometryRef()
        for part in () if geometry is None else _parts(geometry.GetLinearGeometry(), kind):
            part.FlattenTo2D()
            found.append(shapely.from_wkb(bytes(part.ExportToWkb())))
            vertices += int(shapely.get_num_coordinates(found[-1]))
        if number >= _MOST_FEATURES or vertices > _MOST_VERTICES:
            problem = f"has more than {_MOST_FEATURES:,} features or {_MOST_VERTICES:,} vertices"
            raise FileError(problem, file=path, fix="simplify it, or take the part that is meant")
    return found


def _parts(geometry: Any, kind: GeometryKind) -> Iterator[Any]:
    """The polygons, or lines, in a geometry, however deep."""
    found = ogr.GT_Flatten(geometry.GetGeometryType())
    if found == kind.single:
        if not geometry.IsEmpty():
            yield geometry
    else:
        for i in range(geometry.GetGeometryCount() if found >= ogr.wkbMultiPoint else 0):
            yield from _parts(geometry.GetGeometryRef(i), kind)
