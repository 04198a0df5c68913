"""Misalignment of pairs, errors of frames on the ground, trends along a line, and truth from a file."""

from __future__ import annotations

import numpy as np
import pytest

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.errors import FileError, UnknownNameError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.misalignment import FramesOverGround, frame_ground_errors, pair_misalignments, trend
from geomosaic.quality.positions import read_poses
from geomosaic.quality.scores import CCIR_500_1, CRITERIA

CAMERA = Camera("c", 1000, 800, 900.0, 500.0, 400.0)
FLAT = GroundSurface("flat", -1000.0, -1000.0, 2000.0, np.zeros((2, 2)))


def poses(positions, rotations):
    zeros = np.zeros((len(positions), 3))
    return Poses(np.array(positions, dtype=float), np.array(rotations), zeros, zeros)


def nadir(yaw_deg=0.0, pitch_deg=0.0):
    return Rotation.from_yaw_pitch_roll(np.radians(yaw_deg), np.radians(pitch_deg), 0.0).matrix


def test_pairs_have_their_mean_and_the_length_of_it():
    points = np.zeros((2, 2))
    numbers = np.zeros(2, dtype=np.int32)
    ties = TiePoints(tuple(TiePair(i, i + 1, points, points, numbers, numbers) for i in (0, 4)))
    found = pair_misalignments(ties, [np.array([[3.0, 4.0], [3.0, -4.0]]), np.empty((0, 2))])
    assert found.left.tolist() == [0, 4] and found.right.tolist() == [1, 5]
    assert found.points.tolist() == [2, 0]
    assert found.mean_m[0].tolist() == [3.0, 0.0] and found.length_m[0] == 3.0
    assert found.rms_m[0] == pytest.approx(5.0) and found.max_m[0] == pytest.approx(5.0)
    assert np.isnan(found.rms_m[1]) and np.isnan(found.mean_m[1]).all()
    none = pair_misalignments(TiePoints(()), [])
    assert none.mean_m.shape == (0, 2)


def test_a_frame_that_leans_forward_lands_ahead():
    truth = poses([[0, 0, 100], [10, 20, 100]], [nadir(), nadir(90.0)])
    tilted = poses([[0, 0, 100], [10.5, 20, 100]], [nadir(0.0, 1.0), nadir(90.0)])
    error = frame_ground_errors(
        FramesOverGround(tilted, [CAMERA] * 2, FLAT), FramesOverGround(truth, [CAMERA] * 2, FLAT)
    )
    np.testing.assert_allclose(error, [[0.0, 100 * np.tan(np.radians(1.0))], [0.5, 0.0]], atol=1e-6)


def test_tilt_and_position_may_cancel_on_the_ground():
    back = -100 * np.tan(np.radians(2.0))
    truth = poses([[0, 0, 100]], [nadir()])
    moved = FramesOverGround(poses([[0, back, 100]], [nadir(0, 2.0)]), [CAMERA], FLAT)
    error = frame_ground_errors(moved, FramesOverGround(truth, [CAMERA], FLAT))
    np.testing.assert_allclose(error, 0.0, atol=1e-6)


def test_a_trend_and_none():
    number = np.arange(30)
    noise = np.random.default_rng(5).normal(0.0, 0.1, 30)
    up = trend(number, 0.05 * number + 2.0 + noise)
    assert up.slope == pytest.approx(0.05, abs=3 * up.slope_sd) and up.grows
    assert up.slope_sd == pytest.approx(0.1 / np.sqrt(30 * (30**2 - 1) / 12), rel=0.3)
    assert not trend(number, noise).grows
    with_gap = np.where(number == 3, np.nan, 0.05 * number)
    assert trend(number, with_gap).slope == pytest.approx(0.05)
    assert np.isnan(trend([1, 2, 3], [1, 2, 3]).slope)


def test_a_walk_of_alike_neighbours_is_not_taken_for_a_trend_too_often():
    rng = np.random.default_rng(8)
    plain = naive = 0
    for _ in range(200):
        noise = rng.normal(size=40)
        walk = np.empty(40)
        walk[0] = noise[0]
        for i in range(1, 40):
            walk[i] = 0.7 * walk[i - 1] + noise[i]
        t = trend(np.arange(40), walk)
        plain += t.grows
        dx = np.arange(40) - 19.5
        left = walk - walk.mean() - t.slope * dx
        naive += abs(t.slope) > 2.0 * np.sqrt(left @ left / 38 / (dx @ dx))
    assert naive > 50 and plain < 35


def test_truth_from_positions_csv(tmp_path):
    path = tmp_path / "positions.csv"
    path.write_text(
        "frame,status,lon_deg,lat_deg,height_ellipsoidal_m,yaw_deg,pitch_deg,roll_deg\n"
        "b.jpg,tied,9.001,47.0,550,90,-88,0\n"
        "a.jpg,tied,9.0,47.0,500,0,-90,0\n"
    )
    found = read_poses(path, ["a.jpg", "b.jpg"], LocalFrame(9.0, 47.0, 400.0))
    np.testing.assert_allclose(found.positions_m[0], [0.0, 0.0, 100.0], atol=1e-6)
    assert found.positions_m[1, 0] == pytest.approx(76.06, abs=0.05)
    # facing east, the nose 2 degrees up: the view leans east
    view = -found.rotations[1][:, 2]
    np.testing.assert_allclose(view, [np.sin(np.radians(2)), 0, -np.cos(np.radians(2))], atol=3e-5)
    with pytest.raises(UnknownNameError, match=r"positions\.csv: unknown frame 'c\.jpg'"):
        read_poses(path, ["c.jpg"], LocalFrame(9.0, 47.0, 400.0))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"frame,lon_deg\na,1\n", "no column 'lat_deg'"),
        (b"frame,lon_deg,lat_deg,height_ellipsoidal_m,yaw_deg,pitch_deg,roll_deg\na,1,2,x,0,0,0\n", "line 2"),
        (b"\xff\xfe\x00\x01", "no column 'frame'"),
        (b"", "is empty"),
    ],
)
def test_bad_truth_files(tmp_path, content, says):
    path = tmp_path / "truth.csv"
    path.write_bytes(content)
    with pytest.raises(FileError, match=says):
        read_poses(path, ["a"], LocalFrame(9.0, 47.0, 400.0))


def test_the_table_of_scores():
    assert [level.score for level in CCIR_500_1] == [5, 4, 3, 2, 1]
    assert len({c.key for c in CRITERIA}) == len(CRITERIA) == 5
