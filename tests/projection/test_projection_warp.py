"""The warp against the exact path, and against numbers worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.camera.exterior import Pose, Turns
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface, RaisedObject, flat_ground
from geomosaic.projection.lattice import MapLattice
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.warp import frame_from_map, ground_window

CRS = "EPSG:32632"
HOME = LocalFrame(9.7, 47.2, 430.0)
LENS = Camera("lens", 4000, 3000, 2400.0, 2013.7, 1488.2, -0.28, 0.09, -0.01, 0.0011, -0.0007)
PLAIN = Camera("plain", 800, 600, 1000.0, 400.0, 300.0)


def hills() -> GroundSurface:
    i, j = np.mgrid[0:61, 0:61]
    rough = np.random.default_rng(3).normal(0.0, 1.5, (61, 61))
    return GroundSurface("dem", -300.0, -300.0, 10.0, 25.0 * np.sin(i / 4.0) + 18.0 * np.cos(j / 5.0) + rough)


def exact(ground: GroundSurface, pose: Pose, camera: Camera, west: float, north: float, gsd: float, n: int):
    """The same by pyproj at every pixel and the fixed point run to its end."""
    axis = (np.arange(n) + 0.5) * gsd
    easting, northing = np.meshgrid(west + axis, north - axis)
    lonlat = MapProjection(CRS).geodetic_from_map(easting, northing)
    height = np.full(easting.shape, 430.0)
    for _ in range(8):
        enu = HOME.enu_from_geodetic(lonlat[..., 0], lonlat[..., 1], height)
        height += ground.up_at(enu[..., 0], enu[..., 1]) - enu[..., 2]
    enu = HOME.enu_from_geodetic(lonlat[..., 0], lonlat[..., 1], height)
    return pose.image_from_ground(camera, enu)


@pytest.mark.parametrize("ground", [flat_ground(HOME, 431.5, 600.0), hills()], ids=["flat", "dem"])
@pytest.mark.parametrize("tilt_deg", [0.0, 12.0, 35.0])
@pytest.mark.parametrize("lens", [LENS, replace(LENS, kind="fisheye", k3=0.001)], ids=["brown", "fisheye"])
def test_the_warp_is_the_exact_path_for_tilted_frames_with_distortion(ground, tilt_deg, lens):
    west, north = MapProjection(CRS).map_from_geodetic(9.7, 47.2) + np.array([-60.0, 70.0])
    pose = Pose(
        np.array([12.0, -31.0, 120.0]), Rotation.from_yaw_pitch_roll(0.6, np.radians(tilt_deg), -0.07)
    )
    window = ground_window(MapGrid(CRS, west, north, 0.5, 256, 256), HOME, ground)
    col, row = frame_from_map(window, pose, lens)
    want = exact(ground, pose, lens, west, north, 0.5, 256)
    inside = (want > 0.0).all(axis=-1) & (want < [4000.0, 3000.0]).all(axis=-1)
    assert inside.mean() > 0.3
    assert np.abs(col - want[..., 0])[inside].max() < 0.02
    assert np.abs(row - want[..., 1])[inside].max() < 0.02
    seen = np.isfinite(col) & (col > 0.0) & (col < 4000.0) & (row > 0.0) & (row < 3000.0)
    assert (seen == inside).mean() > 0.9995, "nothing folds back into the frame"


def test_a_part_of_the_window_is_the_same_part_of_the_whole():
    west, north = MapProjection(CRS).map_from_geodetic(9.7, 47.2)
    window = ground_window(MapGrid(CRS, west, north, 0.3, 200, 150), HOME, hills())
    pose = Pose(np.array([30.0, -20.0, 150.0]), Rotation.from_yaw_pitch_roll(2.0, 0.1, 0.2))
    col, row = frame_from_map(window, pose, LENS)
    part_col, part_row = frame_from_map(window, pose, LENS, slice(70, 149), slice(20, 95))
    np.testing.assert_array_equal(part_col, col[70:149, 20:95])
    np.testing.assert_array_equal(part_row, row[70:149, 20:95])


def test_corner_origin_by_hand():
    """A camera 100 m over the origin, f = 1000 px: 0.1 m on the ground is one pixel; top to the north.

    The window's upper left pixel is centred 3 m west and 2 m north of the nadir: col 400 - 30 = 370,
    row 300 - 20 = 280. On the central meridian UTM shrinks by 0.9996 and there is no convergence.
    """
    home = LocalFrame(9.0, 47.0, 0.0)
    ground = flat_ground(home, 0.0, 300.0)
    centre = MapProjection(CRS).map_from_geodetic(9.0, 47.0)
    scale = 0.9996
    west, north = centre + np.array([-3.05, 2.05]) * scale
    window = ground_window(MapGrid(CRS, west, north, 0.1 * scale, 64, 48), home, ground)
    pose = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    col, row = frame_from_map(window, pose, PLAIN)
    assert col[0, 0] == pytest.approx(370.0, abs=2e-3)
    assert row[0, 0] == pytest.approx(280.0, abs=2e-3)
    assert col[0, 10] == pytest.approx(380.0, abs=2e-3)
    assert row[5, 0] == pytest.approx(285.0, abs=2e-3)


def test_relief_displaces_away_from_the_nadir():
    """20 m high under a camera at 100 m, 30 m east of its nadir: 1000 * 30 / 80 = 375 px, not 300."""
    home = LocalFrame(9.0, 47.0, 0.0)
    table = GroundSurface("dem", -500.0, -500.0, 1000.0, np.full((2, 2), 20.0))
    centre = MapProjection(CRS).map_from_geodetic(9.0, 47.0)
    window = ground_window(
        MapGrid(CRS, centre[0] + 29.95 * 0.9996, centre[1] + 0.05, 0.1 * 0.9996, 4, 4), home, table
    )
    pose = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    col, row = frame_from_map(window, pose, PLAIN)
    assert col[0, 0] == pytest.approx(775.0, abs=0.01)
    assert row[0, 0] == pytest.approx(300.0, abs=0.01)


def test_an_object_on_flat_ground_is_displaced_and_all_else_stays_to_the_bit():
    """A box 20 m high, from 25 m to 35 m east of the nadir: at 30 m it is seen at 375 px, not 300."""
    home = LocalFrame(9.0, 47.0, 0.0)
    flat = flat_ground(home, 0.0, 500.0)
    assert not flat.has_relief
    box = RaisedObject(25.0, -5.0, 0.5, np.full((21, 21), 20.0, np.float32))
    raised = replace(flat, raised=(box,))
    assert raised.has_relief and raised.kind == "flat"
    west, north = MapProjection(CRS).map_from_geodetic(9.0, 47.0) + np.array([19.95, 0.05]) * 0.9996
    grid = MapGrid(CRS, west, north, 0.1 * 0.9996, 200, 16)
    pose, everything = (
        Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0)),
        slice(0, 200),
    )
    bare = frame_from_map(ground_window(grid, home, flat), pose, PLAIN)
    found = frame_from_map(ground_window(grid, home, raised), pose, PLAIN)
    lattice = MapLattice(grid, home, raised).seen(pose, PLAIN, slice(0, 16), everything)
    for col, row in (found, (lattice.cols, lattice.rows)):
        assert col[0, 100] == pytest.approx(775.0, abs=0.02)
        assert row[0, 100] == pytest.approx(300.0, abs=0.02)
    beyond = np.r_[0:46, 155:200]
    np.testing.assert_array_equal(found[0][:, beyond], bare[0][:, beyond])
    np.testing.assert_array_equal(found[1][:, beyond], bare[1][:, beyond])


def test_what_lies_behind_the_camera_is_not_seen():
    home = LocalFrame(9.0, 47.0, 0.0)
    west, north = MapProjection(CRS).map_from_geodetic(9.0, 47.0)
    window = ground_window(MapGrid(CRS, west, north, 10.0, 32, 32), home, flat_ground(home, 0.0, 500.0))
    upwards = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, np.pi, 0.0))
    col, row = frame_from_map(window, upwards, PLAIN)
    assert np.isnan(col).all() and np.isnan(row).all()


def test_far_from_the_origin_and_wide_windows_stay_exact():
    """A 10 m ground pixel, 10 km window, 40 km from the work frame's origin: bend of 125 m, convergence."""
    ground = flat_ground(HOME, 500.0, 60000.0)
    far = MapProjection(CRS).map_from_geodetic(10.2, 47.3)
    enu = HOME.enu_from_geodetic(10.2, 47.3, 9000.0)
    pose = Pose(
        enu,
        Rotation(HOME.enu_from_local_rotation(10.2, 47.3) @ Rotation.from_yaw_pitch_roll(1, 0.1, 0).matrix),
    )
    window = ground_window(MapGrid(CRS, far[0] - 5000, far[1] + 5000, 100.0, 100, 100), HOME, ground)
    col, row = frame_from_map(window, pose, PLAIN)
    want = exact(ground, pose, PLAIN, far[0] - 5000, far[1] + 5000, 100.0, 100)
    inside = (want > 0.0).all(axis=-1) & (want < [800.0, 600.0]).all(axis=-1)
    assert inside.sum() > 1000
    assert np.abs(col - want[..., 0])[inside].max() < 0.02
    assert np.abs(row - want[..., 1])[inside].max() < 0.02


