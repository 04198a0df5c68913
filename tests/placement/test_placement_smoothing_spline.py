"""Slopes of noisy courses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_smoothing_spline

from geomosaic.placement import smoothing_spline
from geomosaic.placement.smoothing_spline import slopes


def test_a_smooth_course_has_the_slopes_of_scipys_natural_spline() -> None:
    times = np.array([0.0, 1.3, 2.1, 3.9, 5.0, 6.4, 7.0, 8.8])
    values = np.column_stack([np.sin(times), 3.0 * np.cos(0.5 * times)])
    (found,) = slopes([times], [values])
    np.testing.assert_allclose(found, CubicSpline(times, values, bc_type="natural")(times, 1), atol=0.01)


def test_stiffness_is_scipys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its `lam` weighs the integral of the squared second derivative as ours does, per squared value."""
    rng = np.random.default_rng(3)
    times = np.sort(rng.uniform(0.0, 10.0, 30))
    values = np.sin(times) + rng.normal(0.0, 0.2, 30)
    unit = float(np.median(np.diff(times))) ** 3
    monkeypatch.setattr(smoothing_spline, "_STIFFNESS", np.array([0.7 / unit]))
    (found,) = slopes([times], [values[:, None]])
    wanted = make_smoothing_spline(times, values, lam=0.7).derivative()(times)
    np.testing.assert_allclose(found[:, 0], wanted, atol=1e-6)


def test_jitter_is_no_velocity_and_a_curve_is() -> None:
    """Ten lines of twelve: white jitter of 1 m leaves the slope of the line; the same size, smooth, is flown."""
    rng = np.random.default_rng(8)
    times = [np.arange(12) * 1.5] * 10
    jitter = [6.0 * t[:, None] + rng.normal(0.0, 1.0, (12, 2)) for t in times]
    off = np.concatenate(slopes(times, jitter)) - 6.0
    assert np.sqrt((off**2).mean()) < 0.15
    phase = rng.uniform(0.0, 6.28, (10, 2))
    smooth = [
        6.0 * t[:, None] + 1.4 * np.sin(t[:, None] / 3.0 + p) for t, p in zip(times, phase, strict=True)
    ]
    true = [6.0 + 1.4 / 3.0 * np.cos(t[:, None] / 3.0 + p) for t, p in zip(times, phase, strict=True)]
    off = np.concatenate(slopes(times, smooth)) - np.concatenate(true)
    assert np.sqrt((off**2).mean()) < 0.03


def test_two_values_have_their_lines_slope() -> None:
    found = slopes([np.array([1.0, 3.0])], [np.array([[2.0, 0.0], [8.0, -1.0]])])
    np.testing.assert_allclose(found[0], [[3.0, -0.5], [3.0, -0.5]])
    assert slopes([], []) == []
