"""The scene's raster: overviews made block by block."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from osgeo import gdal

from geomosaic.composition.raster import BLOCK_ROWS, SceneGreys, writing_scene
from geomosaic.composition.tiles import halved
from geomosaic.composition.window import Composed, Window
from geomosaic.export.cog import write_cog


def block(top: int, pixels: np.ndarray, valid: np.ndarray, left: int = 0) -> Composed:
    window = Window(left, top, pixels.shape[1], len(pixels))
    return Composed(window, pixels[..., None], valid, valid.astype(np.int16) - 1, (0,), (0,))


@settings(deadline=None, max_examples=40)
@given(rows=st.integers(1, 9), cols=st.integers(1, 9), seed=st.integers(0, 99), share=st.floats(0, 1))
def test_halved_is_the_mean_of_the_valid_ones(rows: int, cols: int, seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    pixels, valid = rng.integers(0, 65536, (rows, cols)).astype(np.uint16), rng.random((rows, cols)) <= share
    means, some = halved(pixels[..., None], valid)
    means = means[..., 0]
    assert means.shape == some.shape == (-(-rows // 2), -(-cols // 2)) and means.dtype == np.uint16
    for i, j in np.ndindex(means.shape):
        at = slice(2 * i, 2 * i + 2), slice(2 * j, 2 * j + 2)
        four = pixels[at][valid[at]].astype(float)
        assert some[i, j] == bool(four.size)
        assert abs(float(means[i, j]) - (four.mean() if four.size else 0.0)) <= 0.5


def test_overviews_are_whole_and_the_cog_takes_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    height, width = 2 * BLOCK_ROWS + 301, 1501
    pixels = rng.integers(100, 1000, (height, width)).astype(np.uint16)
    valid = np.ones((height, width), dtype=bool)
    valid[:700, :300] = False
    with writing_scene(
        tmp_path / "a.tif", (width, height), SceneGreys("uint16", 10), {"LINE_OFF": "7"}
    ) as raster:
        for top in range(0, height, BLOCK_ROWS):
            rows = slice(top, min(top + BLOCK_ROWS, height))
            shown = np.where(valid, pixels, 0)[rows]
            raster.write(block(top, shown[:, :700], valid[rows, :700]))
            raster.write(block(top, shown[:, 700:], valid[rows, 700:], 700))
    write_cog(tmp_path / "a.tif", tmp_path / "cog.tif")
    for path in (tmp_path / "a.tif", tmp_path / "cog.tif"):
        dataset = gdal.Open(str(path))
        band = dataset.GetRasterBand(1)
        assert band.GetOverviewCount() == 2
        wanted, seen = np.where(valid, pixels, 0).astype(np.uint16), valid
        for level in range(3):
            at = band if level == 0 else band.GetOverview(level - 1)
            np.testing.assert_array_equal(at.ReadAsArray(), wanted)
            np.testing.assert_array_equal(at.GetMaskBand().ReadAsArray() > 0, seen)
            wanted, seen = halved(wanted[..., None], seen)
            wanted = wanted[..., 0]


def test_a_full_disk_at_the_very_end_is_an_error_and_no_traceback(tmp_path: Path) -> None:
    """A dataset that can't be closed must not raise where nothing can catch it: pytest makes that an error."""
    height, width = 3 * BLOCK_ROWS, 1501
    pixels = np.random.default_rng(4).integers(100, 60000, (height, width)).astype(np.uint16)
    whole = 2 * pixels.size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for room in np.linspace(2000, 2.0 * whole, 40).astype(int).tolist():
        failed = False
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, before[1]))
        try:
            with writing_scene(
                tmp_path / f"{room}.tif", (width, height), SceneGreys("uint16", 16), None
            ) as raster:
                for top in range(0, height, BLOCK_ROWS):
                    rows = slice(top, top + BLOCK_ROWS)
                    raster.write(block(top, pixels[rows], np.ones((BLOCK_ROWS, width), dtype=bool)))
        except OSError:
            failed = True
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert failed or room > whole  # the mask and overviews take more
        (tmp_path / f"{room}.tif").unlink(missing_ok=True)
    assert not failed
