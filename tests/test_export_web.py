"""VRT, tiles and STAC item of a finished mosaic."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import rasterio
import shapely
from osgeo import gdal
from test_export_cog import raw_raster

from geomosaic.errors import CancelledError
from geomosaic.export.cog import write_cog
from geomosaic.export.stac import stac_item, write_stac
from geomosaic.export.web import write_tiles, write_vrt
from geomosaic.mosaic.model import Mosaic, OutputGrid, Seamline


@pytest.fixture
def cog(tmp_path):
    raw_raster(tmp_path / "raw.tif", side=700)
    write_cog(tmp_path / "raw.tif", tmp_path / "mosaic.tif")
    return tmp_path / "mosaic.tif"


def test_the_vrt_moves_with_its_mosaic(cog, tmp_path):
    write_vrt(cog, tmp_path / "mosaic.vrt")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("mosaic.tif", "mosaic.vrt"):
        (tmp_path / name).rename(elsewhere / name)
    dataset = gdal.Open(str(elsewhere / "mosaic.vrt"))
    assert dataset.RasterCount == 4
    assert dataset.GetRasterBand(4).GetColorInterpretation() == gdal.GCI_AlphaBand
    pixels = dataset.ReadAsArray()
    with rasterio.open(elsewhere / "mosaic.tif") as tiff:
        np.testing.assert_array_equal(pixels[:3], tiff.read())
        np.testing.assert_array_equal(pixels[3], tiff.dataset_mask())


@pytest.mark.parametrize("tile_format", ["png", "webp"])
def test_tiles_lie_where_the_mosaic_lies(cog, tmp_path, tile_format):
    write_tiles(cog, tmp_path / "tiles", tile_format=tile_format, processes=1)
    index = json.loads((tmp_path / "tiles" / "tiles.json").read_text())
    # 156543 m * cos(46.84 deg) / 2^z is 0.0128 m at z = 23 and 0.0255 m at 22; the mosaic has 0.0169 m.
    assert index["maxzoom"] == 23
    assert index["bounds"] == pytest.approx([-91.995038, 46.843320, -91.994882, 46.843382], abs=2e-6)
    names = sorted(p.name for p in (tmp_path / "tiles").iterdir())
    assert names == [str(z) for z in range(index["minzoom"], 24)] + ["tiles.json"]
    tiles = list((tmp_path / "tiles" / "23").rglob(f"*.{tile_format}"))
    lon = (index["bounds"][0] + index["bounds"][2]) / 2
    assert str(int((lon + 180) / 360 * 2**23)) in {t.parent.name for t in tiles}
    image = cv2.imread(str(tiles[len(tiles) // 2]), cv2.IMREAD_UNCHANGED)
    assert image.shape == (256, 256, 4)


def test_tiles_of_sixteen_bits_and_five_bands_are_stretched(tmp_path):
    raw_raster(tmp_path / "raw.tif", bands=5, dtype="uint16", side=400)
    write_tiles(tmp_path / "raw.tif", tmp_path / "tiles", max_zoom=22, min_zoom=22, processes=1)
    images = [cv2.imread(str(t), cv2.IMREAD_UNCHANGED) for t in (tmp_path / "tiles").rglob("*.png")]
    seen = np.concatenate([p[p[..., 3] == 255] for p in images])
    assert seen[:, :3].min() < 10
    assert seen[:, :3].max() > 245


def test_tiles_can_be_stopped(cog, tmp_path):
    def stop() -> None:
        raise CancelledError

    with pytest.raises(CancelledError):
        write_tiles(cog, tmp_path / "tiles", max_zoom=26, processes=1, check_cancelled=stop)


def test_the_stac_item_says_what_where_and_when(tmp_path):
    grid = OutputGrid("EPSG:32615", 576_625.6, 5_188_250.2, 0.02, 5000, 4000)
    ring = np.array([[576_630.0, 5_188_180.0], [576_720.0, 5_188_180.0], [576_720.0, 5_188_240.0],
                     [576_630.0, 5_188_180.0]])  # fmt: skip
    mosaic = Mosaic(grid, "raw.tif", 3, "uint8", None, (Seamline(0, ((ring,),)),), (0,), 1)
    item = stac_item("brighton", mosaic, [1.5e9, 1.5e9 + 90.5], ["mosaic.tif", "positions.csv"])
    write_stac(tmp_path / "i.json", item)
    read = json.loads((tmp_path / "i.json").read_text())
    assert (read["type"], read["stac_version"], read["id"]) == ("Feature", "1.0.0", "brighton")
    area = shapely.geometry.shape(read["geometry"])
    assert area.bounds == pytest.approx(tuple(read["bbox"]))
    assert area.bounds == pytest.approx((-91.994991, 46.842739, -91.993801, 46.843279), abs=2e-6)
    p = read["properties"]
    assert (p["datetime"], p["end_datetime"]) == ("2017-07-14T02:40:00.000Z", "2017-07-14T02:41:30.500Z")
    assert (p["gsd"], p["proj:epsg"], p["proj:shape"]) == (0.02, 32615, [4000, 5000])
    assert p["proj:bbox"] == pytest.approx([576_625.6, 5_188_170.2, 576_725.6, 5_188_250.2])
    assert read["assets"]["mosaic"]["href"] == "./mosaic.tif"
    assert set(read["assets"]) == {"mosaic", "positions"}
