"""How fast the platform flew."""

from __future__ import annotations

import numpy as np

from geomosaic.placement.velocity import flown_m_per_s, unsteady_m_per_s, velocities_m_per_s


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
    np.testing.assert_allclose(found, np.repeat([[10.0, 0.0, 0.0], [-10.0, 0.0, 0.0]], 11, axis=0), atol=1e-9)


def circle(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities on a circle of 40 m at 8 m/s, climbing at 1.2 m/s."""
    angle = 0.2 * times
    at = np.column_stack([40.0 * np.sin(angle), 40.0 * np.cos(angle), 1.2 * times])
    return at, np.column_stack([8.0 * np.cos(angle), -8.0 * np.sin(angle), np.full(len(times), 1.2)])


def test_on_a_curve_the_parabola_tells_the_velocity() -> None:
    times = np.array([0.13, 1.52, 3.2, 4.61, 6.33, 7.7, 9.41])
    at, true = circle(times)
    off = np.linalg.norm(flown_m_per_s(at, times) - true, axis=1)
    assert off[1:-1].max() < 0.2
    assert off.max() < 0.8
    assert np.linalg.norm(velocities_m_per_s(at, times) - true, axis=1).max() > 2.0


def test_a_clock_of_whole_seconds_tells_the_speed_of_some_steps() -> None:
    times = np.array([0.3, 1.6, 3.4, 4.7, 6.2, 7.8, 9.4, 10.7])
    at, true = circle(times)
    off = np.linalg.norm(flown_m_per_s(at, np.floor(times)) - true, axis=1)
    assert off[1:-1].max() < 1.6


def test_frames_of_one_whole_second_share_it() -> None:
    """Two frames a second and more: by such a clock no time passes between some."""
    times = 1000.2 + 0.7 * np.arange(30)
    at = np.column_stack([9.0 * times, 2.0 * times, np.full(30, 80.0)])
    for known, off in ((velocities_m_per_s, 1.5), (flown_m_per_s, 0.3)):
        np.testing.assert_allclose(known(at, np.floor(times)), np.tile([9.0, 2.0, 0.0], (30, 1)), atol=off)


def test_flown_lines_end_as_they_were_flown() -> None:
    east = np.concatenate([np.arange(11.0), np.arange(10.0, -1.0, -1.0)]) * 10.0
    at = np.column_stack([east, np.repeat([0.0, 40.0], 11), np.zeros(22)])
    found = flown_m_per_s(at, np.arange(22.0))
    np.testing.assert_allclose(found, np.repeat([[10.0, 0.0, 0.0], [-10.0, 0.0, 0.0]], 11, axis=0), atol=1e-9)
    assert not flown_m_per_s(at, np.full(22, np.nan)).any()


def test_a_platform_thrown_about_its_line_flies_at_its_speed() -> None:
    """1 m of wander from frame to frame, 1.2 s apart, is no velocity of 1.2 m/s."""
    rng = np.random.default_rng(5)
    times = np.arange(20) * 1.2 + 0.1
    at = times[:, None] * [6.0, 3.0, 0.0] + rng.normal(0.0, 1.0, (20, 3))
    off = flown_m_per_s(at, times) - [6.0, 3.0, 0.0]
    assert np.sqrt((off[3:-3] ** 2).mean(axis=0)).max() < 0.25
    assert np.sqrt((off**2).mean()) < 0.5 * np.sqrt(
        ((np.gradient(at, times, axis=0) - [6.0, 3.0, 0.0]) ** 2).mean()
    )


def test_where_a_flight_ends_its_velocity_is_unsure() -> None:
    """A line east at 10 m/s with steps of 2 s and a little wander, then down at 4 m/s. The last frame of the
    line and those of the descent next to it may fly either way. Clocks of whole seconds show no change."""
    rng = np.random.default_rng(7)
    line = np.arange(9)[:, None] * [20.0, 0.0, 0.0]
    down = line[-1] + np.arange(1, 4)[:, None] * [0.0, 0.0, -8.0]
    at = np.concatenate([line, down]) + rng.normal(0.0, 0.05, (12, 3))
    times = 0.2 + 2.0 * np.arange(12)
    found = unsteady_m_per_s(at, times)
    assert np.flatnonzero(found > 0.2).tolist() == [8]
    np.testing.assert_allclose(found[8], 0.5 * np.hypot(10.0, 4.0), rtol=0.02)
    assert np.flatnonzero(unsteady_m_per_s(at[:10], times[:10]) > 0.2).tolist() == [8, 9]
    assert not unsteady_m_per_s(line, np.floor(1.4 * np.arange(9))).any()
    assert not unsteady_m_per_s(at, np.full(12, np.nan)).any()


def test_the_ends_of_a_curved_flight_are_unsure() -> None:
    """A spiral at 10 m/s with a frame each 4 s: where it begins, no frame before shows how it curves."""
    radius_m = np.linspace(20.0, 80.0, 15)
    angle = np.cumsum(40.0 / radius_m)
    at = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(15)])
    times = 0.2 + 4.0 * np.arange(15)
    true = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(15)]) * 10.0
    off = np.linalg.norm(flown_m_per_s(at, times) - true, axis=1)
    unsure = unsteady_m_per_s(at, times)
    assert off[0] > 4.0 and off[0] < 3.0 * unsure[0]
    assert np.flatnonzero(unsure).tolist() == [0, 14]
