"""What people draw of a surface: its shading, its contours."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from osgeo import gdal, ogr

from geomosaic.doors.gdal_failures import GdalProgress, Progress, close, gdal_failures, gdal_options
from geomosaic.doors.raster import OWN, open_with_osgeo

_LAYER: Final = "contours"
_NO_TIME: Final = "1970-01-01T00:00:00.000Z"


def write_hillshade(surface: Path, out: Path, progress: Progress | None = None) -> None:
    """A plain raster of 8 bits, the sun in the north-west at 45 degrees, 0 where nothing is known.

    Raises: `OSError` if it can't be written.
    """
    callback = GdalProgress(progress)
    with callback.reraise(), gdal_failures(out), gdal_options({"GDAL_PAM_ENABLED": "NO"}):
        source = open_with_osgeo(surface, OWN)
        tiled = ["TILED=YES", "BIGTIFF=IF_SAFER"]
        made = gdal.DEMProcessing(
            str(out), source, "hillshade", computeEdges=True, creationOptions=tiled, callback=callback
        )
        close(made)
        del source


def write_contours(terrain: Path, out: Path, interval_m: float, progress: Progress | None = None) -> None:
    """A GeoPackage of lines whose height is a multiple of an interval, each with its `height_m`.

    Raises: `OSError` if it can't be written.
    """
    settings = {"OGR_CURRENT_DATE": _NO_TIME, "OGR_SQLITE_SYNCHRONOUS": "OFF"}
    callback = GdalProgress(progress)
    with callback.reraise(), gdal_failures(out), gdal_options(settings):
        source = open_with_osgeo(terrain, OWN)
        band = source.GetRasterBand(1)
        dataset = ogr.GetDriverByName("GPKG").CreateDataSource(str(out))
        layer = dataset.CreateLayer(_LAYER, source.GetSpatialRef(), ogr.wkbLineString)
        for name, kind in (("number", ogr.OFTInteger), ("height_m", ogr.OFTReal)):
            layer.CreateField(ogr.FieldDefn(name, kind))
        layer.StartTransaction()
        options = [f"LEVEL_INTERVAL={interval_m!r}", "ID_FIELD=0", "ELEV_FIELD=1"]
        gdal.ContourGenerateEx(band, layer, [*options, f"NODATA={band.GetNoDataValue()!r}"], callback)
        layer.CommitTransaction()
        del layer
        close(dataset)
        del band, source
