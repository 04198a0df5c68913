"""Tall houses are no ground: the surface of tie points goes on below them, and the land stays as it is."""

from collections.abc import Callable

import numpy as np
import pytest

from geomosaic.adjustment.ground.tie_surface import tie_surface
from geomosaic.adjustment.ground.trial_surface import Heights
from geomosaic.adjustment.ground.walls import leaning_houses, points_on_walls

LOW, HIGH = np.array([-130.0, -110.0]), np.array([130.0, 110.0])
Relief = Callable[[np.ndarray, np.ndarray], np.ndarray]


def hill(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return 5.0 + 0.08 * east + 2.0 * np.sin(north / 40.0)


def in_town(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Under houses of 24 x 40 m, each 50 x 70 m: a quarter of the land."""
    return ((east + 25.0) % 50.0 < 24.0) & ((north + 35.0) % 70.0 < 40.0)


def town(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return hill(east, north) + 30.0 * in_town(east, north)


def quarry(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return hill(east, north) + 30.0 * (east + 0.3 * north > -10.0)


def canyon(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return hill(east, north) - 30.0 * (np.abs(east + 0.3 * north) < 20.0)


def ridge(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Slopes of 45 degrees on either side, 35 m high."""
    return hill(east, north) + np.maximum(35.0 - np.abs(east + 0.2 * north), 0.0)


def seen(relief: Relief, seed: int, count: int = 5000) -> Heights:
    """Points with a deviation of 0.1 m from 100 m above, six times as many on roofs as elsewhere. Of the
    others a third are on things of up to 8 m."""
    rng = np.random.default_rng(seed)
    at = rng.uniform([-100.0, -80.0], [100.0, 80.0], (6 * count, 2))
    at = at[in_town(*at.T) | (rng.random(len(at)) < 1.0 / 6.0)][:count]
    low_m = rng.uniform(0.0, 8.0, count) * (rng.random(count) < 1.0 / 3.0) * ~in_town(*at.T)
    up = relief(*at.T) + low_m + rng.normal(0.0, 0.1, count)
    return Heights(np.column_stack([at, up]), np.full(count, 0.1), LOW, HIGH, 100.0)


@pytest.mark.parametrize("seed", [1, 3, 5])
def test_points_on_tall_houses_are_found(seed: int) -> None:
    heights = seen(town, seed)
    surface = tie_surface(heights)
    on_walls, share = points_on_walls(surface, heights.points_m, heights.height_m)
    roofs = in_town(*heights.points_m[:, :2].T)
    assert on_walls[roofs].mean() > 0.95
    below = tie_surface(heights.without(on_walls))
    east, north = (a.ravel() for a in np.meshgrid(np.arange(-98.0, 99.0, 4.0), np.arange(-78.0, 79.0, 4.0)))
    bent_m, off_m = (np.abs(its.up_at(east, north) - hill(east, north)) for its in (surface, below))
    assert np.quantile(bent_m[~in_town(east, north)], 0.9) > 10.0
    assert np.quantile(off_m, 0.9) < 1.5
    assert share == pytest.approx(in_town(east, north).mean(), rel=0.5)


@pytest.mark.parametrize("seed", [4, 5])
@pytest.mark.parametrize("relief", [hill, quarry, canyon, ridge])
def test_land_stays_land(relief: Relief, seed: int) -> None:
    heights = seen(relief, seed)
    on_walls, share = points_on_walls(tie_surface(heights), heights.points_m, heights.height_m)
    assert not on_walls.any() and share == 0.0


def test_a_thing_on_a_hundredth_of_the_land_is_no_town() -> None:
    """Photos by hand of a sandbox had one, and seams of 13 px passed for leaning houses."""
    assert leaning_houses(0.0) == leaning_houses(0.01) == []
    (warning,) = leaning_houses(0.08)
    assert warning.code == "houses-lean" and "8 % of the land" in warning.text
