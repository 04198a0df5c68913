"""Rasters compared: grids, coordinate systems, masks, blocks, and clear errors. All files are real."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import rasterio
from quality_images import eight_bits, moved, north_up, texture, write_tif
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.warp import Resampling, reproject, transform_bounds
from rasterio.windows import Window

from geomosaic.errors import FileError, InputError
from geomosaic.quality import compare as module
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.rasters import read_luma
from geomosaic.report.glance import glance_of

WEST, NORTH, GSD = 500000.0, 5200000.0, 0.1


def test_displacement_in_metres_of_the_map_between_grids_a_fraction_apart(tmp_path):
    base = texture(640, 768, seed=7)
    reference = write_tif(tmp_path / "ortho.tif", eight_bits(base), WEST, NORTH, GSD)
    shifted = eight_bits(moved(base, 1.5, -2.25))
    mosaic = write_tif(tmp_path / "mosaic.tif", shifted, WEST + 7.25 * GSD, NORTH - 4.5 * GSD, GSD)
    c = compare(mosaic, reference, ComparisonOptions(search_px=32))
    # the image shows things 7.25 - 2.25 pixels too far east and 4.5 + 1.5 too far south
    assert c.figures.mean_east_m == pytest.approx(0.5, abs=0.002)
    assert c.figures.mean_north_m == pytest.approx(-0.6, abs=0.002)
    assert c.figures.absolute_rmse_m == pytest.approx(0.781, abs=0.002)
    assert c.figures.after_similarity_px < 0.03
    assert c.figures.share_measured > 0.75
    assert c.gsd_m == pytest.approx(0.1)
    assert c.overlap_share == pytest.approx((768 - 7.25) / 768 * (640 - 4.5) / 640, abs=0.005)
    centre_px = (c.vectors_m[:, :2] - [WEST + 7.25 * GSD, NORTH - 4.5 * GSD]) / [GSD, -GSD]
    np.testing.assert_allclose(centre_px % 64, 32.0, atol=1e-4)
    np.testing.assert_allclose(c.vectors_m[:, 2:], np.tile([0.5, -0.6], (len(c.vectors_m), 1)), atol=0.005)


def test_ssim_after_registration_tells_of_the_image_and_not_of_its_place(tmp_path):
    """A mosaic without a fault, three pixels off, turned by 0.2 degrees and larger by 4 in a thousand."""
    base = texture(700, 800, seed=17, slope=1.2)
    reference = write_tif(tmp_path / "ortho.tif", eight_bits(base), WEST, NORTH, GSD)
    turn = cv2.getRotationMatrix2D((400.0, 350.0), 0.2, 1.004) + [[0.0, 0.0, 3.0], [0.0, 0.0, -2.0]]
    image = cv2.warpAffine(eight_bits(base)[0], turn, (800, 700), flags=cv2.INTER_CUBIC)
    c = compare(
        write_tif(tmp_path / "mosaic.tif", image[None], WEST, NORTH, GSD),
        reference,
        ComparisonOptions(search_px=32),
    )
    assert c.figures.similarity.scale == pytest.approx(1.004, abs=1e-4)
    assert c.ssim.ssim < 0.5 and c.ssim_registered.ssim > 0.93
    other = write_tif(tmp_path / "other.tif", eight_bits(texture(700, 800, seed=99)), WEST, NORTH, GSD)
    alike = compare(other, reference, ComparisonOptions(search_px=32)).ssim_registered
    assert alike is None or alike.ssim < 0.5


def test_blocks_do_not_show(tmp_path, monkeypatch):
    base = texture(500, 600, seed=9)
    reference = write_tif(tmp_path / "ortho.tif", eight_bits(base), WEST, NORTH, GSD)
    mosaic = write_tif(tmp_path / "mosaic.tif", eight_bits(moved(base, 0.4, 1.7)), WEST, NORTH, GSD)
    whole = compare(mosaic, reference, ComparisonOptions(patch_px=32, step_px=32, search_px=16))
    seen = []
    monkeypatch.setattr(module, "GLANCE_PX", 200)
    parts = compare(
        mosaic,
        reference,
        ComparisonOptions(patch_px=32, step_px=32, search_px=16),
        progress=lambda *a: seen.append(a),
    )
    assert seen[0] == (0, 12) and seen[-1] == (12, 12)
    assert parts.ssim.pixels == whole.ssim.pixels == 490 * 590
    assert parts.ssim.ssim == pytest.approx(whole.ssim.ssim, abs=1e-9)
    assert parts.figures.measured == whole.figures.measured
    assert parts.figures.absolute_rmse_m == pytest.approx(whole.figures.absolute_rmse_m, abs=1e-4)
    np.testing.assert_allclose(parts.ssim_cells, whole.ssim_cells, atol=1e-5)
    assert whole.ssim_cells.shape == (16, 19)
    asked = [Window(64, 96, 160, 96), Window(320, 0, 128, 128)]
    some = compare(mosaic, reference, ComparisonOptions(patch_px=32, step_px=32, search_px=16), parts=asked)
    within = np.zeros(whole.ssim_cells.shape, dtype=bool)
    within[3:6, 2:7] = within[:4, 10:14] = True
    np.testing.assert_allclose(some.ssim_cells[within], whole.ssim_cells[within], atol=1e-5)
    assert np.isnan(some.ssim_cells[~within]).all()
    assert some.figures.measured == within.sum() == some.figures.asked
    with pytest.raises(InputError, match="no part of the reference"):
        compare(mosaic, reference, parts=[])


def test_a_reference_in_another_coordinate_system_and_at_another_pixel(tmp_path):
    base = texture(900, 900, seed=13)
    west, north = 728000.0, 5200000.0
    mosaic = write_tif(tmp_path / "mosaic.tif", eight_bits(base), west, north, 0.2)
    bounds = (west, north - 180.0, west + 180.0, north)
    left, bottom, right, top = transform_bounds("EPSG:32632", "EPSG:32633", *bounds)
    size = int((right - left) / 0.15), int((top - bottom) / 0.15)
    other = np.zeros((1, size[1], size[0]), dtype=np.uint8)
    valid = np.zeros(other.shape[1:], dtype=np.uint8)
    affine = north_up(left, top, 0.15)
    crs = {"src_crs": CRS.from_epsg(32632), "dst_crs": CRS.from_epsg(32633)}
    src = north_up(west, north, 0.2)
    affines = {"src_transform": src, "dst_transform": affine}
    reproject(eight_bits(base), other, resampling=Resampling.cubic, tolerance=0.0, **affines, **crs)
    ones = np.full((900, 900), 255, dtype=np.uint8)
    reproject(ones, valid, resampling=Resampling.nearest, **affines, **crs)
    reference = write_tif(tmp_path / "reference.tif", other, left, top, 0.15, "EPSG:32633", valid == 255)
    c = compare(mosaic, reference, ComparisonOptions(search_px=16))
    assert c.figures.share_measured > 0.95
    assert np.abs(c.vectors_m[:, 2:]).max() < 0.05 * 0.2
    assert c.overlap_share > 0.97
    assert c.ssim.ssim > 0.9


def test_masks_alpha_and_colour(tmp_path):
    base = texture(300, 400, seed=15)
    colour = np.concatenate([eight_bits(base), eight_bits(base * 0.8), eight_bits(base * 1.1)])
    valid = np.ones((300, 400), dtype=bool)
    valid[:, :100] = False
    alpha = np.concatenate([colour, np.full((1, 300, 400), 255, dtype=np.uint8)])
    alpha[3, 200:] = 0
    mosaic = write_tif(tmp_path / "mosaic.tif", colour, WEST, NORTH, GSD, valid=valid)
    reference = tmp_path / "alpha.tif"
    with rasterio.open(
        reference, "w", driver="GTiff", width=400, height=300, count=4, dtype="uint8", crs="EPSG:32632",
        transform=north_up(WEST, NORTH, GSD), photometric="RGB", alpha="YES",
    ) as dataset:  # fmt: skip
        dataset.write(alpha)
    c = compare(mosaic, reference, ComparisonOptions(patch_px=32, step_px=32, search_px=8))
    assert c.overlap_share == pytest.approx(200 / 300, abs=0.001)
    assert c.ssim.ssim == pytest.approx(1.0, abs=1e-6)
    assert c.ssim.pixels == (300 - 10) * (200 - 10)
    assert c.vectors_m[:, 0].min() > WEST + 10.0 and c.vectors_m[:, 1].min() > NORTH - 20.0
    assert np.isnan(c.ssim_cells[0, 0]) and np.isfinite(c.ssim_cells[1, 5])


def test_tone_may_be_matched_before_ssim(tmp_path):
    base = texture(256, 256, seed=17)
    reference = write_tif(tmp_path / "r.tif", eight_bits(base), WEST, NORTH, GSD)
    mosaic = write_tif(tmp_path / "m.tif", eight_bits(0.6 * base + 20.0), WEST, NORTH, GSD)
    plain = compare(mosaic, reference, ComparisonOptions(search_px=8))
    matched = compare(mosaic, reference, ComparisonOptions(search_px=8, match_tone=True))
    assert plain.ssim.ssim < 0.9 < 0.99 < matched.ssim.ssim
    assert matched.ssim.gain == pytest.approx(1 / 0.6, rel=0.01)
    assert matched.figures.absolute_rmse_m < 0.001


def test_sixteen_bits(tmp_path):
    base = texture(256, 256, seed=19)
    values = np.rint(base * 40.0).astype(np.uint16)[None]
    mosaic = write_tif(tmp_path / "m.tif", values, WEST, NORTH, GSD)
    reference = write_tif(tmp_path / "r.tif", values, WEST, NORTH, GSD)
    c = compare(mosaic, reference, ComparisonOptions(search_px=8))
    assert c.ssim.ssim == pytest.approx(1.0) and c.figures.share_measured == 1.0


@pytest.mark.parametrize("kind", ["uint8", "int16", "uint16", "uint32", "float32"])
@pytest.mark.parametrize("nodata", [None, 0])
def test_ground_beyond_a_reference_and_its_nodata_are_not_compared(tmp_path, kind, nodata):
    """The reference covers the left half of the mosaic, and its first 40 columns have nodata."""
    base = eight_bits(texture(256, 256, seed=19)).clip(1).astype(kind)
    mosaic = write_tif(tmp_path / "m.tif", base, WEST, NORTH, GSD)
    half = base[:, :, :128].copy()
    if nodata is not None:
        half[:, :, :40] = nodata
    reference = write_tif(tmp_path / "r.tif", half, WEST, NORTH, GSD)
    with rasterio.open(reference, "r+") as dataset:
        dataset.nodata = nodata
    c = compare(mosaic, reference, ComparisonOptions(patch_px=32, step_px=32, search_px=8))
    assert c.overlap_share == pytest.approx((0.5 if nodata is None else 88 / 256), abs=0.005)
    assert c.ssim.ssim == pytest.approx(1.0, abs=1e-6)
    far = write_tif(tmp_path / "far.tif", base, WEST + 100_000.0, NORTH, GSD)
    with pytest.raises(InputError, match=r"far\.tif: does not overlap the mosaic"):
        compare(mosaic, far)


def test_an_alpha_band_of_floats_is_a_mask(tmp_path):
    values = np.full((2, 20, 30), 300.0, np.float32)
    values[1] = 255.0
    values[1, :, 12:] = 0.0
    path = write_tif(tmp_path / "alpha.tif", values, WEST, NORTH, GSD)
    with rasterio.open(path, "r+") as dataset:
        dataset.colorinterp = [ColorInterp.gray, ColorInterp.alpha]
    with rasterio.open(path) as dataset:
        grey, valid = read_luma(dataset, None)
        assert glance_of(dataset, 30).covered_m2 == pytest.approx(20 * 12 * GSD**2)
    assert valid[:, :12].all() and not valid[:, 12:].any() and grey[0, 0] == 300.0


def test_errors_name_the_file_and_the_fix(tmp_path):
    image = eight_bits(texture(64, 64, seed=1))
    good = write_tif(tmp_path / "good.tif", image, WEST, NORTH, GSD)
    far = write_tif(tmp_path / "far.tif", image, WEST + 5000.0, NORTH, GSD)
    with pytest.raises(InputError, match=r"far\.tif: does not overlap the mosaic; give"):
        compare(good, far)
    text = tmp_path / "text.tif"
    text.write_text("no raster file")
    with pytest.raises(FileError, match=r"text\.tif: is no raster file that can be read; give"):
        compare(good, text)
    with pytest.raises(FileError, match=r"none\.tif: no such file; give"):
        compare(tmp_path / "none.tif", good)
    nowhere = write_tif(tmp_path / "nowhere.tif", image, WEST, NORTH, GSD, crs=None)
    with pytest.raises(FileError, match=r"nowhere\.tif: has no coordinate reference system; give"):
        compare(good, nowhere)
    degrees = write_tif(tmp_path / "degrees.tif", image, 9.0, 47.0, 1e-6, crs="EPSG:4326")
    with pytest.raises(FileError, match=r"degrees\.tif: is not in a map projection; warp"):
        compare(degrees, good)
    with pytest.raises(InputError, match="out of bounds"):
        compare(good, good, ComparisonOptions(patch_px=4))
