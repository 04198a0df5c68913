"""SSIM against closed forms worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from quality_images import texture

from geomosaic.quality.ssim import gain_and_offset, luma, mean_terms, pooled, ssim_maps

ALL = np.ones((40, 50), dtype=bool)
CHECKERS = np.where((np.arange(40)[:, None] + np.arange(50)) % 2 == 0, 1.0, -1.0)


def test_uniform_images_differ_in_luminance_alone():
    terms = mean_terms(ssim_maps(np.full((40, 50), 100.0), np.full((40, 50), 110.0), ALL, 255.0))
    # (2 * 100 * 110 + 2.55^2) / (100^2 + 110^2 + 2.55^2)
    assert terms.ssim == pytest.approx(22006.5025 / 22106.5025, abs=1e-12)
    assert (terms.luminance, terms.contrast, terms.structure) == pytest.approx((terms.ssim, 1.0, 1.0))
    assert terms.pixels == 30 * 40


def test_an_inverted_image_has_negative_structure():
    terms = mean_terms(ssim_maps(128 + 20 * CHECKERS, 128 - 20 * CHECKERS, ALL, 255.0))
    # variance 400, covariance -400, C2 / 2 = 7.65^2 / 2 = 29.26125
    assert terms.structure == pytest.approx((-400 + 29.26125) / (400 + 29.26125), abs=1e-5)
    assert terms.contrast == pytest.approx(1.0, abs=1e-9)


def test_half_the_contrast():
    terms = mean_terms(ssim_maps(128 + 20 * CHECKERS, 128 + 10 * CHECKERS, ALL, 255.0))
    # variances 400 and 100: (2 * 20 * 10 + 58.5225) / (400 + 100 + 58.5225)
    assert terms.contrast == pytest.approx(458.5225 / 558.5225, abs=1e-5)
    # covariance 200 = product of the deviations
    assert terms.structure == pytest.approx(1.0, abs=1e-9)
    assert terms.ssim == pytest.approx(458.5225 / 558.5225, abs=1e-5)


def test_the_three_terms_multiply_to_the_standard_form():
    x, y = texture(64, 64, seed=1), texture(64, 64, seed=2)
    maps = ssim_maps(x, y, np.ones((64, 64), dtype=bool), 255.0)
    middle = maps.ssim[32, 32]
    w = np.exp(-(np.arange(-5, 6) ** 2) / (2 * 1.5**2))
    w = np.outer(w, w) / w.sum() ** 2
    a, b = x[27:38, 27:38], y[27:38, 27:38]
    ma, mb = (w * a).sum(), (w * b).sum()
    va, vb = (w * (a - ma) ** 2).sum(), (w * (b - mb) ** 2).sum()
    cab = (w * (a - ma) * (b - mb)).sum()
    c1, c2 = 6.5025, 58.5225
    by_hand = (2 * ma * mb + c1) * (2 * cab + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
    assert middle == pytest.approx(by_hand, abs=1e-9)


def test_only_windows_that_are_wholly_valid_count():
    valid = ALL.copy()
    valid[20, 30] = False
    image, reference = np.full((40, 50), 100.0), np.full((40, 50), 100.0)
    image[20, 30] = 9999.0
    terms = mean_terms(ssim_maps(image, reference, valid, 255.0))
    assert terms.ssim == pytest.approx(1.0)
    assert terms.pixels == 30 * 40 - 11 * 11
    nothing = mean_terms(ssim_maps(image, reference, np.zeros((40, 50), dtype=bool), 255.0))
    assert nothing.pixels == 0 and np.isnan(nothing.ssim)


def test_parts_pool_by_their_pixels():
    hundred = np.full((40, 50), 100.0)
    parts = [mean_terms(ssim_maps(np.full((40, 50), v), hundred, ALL, 255.0)) for v in (100.0, 50.0)]
    both = pooled(parts)
    assert both.pixels == 2 * 30 * 40
    assert both.ssim == pytest.approx((1.0 + (10000 + 6.5025) / (12500 + 6.5025)) / 2)


def test_gain_and_offset_bring_mean_and_deviation_together():
    image = np.array([10.0, 20.0, 30.0])
    gain, offset = gain_and_offset(image, 3.0 * image - 7.0)
    assert (gain, offset) == pytest.approx((3.0, -7.0))
    assert gain_and_offset(np.full(3, 4.0), np.full(3, 9.0)) == (1.0, 5.0)


def test_luma_of_bt_601():
    assert luma(np.array([[[100.0]], [[200.0]], [[50.0]]]))[0, 0] == pytest.approx(153.0, abs=1e-4)
    assert luma(np.array([[[100.0]], [[200.0]]]))[0, 0] == 100.0
