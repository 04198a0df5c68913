"""Image errors that a frame's points share count in the stated accuracy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.solver.place_uncertainty import DesignEffect
from geomosaic.matching.tracks import Tracks
from tools.bench import bench_monte_carlo as bench
from tools.bench.cramer_rao import size_px

SMALL = replace(
    bench.CASES[0],
    plan=replace(bench.FRAMES, lines=3, frames_per_line=6, width_px=800, height_px=600),
    per_m2=0.2,
)
SEEDS = range(1, 5)
BREATHES_PX = 3.0
"""Radial, at the corner: each frame's lens differs by as much from all others."""


def breathing(block: Block, size: np.ndarray, seed: int, breathes_px: float) -> Block:
    """The block as lenses take it that each frame bends otherwise."""
    own = np.random.default_rng([seed, 77]).normal(0.0, breathes_px, len(block.names))

    def breathed(px: np.ndarray, frame: int) -> np.ndarray:
        out = (px - size / 2.0) / np.linalg.norm(size / 2.0)
        return px + own[frame] * out * (out**2).sum(axis=1, keepdims=True)

    pairs = tuple(
        replace(p, left_px=breathed(p.left_px, p.left), right_px=breathed(p.right_px, p.right))
        for p in block.ties.pairs
    )
    return replace(block, ties=replace(block.ties, pairs=pairs))


def design_effect(seed: int, breathes_px: float) -> float:
    drawn = bench.draw(SMALL, seed)
    block = breathing(drawn.block, size_px(drawn.camera), seed, breathes_px)
    return METHODS["bundle"](block, Settings(model="given")).figures["design_effect"]


def test_of_more_points_a_frame_more_have_their_error_in_common():
    """Of 11 in a frame, two have (3 - 1 - 1) / 10 in common, one deviation less: 41 count as 5."""
    tracks = Tracks(np.repeat(np.arange(3), 41), np.arange(123), np.zeros((123, 2)))
    assert DesignEffect(3.0, 1.0, 11.0).among(tracks) == pytest.approx(1.0 + 40 * 0.1)
    assert DesignEffect(1.5, 1.0, 11.0).among(tracks) == 1.0


def rtk_m(seed: int) -> tuple[float, float]:
    """RMSE in plan of frames reported to 2 cm, where lenses breathe by 1 px: solved, reported. Breathing draws a
    frame's height too, which its own images alone would show."""
    drawn = bench.draw(SMALL, seed)
    block = breathing(drawn.block, size_px(drawn.camera), seed, 1.0)
    true_m, rng = drawn.poses.positions_m, np.random.default_rng([seed, 78])
    reported_m = true_m + rng.normal(0.0, 0.02, true_m.shape)
    reported = replace(block.poses, positions_m=reported_m, positions_sd_m=np.full(true_m.shape, 0.02))
    solved_m = METHODS["bundle"](replace(block, poses=reported), Settings(model="given")).poses.positions_m
    solved, given = (float(np.sqrt(np.square(m - true_m)[:, :2].mean())) for m in (solved_m, reported_m))
    return solved, given


@pytest.mark.proof
def test_positions_are_not_outweighed_by_what_points_share():
    """With independent weights solved positions are twice as far off as those reported."""
    solved, reported = np.mean([rtk_m(seed) for seed in SEEDS], axis=0)
    assert solved < 1.4 * reported


@pytest.mark.proof
def test_independent_errors_have_none():
    assert np.median([design_effect(seed, 0.0) for seed in SEEDS]) < 1.5


@pytest.mark.proof
def test_what_the_points_of_a_frame_share_is_found():
    assert min(design_effect(seed, BREATHES_PX) for seed in SEEDS[:2]) > 3.0
