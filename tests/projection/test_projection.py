"""Rays to the ground and footprints."""

import numpy as np
import pytest

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.footprint import footprint, ground_from_image, ground_sampling_distance_m
from geomosaic.projection.ground import GroundSurface, flat_ground

PLAIN = Camera("plain", 800, 600, 1000.0, 400.0, 300.0)
LENS = Camera("lens", 4000, 3000, 3000.0, 2010.0, 1490.0, k1=-0.08, p1=0.001)
LEVEL = GroundSurface("flat", 0.0, 0.0, 1.0, np.full((1, 1), -20.0))


def test_corners_of_a_nadir_frame_by_hand() -> None:
    """120 m above the ground with f 1000 px: 800 x 600 px cover 96 x 72 m; heading east, the top
    left corner lies north-east."""
    pose = Pose(np.array([10.0, 20.0, 100.0]), Rotation.from_yaw_pitch_roll(np.pi / 2, 0.0, 0.0))
    corners = footprint(pose, PLAIN, LEVEL, per_side=1)
    assert corners[0] == pytest.approx([10 + 36, 20 + 48, -20.0], abs=1e-6)
    assert corners[2] == pytest.approx([10 - 36, 20 - 48, -20.0], abs=1e-6)
    assert ground_sampling_distance_m(pose, PLAIN, LEVEL) == pytest.approx(0.12, rel=1e-6)


def test_flat_ground_is_a_surface_of_one_ellipsoidal_height() -> None:
    work = LocalFrame(11.0, 48.0, 500.0)
    ground = flat_ground(work, 450.0, 3000.0)
    at = np.random.default_rng(1).uniform(-3000, 3000, (1000, 2))
    enu = np.column_stack([at, ground.up_at(*at.T)])
    assert work.geodetic_from_enu(enu)[:, 2] == pytest.approx(np.full(1000, 450.0), abs=1e-3)
    assert ground.up_at(3000.0, 0.0) == pytest.approx(-50.0 - 3000.0**2 / (2 * 6.388e6), abs=0.01)


def _hills() -> GroundSurface:
    axis = np.arange(-400.0, 401.0, 2.0)
    east, north = np.meshgrid(axis, axis)
    return GroundSurface("dem", -400.0, -400.0, 2.0, 25.0 * np.sin(east / 20.0) * np.cos(north / 33.0))


def test_points_on_hills_project_back_to_their_pixels() -> None:
    pose = Pose(np.array([30.0, -10.0, 260.0]), Rotation.from_yaw_pitch_roll(0.5, 0.1, -0.07))
    px = np.random.default_rng(2).uniform([0, 0], [4000, 3000], (3000, 2))
    ground = ground_from_image(pose, LENS, _hills(), px)
    assert ground[:, 2] == pytest.approx(_hills().up_at(ground[:, 0], ground[:, 1]), abs=1e-5)
    assert pose.image_from_ground(LENS, ground) == pytest.approx(px, abs=1e-5)


def test_the_first_of_two_crossings_counts() -> None:
    """A ray that comes in at 45 degrees meets the near side of a wall, not the ground behind it."""
    axis = np.arange(0.0, 101.0)
    wall = np.zeros((101, 101))
    wall[:, 50:53] = 30.0
    ground = GroundSurface("dem", 0.0, 0.0, 1.0, wall)
    hit = ground.intersect(np.array([0.0, 50.0, 60.0]), np.array([1.0, 0.0, -1.0]))
    assert hit[0] == pytest.approx(49.3, abs=0.3) and 10.0 < hit[2] < 30.0
    assert axis.size == 101


def test_rays_to_the_sky_miss() -> None:
    rays = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    hit = LEVEL.intersect(np.array([0.0, 0.0, 10.0]), rays)
    assert np.isnan(hit[:2]).all() and hit[2] == pytest.approx([0.0, 0.0, -20.0])
