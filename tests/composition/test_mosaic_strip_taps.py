"""A strip's pixels between its pixels, against the kernels' own sums and against OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from geomosaic.ccd.layout import StripLookup
from geomosaic.composition.strip_lines import LineBlock
from geomosaic.composition.strip_taps import between
from geomosaic.composition.strip_window import StripBlock, part_of_strip
from geomosaic.projection.resample import RESAMPLING

IMAGE = np.random.default_rng(5).uniform(100.0, 900.0, (60, 150)).astype(np.float32)


def lanczos(image, row, col):
    """One pixel of an image at a place with centre origin, by the sum as textbooks have it."""
    rows, cols = np.arange(int(row) - 3, int(row) + 5), np.arange(int(col) - 3, int(col) + 5)
    down, across = (np.sinc(d) * np.sinc(d / 4.0) for d in (rows - row, cols - col))
    part = image[np.clip(rows, 0, len(image) - 1)[:, None], np.clip(cols, 0, image.shape[1] - 1)]
    return down @ part @ across / down.sum() / across.sum()


def test_lanczos_is_the_textbooks_at_any_place():
    """To 1/512 px of the table, where OpenCV's places are rounded to 1/32."""
    rng = np.random.default_rng(6)
    down, across = 12.0 + rng.uniform(-3.0, 3.0, (20, 5)), 9.0 + rng.uniform(-3.0, 3.0, (20, 5))
    found = between(IMAGE, down, across, 16, "lanczos")
    assert found.shape == (20, 80)
    want = [
        [lanczos(IMAGE, r + down[r, c // 16], c + across[r, c // 16]) for c in range(80)] for r in range(20)
    ]
    assert np.abs(found - want).max() < 3.0  # of slopes of 800 greys a pixel
    assert np.sqrt(((found - want) ** 2).mean()) < 1.0


@pytest.mark.parametrize("resampling", RESAMPLING)
def test_places_that_opencv_does_not_round_are_opencvs(resampling):
    rng = np.random.default_rng(7)
    down, across = (rng.integers(-300, 300, (40, 12)) / 32.0 for _ in range(2))
    found = between(IMAGE, down, across, 8, resampling)
    rows = np.arange(40)[:, None] + np.repeat(down, 8, axis=1)
    cols = np.arange(96) + np.repeat(across, 8, axis=1)
    want = cv2.remap(
        IMAGE,
        cols.astype(np.float32),
        rows.astype(np.float32),
        RESAMPLING[resampling],
        borderMode=cv2.BORDER_REPLICATE,
    )
    np.testing.assert_allclose(found, want, atol=2e-3)


def test_whole_places_are_the_pixels_themselves():
    found = between(IMAGE, np.full((10, 3), 4.0), np.full((10, 3), 7.0), 20, "lanczos")
    np.testing.assert_array_equal(found, IMAGE[4:14, 7:67])


def sloping(knots, rows):
    """Places whose columns and lines lie off by up to 3 px more from knot to knot, and wave with the rows."""
    wave = np.sin(np.arange(rows) / 9.0)[:, None]
    col = knots - 10.0 + 0.02 * (knots - 60.0) + wave
    line = np.arange(rows)[:, None] + 10.5 + 2.0 * np.sin(knots / 50.0) - wave
    return StripLookup(knots, np.stack([col, line]))


def test_a_pixel_is_the_same_in_whatever_part():
    places = sloping(np.array([10.0, 30.0, 140.0, 160.0]), 40)
    lines = LineBlock(0, IMAGE, None)
    whole = part_of_strip(StripBlock(0, places, lines), 60, (0, 40), (10, 160), "lanczos")
    assert whole.valid.any()
    assert not whole.valid.all()
    for first, last in ((10, 47), (47, 48), (48, 160)):
        part = part_of_strip(StripBlock(0, places, lines), 60, (0, 40), (first, last), "lanczos")
        np.testing.assert_array_equal(part.valid, whole.valid[:, first - 10 : last - 10])
        mine = part.valid, whole.valid[:, first - 10 : last - 10]
        np.testing.assert_allclose(
            part.pixels[mine[0]], whole.pixels[:, first - 10 : last - 10][mine[1]], rtol=1e-5
        )


def test_sloping_places_are_within_half_of_a_32nd_of_a_pixel():
    """A ramp shows where a pixel comes from."""
    places = sloping(np.array([10.0, 30.0, 140.0, 160.0]), 40)
    col = np.arange(12, 158) + 0.5
    truth = [np.stack([np.interp(col, places.knots_px, row) for row in axis]) for axis in places.image_px]
    for axis, size in ((0, 150), (1, 60)):
        ramp = np.arange(size, dtype=np.float32) if axis == 0 else np.arange(size, dtype=np.float32)[:, None]
        lines = LineBlock(0, np.broadcast_to(ramp, (60, 150)), None)
        part = part_of_strip(StripBlock(0, places, lines), 60, (0, 40), (12, 158), "lanczos")
        inside = part.valid & (truth[0] > 6) & (truth[0] < 144) & (truth[1] > 6) & (truth[1] < 54)
        assert np.abs(part.pixels + 0.5 - truth[axis])[inside].max() < 1.0 / 64.0 + 0.004
