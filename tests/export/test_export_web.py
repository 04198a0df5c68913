"""VRT, tiles and STAC item of a finished mosaic."""

from __future__ import annotations

import gzip
import json
import re
import sqlite3
import struct
import zipfile
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import rasterio
import shapely
from osgeo import gdal
from pyproj import Transformer
from quality_images import write_tif
from rasterio.warp import transform_bounds
from stac_schema import check_schema
from test_export_cog import raw_raster

from geomosaic.composition.model import Mosaic, OutputGrid, Seamline
from geomosaic.errors import CancelledError, InputError
from geomosaic.export.cog import write_cog
from geomosaic.export.footprints import write_footprints
from geomosaic.export.geopackage import MapFeatures, write_geopackage
from geomosaic.export.packed_tiles import write_packed
from geomosaic.export.stac import coverage_of_mosaic, coverage_of_scene, stac_item, write_stac
from geomosaic.export.web import TileOptions, write_kmz, write_tiles, write_vrt


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
    write_tiles(cog, tmp_path / "tiles", TileOptions(tile_format=tile_format, threads=1))
    index = json.loads((tmp_path / "tiles" / "tiles.json").read_text())
    # 156543 m * cos(46.84 deg) / 2^z is 0.0128 m at z = 23 and 0.0255 m at 22; the mosaic has 0.0169 m.
    assert index["maxzoom"] == 23
    assert index["bounds"] == pytest.approx([-91.995038, 46.843320, -91.994882, 46.843382], abs=2e-6)
    names = sorted(p.name for p in (tmp_path / "tiles").iterdir())
    assert names == [str(z) for z in range(index["minzoom"], 24)] + ["index.html", "tiles.json"]
    tiles = list((tmp_path / "tiles" / "23").rglob(f"*.{tile_format}"))
    lon = (index["bounds"][0] + index["bounds"][2]) / 2
    assert str(int((lon + 180) / 360 * 2**23)) in {t.parent.name for t in tiles}
    image = cv2.imread(str(tiles[len(tiles) // 2]), cv2.IMREAD_UNCHANGED)
    assert image.shape == (256, 256, 4)


def test_tiles_show_what_lies_there_and_coarser_ones_its_mean(cog, tmp_path):
    """Against the mosaic's own pixels at the places of the tiles' pixels, by pyproj, and a quarter of one off."""
    reports = []
    tiles = tmp_path / "tiles"
    write_tiles(
        cog, tiles, TileOptions(threads=2), progress=lambda done, total: reports.append((done, total))
    )
    assert reports == [(k, reports[-1][1]) for k in range(1, reports[-1][1] + 1)]
    with rasterio.open(cog) as tiff:
        mosaic, t = np.moveaxis(tiff.read(), 0, -1).astype(np.float32), tiff.transform
    to_map = Transformer.from_crs("EPSG:3857", "EPSG:32615", always_xy=True)
    side, off = 2 * np.pi * 6_378_137.0 / 2**23 / 256, np.zeros(2)
    for tile in (tiles / "23").rglob("*.png"):
        image = cv2.imread(str(tile), cv2.IMREAD_UNCHANGED)
        within = cv2.erode(image[..., 3], np.ones((5, 5)), borderValue=0) == 255
        row, col = (v[::7] + 0.5 for v in np.nonzero(within))
        x, y = int(tile.parent.name) * 256 + col, int(tile.stem) * 256 + row
        east, north = to_map.transform(x * side - 2**22 * 256 * side, 2**22 * 256 * side - y * side)
        at = np.stack([(east - t.c) / t.a, (north - t.f) / t.e], axis=-1).astype(np.float32) - 0.5
        for k, shift in enumerate((0.0, 0.25)):
            there = cv2.remap(mosaic, at[:, None] + np.float32(shift), None, cv2.INTER_LINEAR)[:, 0]
            off[k] += np.abs(there - image[within][::7, 2::-1]).sum() / 1e6
    assert off[0] < 0.25 * off[1]
    for coarse in (p for p in (tiles / "20").rglob("*.png")):
        above = cv2.imread(str(coarse), cv2.IMREAD_UNCHANGED)
        x, y = 2 * int(coarse.parent.name), 2 * int(coarse.stem)
        for i, j in np.ndindex(2, 2):
            half = above[128 * i :, 128 * j :][:128, :128]
            if not (below := tiles / "21" / f"{x + j}" / f"{y + i}.png").exists():
                assert not half[..., 3].any()
                continue
            fine = cv2.imread(str(below), cv2.IMREAD_UNCHANGED).reshape(128, 2, 128, 2, 4)
            full = (fine[..., 3] == 255).all(axis=(1, 3))
            assert np.abs(fine[..., :3].mean(axis=(1, 3)) - half[..., :3])[full].max() <= 1.0


def test_tiles_of_sixteen_bits_and_five_bands_are_stretched(tmp_path):
    raw_raster(tmp_path / "raw.tif", bands=5, dtype="uint16", side=400)
    write_tiles(tmp_path / "raw.tif", tmp_path / "tiles", TileOptions(max_zoom=22, min_zoom=22, threads=1))
    images = [cv2.imread(str(t), cv2.IMREAD_UNCHANGED) for t in (tmp_path / "tiles").rglob("*.png")]
    seen = np.concatenate([p[p[..., 3] == 255] for p in images])
    assert seen[:, :3].min() < 10
    assert seen[:, :3].max() > 245


def test_tiles_can_be_stopped(cog, tmp_path):
    def stop(done, total) -> None:
        raise CancelledError

    with pytest.raises(CancelledError):
        write_tiles(cog, tmp_path / "tiles", TileOptions(max_zoom=26, threads=1), progress=stop)


def test_the_stac_item_says_what_where_and_when(tmp_path):
    grid = OutputGrid("EPSG:32615", 576_625.6, 5_188_250.2, 0.02, 5000, 4000)
    ring = np.array([[576_630.0, 5_188_180.0], [576_720.0, 5_188_180.0], [576_720.0, 5_188_240.0],
                     [576_630.0, 5_188_180.0]])  # fmt: skip
    mosaic = Mosaic(grid, "raw.tif", 3, "uint8", None, (Seamline(0, ((ring,),)),), (0,), 1)
    coverage = coverage_of_mosaic(mosaic)
    raw_raster(tmp_path / "mosaic.tif", side=700)
    (tmp_path / "positions.csv").touch()
    item = stac_item("brighton", coverage, [1.5e9, 1.5e9 + 90.5], 1.6e9, tmp_path)
    check_schema(item)
    write_stac(tmp_path / "i.json", item)
    read = json.loads((tmp_path / "i.json").read_text())
    assert (read["type"], read["stac_version"], read["id"]) == ("Feature", "1.1.0", "brighton")
    area = shapely.geometry.shape(read["geometry"])
    assert area.bounds == pytest.approx(tuple(read["bbox"]))
    assert area.bounds == pytest.approx((-91.994991, 46.842739, -91.993801, 46.843279), abs=2e-6)
    p = read["properties"]
    assert (p["datetime"], p["start_datetime"]) == ("2017-07-14T02:40:00Z",) * 2
    assert p["end_datetime"] == "2017-07-14T02:41:30.500000Z"
    assert (p["gsd"], p["proj:code"], p["proj:shape"]) == (0.02, "EPSG:32615", [4000, 5000])
    assert p["proj:bbox"] == pytest.approx([576_625.6, 5_188_170.2, 576_725.6, 5_188_250.2])
    assert read["assets"]["mosaic"]["href"] == "./mosaic.tif"
    assert set(read["assets"]) == {"mosaic", "positions"}
    assert "proj:epsg" not in p, "gone in version 2 of the extension"


def test_a_stac_item_without_times_or_map_invents_none(tmp_path):
    ring = np.array([[7.0, 50.0], [7.2, 50.0], [7.2, 50.3], [7.0, 50.0]])
    item = stac_item("scene", coverage_of_scene(ring, 2.0, 900, 700), [], 1.6e9, tmp_path)
    check_schema(item)
    p = item["properties"]
    assert (p["datetime"], p["proj:code"], p["proj:shape"]) == ("2020-09-13T12:26:40Z", None, [900, 700])
    assert not {"start_datetime", "end_datetime"} & set(p)
    assert "unknown" in p["description"]
    assert "1970" not in json.dumps(item)
    assert item["bbox"] == [7.0, 50.0, 7.2, 50.3]
    nowhere = stac_item("scene", coverage_of_scene(np.zeros((0, 2)), 2.0, 900, 700), [], 1.6e9, tmp_path)
    check_schema(nowhere)
    assert nowhere["geometry"] is None


def test_mbtiles_hold_the_tiles_of_the_folder(cog, tmp_path):
    """Read as its specification says: a table of tiles, their rows counted from the south."""
    coarse = tmp_path / "coarse.tif"
    gdal.Translate(str(coarse), str(cog), outputBounds=[576_600, 5_188_300, 576_740, 5_188_300 - 140])
    write_tiles(coarse, tmp_path / "tiles", TileOptions(threads=1))
    write_packed(coarse, tmp_path / "mosaic.mbtiles", "mbtiles", TileOptions(threads=1))
    with sqlite3.connect(tmp_path / "mosaic.mbtiles") as file:
        reported = dict(file.execute("SELECT name, value FROM metadata"))
        packed = {
            (z, x, 2**z - 1 - y): cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            for z, x, y, data in file.execute(
                "SELECT zoom_level, tile_column, tile_row, tile_data FROM tiles"
            )
        }
    index = json.loads((tmp_path / "tiles" / "tiles.json").read_text())
    assert (int(reported["minzoom"]), int(reported["maxzoom"])) == (index["minzoom"], index["maxzoom"])
    assert (reported["format"], reported["type"]) == ("png", "overlay")
    tiles = list((tmp_path / "tiles").rglob("*.png"))
    assert len(tiles) == len(packed)
    for tile in tiles:
        at = int(tile.parent.parent.name), int(tile.parent.name), int(tile.stem)
        np.testing.assert_array_equal(packed[at], cv2.imread(str(tile), cv2.IMREAD_UNCHANGED))
    with rasterio.open(tmp_path / "mosaic.mbtiles") as tiff:
        assert tiff.crs.to_epsg() == 3857
        west, south, east, north = transform_bounds(tiff.crs, "EPSG:32615", *tiff.bounds)
        assert (west, south, east, north) == pytest.approx((576_600, 5_188_160, 576_740, 5_188_300), abs=40)
        assert tiff.read(4).any()


def test_mbtiles_finer_than_gdal_opens_end_at_zoom_22(cog, tmp_path):
    """The mosaic's pixels of 17 mm are zoom 23, which can be asked for."""
    for name, options in {"auto": TileOptions(), "asked": TileOptions(max_zoom=23)}.items():
        write_packed(cog, tmp_path / f"{name}.mbtiles", "mbtiles", options)
    with rasterio.open(tmp_path / "auto.mbtiles") as tiff:
        assert tiff.res[0] == pytest.approx(156_543.034 / 2**22, rel=1e-6)
        assert tiff.read(4).any()
    with sqlite3.connect(tmp_path / "asked.mbtiles") as file:
        assert file.execute("SELECT max(zoom_level) FROM tiles").fetchone() == (23,)


@pytest.mark.parametrize("tile_format", [pytest.param("png", marks=pytest.mark.proof), "webp"])
def test_pmtiles_hold_the_tiles_of_the_folder(cog, tmp_path, tile_format):
    write_tiles(cog, tmp_path / "tiles", TileOptions(tile_format=tile_format, threads=1))
    for name in ("a", "b"):
        write_packed(cog, tmp_path / name, "pmtiles", TileOptions(tile_format=tile_format, threads=1))
    data = (tmp_path / "a").read_bytes()
    assert data == (tmp_path / "b").read_bytes()
    reported, packed = read_pmtiles(data)
    index = json.loads((tmp_path / "tiles" / "tiles.json").read_text())
    assert reported == {
        "type": {"png": 2, "webp": 4}[tile_format], "zooms": (index["minzoom"], index["maxzoom"]),
        "bounds": pytest.approx(index["bounds"], abs=1e-7), "clustered": 1,
        "metadata": {"name": tmp_path.name, "type": "overlay"},
    }  # fmt: skip
    tiles = {
        (int(tile.parent.parent.name), int(tile.parent.name), int(tile.stem)): tile.read_bytes()
        for tile in (tmp_path / "tiles").glob(f"*/*/*.{tile_format}")
    }
    assert packed == tiles
    assert len(tiles) > 10


def read_pmtiles(data):
    """As its specification says, version 3: a header of 127 bytes, directories of varints, Hilbert's curve."""
    assert data[:8] == b"PMTiles\x03"
    root, root_length, meta, meta_length, _, leaves_length, tiles, _, _, entries, _ = struct.unpack(
        "<11Q", data[8:96]
    )
    clustered, packing, tile_packing, kind, least, most, *box = struct.unpack("<6B4i", data[96:118])
    assert (packing, tile_packing, leaves_length) == (2, 1, 0), "directories by gzip, tiles as they are"
    numbers = iter(varints(gzip.decompress(data[root : root + root_length])))
    count = next(numbers)
    assert count == entries
    ids = np.cumsum([next(numbers) for _ in range(count)])
    runs, lengths, offsets = ([next(numbers) for _ in range(count)] for _ in range(3))
    found, after = {}, 0
    for id, run, length, offset in zip(ids, runs, lengths, offsets, strict=True):
        start = after if offset == 0 else offset - 1
        after = start + length
        for k in range(run):
            found[tile_of(int(id) + k)] = data[tiles + start : tiles + after]
    metadata = json.loads(gzip.decompress(data[meta : meta + meta_length]))
    reported = {
        "type": kind,
        "zooms": (least, most),
        "bounds": [v / 1e7 for v in box],
        "clustered": clustered,
    }
    return {**reported, "metadata": metadata}, found


def varints(data):
    value = shift = 0
    for byte in data:
        value |= (byte & 127) << shift
        shift += 7
        if byte < 128:
            yield value
            value = shift = 0


def tile_of(id):
    """Zoom, column, row of a number along Hilbert's curves, one zoom after the other."""
    zoom, before = 0, 0
    while id >= before + 4**zoom:
        before += 4**zoom
        zoom += 1
    at, x, y, side = id - before, 0, 0, 1
    while side < 2**zoom:
        right = 1 & (at // 2)
        down = 1 & (at ^ right)
        if not down:
            x, y = (side - 1 - y, side - 1 - x) if right else (y, x)
        x, y, at, side = x + side * right, y + side * down, at // 4, side * 2
    return zoom, x, y


def test_kmz_lies_where_the_mosaic_lies(cog, tmp_path):
    write_kmz(cog, tmp_path / "mosaic.kmz")
    with zipfile.ZipFile(tmp_path / "mosaic.kmz") as archive:
        names = archive.namelist()
        assert names[0] == "doc.kml"
        found = [
            (name, ElementTree.fromstring(archive.read(name))) for name in names if name.endswith(".kml")
        ]
        ns = {"k": "http://www.opengis.net/kml/2.2"}
        boxes, shown = [], 0
        for name, document in found:
            for overlay in document.iterfind(".//k:GroundOverlay", ns):
                box = [
                    float(overlay.findtext(f".//k:LatLonBox/k:{side}", "", ns))
                    for side in ("west", "south", "east", "north")
                ]
                boxes.append(box)
                image = f"{name.rpartition('/')[0]}/{overlay.findtext('.//k:href', '', ns)}".lstrip("/")
                pixels = cv2.imdecode(np.frombuffer(archive.read(image), np.uint8), cv2.IMREAD_UNCHANGED)
                shown += bool(pixels.any())
    boxes = np.array(boxes)
    whole = (*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0))
    assert whole == pytest.approx([-91.995038, 46.843320, -91.994882, 46.843382], abs=3e-5)
    assert shown == len(boxes)
    write_kmz(cog, tmp_path / "coarse.kmz", max_zoom=20)
    assert (tmp_path / "coarse.kmz").stat().st_size < 0.2 * (tmp_path / "mosaic.kmz").stat().st_size


@pytest.mark.parametrize(
    ("kind", "low", "high"), [("uint8", 40, 240), ("uint16", 2000, 6000), ("float32", -5, -5)]
)
def test_a_kmz_of_one_grey_band(tmp_path, kind, low, high):
    """High in the east. A uniform one has a colour too."""
    values = np.where(np.arange(400) < 200, low, high)[None, None].repeat(300, axis=1).astype(kind)
    write_tif(tmp_path / "mosaic.tif", values, 576_625.6, 5_188_250.2, 0.05, "EPSG:32615")
    write_kmz(tmp_path / "mosaic.tif", tmp_path / "mosaic.kmz")
    with zipfile.ZipFile(tmp_path / "mosaic.kmz") as archive:
        images = [name for name in archive.namelist() if not name.endswith(".kml")]
        (coarsest,) = [name for name in images if name.startswith("0/0/0.")]
        shown = cv2.imdecode(np.frombuffer(archive.read(coarsest), np.uint8), cv2.IMREAD_UNCHANGED)
    opaque = shown[..., 3] > 0 if shown.shape[2] == 4 else np.ones(shown.shape[:2], bool)
    grey, cols = shown[..., :3], np.nonzero(opaque.any(axis=0))[0]
    assert np.ptp(grey.astype(int), axis=2).max() <= 3
    west, east = (np.median(grey[:, at][opaque[:, at]]) for at in np.array_split(cols, 2))
    expected = {"uint8": (40, 240), "uint16": (0, 255), "float32": (0, 0)}[kind]
    assert (west, east) == pytest.approx(expected, abs=4)


def test_the_page_of_the_tiles_needs_no_network(cog, tmp_path):
    """And shows the run's layers; no name in them can end its script."""
    evil = "</script><script>alert(1)//`${1}"
    fields = {"frame": [evil], "status": ["tied"]}
    frames = MapFeatures("frames", "", "Point", [shapely.Point(576_627.0, 5_188_249.0)], fields)
    write_geopackage(tmp_path / "layers.gpkg", "EPSG:32615", None, [frames])
    write_tiles(
        cog, tmp_path / "tiles", TileOptions(max_zoom=20, threads=1), layers_file=tmp_path / "layers.gpkg"
    )
    page = (tmp_path / "tiles" / "index.html").read_text()
    assert not re.findall(r"(?:src\s*=\s*|url\()[\"']?https?:", page)
    assert evil not in page
    (text,) = re.findall(r'id="layers">(.*?)</script>', page)
    (layer,) = json.loads(text)
    (feature,) = layer["data"]["features"]
    assert feature["properties"]["frame"] == evil
    assert feature["geometry"]["coordinates"] == pytest.approx([-91.995020, 46.843370], abs=2e-5)


def test_footprints_are_geojson_in_wgs_84(tmp_path):
    ring = shapely.box(576_600.0, 5_188_200.0, 576_700.0, 5_188_300.0)
    fields = {"frame": ["a.jpg"], "time_utc": np.array(["2024-06-12T09:30:00.250"], "datetime64[ms]")}
    layer = MapFeatures("footprints", "", "Polygon", [ring], fields)
    write_geopackage(tmp_path / "layers.gpkg", "EPSG:32615", None, [layer])
    write_footprints(tmp_path / "layers.gpkg", tmp_path / "f.geojson")
    (feature,) = json.loads((tmp_path / "f.geojson").read_text())["features"]
    assert feature["properties"]["frame"] == "a.jpg"
    assert feature["properties"]["time_utc"].startswith("2024-06-12T09:30:00")
    area = shapely.geometry.shape(feature["geometry"])
    assert area.exterior.is_ccw
    to_map = Transformer.from_crs("OGC:CRS84", "EPSG:32615", always_xy=True)
    back = shapely.transform(area, lambda xy: np.column_stack(to_map.transform(xy[:, 0], xy[:, 1])))
    assert back.symmetric_difference(ring).area < 0.2


def test_zooms_in_the_wrong_order_are_refused(tmp_path):
    raw_raster(tmp_path / "raw.tif", bands=3, dtype="uint8", side=400)
    with pytest.raises(InputError, match="min_zoom"):
        write_tiles(
            tmp_path / "raw.tif", tmp_path / "tiles", TileOptions(max_zoom=10, min_zoom=20, threads=1)
        )
    assert not (tmp_path / "tiles").exists()


def test_web_mercator_ends_before_the_pole(tmp_path):
    """A mosaic at 88 degrees north is in no web map; a KMZ has no such end."""
    values = np.full((1, 200, 300), 90, np.uint8)
    mosaic = write_tif(tmp_path / "mosaic.tif", values, 30_000.0, -210_000.0, 0.5, "EPSG:3413")
    for form in ("mbtiles", "pmtiles"):
        with pytest.raises(InputError, match=r"beyond 85\.05 degrees.*geomosaic export kmz"):
            write_packed(mosaic, tmp_path / f"mosaic.{form}", form)
    with pytest.raises(InputError, match=r"mosaic\.tif: lies beyond 85\.05 degrees"):
        write_tiles(mosaic, tmp_path / "tiles")
    write_kmz(mosaic, tmp_path / "mosaic.kmz")
    assert (tmp_path / "mosaic.kmz").stat().st_size > 1000