def test_far_from_the_origin_hills_stand_along_their_own_vertical():
    """60 km east of the origin it leans by 9 mrad: 40 m of hill stand 0.4 m aside, on slopes of 30 degrees."""
    near, there = hills(), HOME.enu_from_geodetic(10.49, 47.2, 430.0)
    ground = GroundSurface("dem", there[0] - 300.0, there[1] - 300.0, 10.0, near.up_m + there[2])
    west, north = MapProjection(CRS).map_from_geodetic(10.49, 47.2) + np.array([-60.0, 70.0])
    points = ground_window(MapGrid(CRS, west, north, 0.5, 256, 256), HOME, ground).points_m()
    on_map = MapProjection(CRS).map_from_geodetic(*np.moveaxis(HOME.geodetic_from_enu(points), -1, 0)[:2])
    assert np.abs(on_map[..., 0] - west - (np.arange(256) + 0.5) * 0.5).max() < 0.02
    assert np.abs(north - on_map[..., 1] - (np.arange(256)[:, None] + 0.5) * 0.5).max() < 0.02
    assert np.abs(ground.up_at(points[..., 0], points[..., 1]) - points[..., 2]).max() < 0.05


def test_a_rolling_shutter_is_followed_row_by_row():
    """The frame is 100 m over the ground, 0.1 m a pixel. Flying 6 m to the east within a readout moves row
    150 (a quarter before the middle) by 1.5 m to the west. Its ground lies 15 px further to the right."""
    home = LocalFrame(9.0, 47.0, 0.0)
    ground = flat_ground(home, 0.0, 300.0)
    centre = MapProjection(CRS).map_from_geodetic(9.0, 47.0)
    scale = 0.9996
    window = ground_window(
        MapGrid(CRS, *(centre + [-3.05, 15.05] * np.array(scale)), 0.1 * scale, 64, 48), home, ground
    )
    rolling = replace(PLAIN, readout_s=0.5)
    level = Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0)
    pose = Pose(np.array([0.0, 0.0, 100.0]), level, np.array([12.0, 0.0, 0.0]))
    col, row = frame_from_map(window, pose, rolling)
    assert row[0, 0] == pytest.approx(150.0, abs=2e-3)
    assert col[0, 0] == pytest.approx(370.0 + 15.0, abs=2e-3)
    turned = Rotation.from_yaw_pitch_roll(0.4, 0.2, -0.1)
    tilted = Pose(np.array([2.0, -9.0, 110.0]), turned, np.array([12.0, -7.0, 3.0]))
    col, row = frame_from_map(window, tilted, rolling)
    want = exact_in(tilted, rolling, window)
    np.testing.assert_allclose(np.stack([col, row], axis=-1), want, atol=0.02)
    back = ground_from_image(tilted, rolling, ground, want)
    np.testing.assert_allclose(back, window.points_m(), atol=2e-3)


