"""Image errors that a frame's points share count in the stated accuracy."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

import bench_monte_carlo as bench
from cramer_rao import size_px

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings

SMALL = replace(
    bench.CASES[0],
    plan=replace(bench.FRAMES, lines=3, frames_per_line=6, width_px=800, height_px=600),
    per_m2=0.2,
)
SEEDS = range(1, 5)
BREATHES_PX = 3.0
"""Radial, at the corner: each frame's lens differs by as much from all others."""


def design_effect(seed: int, breathes_px: float) -> float:
    drawn = bench.draw(SMALL, seed)
    block, size = drawn.block, size_px(drawn.camera)
    own = np.random.default_rng([seed, 77]).normal(0.0, breathes_px, len(block.names))

    def breathed(px: np.ndarray, frame: int) -> np.ndarray:
        out = (px - size / 2.0) / np.linalg.norm(size / 2.0)
        return px + own[frame] * out * (out**2).sum(axis=1, keepdims=True)

    pairs = tuple(
        replace(p, left_px=breathed(p.left_px, p.left), right_px=breathed(p.right_px, p.right))
        for p in block.ties.pairs
    )
    block = replace(block, ties=replace(block.ties, pairs=pairs))
    return METHODS["bundle"](block, Settings(model="given")).figures["design_effect"]


def test_independent_errors_have_none():
    assert np.median([design_effect(seed, 0.0) for seed in SEEDS]) < 1.5


def test_what_the_points_of_a_frame_share_is_found():
    assert min(design_effect(seed, BREATHES_PX) for seed in SEEDS) > 3.0
