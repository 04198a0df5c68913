"""Rays against walls: a box by hand, walls narrower than a ray's samples are apart, and slopes."""

from __future__ import annotations

import numpy as np
import pytest

from geomosaic.projection.ground import GroundSurface

SPACING_M = 0.25


def walled(up: np.ndarray) -> GroundSurface:
    return GroundSurface("dense", -60.0, -60.0, SPACING_M, up)


def nodes() -> tuple[np.ndarray, np.ndarray]:
    axis = -60.0 + SPACING_M * np.arange(481)
    east, north = np.meshgrid(axis, axis)
    return east, north


def test_rays_meet_the_walls_and_the_roof_of_a_box() -> None:
    """Against the box's six planes; walls are ramps one node wide, outside of the box."""
    east, north = nodes()
    ground = walled(np.where((east >= 10.0) & (east <= 20.0) & (np.abs(north) <= 5.0), 12.0, 0.0))
    rng = np.random.default_rng(0)
    origin = np.column_stack([rng.uniform(-30.0, 40.0, (4000, 2)), np.full(4000, 40.0)])
    rays = np.column_stack([rng.uniform(-10.0, 40.0, 4000), rng.uniform(-20.0, 20.0, 4000), np.zeros(4000)])
    rays -= origin
    hit = ground.intersect(origin, rays)

    def shares(wider_m: float) -> np.ndarray:
        """Of the way to the ground, where each ray comes into the box and leaves it."""
        share = np.full((2, 4000), [[28.0 / 40.0], [1.0]])
        for axis, low, high in ((0, 10.0, 20.0), (1, -5.0, 5.0)):
            ends = (np.array([[low - wider_m], [high + wider_m]]) - origin[:, axis]) / rays[:, axis]
            share[0] = np.maximum(share[0], ends.min(axis=0))
            share[1] = np.minimum(share[1], ends.max(axis=0))
        return share

    share, about = shares(0.0), shares(SPACING_M)
    meets, grazes = share[0] < share[1], about[0] < about[1]
    true = origin + rays * np.where(meets, share[0], 1.0)[:, None]
    off_m = np.linalg.norm((hit - true)[:, :2], axis=1)
    assert 500 < meets.sum() < 3500
    assert off_m[~grazes].max() < 1e-9
    way = (40.0 - hit[:, 2]) / 40.0
    assert (way[meets] >= about[0, meets] - 1e-9).all() and (way[meets] <= share[0, meets] + 1e-9).all()
    assert off_m[meets & (share[0] == 28.0 / 40.0)].max() < 1e-9, "on the roof"


def test_no_wall_is_stepped_over() -> None:
    """A wall of one node, 6 m high, in land whose highest place is 500 m above: samples lie 10 m apart."""
    up = np.zeros((481, 481))
    up[:, 300] = 6.0
    up[0, 0] = 500.0
    origin = np.array([-59.0, 0.0, 530.0])
    for aim_m in (1.0, 3.0, 5.0):
        ray = np.array([15.0, 0.5, aim_m]) - origin
        hit = walled(up).intersect(origin, ray)
        assert hit == pytest.approx([15.0, 0.5, aim_m], abs=SPACING_M + 0.3 * 10.0)
        assert abs(hit[0] - 15.0) < SPACING_M, "it is met, not the land behind it"


def test_over_slopes_it_is_what_sampling_finds_and_beyond_the_grid_too() -> None:
    east, north = nodes()
    up = 3.0 * np.sin(east / 9.0) * np.cos(north / 7.0)
    rng = np.random.default_rng(1)
    rays = np.column_stack([rng.uniform(-1.2, 1.2, (3000, 2)), np.full(3000, -1.0)])
    origin = np.array([1.0, 2.0, 60.0])
    walked = walled(up).intersect(origin, rays)
    sampled = GroundSurface("dem", -60.0, -60.0, SPACING_M, up).intersect(origin, rays)
    assert walked == pytest.approx(sampled, abs=1e-4)
    assert (np.abs(walked[:, :2]).max(axis=1) > 60.0).sum() > 100
    assert np.isnan(walled(up).intersect(origin, np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]))).all()
    assert walled(up).intersect(origin, np.array([0.0, 0.0, -2.0])) == pytest.approx(
        [1.0, 2.0, float(walled(up).up_at(1.0, 2.0))], abs=1e-9
    )
