"""The mosaic's raster: tiles packed as they come, put together as a COG that both GDALs and the validator know."""

from __future__ import annotations

import errno
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
import pytest
import rasterio
from osgeo import gdal
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from rasterio.enums import ColorInterp

from geomosaic.composition import cog_layout
from geomosaic.composition.blended import Blended, BlendedBlock, place_over
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.plan import windows as along_the_curve
from geomosaic.composition.pyramid import RasterPyramid
from geomosaic.composition.raster import MosaicFiles, SceneGreys, index_kind, writing_mosaic, writing_scene
from geomosaic.composition.tiles import TILE_PX, TileKind, halved
from geomosaic.composition.window import Composed, Window
from geomosaic.export.cog import CogOptions, write_cog

WIDTH, HEIGHT = 2301, 1300
GRID = OutputGrid("EPSG:32615", 500_000.0, 5e6, 0.05, WIDTH, HEIGHT)


def image(bands: int, dtype: str) -> tuple[np.ndarray, np.ndarray]:
    """Waves with noise, (h, w, bands), about zero where the type has a sign; a corner and a band invalid."""
    col, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    noise = np.random.default_rng(7).normal(0.0, 3.0, (HEIGHT, WIDTH))
    middle = 0.0 if np.dtype(dtype).kind != "u" else 120.0
    pixels = np.stack([middle + 50.0 * np.sin(col / 50.0 + b) + noise for b in range(bands)], axis=-1)
    valid = (col + row > 900) & (abs(col - 1700) > 3)
    pixels[~valid] = 0.0
    return pixels.astype(dtype), valid


def windows(step: int) -> list[Window]:
    return [
        Window(col, row, min(step, WIDTH - col), min(step, HEIGHT - row))
        for row in range(0, HEIGHT, step)
        for col in range(0, WIDTH, step)
    ]


def of(window: Window, pixels: np.ndarray, valid: np.ndarray) -> Composed:
    rows, cols = window.within(Window(0, 0, WIDTH, HEIGHT))
    label = valid[rows, cols].astype(np.int16) - np.int16(1)
    return Composed(window, pixels[rows, cols], valid[rows, cols], label, (1,), (1,))


def written(path: Path, pixels: np.ndarray, valid: np.ndarray, step: int = TILE_PX, threads: int = 1) -> Path:
    files, kind = MosaicFiles(path, path.with_suffix(".sources")), TileKind(pixels.shape[2], pixels.dtype)
    with (
        writing_mosaic(files, GRID, kind, ["a", "b"]) as raster,
        ThreadPoolExecutor(threads) as pool,
    ):
        list(
            pool.map(lambda w: raster.write(of(w, pixels, valid)), windows(step)[:: -1 if threads > 1 else 1])
        )
    return path


@pytest.mark.parametrize(
    ("bands", "dtype"),
    [
        (3, "uint8"),
        pytest.param(1, "uint8", marks=pytest.mark.proof),
        (5, "uint16"),
        pytest.param(2, "int16", marks=pytest.mark.proof),
        (1, "float32"),
        pytest.param(3, "float32", marks=pytest.mark.proof),
    ],
)
def test_a_cog_of_all_types_that_both_gdals_read(tmp_path: Path, bands: int, dtype: str) -> None:
    pixels, valid = image(bands, dtype)
    path = written(tmp_path / "a.tif", pixels, valid)
    assert validate(str(path), full_check=True)[:2] == ([], [])
    band_first = np.moveaxis(pixels, -1, 0)
    with rasterio.open(path) as tiff:
        np.testing.assert_array_equal(tiff.read(), band_first)
        np.testing.assert_array_equal(tiff.dataset_mask() > 0, valid)
        assert (tiff.crs.to_epsg(), tiff.transform[:6]) == (32615, (0.05, 0.0, 500_000.0, 0.0, -0.05, 5e6))
        assert (tiff.overviews(1), tiff.block_shapes[0]) == ([2, 4, 8], (512, 512))
        assert tiff.tags()["GSD_M"] == "0.05" and tiff.tags()["TIFFTAG_SOFTWARE"].startswith("geomosaic ")
        assert tiff.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        reported = [
            {k[11:]: float(v) for k, v in tiff.tags(b + 1).items() if "STAT" in k} for b in range(bands)
        ]
    for b, figures in enumerate(reported):
        values = pixels[valid][:, b].astype(float)
        exact = {
            "MINIMUM": values.min(),
            "MAXIMUM": values.max(),
            "MEAN": values.mean(),
            "STDDEV": values.std(),
        }
        assert figures == pytest.approx(exact, rel=1e-6, abs=1e-6)
    dataset = gdal.Open(str(path))
    np.testing.assert_array_equal(dataset.ReadAsArray().reshape(band_first.shape), band_first)
    for level in range(3):
        pixels, valid = halved(pixels, valid)
        overviews = [dataset.GetRasterBand(b + 1).GetOverview(level) for b in range(bands)]
        np.testing.assert_array_equal(np.stack([o.ReadAsArray() for o in overviews], axis=-1), pixels)
        np.testing.assert_array_equal(overviews[0].GetMaskBand().ReadAsArray() > 0, valid)


