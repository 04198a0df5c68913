"""The COG, checked by GDAL's own validator and by reading it back with the other GDAL."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate

from geomosaic.errors import CancelledError, InputError
from geomosaic.export.cog import COMPRESSIONS, LOSSY, CogOptions, write_cog


def raw_raster(path: Path, bands: int = 3, dtype: str = "uint8", side: int = 1300) -> np.ndarray:
    col, row = np.meshgrid(np.arange(side), np.arange(side - 300))
    top = 250.0 if dtype == "uint8" else 60_000.0
    waves = [0.5 + 0.5 * np.sin(col / (9.0 + b) + row / 23.0) for b in range(bands)]
    pixels = (np.stack(waves) * top).astype(dtype)
    valid = (col + row > 400) & (col - row < 1000)
    pixels[:, ~valid] = 0
    shape = {"width": side, "height": side - 300, "count": bands, "dtype": dtype, "crs": "EPSG:32615"}
    transform = rasterio.Affine(0.0169, 0.0, 576_625.6, 0.0, -0.0169, 5_188_250.2)
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
        rasterio.open(path, "w", driver="GTiff", tiled=True, transform=transform, **shape) as tiff,
    ):
        tiff.write(pixels)
        tiff.write_mask(valid.astype(np.uint8) * 255)
    return pixels


@pytest.mark.parametrize("compression", sorted(COMPRESSIONS))
def test_a_cog_that_the_validator_passes(tmp_path, compression):
    pixels = raw_raster(tmp_path / "raw.tif")
    out = tmp_path / "mosaic.tif"
    write_cog(tmp_path / "raw.tif", out, CogOptions(compression=compression))
    warnings, errors, _ = validate(str(out), full_check=True)
    assert (warnings, errors) == ([], [])
    with rasterio.open(out) as tiff:
        assert tiff.crs.to_epsg() == 32615
        assert tiff.transform[:6] == pytest.approx((0.0169, 0.0, 576_625.6, 0.0, -0.0169, 5_188_250.2))
        assert tiff.block_shapes[0] == (512, 512)
        assert tiff.overviews(1) == [2, 4]
        assert tiff.tags()["GSD_M"] == "0.0169"
        assert tiff.tags()["TIFFTAG_SOFTWARE"].startswith("geomosaic ")
        assert tiff.profile["compress"].lower().startswith(compression)
        mask = tiff.dataset_mask()
        read = tiff.read()
    assert not (tmp_path / "mosaic.tif.msk").exists(), "the mask lies inside"
    assert (mask[0, 0], mask[500, 500], mask[0, 1299]) == (0, 255, 0)
    difference = np.abs(read.astype(int) - pixels)[:, mask > 0]
    assert difference.mean() < 6.0 if compression in LOSSY else difference.max() == 0


def test_lerc_changes_values_by_no_more_than_it_may(tmp_path):
    pixels = raw_raster(tmp_path / "raw.tif", bands=1, dtype="uint16")
    sizes = []
    for most_off in (0.0, 20.0):
        write_cog(
            tmp_path / "raw.tif", tmp_path / "out.tif", CogOptions(compression="lerc", most_off=most_off)
        )
        with rasterio.open(tmp_path / "out.tif") as tiff:
            off = np.abs(tiff.read().astype(int) - pixels)[:, tiff.dataset_mask() > 0]
        assert off.max() <= most_off
        sizes.append((tmp_path / "out.tif").stat().st_size)
    assert off.max() > 5.0 and sizes[1] < 0.7 * sizes[0]


def test_statistics_are_of_valid_pixels_alone(tmp_path):
    """Half of the raster is masked zeros; nothing is left but the files."""
    pixels = raw_raster(tmp_path / "raw.tif", dtype="uint16")
    write_cog(tmp_path / "raw.tif", tmp_path / "out.tif")
    with rasterio.open(tmp_path / "out.tif") as tiff:
        reported = [float(tiff.tags(b)["STATISTICS_MEAN"]) for b in (1, 2, 3)]
        valid = tiff.dataset_mask() > 0
    assert reported == pytest.approx(pixels[:, valid].mean(axis=1), rel=0.05)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out.tif", "raw.tif"]


def test_sixteen_bits_and_five_bands(tmp_path):
    pixels = raw_raster(tmp_path / "raw.tif", bands=5, dtype="uint16", side=700)
    write_cog(tmp_path / "raw.tif", tmp_path / "out.tif")
    assert validate(str(tmp_path / "out.tif"))[:2] == ([], [])
    with rasterio.open(tmp_path / "out.tif") as tiff:
        np.testing.assert_array_equal(tiff.read(), pixels)
    with pytest.raises(
        InputError, match="jpeg can't hold 5 bands of UInt16; choose deflate, zstd, lzw or lerc"
    ):
        write_cog(tmp_path / "raw.tif", tmp_path / "no.tif", CogOptions(compression="jpeg"))
    assert not (tmp_path / "no.tif").exists()


def test_equal_mosaics_give_equal_bytes(tmp_path):
    raw_raster(tmp_path / "raw.tif")
    write_cog(tmp_path / "raw.tif", tmp_path / "a.tif", CogOptions(threads=1))
    write_cog(tmp_path / "raw.tif", tmp_path / "b.tif", CogOptions(threads=2))
    assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()


def test_progress_may_stop_it(tmp_path):
    raw_raster(tmp_path / "raw.tif")
    seen = []

    def stop_halfway(done: int, total: int) -> None:
        seen.append(done / total)
        if done / total > 0.5:
            raise CancelledError

    with pytest.raises(CancelledError):
        write_cog(tmp_path / "raw.tif", tmp_path / "out.tif", progress=stop_halfway)
    assert seen[-1] > 0.5
    assert seen == sorted(seen)


FULL_DISK = """
import errno, resource, signal, sys
from pathlib import Path
from geomosaic.export.cog import write_cog
from geomosaic.export.geopackage import MapFeatures, write_geopackage
import numpy as np, shapely
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (120_000, 120_000))
folder = Path(sys.argv[1])
for write in (
    lambda: write_cog(folder / "raw.tif", folder / "out.tif"),
    lambda: fill(folder / "out.gpkg"),
):
    def fill(path):
        points = shapely.points(np.random.rand(20000, 2))
        write_geopackage(path, "EPSG:32615", None, [MapFeatures("p", "", "Point", points, {})])
    try:
        write()
        print("written")
    except OSError as error:
        print("OSError", error)
"""


def test_a_file_that_can_not_grow_is_an_error(tmp_path):
    """As on a full disk: the system refuses further bytes; GDAL may notice only while closing."""
    raw_raster(tmp_path / "raw.tif")
    run = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)], capture_output=True, text=True, timeout=60
    )
    assert [line.split()[0] for line in run.stdout.splitlines()] == ["OSError", "OSError"], run.stdout
