"""Displacement vectors: known shifts, seams, masks, poor texture, stated deviations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from quality_images import moved, texture

from geomosaic.matching.displacement import PatchMatching, measure_displacements, patch_corners
from geomosaic.matching.least_squares_matching import MaskedImage


def measured(image, reference, valid=None, other=None, patch=64, step=64, search=128, margin=0):
    everywhere = np.ones(image.shape, dtype=bool)
    corners = patch_corners((image.shape[0] - 2 * margin, image.shape[1] - 2 * margin), patch, step)
    return measure_displacements(
        MaskedImage(image.astype(np.float32), everywhere if valid is None else valid),
        MaskedImage(reference.astype(np.float32), everywhere if other is None else other),
        corners + margin,
        PatchMatching(patch, search),
    )


@pytest.mark.parametrize(("right", "down"), [(0.37, -0.61), (-17.28, 31.5), (88.25, -40.5)])
def test_a_known_shift_is_found_to_a_fiftieth_of_a_pixel(right, down):
    reference = texture(768, 896, seed=11)
    found = measured(moved(reference, down, right), reference, margin=96)
    error = found.displacement_px - [right, down]
    assert len(error) == found.asked == 9 * 11
    assert np.abs(error).max() < 0.02


@settings(max_examples=12, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(0.6, 1.5), st.floats(-20.0, 20.0))
def test_any_fraction_gain_and_offset(right, down, gain, offset):
    reference = texture(256, 320, seed=5)
    image = gain * moved(reference, down, right) + offset
    found = measured(image, reference, search=8, margin=8)
    assert len(found.displacement_px) == found.asked == 12
    np.testing.assert_allclose(found.displacement_px, np.tile([right, down], (12, 1)), atol=0.02)


def test_rounding_and_noise_leave_the_stated_deviation():
    reference = texture(1024, 1024, seed=3)
    rng = np.random.default_rng(4)
    image = np.rint(moved(reference, 2.4, -1.3) + rng.normal(0.0, 5.0, reference.shape))
    found = measured(image, np.rint(reference + rng.normal(0.0, 5.0, reference.shape)), margin=32)
    error = found.displacement_px - [-1.3, 2.4]
    assert len(error) == 225
    assert np.abs(error.mean(axis=0)).max() < 0.004
    assert 0.6 < np.sqrt(np.mean((error / found.sd_px[:, None]) ** 2)) < 1.4


def test_both_sides_of_a_seam_are_followed():
    reference = texture(768, 1024, seed=8)
    left, right = moved(reference, 3.2, -1.4), moved(reference, -9.7, 13.3)
    found = measured(np.where(np.arange(1024) < 512, left, right), reference, margin=32)
    west, east = found.centres_px[:, 0] < 440, found.centres_px[:, 0] > 600
    assert west.sum() == 6 * 11 and east.sum() == 6 * 11
    np.testing.assert_allclose(np.median(found.displacement_px[west], axis=0), [-1.4, 3.2], atol=0.01)
    np.testing.assert_allclose(np.median(found.displacement_px[east], axis=0), [13.3, -9.7], atol=0.01)
    for side, true in ((west, [-1.4, 3.2]), (east, [13.3, -9.7])):
        assert np.abs(found.displacement_px[side] - true).max() < 0.02


def test_invalid_pixels_neither_count_nor_disturb():
    reference = texture(640, 640, seed=21)
    image = moved(reference, 1.25, -2.75)
    valid = np.ones((640, 640), dtype=bool)
    valid[:, 500:] = False
    valid[100:110, 100:110] = False
    image[~valid] = 0.0
    found = measured(image, reference, valid)
    assert found.asked == 70
    assert found.centres_px[:, 0].max() < 500
    assert len(found.displacement_px) >= 60
    np.testing.assert_allclose(
        found.displacement_px, np.tile([-2.75, 1.25], (len(found.displacement_px), 1)), atol=0.02
    )


def test_what_cannot_be_measured_is_rejected():
    reference = texture(512, 512, seed=2)
    unlike = texture(512, 512, seed=3)
    flat = np.full((512, 512), 90.0)
    assert len(measured(unlike, reference).displacement_px) <= 1
    assert len(measured(flat, reference).displacement_px) == 0
    assert len(measured(reference, flat).displacement_px) == 0
    assert measured(unlike, reference).asked == 64
    faint = flat + np.random.default_rng(1).normal(0.0, 1.0, flat.shape)
    again = flat + np.random.default_rng(2).normal(0.0, 1.0, flat.shape)
    assert len(measured(faint, again).displacement_px) <= 1


def test_an_image_smaller_than_a_patch_has_no_vectors():
    small = texture(40, 300, seed=1)
    found = measured(small, small)
    assert found.asked == 0 and found.displacement_px.shape == (0, 2)
