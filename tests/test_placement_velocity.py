"""How fast the platform flew."""

from __future__ import annotations

import numpy as np

from geomosaic.placement.velocity import velocities_m_per_s


def test_each_line_has_its_own_velocity_whatever_one_position_says() -> None:
    """15 m/s to the north-east by 3-4-5, then 12 m/s back south; one position of the second line is 100 m off."""
    there = np.array([[9.0, 12.0, 0.0]]) * np.arange(6)[:, None] * 2.0
    back = np.array([[200.0, 300.0, 5.0]]) + np.array([[0.0, -12.0, 0.5]]) * np.arange(8)[:, None] * 2.0
    back[4, 0] += 100.0
    times = np.concatenate([2.0 * np.arange(6), 40.0 + 2.0 * np.arange(8)])
    found = velocities_m_per_s(np.concatenate([there, back]), times)
    np.testing.assert_allclose(found[:6], np.tile([9.0, 12.0, 0.0], (6, 1)))
    np.testing.assert_allclose(found[6:], np.tile([0.0, -12.0, 0.5], (8, 1)))


def test_without_times_or_neighbours_nothing_is_known() -> None:
    at = np.array([[0.0, 0.0, 0.0], [30.0, 0.0, 0.0], [60.0, 9.0, 0.0]])
    assert not velocities_m_per_s(at, np.full(3, np.nan)).any()
    assert not velocities_m_per_s(at, np.zeros(3)).any()


def test_a_line_that_ends_without_a_pause() -> None:
    """Ten steps east at 10 m/s, one across, ten back west: the last frame of a line flies as the line does."""
    east = np.concatenate([np.arange(11.0), np.arange(10.0, -1.0, -1.0)]) * 10.0
    at = np.column_stack([east, np.repeat([0.0, 40.0], 11), np.zeros(22)])
    found = velocities_m_per_s(at, np.arange(22.0))
    np.testing.assert_allclose(found, np.repeat([[10.0, 0.0, 0.0], [-10.0, 0.0, 0.0]], 11, axis=0))
