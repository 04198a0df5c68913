"""Wrong matches that draw their points to a camera."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly, hills

from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.solver.single_points import clearances_m, too_near
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.matching.tracks import Tracks


def with_points_at_the_camera(flown: Flown, low: int, seer: int, off_px: tuple[float, ...]) -> Block:
    """The block with points that one camera sees where another one flies, but for so many px, and that one
    somewhere else."""
    rng, block = np.random.default_rng(0), flown.block
    pairs = {(t.left, t.right): t for t in block.ties.pairs}
    seen = [np.array([400.0, 300.0]) + rng.uniform(-200.0, 200.0, 2) for _ in off_px]
    camera = flown.truth[seer].image_from_ground(block.cameras[seer], flown.truth.positions_m[low])
    at_camera = [camera + rng.normal(0.0, off, 2) for off in off_px]
    number = (10_000 + np.arange(len(off_px))).astype(np.int32)
    pairs[low, seer] = TiePair(low, seer, np.array(seen), np.array(at_camera), number, number)
    return replace(block, ties=TiePoints(tuple(pairs.values())))


@pytest.mark.parametrize(
    ("noise_px", "off_px"),
    [
        (0.3, 0.02),
        pytest.param(0.02, 0.02, marks=pytest.mark.proof),
        pytest.param(0.02, 0.3, marks=pytest.mark.proof),
    ],
)
def test_a_wrong_match_by_the_image_of_another_camera_does_not_throw_that_off(
    noise_px: float, off_px: float
) -> None:
    """Without a clearance frame 7 came to lie 30 m off, or the equations had no solution there. Three points
    of one other frame do not determine a pose."""
    flown = fly(3, noise_px=noise_px, relief=hills, low_m={7: 30.0})
    adjusted = pose_block(with_points_at_the_camera(flown, 7, 8, (off_px,) * 3), Settings(model="given"))
    assert [w.frame for w in adjusted.warnings if w.code == "pose-not-determined"] == ["007.jpg"]
    assert adjusted.status[7] == "placed"
    assert "bundle-failed" not in {w.code for w in adjusted.warnings}
    off_m = np.linalg.norm(adjusted.poses.positions_m - flown.truth.positions_m, axis=1)
    assert off_m[7] < 3.0
    assert off_m.mean() < 1.0


def test_the_clearance_goes_by_each_frame_s_own_points() -> None:
    """Points 100 m and 40 m below two cameras, and one 3 m below the first: nearer than a twentieth."""
    tracks = Tracks(np.array([0, 1, 0, 1, 0, 1]), np.array([0, 0, 1, 1, 2, 2]), np.zeros((6, 2)))
    points = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [1.0, 0.0, 97.0]])
    cameras = np.array([[0.0, 0.0, 100.0], [0.0, 0.0, 40.0], [0.0, 0.0, 0.0]])
    clearance = clearances_m(tracks, cameras, points)
    assert clearance == pytest.approx([5.0, 2.0, 0.0], rel=0.01)
    assert too_near(tracks, clearance, cameras, points).tolist() == [2]
    assert too_near(tracks, clearance, cameras, points[[0, 1, 1]]).tolist() == []
