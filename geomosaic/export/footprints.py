"""Footprints as GeoJSON (RFC 7946): longitude and latitude of WGS 84, outer rings to the left."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from osgeo import gdal

from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.doors.vector import open_vector
from geomosaic.geodesy.mapcrs import check_on_earth

_LAYERS: Final = ("footprints", "ccd_strips")
_DECIMALS: Final = 8
"""Of degrees: a millimetre."""


def write_footprints(package: Path, out: Path) -> None:
    """Writes those of a run's layers.gpkg, of frames or of CCD strips.

    Raises: `InputError` in a local frame; `OSError` if it can't be written.
    """
    with gdal_failures(out):
        source = open_vector(package)
        names = [source.GetLayer(i).GetName() for i in range(source.GetLayerCount())]
        (name,) = (name for name in _LAYERS if name in names)
        crs = source.GetLayerByName(name).GetSpatialRef().ExportToWkt(["FORMAT=WKT2_2019"])
        check_on_earth(crs, "footprint")
        done = gdal.VectorTranslate(
            str(out),
            source,
            format="GeoJSON",
            layers=[name],
            layerName=name,
            layerCreationOptions=["RFC7946=YES", f"COORDINATE_PRECISION={_DECIMALS}", "ID_FIELD=fid"],
        )
        close(done)
        close(source)
