"""Images that were turned after the flight are read from the other end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly
from test_chosen_model import _bent_m

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.problem.usable_block import turned_poses
from geomosaic.camera.interior import Camera

LENS = Camera("rolling", 800, 600, 1000.0, 402.0, 297.0, k1=-0.02, readout_s=0.08, readout_sd_s=0.02)


def turned(block: Block, frames: list[int]) -> Block:
    """The block with images turned by 180 degrees in their files, and headings that nobody knows."""
    size = np.array([800.0, 600.0])
    pairs = tuple(
        replace(
            t,
            left_px=size - t.left_px if t.left in frames else t.left_px,
            right_px=size - t.right_px if t.right in frames else t.right_px,
        )
        for t in block.ties.pairs
    )
    poses = turned_poses(block.poses, [2 * int(i in frames) for i in range(len(block.names))])
    poses.rotations_sd_rad[:, 2] = np.pi
    return replace(block, poses=poses, ties=replace(block.ties, pairs=pairs))


def solved(block: Block) -> Adjusted:
    return METHODS["bundle"](block, Settings(model="given"))


def bent_m(flown: Flown, found: Adjusted) -> float:
    return _bent_m(found.poses.positions_m, flown.truth.positions_m)


@pytest.mark.proof
@pytest.mark.parametrize(("seed", "lines", "line"), [(3, 3, 2), (4, 3, 2), (5, 2, 0)])
def test_a_line_turned_in_its_files_is_turned_back(seed: int, lines: int, line: int) -> None:
    """Lines there and back; one looks as if it had been flown backwards. Of two it is that one too."""
    flown = fly(seed, lines, 15 // lines, there_and_back=True, lens=LENS)
    each = 15 // lines
    turned_ones = list(range(each * line, each * line + each))
    found = solved(turned(flown.block, turned_ones))
    named = [w.frame for w in found.warnings if w.code == "frame-turned"]
    assert named == [f"{i:03d}.jpg" for i in turned_ones]
    assert bent_m(flown, found) < 1.2 * bent_m(flown, solved(turned(flown.block, [])))
    quarters = [2 * int(i in turned_ones) for i in range(lines * each)]
    assert [round(c.readout_s, 2) for c in found.cameras] == [-0.08 if q else 0.08 for q in quarters]
    as_flown = turned_poses(found.poses, quarters).rotations @ np.swapaxes(flown.truth.rotations, 1, 2)
    assert np.degrees(np.arccos(as_flown[:, 2, 2])).max() < 1.0
    assert (np.trace(as_flown, axis1=1, axis2=2) > 2.99).all()


def test_a_line_that_was_flown_backwards_stays() -> None:
    """A platform that does not turn at the ends of lines: its second line is flown backwards."""
    back = np.where(np.arange(15) // 5 == 1, -30.0, 0.0)[:, None] * [0.0, 1.0, 0.0]
    flown = fly(5, 3, 5, unreported_m_per_s=back, lens=LENS)
    poses = replace(flown.block.poses, velocities_m_per_s=flown.truth.velocities_m_per_s)
    found = solved(turned(replace(flown.block, poses=poses), []))
    assert not [w for w in found.warnings if w.code == "frame-turned"]
    assert [round(c.readout_s, 2) for c in found.cameras] == [0.08] * 15
