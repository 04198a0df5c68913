"""Frames that look aside without anybody saying so, over flat land, which has two poses for each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly

from geomosaic.adjustment.model import Adjusted, Settings
from geomosaic.adjustment.procedure import bundle_method as solving
from geomosaic.camera.rotation import Rotation

ASIDE = {7: 50.0, 10: -48.0}


def flown_aside(seed: int) -> Flown:
    """Three lines of six; frames 7 and 10 look 50 degrees forward and back, and no attitude is known."""
    flown = fly(seed, aslant_deg=ASIDE, points=1600)
    poses = flown.block.poses
    down = Rotation.from_yaw_pitch_roll(*np.radians(np.tile([[0.0], [0.0], [0.0]], len(poses)))).matrix
    unknown = np.tile(np.radians([5.0, 5.0, 180.0]), (len(poses), 1))
    return replace(
        flown, block=replace(flown.block, poses=replace(poses, rotations=down, rotations_sd_rad=unknown))
    )


def off_m(flown: Flown, adjusted: Adjusted) -> np.ndarray:
    """How far each frame is from its place, without what all have in common."""
    off = adjusted.poses.positions_m - flown.truth.positions_m
    return np.linalg.norm((off - np.median(off, axis=0))[:, :2], axis=1)


@pytest.mark.proof
@pytest.mark.parametrize("seed", range(2))
def test_frames_that_look_aside_are_found(seed: int) -> None:
    flown = flown_aside(seed)
    adjusted = solving.pose_block(flown.block, Settings())
    assert off_m(flown, adjusted)[list(ASIDE)].max() < 1.0, "of 1.5 m that positions are off"
    tilt = np.degrees(np.arccos(adjusted.poses.rotations[:, 2, 2]))
    assert tilt[list(ASIDE)] == pytest.approx([50.0, 48.0], abs=4.0)
    assert not adjusted.warnings or "frame-contradicted" not in {w.code for w in adjusted.warnings}


@pytest.mark.proof
def test_what_stays_wrong_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the second look at least one ends at the pose that looks alike, and is named."""
    monkeypatch.setattr(solving, "resected", lambda *_: None)
    left_out = 0
    for seed in range(2):
        flown = flown_aside(seed)
        adjusted = solving.pose_block(flown.block, Settings())
        named = {w.frame for w in adjusted.warnings if w.code in ("frame-contradicted", "frame-oblique")}
        wrong = {flown.block.names[i] for i in np.flatnonzero(off_m(flown, adjusted) > 10.0)}
        assert wrong == named
        left_out += len(named)
    assert left_out
