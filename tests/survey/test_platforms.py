"""Aircraft without serial numbers that fly at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.survey.model import Attitude, Frame, Position
from geomosaic.survey.platforms import paths_of, with_platforms


def flight(speed: float, lines: int, per_line: int, interval_s: float) -> tuple[np.ndarray, np.ndarray]:
    """East, north and times of a flight of lines 20 m apart, with 6 s of turn between them."""
    plan, times = [], []
    for line in range(lines):
        along = np.arange(per_line) * speed * interval_s
        plan += [(20.0 * line, y) for y in (along if line % 2 == 0 else along[::-1])]
        times += [line * (per_line * interval_s + 6.0) + k * interval_s for k in range(per_line)]
    return np.array(plan), np.array(times)


def together(*flights: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, times and numbers of the flights, by time."""
    plan, times = (np.concatenate([one[k] for one in flights]) for k in (0, 1))
    which = np.concatenate([np.full(len(one[1]), k) for k, one in enumerate(flights)])
    order = np.argsort(times, kind="stable")
    return plan[order], times[order], which[order]


@pytest.mark.parametrize("whole_seconds", [False, True])
@pytest.mark.parametrize("drones", [2, 3])
@pytest.mark.parametrize("seed", range(3))
def test_drones_that_fly_at_once_have_paths_of_their_own(whole_seconds: bool, drones: int, seed: int) -> None:
    """Between two turns: a path may go on with another drone's lines after a pause."""
    rng = np.random.default_rng(seed)
    flights = []
    for k in range(drones):
        plan, times = flight(10.0, 1, 20, 2.0)
        flights.append((plan + (250.0 * k, 30.0 * k), times + 0.65 * k))
    plan, times, which = together(*flights)
    times = np.floor(times) if whole_seconds else times + 0.25
    paths = paths_of(plan + rng.normal(0.0, 2.0, plan.shape), times, 2.0)
    assert len({*zip(paths.tolist(), which.tolist(), strict=True)}) == drones


@pytest.mark.parametrize(
    ("speed", "interval_s", "lines"), [(10.0, 2.0, 6), (3.0, 1.0, 12), (28.0, 1.0, 5), (70.0, 2.5, 4), (8.0, 0.4, 4)]
)  # fmt: skip
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("whole_seconds", [False, True])
def test_one_aircraft_is_one_path(
    speed: float, interval_s: float, lines: int, seed: int, whole_seconds: bool
) -> None:
    """A multirotor, a slow one, a fast wing, a manned aircraft, and frames faster than the clock."""
    rng = np.random.default_rng(seed)
    plan, times = flight(speed, lines, 12, interval_s)
    times = np.floor(times) if whole_seconds else times + 0.25
    assert not paths_of(plan + rng.normal(0.0, 2.0, plan.shape), times, 5.0).any()


def test_a_position_far_off_is_no_aircraft() -> None:
    plan, times = flight(10.0, 4, 12, 2.0)
    plan[17] += 900.0
    assert not paths_of(plan, times + 0.25, 5.0).any()


def test_a_position_far_off_at_the_start_of_a_line_parts_no_flight() -> None:
    """The pause before it leaves time to fly there; the way back to the line does not."""
    plan, times = flight(10.0, 4, 12, 2.0)
    plan[24] += 110.0
    assert not paths_of(plan, times + 0.25, 5.0).any()


def test_a_position_far_off_belongs_to_an_aircraft_that_flies() -> None:
    """Of two at once; a path of its own would leave it without a velocity."""
    plan, times, which = together(
        flight(10.0, 1, 20, 2.0), (flight(10.0, 1, 20, 2.0)[0] + 400.0, np.arange(20) * 2.0 + 0.9)
    )
    plan[17] += 900.0
    paths = paths_of(plan, times + 0.25, 5.0)
    assert set(paths.tolist()) == {0, 1}
    assert (np.delete(paths, 17) == np.delete(which, 17)).all()


def test_frames_of_named_drones_keep_their_names() -> None:
    """Two 300 m apart, both to the north at 10 m/s."""
    level = Attitude(0.0, 0.0, 0.0, 1.0, 1.0, "test")
    frames = []
    for k in range(8):
        for lon, offset_s in ((11.0, 0.25), (11.004, 0.95)):
            place = Position(lon, 48.0 + 0.00018 * k, 600.0, None, 1.5, 1.5, 3.0, "test")
            time_s = 1.7e9 + 2.0 * k + offset_s
            frames.append(Frame("a", "/a", 800, 600, 3, "uint8", "cam", place, level, time_s))
    assert [f.platform for f in with_platforms(frames)] == ["path 1", "path 2"] * 8
    by_name = [*frames[8:], *frames[:8]]
    assert sorted({f.platform for f in with_platforms(by_name)}) == ["path 1", "path 2"]
    whole = [replace(f, time_s=float(int(f.time_s or 0.0))) for f in frames[::-1]]
    assert len(with_platforms(whole)) == len(whole)
    named = [replace(f, platform="A") for f in frames]
    assert with_platforms(named) == tuple(named)
    untimed = [replace(f, time_s=None) for f in frames]
    assert with_platforms(untimed) == tuple(untimed)
