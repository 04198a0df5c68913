"""The figures' definitions, pinned with vectors whose answers are known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from geomosaic.quality.figures import best_similarity, figures, touching_patches

GRID = np.stack(np.meshgrid(np.arange(8) * 6.4, np.arange(5) * 6.4), axis=-1).reshape(-1, 2)


def test_a_pure_shift_is_absolute_error_and_nothing_else():
    shift = np.tile([3.0, -4.0], (40, 1))
    f = figures(GRID + np.array([500000.0, 5200000.0]), shift, touching_patches(GRID * 10, 64, 64), 0.1, 50)
    assert (f.asked, f.measured, f.share_measured) == (50, 40, 0.8)
    assert (f.mean_east_m, f.mean_north_m) == pytest.approx((3.0, -4.0))
    assert f.absolute_rmse_m == pytest.approx(5.0) and f.ce90_m == pytest.approx(5.0)
    assert f.after_similarity_px == pytest.approx(0.0, abs=1e-6)
    assert f.jump_99_px == pytest.approx(0.0, abs=1e-9)
    assert f.similarity.scale == pytest.approx(1.0, abs=1e-12)
    assert (f.similarity.shift_east_m, f.similarity.shift_north_m) == pytest.approx((3.0, -4.0))


def test_a_similarity_is_found_with_its_signs():
    turn, scale = math.radians(2.0), 1.003
    about = GRID.mean(axis=0)
    matrix = scale * np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    moved = (GRID - about) @ matrix.T + about + [1.5, -0.25]
    similarity, left = best_similarity(GRID, moved - GRID)
    assert similarity.scale == pytest.approx(1.003)
    assert similarity.rotation_rad == pytest.approx(math.radians(2.0))
    assert similarity.shift_east_m == pytest.approx(1.5)
    assert similarity.shift_north_m == pytest.approx(-0.25)
    assert (similarity.centre_east_m, similarity.centre_north_m) == pytest.approx((22.4, 12.8))
    assert np.abs(left).max() < 1e-9


def test_what_the_similarity_leaves_is_in_pixels_of_the_mosaic():
    wave = np.zeros((40, 2))
    wave[:, 0] = np.where(np.arange(40) % 2 == 0, 0.03, -0.03)
    wave[:, 1] = np.where(np.arange(40) // 8 % 2 == 0, 0.04, -0.04)
    f = figures(GRID, wave, touching_patches(GRID * 10, 64, 64), 0.1, 40)
    assert f.absolute_rmse_m == pytest.approx(0.05)
    assert 0.45 < f.after_similarity_px <= 0.5


def test_a_seam_shows_as_a_jump_of_its_full_size():
    step = np.where(np.abs(GRID[:, :1] - 22.4) < 14.0, [0.3, 0.4], [0.0, 0.0])
    touching = touching_patches(GRID * 10, 64, 64)
    assert len(touching) == 7 * 5 + 8 * 4
    f = figures(GRID, step, touching, 0.1, 40)
    assert f.jump_99_px == pytest.approx(5.0)
    assert f.jump_rms_px == pytest.approx(math.sqrt(10 * 25.0 / 67))


def test_a_mosaic_scaled_as_a_whole_has_no_jumps():
    f = figures(GRID, 0.02 * (GRID - 10.0), touching_patches(GRID * 10, 64, 64), 0.1, 40)
    assert f.absolute_rmse_m > 0.3 and f.similarity.scale == pytest.approx(1.02)
    assert f.jump_99_px == pytest.approx(0.0, abs=1e-9)


def test_jumps_are_between_patches_that_touch_whatever_the_step():
    centres = np.stack(np.meshgrid(np.arange(9) * 32.0, np.arange(2) * 32.0), axis=-1).reshape(-1, 2)
    pairs = touching_patches(centres, 64, 32)
    apart = centres[pairs[:, 1]] - centres[pairs[:, 0]]
    assert len(pairs) == 14
    np.testing.assert_array_equal(np.abs(apart).sum(axis=1), 64.0)


def test_ce90_is_the_length_that_nine_tenths_stay_below():
    length = np.arange(1.0, 12.0)
    vectors = np.stack([length, np.zeros(11)], axis=-1)
    f = figures(GRID[:11], vectors, np.empty((0, 2), dtype=np.int64), 0.1, 11)
    assert f.ce90_m == pytest.approx(10.0)
    assert math.isnan(f.jump_99_px)


def test_no_vectors_no_figures():
    nothing = np.empty((0, 2))
    f = figures(nothing, nothing, touching_patches(nothing, 64, 64), 0.1, 0)
    assert f.measured == 0 and f.share_measured == 0.0
    assert math.isnan(f.absolute_rmse_m) and math.isnan(f.similarity.scale)
