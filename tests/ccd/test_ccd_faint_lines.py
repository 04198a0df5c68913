"""Lines with little contrast, and ground that each strip shows in other columns: no bias, honest deviations."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from geomosaic.ccd.columns import even_columns
from geomosaic.ccd.expected import expected
from geomosaic.ccd.least_squares_matching import measure, pair_images
from geomosaic.ccd.lost_lines import steps
from geomosaic.ccd.rows import RowPair
from geomosaic.ccd.second_layers import widest_step
from geomosaic_simulate.strip_plan import StripPlan

KNOT_LINES, KNOTS, WIDTH_PX, MARGIN_PX = 16, 120, 110, 14
LIKELY = expected(StripPlan().geometry())


def pair(ground_sd_px, contrast, noise, off_px, seed):
    """A pair over one ground: the trailing strip `off_px` (dcol, dline) from nominal, in columns MARGIN_PX on."""
    rng = np.random.default_rng(seed)
    n = KNOT_LINES * KNOTS
    ground = gaussian_filter(rng.normal(size=(n + 40, WIDTH_PX + 60)), ground_sd_px)
    ground *= contrast / ground.std()
    moved = shift(ground, off_px[::-1], order=5, mode="nearest")
    lead = ground[20 : 20 + n, 20 : 20 + WIDTH_PX]
    trail = moved[20 : 20 + n, 20 + MARGIN_PX : 20 + MARGIN_PX + WIDTH_PX]
    lead, trail = ((400.0 + x + rng.normal(0.0, noise, x.shape)).astype(np.float32) for x in (lead, trail))
    valid = np.ones(lead.shape, dtype=bool)
    return RowPair(lead, trail, valid, np.zeros((2, 1, 1)), -MARGIN_PX, np.zeros(n))


def measured(given, curve_px, scale=1):
    """Offsets less the curve (dcol, dline) that the cells are measured along, and their information."""
    n = KNOT_LINES * KNOTS
    along = np.repeat(np.array(curve_px)[:, None], n, axis=1)
    return measure(pair_images(given, scale), along, given.known_px, KNOT_LINES)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_ground_without_detail_does_not_shift_the_columns(seed):
    found = measured(pair(12.0, 60.0, 1.0, (0.0, 0.0), seed), (0.0, 0.0))
    assert np.abs(found.offset_px.mean(axis=0)).max() < 0.015


@pytest.mark.parametrize("seed", [4, 5])
def test_faint_ground_is_measured_without_bias_and_with_honest_deviations(seed):
    """Contrast a third of the noise: knots by themselves are worth half a pixel, all of them a twentieth."""
    true = np.array([0.3, -0.2])
    found = measured(pair(1.5, 3.0, 9.0, true, seed), (0.0, 0.0))
    weight = found.information
    error = found.offset_px - true
    total = weight.sum(axis=0)
    mean = np.linalg.solve(total, np.einsum("kij,kj->i", weight, error))
    assert np.abs(mean).max() < 0.1
    square = np.einsum("ki,kij,kj->k", error, weight, error)
    assert 0.7 < np.median(square) / (2.0 * np.log(2.0)) < 1.5


def test_two_different_images_have_next_to_no_information():
    one, other = pair(1.5, 30.0, 3.0, (0.0, 0.0), 6), pair(1.5, 30.0, 3.0, (0.0, 0.0), 7)
    same = measured(one, (0.0, 0.0))
    apart = measured(
        RowPair(one.lead, other.trail, one.valid, one.grey, -MARGIN_PX, one.known_px), (0.0, 0.0)
    )
    assert np.trace(apart.information.mean(axis=0)) < 0.01 * np.trace(same.information.mean(axis=0))


def test_noise_of_faint_knots_makes_no_step_and_a_step_is_still_found():
    rng = np.random.default_rng(9)
    sd = np.full((3, 200, 2), 0.02)
    sd[:, 80:] = 0.8
    offset = rng.normal(0.0, sd)
    own, known = np.ones((3, 200), dtype=bool), np.zeros((3, 200))
    assert widest_step(offset, sd, own, known, LIKELY) == 0.0
    offset[0, 40:60] += 2.0
    assert widest_step(offset, sd, own, known, LIKELY) == pytest.approx(np.hypot(2.0, 2.0), abs=0.2)


def test_coarse_forms_carry_ground_without_fine_detail():
    """Forms of 6 px at a third of the noise: nothing but noise is in fine detail."""
    found = measured(pair(6.0, 3.0, 9.0, (0.0, 0.0), 10), (0.0, 0.0))
    total = found.information.sum(axis=0)
    mean = np.linalg.solve(total, np.einsum("kij,kj->i", found.information, found.offset_px))
    assert mean @ total @ mean < 16.0
    assert (np.trace(total) / 2) ** -0.5 < 0.1


def test_the_response_of_columns_is_read_off_faint_lines():
    rng = np.random.default_rng(11)
    ground = gaussian_filter(rng.normal(size=(2000, 100)), 12.0)
    ground *= 0.1 / ground.std()
    ground[800:] *= 0.05
    response = 1.0 + 0.005 * rng.normal(size=100)
    image = 400.0 * (1.0 + ground) * response + rng.normal(0.0, 3.0, ground.shape)
    even = even_columns(image.astype(np.float32), np.ones(image.shape, dtype=bool))
    left = even[800:].mean(axis=0) / (400.0 * (1.0 + ground[800:])).mean(axis=0)
    assert (left / left.mean()).std() < 0.001


def test_the_response_of_columns_is_read_where_most_lines_are_missing():
    """A third of the lines is valid, as next to a long gap; a stuck column is in none of them."""
    rng = np.random.default_rng(13)
    response = 1.0 + 0.02 * rng.normal(size=100)
    image = (400.0 + rng.normal(0.0, 3.0, (1800, 100))) * response
    valid = np.zeros(image.shape, dtype=bool)
    valid[600:1200] = True
    valid[:, 60] = False
    left = even_columns(image.astype(np.float32), valid)[600:1200].mean(axis=0)
    left = np.delete(left, 60)
    assert (left / left.mean()).std() < 0.001


def test_two_equal_rises_end_the_search_for_lost_lines():
    offset = np.zeros((1, KNOTS, 2))
    slope = np.exp(-0.5 * ((np.arange(KNOTS)[:, None] - np.array([36.0, 84.0])) / 4.0) ** 2)
    offset[0, :, 1] = np.cumsum(slope @ np.array([1.0, -1.0]))
    assert steps([pair(1.5, 30.0, 3.0, (0.0, 0.0), 12)], offset, LIKELY) == []
