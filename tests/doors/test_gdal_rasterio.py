"""Two GDALs in one process, osgeo's and rasterio's: they agree on CRS and pixels, either way round."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from osgeo import gdal, gdal_array, osr
from pyproj import Transformer

gdal.UseExceptions()
osr.UseExceptions()
TRANSFORM = (443_210.5, 0.25, 0.0, 5_215_678.25, 0.0, -0.25)
PIXELS = np.arange(3 * 40 * 50, dtype=np.uint16).reshape(3, 40, 50) * 7


def test_osgeo_has_numpy():
    assert gdal_array.GDALTypeCodeToNumericTypeCode(gdal.GDT_UInt16) == np.uint16


def test_rasterio_reads_what_osgeo_wrote(tmp_path):
    path = tmp_path / "osgeo.tif"
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(32632)
    dataset = gdal.GetDriverByName("GTiff").Create(
        str(path), 50, 40, 3, gdal.GDT_UInt16, ["COMPRESS=DEFLATE"]
    )
    dataset.SetProjection(reference.ExportToWkt())
    dataset.SetGeoTransform(TRANSFORM)
    dataset.WriteArray(PIXELS)
    del dataset
    with rasterio.open(path) as tiff:
        assert tiff.crs.to_epsg() == 32632
        assert tiff.transform.to_gdal() == TRANSFORM
        np.testing.assert_array_equal(tiff.read(), PIXELS)


def test_osgeo_reads_what_rasterio_wrote(tmp_path):
    path = tmp_path / "rasterio.tif"
    transform = rasterio.Affine.from_gdal(*TRANSFORM)
    shape = {"width": 50, "height": 40, "count": 3, "dtype": "uint16"}
    with rasterio.open(path, "w", driver="GTiff", crs="EPSG:32632", transform=transform, **shape) as tiff:
        tiff.write(PIXELS)
    dataset = gdal.Open(str(path))
    assert dataset.GetSpatialRef().GetAuthorityCode(None) == "32632"
    assert dataset.GetGeoTransform() == TRANSFORM
    np.testing.assert_array_equal(dataset.ReadAsArray(), PIXELS)


def test_osr_and_pyproj_put_a_point_at_the_same_place():
    source, target = osr.SpatialReference(), osr.SpatialReference()
    source.ImportFromEPSG(4326)
    target.ImportFromEPSG(32632)
    for reference in (source, target):
        reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    east, north, _ = osr.CoordinateTransformation(source, target).TransformPoint(9.71, 47.23)
    same = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(9.71, 47.23)
    assert (east, north) == pytest.approx(same, abs=1e-6)
    east, north, _ = osr.CoordinateTransformation(source, target).TransformPoint(9.0, 0.0)
    assert (east, north) == pytest.approx((500_000.0, 0.0), abs=1e-6)
