"""Web formats of a mosaic that 180 degrees of longitude cross."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
import shapely
from pyproj import Transformer
from stac_schema import check_schema
from test_export_cog import raw_raster

from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.errors import InputError
from geomosaic.export.cog import write_cog
from geomosaic.export.packed_tiles import write_packed
from geomosaic.export.stac import coverage_of_mosaic, stac_item
from geomosaic.export.web import TileOptions, write_kmz, write_tiles

UTM = "EPSG:32760"
GSD_M = 0.25
SOUTH_DEG = -17.0


@pytest.fixture
def crossing(tmp_path: Path) -> Path:
    """700 x 400 px about 180 degrees: easting 819,000 m or so of zone 60."""
    raw_raster(tmp_path / "raw.tif", side=700)
    east, north = Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(180.0, SOUTH_DEG)
    assert 800_000.0 < east < 840_000.0
    with rasterio.open(tmp_path / "raw.tif", "r+") as tiff:
        tiff.crs = UTM
        tiff.transform = rasterio.Affine(GSD_M, 0.0, east - 350 * GSD_M, 0.0, -GSD_M, north + 200 * GSD_M)
    write_cog(tmp_path / "raw.tif", tmp_path / "mosaic.tif")
    return tmp_path / "mosaic.tif"


def test_tiles_lie_on_both_sides(crossing: Path, tmp_path: Path) -> None:
    """Each tile's pixels are the mosaic's at their places, by pyproj."""
    tiles = tmp_path / "tiles"
    write_tiles(crossing, tiles, TileOptions(threads=1))
    index = json.loads((tiles / "tiles.json").read_text())
    west, south, east, north = index["bounds"]
    assert (west, east) == (-180.0, 180.0) and south < SOUTH_DEG < north and north - south < 0.002
    assert abs(index["center"][0]) == pytest.approx(180.0, abs=1e-4)
    zoom = index["maxzoom"]
    columns = {int(p.name) for p in (tiles / f"{zoom}").iterdir()}
    assert {0, 2**zoom - 1} <= columns and len(columns) < 20
    with rasterio.open(crossing) as tiff:
        mosaic, t = np.moveaxis(tiff.read(), 0, -1).astype(np.float32), tiff.transform
    to_map = Transformer.from_crs("EPSG:3857", UTM, always_xy=True)
    side = 2 * np.pi * 6_378_137.0 / 2**zoom / 256
    seen = 0
    for tile in (tiles / f"{zoom}").rglob("*.png"):
        image = cv2.imread(str(tile), cv2.IMREAD_UNCHANGED)
        within = cv2.erode(image[..., 3], np.ones((5, 5)), borderValue=0) == 255
        row, col = (v[::7] + 0.5 for v in np.nonzero(within))
        x, y = int(tile.parent.name) * 256 + col, int(tile.stem) * 256 + row
        half = 2 ** (zoom - 1) * 256 * side
        at_east, at_north = to_map.transform(x * side - half, half - y * side)
        at = np.stack([(at_east - t.c) / t.a, (at_north - t.f) / t.e], axis=-1).astype(np.float32) - 0.5
        if len(at):
            there = cv2.remap(mosaic, at[:, None], None, cv2.INTER_LINEAR)[:, 0]
            assert np.abs(there - image[within][::7, 2::-1]).mean() < 3.0
            seen += len(there)
    assert seen * 7 > 0.5 * 700 * 400


def test_packed_tiles_are_few_and_say_where(crossing: Path, tmp_path: Path) -> None:
    write_packed(crossing, tmp_path / "mosaic.mbtiles", "mbtiles", TileOptions(threads=1))
    with sqlite3.connect(tmp_path / "mosaic.mbtiles") as file:
        about = dict(file.execute("SELECT name, value FROM metadata"))
        (count,) = file.execute("SELECT count(*) FROM tiles").fetchone()
    assert about["bounds"].startswith("-180.0") and about["center"].split(",")[0].lstrip("-").startswith(
        "180"
    )
    assert 4 < count < 200
    write_packed(crossing, tmp_path / "mosaic.pmtiles", "pmtiles", TileOptions(threads=1))
    assert (tmp_path / "mosaic.pmtiles").stat().st_size < 10 * crossing.stat().st_size


def test_a_kmz_says_what_to_write_instead(crossing: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="180 degrees") as caught:
        write_kmz(crossing, tmp_path / "mosaic.kmz")
    assert "geomosaic export tiles" in str(caught.value)
    assert not (tmp_path / "mosaic.kmz").exists()


def test_the_stac_item_is_cut_at_180_degrees(crossing: Path, tmp_path: Path) -> None:
    with rasterio.open(crossing) as tiff:
        west_m, north_m = tiff.transform.c, tiff.transform.f
    grid = OutputGrid(UTM, west_m, north_m, GSD_M, 700, 400)
    mosaic = Mosaic(grid, "mosaic.tif", 3, "uint8", None, (), (0,), 1)
    item = stac_item("fiji", coverage_of_mosaic(mosaic), [1.5e9], 1.6e9, tmp_path)
    check_schema(item)
    west, south, east, north = item["bbox"]
    assert 179.999 < west < 180.0 and -180.0 < east < -179.999 and south < SOUTH_DEG < north
    area = shapely.geometry.shape(item["geometry"])
    assert area.geom_type == "MultiPolygon" and len(area.geoms) == 2
    assert sorted(round(part.bounds[0]) for part in area.geoms) == [-180, 180]
    width_deg = sum(part.bounds[2] - part.bounds[0] for part in area.geoms)
    assert width_deg == pytest.approx(700 * GSD_M / (111_320.0 * np.cos(np.radians(SOUTH_DEG))), rel=0.03)
