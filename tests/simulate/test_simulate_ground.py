"""The simulated ground: any window alike, no repetition, hills as stated, buildings in their places."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geomosaic_simulate.buildings import Building
from geomosaic_simulate.landscape import Landscape
from geomosaic_simulate.noise import hashed, lattice_noise, spline_noise
from geomosaic_simulate.relief import Relief, hills
from geomosaic_simulate.terrain import BLOCK_PX, GroundImage

COL, ROW = 6_711_800, -53_300_200


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return GroundImage(Landscape(5), 0.1).window(COL, ROW, (900, 1200))


def test_a_window_is_the_same_however_it_is_cut(image: np.ndarray) -> None:
    part = GroundImage(Landscape(5), 0.1).window(COL + 301, ROW + 257, (300, 333))
    assert np.array_equal(part, image[257:557, 301:634])
    seam = 2 * BLOCK_PX - COL % BLOCK_PX
    steps = np.abs(np.diff(image.astype(float), axis=1)).mean(axis=(0, 2))
    assert steps[seam - 1] < 1.3 * np.median(steps[seam - 30 : seam + 30])


def test_another_seed_is_another_country(image: np.ndarray) -> None:
    other = GroundImage(Landscape(6), 0.1).window(COL, ROW, (300, 300))
    assert np.abs(other.astype(float) - image[:300, :300]).mean() > 10.0


def test_the_image_looks_like_land_to_a_feature_detector(image: np.ndarray) -> None:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    per_megapixel = len(cv2.SIFT.create().detect(grey)) / grey.size * 1e6
    assert 2500 < per_megapixel < 20000
    assert 15.0 < grey.std() < 60.0
    assert np.mean((image == 0) | (image == 255)) < 0.01
    spectrum = np.abs(np.fft.rfft2(grey[:512, :512] - grey[:512, :512].mean())) ** 2
    low, high = spectrum[4:16, 4:16].mean(), spectrum[96:160, 96:160].mean()
    assert low > 20.0 * high > 0.0


def test_it_does_not_repeat(image: np.ndarray) -> None:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    patch = grey[100:196, 150:246]
    score = cv2.matchTemplate(grey, patch, cv2.TM_CCOEFF_NORMED)
    score[60:140, 110:190] = 0.0
    assert score.max() < 0.75


def test_a_building_is_painted_on_its_footprint() -> None:
    land = Landscape(5)
    found = land.buildings_in((671_000.0, 5_329_800.0, 671_400.0, 5_330_200.0))
    assert len(found) > 3
    b = found[0]
    ground = GroundImage(land, 0.1)
    col, row = int(b.easting_m / 0.1), int(-b.northing_m / 0.1)
    around = ground.window(col - 150, row - 150, (300, 300)).astype(float)
    mask = np.zeros((300, 300), np.uint8)
    px = (b.outline_m() - [(col - 150) * 0.1, -(row - 150) * 0.1]) * [10.0, -10.0] - 0.5
    cv2.fillPoly(mask, [np.round(px).astype(np.int32)], 255)
    inside = cv2.erode(mask, np.ones((7, 7))) > 0
    share = np.abs(around[inside].mean(axis=0) / around[inside].mean() - np.divide(b.roof, np.mean(b.roof)))
    assert share.max() < 0.06
    sides = np.linalg.norm(np.diff(b.outline_m(), axis=0), axis=1)
    np.testing.assert_allclose(sides[:2], [2 * b.half_length_m, 2 * b.half_width_m])


def test_no_buildings_if_none_are_wanted() -> None:
    assert not Landscape(5, buildings=0.0).buildings_in((671_000.0, 5_329_800.0, 671_400.0, 5_330_200.0))


def test_axes_of_a_building() -> None:
    b = Building(100.0, 200.0, 5.0, 3.0, np.radians(90.0), 8.0, (0, 0, 0), True)
    np.testing.assert_allclose(b.outline_m()[1], [103.0, 205.0])


def test_hills_have_the_stated_range_and_slopes() -> None:
    e, n = np.meshgrid(np.arange(671_000.0, 671_600.0, 3.0), np.arange(5_329_000.0, 5_329_600.0, 3.0))
    relief = hills(3, 520.0, 24.0, 300.0, np.stack([e, n], axis=-1))
    height = relief.height_at(e, n)
    assert height.min() == pytest.approx(508.0, abs=1e-6)
    assert height.max() == pytest.approx(532.0, abs=1e-6)
    slope = np.hypot(*np.gradient(height, 3.0))
    assert 0.05 < slope.max() < 0.6
    assert float(relief.height_at(671_000.0, 5_329_000.0)) == pytest.approx(height[0, 0], abs=1e-9)


def test_level_ground_is_level() -> None:
    assert Relief(1, 320.5).height_at(np.array([1.0, 2e6]), np.array([5e6, 0.0])).tolist() == [320.5, 320.5]


def test_hashed_numbers_are_uniform_and_independent() -> None:
    u = hashed(9, 4, np.arange(-200, 200)[:, None], np.arange(-150, 250)[None, :])
    assert 0.0 <= u.min() < 1e-4 and 0.9999 < u.max() < 1.0
    assert u.mean() == pytest.approx(0.5, abs=0.003)
    assert u.var() == pytest.approx(1.0 / 12.0, abs=0.001)
    assert abs(np.corrcoef(u[:-1].ravel(), u[1:].ravel())[0, 1]) < 0.01
    assert abs(np.corrcoef(u[:, :-1].ravel(), u[:, 1:].ravel())[0, 1]) < 0.01
    other = hashed(9, 5, np.arange(-200, 200)[:, None], np.arange(-150, 250)[None, :])
    assert abs(np.corrcoef(u.ravel(), other.ravel())[0, 1]) < 0.01


@settings(max_examples=25, deadline=None)
@given(st.integers(-(10**7), 10**7), st.integers(-(10**7), 10**7), st.sampled_from([1, 2, 8, 64, 512]))
def test_noise_does_not_know_its_window(col: int, row: int, spacing: int) -> None:
    whole = lattice_noise(3, 1, col, row, (40, 50), spacing)
    part = lattice_noise(3, 1, col + 13, row + 7, (20, 30), spacing)
    np.testing.assert_allclose(part, whole[7:27, 13:43], atol=2e-5)


@settings(max_examples=25, deadline=None)
@given(st.floats(-2000, 2000), st.floats(-2000, 2000))
def test_spline_noise_is_smooth_and_pointwise(x: float, y: float) -> None:
    at = spline_noise(1, 2, np.array([x, x + 1e-3, x + 300.0]), np.array([y, y, y - 50.0]))
    assert spline_noise(1, 2, x, y) == pytest.approx(at[0], abs=1e-12)
    assert abs(at[1] - at[0]) < 1.5e-3
    assert 0.0 < at.min() <= at.max() < 1.0


@pytest.mark.proof
def test_crop_rows_run_on_over_the_blocks_edge() -> None:
    """On every block edge of 2 km of land, neighbours differ no more than adjacent pixels."""
    ground = GroundImage(Landscape(8), 0.2)
    worst = []
    for k in range(8):
        edge = BLOCK_PX * (6500 + k)
        strip = ground.window(edge - 30, -26_650_000, (400, 60)).astype(float)
        steps = np.abs(np.diff(strip, axis=1)).mean(axis=(0, 2))
        worst.append(steps[29] / np.median(steps))
    assert max(worst) < 1.25