def test_a_fourth_band_is_no_alpha_band(tmp_path: Path) -> None:
    """Red, green, blue and near infrared: what is valid is in the mask alone."""
    pixels, valid = image(4, "uint8")
    path = written(tmp_path / "a.tif", pixels, valid)
    with rasterio.open(path) as tiff:
        assert ColorInterp.alpha not in tiff.colorinterp
        assert tiff.colorinterp[:3] == (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
        np.testing.assert_array_equal(tiff.read(4), pixels[..., 3])
        np.testing.assert_array_equal(tiff.dataset_mask() > 0, valid)
    assert gdal.Open(str(path)).GetRasterBand(4).GetColorInterpretation() == gdal.GCI_Undefined


def test_windows_threads_and_order_change_no_byte(tmp_path: Path) -> None:
    pixels, valid = image(3, "uint8")
    plain = written(tmp_path / "a.tif", pixels, valid)
    for k, (step, threads) in enumerate(((TILE_PX, 3), (300, 1), (700, 2))):
        other = written(tmp_path / f"{k}.tif", pixels, valid, step, threads)
        assert other.read_bytes() == plain.read_bytes()
        assert other.with_suffix(".sources").read_bytes() == plain.with_suffix(".sources").read_bytes()


@pytest.mark.parametrize(("width", "height"), [(WIDTH, HEIGHT), (300, 200)])
def test_tiles_made_elsewhere_are_the_same_bytes(tmp_path: Path, width: int, height: int) -> None:
    """By blocks under the first overview's tiles, the last one first; a mosaic of a single tile has none."""
    pixels, valid = image(3, "uint8")
    pixels, valid = pixels[-height:, -width:], valid[-height:, -width:]
    grid = replace(GRID, width_px=width, height_px=height)
    kind, index = TileKind(3, np.dtype("uint8")), index_kind(2)
    paths = [tmp_path / f"{name}.tif" for name in ("whole", "blocks")]
    whole, blocks = (
        writing_mosaic(MosaicFiles(path, path.with_suffix(".sources")), grid, kind, ["a", "b"])
        for path in paths
    )
    tiles = along_the_curve(grid, TILE_PX)
    with whole as raster:
        for window in tiles:
            raster.write(of(window, pixels, valid))
    with blocks as raster:
        for place in sorted({place_over(w) for w in tiles}, reverse=True):
            done, under, numbers = [], {}, {}
            for window in (w for w in tiles if place_over(w) == place):
                one = of(window, pixels, valid)
                tile = kind.tile(one.pixels, one.valid)
                given = index.tile(one.source(index.dtype)[..., None], one.valid)
                done.append(Blended(window, tile, given, np.zeros((0, 0), np.int32), None, ()))
                at = window.row // TILE_PX % 2, window.col // TILE_PX % 2
                under[at], numbers[at] = tile, given
            down, across = (
                min(TILE_PX, -(-n // 2) - k * TILE_PX) for n, k in zip((height, width), place, strict=True)
            )
            over, index_over = kind.over(under, down, across), index.over(numbers, down, across)
            raster.put(BlendedBlock(place, tuple(done), over, index_over))
    for suffix in (".tif", ".sources"):
        written_whole, written_by_blocks = (path.with_suffix(suffix).read_bytes() for path in paths)
        assert written_by_blocks == written_whole


def test_the_sources_are_numbers_from_one_and_names(tmp_path: Path) -> None:
    pixels, valid = image(1, "uint8")
    with rasterio.open(written(tmp_path / "a.tif", pixels, valid).with_suffix(".sources")) as tiff:
        np.testing.assert_array_equal(tiff.read(1), np.where(valid, 2, 0))
        assert (tiff.nodata, tiff.dtypes, tiff.tags()["FRAME_2"]) == (0, ("uint8",), "b")


def test_the_sources_have_colours_and_overviews_of_numbers(tmp_path: Path) -> None:
    """Never means of two frames' numbers, which would be a third one's."""
    pixels, valid = image(1, "uint8")
    path = written(tmp_path / "a.tif", pixels, valid).with_suffix(".sources")
    assert validate(str(path), full_check=True)[:2] == ([], [])
    with rasterio.open(path) as tiff:
        assert tiff.colorinterp == (ColorInterp.palette,)
        colours = tiff.colormap(1)
        assert len({colours[n] for n in range(1, 256)}) > 250
        assert tiff.overviews(1)[0] == 2
    with rasterio.open(path, overview_level=0) as tiff:
        np.testing.assert_array_equal(tiff.read(1), np.where(valid, 2, 0)[::2, ::2])
    with rasterio.open(path, overview_level=1) as tiff:
        np.testing.assert_array_equal(tiff.read(1), np.where(valid, 2, 0)[::4, ::4])


def test_more_frames_than_colours_have_larger_numbers() -> None:
    assert [index_kind(n).dtype.name for n in (255, 256, 65_535, 65_536)] == [
        "uint8", "uint16", "uint16", "uint32",
    ]  # fmt: skip


def test_what_is_left_out_or_never_comes_is_empty(tmp_path: Path) -> None:
    """Tiles that wait for nothing more are not kept in memory: the file of tiles grows before the end."""
    pixels, valid = image(1, "uint8")
    with TemporaryFile(dir=tmp_path) as tiles:
        pyramid = RasterPyramid(WIDTH, HEIGHT, TileKind(1, np.dtype("uint8")), tiles, overviews=True)
        pyramid.add_nothing(Window(0, 0, 1024, 512))
        pyramid.add_nothing(Window(0, 512, 1024, 100))
        before = tiles.tell()
        pyramid.add(Window(0, 612, 1024, 412), pixels[612:1024, :1024], valid[612:1024, :1024])
        assert tiles.tell() > before and not pyramid.levels[0].places[0].any()
        assert pyramid.levels[1].places[0, 0, 1] > 0, "the overview's tile needed no more"
        pyramid.finish()
        assert not pyramid.levels[0].places[:, 2:].any() and pyramid.levels[-1].places[0, 0, 1] > 0


def in_hand(pyramid: RasterPyramid) -> int:
    """Tiles, of all levels, of which some pixels are kept."""
    return sum(tile.pixels is not None for gathered in pyramid._gathered for tile in gathered.values())


def test_along_the_curve_no_more_than_a_tile_a_level_is_in_hand(tmp_path: Path) -> None:
    grid = OutputGrid("EPSG:32615", 0.0, 0.0, 1.0, 13 * TILE_PX - 5, 11 * TILE_PX)
    with TemporaryFile(dir=tmp_path) as tiles:
        pyramid = RasterPyramid(
            grid.width_px, grid.height_px, TileKind(1, np.dtype("uint8")), tiles, overviews=True
        )
        most = 0
        for window in along_the_curve(grid, TILE_PX):
            shape = window.height, window.width
            pyramid.add(window, np.ones((*shape, 1), np.uint8), np.ones(shape, bool))
            most = max(most, in_hand(pyramid))
        assert most == len(pyramid.levels) - 1
        assert in_hand(pyramid) == 0, "the last window finishes all"


def test_beyond_four_gigabytes_it_is_a_bigtiff(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its directories have longer numbers, and hold the same."""
    pixels, valid = image(3, "uint8")
    written(tmp_path / "a.tif", pixels, valid)
    monkeypatch.setattr(cog_layout, "_CLASSIC_BYTES", 1000)
    path = written(tmp_path / "b.tif", pixels, valid)
    assert struct.unpack("<2sH", path.read_bytes()[:4]) == (b"II", 43)
    assert validate(str(path), full_check=True)[:2] == ([], [])
    with rasterio.open(path) as big, rasterio.open(tmp_path / "a.tif") as classic:
        np.testing.assert_array_equal(big.read(), classic.read())
        np.testing.assert_array_equal(big.dataset_mask(), classic.dataset_mask())
        assert (big.tags(), big.tags(2), big.crs) == (classic.tags(), classic.tags(2), classic.crs)


def test_the_same_mosaic_is_linked_or_copied_and_another_one_made_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixels, valid = image(3, "uint8")
    path = written(tmp_path / "a.tif", pixels, valid)
    write_cog(path, tmp_path / "same.tif")
    assert (tmp_path / "same.tif").samefile(path)
    with monkeypatch.context() as patch:  # as on FAT
        patch.setattr("os.link", lambda *_: (_ for _ in ()).throw(PermissionError(errno.EPERM, "no links")))
        write_cog(path, tmp_path / "copy.tif")
    assert not (tmp_path / "copy.tif").samefile(path)
    assert (tmp_path / "copy.tif").read_bytes() == path.read_bytes()
    for how in ({"compression": "zstd"}, {"overviews": "cubic"}):
        write_cog(path, tmp_path / "other.tif", CogOptions(**how))
        assert validate(str(tmp_path / "other.tif"), full_check=True)[:2] == ([], [])
        with rasterio.open(tmp_path / "other.tif") as other, rasterio.open(path) as composed:
            np.testing.assert_array_equal(other.read(), composed.read())
            np.testing.assert_array_equal(other.dataset_mask(), composed.dataset_mask())
            assert other.tags(1) == composed.tags(1) and other.tags()["GSD_M"] == "0.05"
            small = [t.read(1, out_shape=(HEIGHT // 2, WIDTH // 2)).astype(int) for t in (other, composed)]
        assert (small[0] != small[1]).any() == ("overviews" in how)


def test_a_scene_keeps_its_bits_and_its_rpc(tmp_path: Path) -> None:
    pixels, valid = image(1, "uint16")
    axes = ("LINE", "SAMP", "LAT", "LONG", "HEIGHT")
    rpc = {f"{axis}_{what}": str(k + 1) for k, axis in enumerate(axes) for what in ("OFF", "SCALE")}
    rpc |= {
        f"{axis}_{part}_COEFF": " ".join(["1"] + ["0"] * 19) for axis in axes[:2] for part in ("NUM", "DEN")
    }
    with writing_scene(tmp_path / "a.tif", (WIDTH, HEIGHT), SceneGreys("uint16", 10), rpc) as raster:
        for window in windows(700):
            raster.write(of(window, pixels, valid))
    write_cog(tmp_path / "a.tif", tmp_path / "cog.tif")
    assert validate(str(tmp_path / "cog.tif"), full_check=True)[:2] == ([], [])
    dataset = gdal.Open(str(tmp_path / "cog.tif"))
    assert rpc.items() <= dataset.GetMetadata("RPC").items()
    assert dataset.GetRasterBand(1).GetMetadataItem("NBITS") == "10"
    assert dataset.GetGeoTransform(can_return_null=True) is None
