"""Headings that share an error do not turn or shrink a block whose positions are right."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, hills

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.camera.rotation import about_z, exp_turn


def _turned(block: Block, heading_error_deg: float) -> Block:
    """Headings count clockwise, rotations about up the other way."""
    rotations = about_z(-np.radians(heading_error_deg)) @ block.poses.rotations
    return replace(block, poses=replace(block.poses, rotations=rotations))


def _warned(adjusted: Adjusted) -> list[str]:
    return [w.text for w in adjusted.warnings if w.code == "headings-off"]


def _length_m(positions_m: np.ndarray) -> float:
    return float(np.linalg.norm(positions_m[-1, :2] - positions_m[0, :2]))


@pytest.mark.parametrize(("heading_error_deg", "words"), [(-52.0, "too small"), (70.0, "too large")])
def test_a_common_error_of_all_headings_is_corrected(heading_error_deg: float, words: str) -> None:
    """33 frames of a drone whose gimbal's zero was 52 degrees off made a block 28 % smaller."""
    flown = fly(5, 2, 6, points=300, there_and_back=True)
    adjusted = METHODS["bundle"](_turned(flown.block, heading_error_deg), Settings(model="given"))
    (text,) = _warned(adjusted)
    assert words in text
    assert float(re.findall(r"(\d+) degrees", text)[0]) == pytest.approx(abs(heading_error_deg), abs=3.0)
    assert _length_m(adjusted.poses.positions_m) == pytest.approx(
        _length_m(flown.truth.positions_m), rel=0.03
    )
    assert not [w for w in adjusted.warnings if w.code in ("yaw-wrong", "scale-doubtful")]


def test_headings_within_their_deviations_stay() -> None:
    flown = fly(5, 2, 6, points=300, there_and_back=True)
    assert not _warned(METHODS["bundle"](_turned(flown.block, 4.0), Settings(model="given")))


def test_one_wrong_heading_is_not_common() -> None:
    flown = fly(5, 2, 6, points=300, there_and_back=True)
    rotations = flown.block.poses.rotations.copy()
    rotations[4] = about_z(np.radians(90.0)) @ rotations[4]
    adjusted = METHODS["bundle"](
        replace(flown.block, poses=replace(flown.block.poses, rotations=rotations)), Settings(model="given")
    )
    assert not _warned(adjusted)
    assert [w.frame for w in adjusted.warnings if w.code == "yaw-wrong"] == [flown.block.names[4]]


def _off_m(block: Block, truth_m: np.ndarray) -> tuple[float, float]:
    """RMS of the errors in plan, found and stated."""
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    error_m = (adjusted.poses.positions_m - truth_m)[:, :2]
    stated_m = adjusted.poses.positions_sd_m[:, :2]
    return float(np.sqrt((error_m**2).mean())), float(np.sqrt((stated_m**2).mean()))


@pytest.mark.parametrize("heading_error_deg", [0.0, 7.0, -11.0])
def test_headings_that_agree_but_share_an_error_do_not_turn_the_block(heading_error_deg: float) -> None:
    """Stated to 3 degrees, they scatter by 0.3, as those of one compass do. By the scatter alone fifteen
    headings would be known to 0.1 degrees, and would turn the block off its positions."""
    flown = fly(3, 3, 5, points=400, relief=hills, there_and_back=True)
    scatter = exp_turn(flown.rng.normal(0.0, np.radians([0.3, 0.3, 0.3]), (15, 3)))
    sd_rad = np.tile(np.radians([1.0, 1.0, 3.0]), (15, 1))
    poses = replace(flown.block.poses, rotations=scatter @ flown.truth.rotations, rotations_sd_rad=sd_rad)
    block = _turned(replace(flown.block, poses=poses), heading_error_deg)
    found_m, stated_m = _off_m(block, flown.truth.positions_m)
    assert found_m < 1.8 * stated_m < 1.4


@pytest.mark.parametrize("crab_deg", [15.0, 60.0, 90.0, 180.0])
def test_cameras_may_look_anywhere_against_the_course(crab_deg: float) -> None:
    """Headings that nobody reported are taken from the course. A camera across or backwards in its mount made
    blocks of the same images up to 64 % too small."""
    flown = fly(3, 2, 4, points=400, relief=hills, there_and_back=True)
    sd_rad = np.tile(np.radians([10.0, 10.0, 20.0]), (8, 1))
    poses = replace(flown.block.poses, rotations=flown.truth.rotations, rotations_sd_rad=sd_rad)
    block = _turned(replace(flown.block, poses=poses), crab_deg)
    found_m, stated_m = _off_m(block, flown.truth.positions_m)
    assert found_m < 1.8 * stated_m < 2.0
    assert not _warned(METHODS["bundle"](block, Settings(model="given")))
