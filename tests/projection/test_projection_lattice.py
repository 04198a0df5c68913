"""The warp by every eighth pixel, against the equations at every pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_projection_warp import CRS, HOME, LENS, PLAIN, hills

from geomosaic.camera.exterior import Pose, Turns
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import GroundSurface, flat_ground
from geomosaic.projection.lattice import MapLattice
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.warp import frame_from_map, ground_window

ROTATION = Rotation.from_yaw_pitch_roll(0.6, 0.15, -0.07)
AFTER_S = np.linspace(-0.06, 0.06, 31)[:, None]
SHAKEN = AFTER_S * [0.3, -0.2, 0.5] + 0.002 * np.sin(2.0 * np.pi * 20.0 * AFTER_S) * [1.0, 0.5, -1.0]
STEEP = GroundSurface(
    "dem", -300.0, -300.0, 1.0, 430.0 + 9.0 * (np.random.default_rng(4).random((601, 601)) > 0.8)
)


@pytest.mark.parametrize(
    "ground", [flat_ground(HOME, 431.5, 600.0), hills(), STEEP], ids=["flat", "hills", "houses"]
)
@pytest.mark.parametrize("shakes", [False, True], ids=["still", "rolling"])
@pytest.mark.parametrize("camera", [LENS, PLAIN], ids=["bent", "plain"])
def test_the_lattice_is_as_good_as_every_pixel(ground, shakes, camera):
    """Where it isn't, the cell is exact: a DEM of houses, and knots of a table of turns."""
    west, north = MapProjection(CRS).map_from_geodetic(9.7, 47.2) + np.array([-40.0, 45.0])
    pose = Pose(np.array([12.0, -31.0, 530.0]), ROTATION, np.array([12.0, -7.0, 3.0]))
    if shakes:
        pose, camera = replace(pose, turns=Turns(0.12, SHAKEN)), replace(camera, readout_s=0.11)
    size = MapGrid(CRS, west, north, 0.25, 253, 301), HOME, ground
    rows, cols = slice(16, 301), slice(8, 240)
    want = frame_from_map(ground_window(*size), pose, camera, rows, cols)
    seen = MapLattice(*size).seen(pose, camera, rows, cols)
    inside = (want[0] > 0.0) & (want[0] < camera.width_px) & (want[1] > 0.0) & (want[1] < camera.height_px)
    assert inside.mean() > 0.3
    off = np.hypot(seen.cols - want[0], seen.rows - want[1])
    assert np.quantile(off[inside], 0.999) < 0.015
    assert off[inside].max() < 0.1
    there = (seen.cols > 0.0) & (seen.cols < camera.width_px)
    there &= (seen.rows > 0.0) & (seen.rows < camera.height_px)
    assert (there == inside).mean() > 0.9995


@pytest.mark.parametrize("gsd_m", [25.0, 200.0])
@pytest.mark.parametrize("camera", [LENS, PLAIN], ids=["bent", "plain"])
def test_frames_of_few_pixels_are_seen(gsd_m, camera):
    """At 25 m frames are 17 and 35 pixels wide, at 200 m 2 and 4: most nodes are NaN, and some times all."""
    pose, lost = Pose(np.array([12.0, -31.0, 530.0]), ROTATION), []
    for k in range(12):
        at_px = np.array([-11.3 - 0.4 * k, 10.4 + 0.7 * k])
        west, north = MapProjection(CRS).map_from_geodetic(9.7, 47.2) + at_px * gsd_m
        size = MapGrid(CRS, west, north, gsd_m, 24, 22), HOME, hills()
        seen = MapLattice(*size).seen(pose, camera, slice(0, 22), slice(0, 24))
        inside, there = (
            (cols > 0.0) & (cols < camera.width_px) & (rows > 0.0) & (rows < camera.height_px)
            for cols, rows in (frame_from_map(ground_window(*size), pose, camera), (seen.cols, seen.rows))
        )
        assert inside.any()
        lost.append(int((inside != there).sum()))
    assert lost == [0] * 12


def test_parts_of_a_window_are_what_the_whole_is():
    west, north = MapProjection(CRS).map_from_geodetic(9.7, 47.2) + np.array([-40.0, 45.0])
    lattice = MapLattice(MapGrid(CRS, west, north, 0.25, 250, 130), HOME, hills())
    pose = Pose(np.array([12.0, -31.0, 530.0]), ROTATION)
    whole = lattice.seen(pose, LENS, slice(0, 130), slice(0, 250))
    part = lattice.seen(pose, LENS, slice(32, 130), slice(64, 176))
    np.testing.assert_array_equal(part.cols, whole.cols[32:, 64:176])
    np.testing.assert_array_equal(part.between(part.node_rows[..., None])[..., 0].shape, (98, 112))
    np.testing.assert_allclose(part.between(part.node_rows[..., None])[..., 0], part.rows, atol=0.2)
