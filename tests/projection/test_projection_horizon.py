"""What stands before what, against the shadow of a box by hand."""

from __future__ import annotations

import numpy as np
import pytest

from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.horizon import hidden_m

SPACING_M, TOP_M = 0.25, 12.0


def box(sd_m: float | None = None) -> tuple[GroundSurface, np.ndarray]:
    """Flat land with a box 10 m wide, 12 m high, from 10 m to 20 m east; and its nodes' places."""
    axis = -60.0 + SPACING_M * np.arange(561)
    east, north = np.meshgrid(axis, axis)
    up = np.where((east >= 10.0) & (east <= 20.0) & (np.abs(north) <= 5.0), TOP_M, 0.0)
    sd = None if sd_m is None else np.where(up > 0.0, sd_m, 0.01)
    ground = GroundSurface("dense", -60.0, -60.0, SPACING_M, up, sd)
    return ground, np.stack([east, north, up], axis=-1)


@pytest.mark.parametrize("camera", [(-30.0, 0.0, 100.0), (15.0, -45.0, 60.0), (70.0, 70.0, 40.0)])
def test_a_box_hides_what_the_line_of_sight_over_its_edge_passes_above(camera: tuple[float, ...]) -> None:
    """Of places on the ground, the way to the camera passes through the box or it doesn't: cut with the four
    walls up to its top. Cameras before it, aside, and at its corner, from which nothing lies below them."""
    ground, places = box()
    found = hidden_m(ground, camera, places) > 0.0
    on_land = places[..., 2] == 0.0
    away = np.asarray(camera) - places
    up_share = TOP_M / away[..., 2]  # of the way to the camera, where it reaches the top's height
    enters, leaves = np.zeros(on_land.shape), up_share
    for axis, low, high in ((0, 10.0, 20.0), (1, -5.0, 5.0)):
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = [(end - places[..., axis]) / away[..., axis] for end in (low, high)]
        within = (places[..., axis] >= low) & (places[..., axis] <= high)
        still = away[..., axis] == 0.0
        enters = np.maximum(enters, np.where(still, np.where(within, 0.0, np.inf), np.minimum(*ends)))
        leaves = np.minimum(leaves, np.where(still, np.where(within, 1.0, -np.inf), np.maximum(*ends)))
    hidden = (enters < leaves) & on_land
    shadow_m2 = np.count_nonzero(hidden) * SPACING_M**2
    wrong = (found != hidden) & on_land
    rim = np.zeros_like(hidden)  # places within two nodes of the shadow's edge, and of the walls, which are
    either = hidden | ~on_land  # ramps between nodes, may go either way
    for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        for by in (1, 2):
            rim |= np.roll(hidden, (by * i, by * j), (0, 1)) != hidden
            rim |= np.roll(either, (by * i, by * j), (0, 1)) != either
    assert shadow_m2 > 20.0
    assert not (wrong & ~rim).any()
    assert wrong.sum() < 0.5 * rim.sum()


def test_depth_of_a_place_below_the_line_of_sight() -> None:
    """From 30 m west and 100 m up over the eastern edge at 20 m the line of sight falls by 1.76 m a metre."""
    ground, places = box()
    below = hidden_m(ground, (-30.0, 0.0, 100.0), places)
    row, cols = 240, [round((east + 60.0) / SPACING_M) for east in (22.0, 24.0, 26.0)]
    assert below[row, cols] == pytest.approx([8.48, 4.96, 1.44], abs=0.5)
    assert (below[row, :270] <= 0.0).all() and (below[row, 360:] <= 0.0).all()


def test_what_is_unsure_and_what_is_narrow_hides_nothing() -> None:
    ground, places = box(sd_m=TOP_M)
    assert (hidden_m(ground, (-30.0, 0.0, 100.0), places)[places[..., 2] == 0.0] <= 0.0).all()
    mast = np.zeros((201, 201))
    mast[100, 100:102] = 15.0
    east, north = np.meshgrid(*[SPACING_M * np.arange(201.0)] * 2)
    ground = GroundSurface("dense", 0.0, 0.0, SPACING_M, mast)
    below = hidden_m(ground, (0.0, 25.0, 80.0), np.stack([east, north, mast], axis=-1))
    assert (below[mast == 0.0] <= 0.0).all()


@pytest.mark.parametrize(
    ("low", "high", "shape"),
    [
        ((3.1, 0.6), (7.9, 2.2), (7, 10)),
        ((-9.0, 4.0), (0.2, 90.0), (6, 6)),
        ((50.0, -9.0), (60.0, -8.0), (1, 1)),
    ],
)
def test_the_part_of_a_ground_about_places_is_the_same_there(
    low: tuple[float, float], high: tuple[float, float], shape: tuple[int, int]
) -> None:
    """Two nodes more on every side, as far as there are some; and off the grid its nearest edge."""
    up = np.random.default_rng(3).random((9, 13))
    whole = GroundSurface("dense", -2.0, -1.0, 1.0, up, 0.1 * up)
    places = np.random.default_rng(4).uniform(low, high, (50, 2))
    places[:2] = low, high
    part = whole.about(places, 2)
    np.testing.assert_allclose(part.up_at(*places.T), whole.up_at(*places.T), atol=1e-12)
    np.testing.assert_allclose(part.sd_at(*places.T), whole.sd_at(*places.T), atol=1e-12)
    assert part.up_m.shape == shape


def test_what_lies_beyond_all_lines_of_sight_is_not_looked_at() -> None:
    """A wide ground costs a frame no more than what it sees, and no height out there moves a bit."""
    ground, places = box()
    near = places[200:360, 240:400]
    up = ground.up_m.copy()
    up[:150], up[:, 420:] = 500.0, -500.0
    far = GroundSurface("dense", ground.east_0_m, ground.north_0_m, SPACING_M, up)
    camera = (12.0, 8.0, 60.0)
    np.testing.assert_array_equal(hidden_m(far, camera, near), hidden_m(ground, camera, near))
