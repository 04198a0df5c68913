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
from pyogrio.raw import read
from pyproj import Transformer
from stac_schema import check_schema
from test_export_cog import raw_raster

from geomosaic.camera.rpc import Rpc
from geomosaic.ccd.outlines import Outlines
from geomosaic.composition.model import Mosaic, OutputGrid
from geomosaic.composition.strip_compose import StripMosaic
from geomosaic.errors import InputError
from geomosaic.export.cog import write_cog
from geomosaic.export.footprints import write_footprints
from geomosaic.export.packed_tiles import write_packed
from geomosaic.export.stac import coverage_of_mosaic, stac_item
from geomosaic.export.strip_layers import SceneOnMap, write_strip_layers
from geomosaic.export.web import TileOptions, write_kmz, write_tiles
from geomosaic.geodesy.antimeridian import split_area
from geomosaic.quality.strip_figures import strip_figures
from geomosaic.quality.strips import PairQuality, StripQuality
from geomosaic.survey.strips import Ccd, StripGeometry

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


@pytest.mark.parametrize(
    ("west", "east", "box", "parts"),
    [
        (179.9, 180.1, (179.9, -179.9), 2),
        (-180.1, -179.9, (179.9, -179.9), 2),
        (180.05, 180.3, (-179.95, -179.7), 1),
        (179.7, 180.0, (179.7, 180.0), 1),
        (-10.0, 10.0, (-10.0, 10.0), 1),
    ],
)
def test_areas_that_go_on_beyond_180_degrees_are_cut(west, east, box, parts) -> None:
    area, found = split_area(shapely.box(west, 10.0, east, 11.0))
    assert found == pytest.approx([box[0], 10.0, box[1], 11.0])
    shapes = shapely.get_parts(area)
    assert len(shapes) == parts and area.area == pytest.approx(east - west)
    assert area.bounds[0] >= -180.0 and area.bounds[2] <= 180.0


@pytest.mark.parametrize("jump", [False, True])
def test_layers_of_a_scene_go_on_beyond_180_degrees(tmp_path: Path, jump: bool) -> None:
    """20 x 10 km about 180 degrees; longitudes of the rings jump there or go on. CCDs lie on either side."""
    geometry = StripGeometry(
        ccds=(Ccd(None, 1), Ccd(None, 2)), width_px=1000, lines=(1000, 1000), overlap_px=100,
        row_separation_lines=0.0, line_rate_hz=1000.0, bit_depth=8,
    )  # fmt: skip
    one, line, sample = np.eye(20)[[0, 2, 1]]
    rpc = Rpc(
        np.array([500.0, 950.0, 10.0, 180.0, 0.0]), np.array([500.0, 950.0, 0.05, 0.1, 500.0]),
        np.array([-line, one, sample, one]),
    )  # fmt: skip
    rings = [np.array(shapely.box(w, 9.95, e, 10.05).exterior.coords) for w, e in
             ((179.9, 180.1), (179.9, 180.005), (179.995, 180.1))]  # fmt: skip
    if jump:
        for ring in rings:
            ring[:, 0] = (ring[:, 0] + 180.0) % 360.0 - 180.0
    quality = StripQuality(
        (PairQuality(0, 1000, *[np.zeros((1, 2)), np.ones(1), np.ones(1), np.zeros((1, 2))], np.full(2, 0.1), (1.0, 0.0, 0.0)),),
        strip_figures([]), 1000, 0, 0,
    )  # fmt: skip
    scene = SceneOnMap(
        StripMosaic("mosaic.tif", 1900, 1000, 0.0, "uint8", 8, None, (1000, 1000), ()),
        Outlines(rings[0], {0: rings[1], 1: rings[2]}), rpc,
    )  # fmt: skip
    write_strip_layers(tmp_path / "layers.gpkg", geometry, scene, quality)
    for layer in ("scene", "ccd_strips", "seam_segments"):
        _, _, shapes, _ = read(tmp_path / "layers.gpkg", layer=layer)
        for shape in shapely.from_wkb(shapes):
            west, _, east, _ = shape.bounds
            assert east - west < 0.21 and abs(abs(west) - 180.0) < 0.11, layer
    write_footprints(tmp_path / "layers.gpkg", tmp_path / "f.geojson")
    for feature in json.loads((tmp_path / "f.geojson").read_text())["features"]:
        area = shapely.geometry.shape(feature["geometry"])
        assert area.area == pytest.approx(0.105 * 0.1, rel=1e-3)
        assert area.bounds[0] >= -180.0 and area.bounds[2] <= 180.0
