"""How far the shape of a block may be off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, level

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.figures import best_similarity

FLAT = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
IMAGE_PX = np.array([[col, row] for col in (80.0, 400.0, 720.0) for row in (60.0, 300.0, 540.0)])


def solved(seed: int, readout_sd_s: float = 0.0) -> tuple[float, float]:
    """What is stated of the shape, and how far the images' places on level ground are off after the best
    similarity, both in pixels."""
    flown = fly(seed, 3, 5, points=250, relief=level)
    cameras = tuple(replace(c, readout_sd_s=readout_sd_s) for c in flown.block.cameras)
    adjusted = METHODS["bundle"](replace(flown.block, cameras=cameras), Settings(model="given"))
    true, found = (
        np.concatenate(
            [ground_from_image(poses[i], cameras[i], ground, IMAGE_PX)[:, :2] for i in range(len(cameras))]
        )
        for poses, cameras, ground in (
            (flown.truth, flown.block.cameras, FLAT),
            (adjusted.poses, adjusted.cameras, adjusted.ground),
        )
    )
    _, left = best_similarity(true, found - true)
    off_px = float(np.sqrt((left**2).sum(axis=1).mean())) / flown.block.ground_pixel_m
    return adjusted.figures["shape_sd_px"], off_px


def test_what_is_stated_of_the_shape_is_what_it_is_off() -> None:
    """The shape of one block is one draw of a few directions: of three together within a half."""
    stated, off = np.array([solved(seed) for seed in (21, 22, 23)]).T
    assert stated.max() < 0.3
    assert 0.67 < np.sqrt((off**2).mean()) / np.sqrt((stated**2).mean()) < 1.5


def test_rays_that_hardly_cut_leave_the_shape_as_sure_as_it_is() -> None:
    """One wrong match, a point far from all others, doubles the deviation of the whole block."""
    flown = fly(21, 3, 5, points=250, relief=level)
    first, *others = flown.block.ties.pairs
    both = np.array([[20.0, 20.0]]), np.array([[20.0, 30.0]])
    lost = replace(
        first,
        left_px=np.concatenate([first.left_px, both[0]]),
        right_px=np.concatenate([first.right_px, both[1]]),
        left_feature=np.append(first.left_feature, 90_001).astype(np.int32),
        right_feature=np.append(first.right_feature, 90_002).astype(np.int32),
    )
    free = Settings(model="given", ground="tie_surface")
    known = METHODS["bundle"](flown.block, free).figures["shape_sd_px"]
    block = replace(flown.block, ties=replace(flown.block.ties, pairs=(lost, *others)))
    assert METHODS["bundle"](block, free).figures["shape_sd_px"] == pytest.approx(known, rel=0.05)


def test_a_shutter_without_a_tag_counts_by_what_images_leave_open() -> None:
    """Lines that cross see a readout apart from all else: it stretches each along its own way."""
    flown = fly(24, 4, 6, points=900, relief=level, crossed=True)
    cameras = tuple(replace(c, readout_sd_s=0.04) for c in flown.block.cameras)
    unreported = METHODS["bundle"](replace(flown.block, cameras=cameras), Settings(model="given"))
    known = METHODS["bundle"](flown.block, Settings(model="given"))
    assert unreported.figures["shape_sd_px"] < 1.5 * known.figures["shape_sd_px"]


def test_a_shutter_without_a_tag_leaves_the_shape_open() -> None:
    """0.04 s at 15 m/s are 0.6 m over frames of 60 m: 1 % along the lines, unless positions say no."""
    known, off = solved(21)
    unreported, as_far_off = solved(21, 0.04)
    assert unreported > 2.0 * known
    assert as_far_off == pytest.approx(off, rel=1e-6)
