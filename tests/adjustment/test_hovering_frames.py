"""Frames that hover: their positions say nothing of headings."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly

from geomosaic.adjustment.procedure.reported_corrections import with_common_heading
from geomosaic.camera.rotation import about_z


@pytest.mark.parametrize(("scale", "by_positions"), [(1.0, True), (0.01, False)])
def test_headings_count_where_positions_show_no_turn(scale: float, by_positions: bool) -> None:
    """Initial poses by the images were turned by 83 degrees, for positions within a metre of each other."""
    block = fly(1).block
    middle_m = block.poses.positions_m.mean(axis=0)
    near_m = middle_m + [scale, scale, 1.0] * (block.poses.positions_m - middle_m)
    block = replace(block, poses=replace(block.poses, positions_m=near_m))
    turn = about_z(np.array([1.45]))[0]
    start = replace(
        block.poses,
        positions_m=middle_m + (near_m - middle_m) @ turn.T,
        rotations=turn @ block.poses.rotations,
    )
    corrected, begun, warnings = with_common_heading(block, start)
    assert [w.code for w in warnings] == ["headings-off"] * by_positions
    for poses, turned in ((corrected.poses, by_positions), (begun, by_positions)):
        expected = start.rotations if turned else block.poses.rotations
        np.testing.assert_allclose(poses.rotations, expected, atol=1e-9)
    np.testing.assert_allclose(begun.positions_m, start.positions_m if by_positions else near_m, atol=1e-9)