@pytest.mark.parametrize("faster", [1.0, 5.0])
def test_a_frame_that_shakes_while_it_is_read(faster):
    """Against the exact path, which is tested by itself: 0.3 rad/s and vibration of 20 Hz, and 1.5 rad/s."""
    home = LocalFrame(9.0, 47.0, 0.0)
    ground = flat_ground(home, 0.0, 300.0)
    centre = MapProjection(CRS).map_from_geodetic(9.0, 47.0)
    window = ground_window(MapGrid(CRS, *(centre + [-40.0, 30.0]), 0.3, 256, 200), home, ground)
    after_s = np.linspace(-0.06, 0.06, 31)[:, None]
    rad = faster * after_s * [0.3, -0.2, 0.5] + 0.002 * np.sin(2.0 * np.pi * 20.0 * after_s) * [
        1.0,
        0.5,
        -1.0,
    ]
    rotation = Rotation.from_yaw_pitch_roll(0.4, 0.1, -0.1)
    pose = Pose(np.array([2.0, -9.0, 110.0]), rotation, np.array([12.0, -7.0, 3.0]), Turns(0.12, rad))
    rolling = replace(PLAIN, readout_s=0.11)
    col, row = frame_from_map(window, pose, rolling)
    want = pose.image_from_ground(rolling, window.points_m())
    still = replace(pose, turns=None).image_from_ground(rolling, window.points_m())
    inside = (want > 0.0).all(axis=-1) & (want < [800.0, 600.0]).all(axis=-1)
    assert inside.mean() > 0.5
    assert np.abs(still - want)[inside].max() > 15.0
    assert np.abs(np.stack([col, row], axis=-1) - want)[inside].max() < 0.03
    back = ground_from_image(pose, rolling, ground, want[inside])
    np.testing.assert_allclose(back, window.points_m()[inside], atol=2e-3)


def exact_in(pose, camera, window):  # type: ignore[no-untyped-def]
    """Each point from where the camera is when its row is read: the root of one equation, by bisection."""
    points = window.points_m()
    low, high = np.full(points.shape[:2], -camera.readout_s), np.full(points.shape[:2], camera.readout_s)
    for _ in range(60):
        after = (low + high) / 2.0
        d = points - pose.position_m - after[..., None] * pose.velocity_m_per_s
        image = camera.image_from_camera(d @ pose.rotation.matrix)
        late = image[..., 1] / camera.height_px - 0.5 > after / camera.readout_s
        low, high = np.where(late, after, low), np.where(late, high, after)
    return image
