"""A GeoPackage of vector layers, written by OGR: CRS, spatial index, typed fields, transactions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from osgeo import gdal, ogr, osr

from geomosaic.export.gdal_failures import gdal_failures

_PER_TRANSACTION = 50_000
_TYPES = {"i": ogr.OFTInteger64, "u": ogr.OFTInteger64, "f": ogr.OFTReal, "U": ogr.OFTString}
_GEOMETRIES = {
    "Point": ogr.wkbPoint,
    "PointZ": ogr.wkbPoint25D,
    "LineString": ogr.wkbLineString,
    "Polygon": ogr.wkbPolygon,
    "MultiPolygon": ogr.wkbMultiPolygon,
}


class GeoPackage:
    """An open GeoPackage to add layers to."""

    def __init__(self, dataset: Any, crs: str) -> None:
        self._dataset = dataset
        self._reference = osr.SpatialReference()
        self._reference.SetFromUserInput(crs)
        self._reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)

    def add_layer(
        self, name: str, text: str, geometry_type: str, geometries: Sequence[Any], fields: dict[str, Any]
    ) -> None:
        """A layer of shapely geometries; `fields` are columns of the same length (numbers or text).

        NaN and None become NULL. Names and texts are data: OGR quotes them.
        """
        layer = self._dataset.CreateLayer(
            name,
            self._reference,
            _GEOMETRIES[geometry_type],
            ["SPATIAL_INDEX=YES", "GEOMETRY_NAME=geom", f"DESCRIPTION={text}"],
        )
        columns = {field: np.asarray(values) for field, values in fields.items()}
        for field, values in columns.items():
            layer.CreateField(ogr.FieldDefn(field, _TYPES[values.dtype.kind]))
        rows: list[list[Any]] = [values.tolist() for values in columns.values()]
        wkb = shapely.to_wkb(np.asarray(geometries, dtype=object), flavor="iso")
        definition = layer.GetLayerDefn()
        self._dataset.StartTransaction()
        for k, geometry in enumerate(wkb):
            feature = ogr.Feature(definition)
            if geometry is not None:
                feature.SetGeometryDirectly(ogr.CreateGeometryFromWkb(geometry))
            for index, column in enumerate(rows):
                value = column[k]
                if value is not None and value == value:
                    feature.SetField(index, value)
            layer.CreateFeature(feature)
            if (k + 1) % _PER_TRANSACTION == 0:
                self._dataset.CommitTransaction()
                self._dataset.StartTransaction()
        self._dataset.CommitTransaction()


@contextmanager
def writing_geopackage(path: Path, crs: str, time_s: float | None) -> Iterator[GeoPackage]:
    """A new GeoPackage at `path`, whole when the block ends.

    time_s: seconds since 1970 UTC that stand as its time of change, so that equal data give equal bytes.
    """
    stamp = datetime.fromtimestamp(time_s or 0.0, UTC).strftime("%Y-%m-%dT%H:%M:%S.000Z")
    settings = {"OGR_CURRENT_DATE": stamp, "OGR_SQLITE_SYNCHRONOUS": "OFF"}
    with gdal_failures(path):
        for key, value in settings.items():
            gdal.SetThreadLocalConfigOption(key, value)
        try:
            dataset = gdal.GetDriverByName("GPKG").Create(str(path), 0, 0, 0, gdal.GDT_Unknown)
            package = GeoPackage(dataset, crs)
            yield package
            package._dataset = None
            dataset.FlushCache()
            del dataset
        finally:
            for key in settings:
                gdal.SetThreadLocalConfigOption(key, None)
