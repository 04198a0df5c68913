"""Frames whose rays miss the ground, by the attitudes given for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.camera.rotation import about_x
from geomosaic.matching.model import TiePoints
from geomosaic.matching.tracks import join_tracks

UP = 120.0


def looking_up(block: Block, frames: list[int]) -> Block:
    """Frames that are given as turned to the sky."""
    rotations = block.poses.rotations.copy()
    rotations[frames] = rotations[frames] @ about_x(np.radians(UP))
    return replace(block, poses=replace(block.poses, rotations=rotations))


def test_a_track_begins_where_those_of_its_rays_meet_that_hit_the_ground() -> None:
    """By the true poses all rays of a point of level land meet there, whatever the ninth frame is given as."""
    flown = fly(3, 2, 6, points=300, noise_px=0.0)
    block = looking_up(replace(flown.block, poses=flown.truth), [8])
    tracks = join_tracks(block.ties)
    true_m = points_on_ground(flown.truth, block.cameras, block.ground, tracks)[0]
    points_m, kept = points_on_ground(block.poses, block.cameras, block.ground, tracks)
    assert kept.points == tracks.points == len(points_m) and (kept.frame == 8).sum() > 30
    assert points_m == pytest.approx(true_m, abs=1e-6)


def test_a_track_that_no_ray_puts_on_the_ground_is_dropped() -> None:
    flown = fly(3, 1, 3, points=200)
    block = looking_up(flown.block, [0, 1])
    tracks = join_tracks(TiePoints(tuple(t for t in block.ties.pairs if (t.left, t.right) == (0, 1))))
    points_m, kept = points_on_ground(block.poses, block.cameras, block.ground, tracks)
    assert tracks.points > 20 and len(points_m) == kept.points == len(kept.frame) == 0


def test_frames_without_any_observation_left_are_placed_and_not_tied() -> None:
    """The last two frames are tied to each other alone, and both are given as turned to the sky."""
    flown = fly(3, 2, 6, points=600)
    ties = tuple(t for t in flown.block.ties.pairs if t.right < 10 or t.left == 10)
    block = looking_up(replace(flown.block, ties=TiePoints(ties)), [10, 11])
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    assert adjusted.status == ("tied",) * 10 + ("placed",) * 2
    moved_m = np.linalg.norm(adjusted.poses.positions_m - block.poses.positions_m, axis=1)[10:]
    assert moved_m.max() < 3.0
    assert adjusted.pose_covariance is not None
    sd_m = np.sqrt(np.diagonal(adjusted.pose_covariance, axis1=1, axis2=2)[10:, :2])
    assert sd_m == pytest.approx(adjusted.poses.positions_sd_m[10:, :2], rel=0.01)
