"""Ground without tie points: where it lies, how much of it, when it is worth a word."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from adjustment_blocks import Flown, fly

from geomosaic.adjustment.model import Adjusted
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.projection.footprint import ground_from_image
from geomosaic.quality.bare_ground import bare_ground, bare_outlines

LAKE_M = np.array([80.0, 65.0])


@pytest.fixture(scope="module")
def flown() -> Flown:
    return fly(1, 5, 8, points=25_000)


def with_lake(flown: Flown, radius_m: float) -> TiePoints:
    """The tie points that lie around a round lake."""
    out = []
    for t in flown.block.ties.pairs:
        at = ground_from_image(flown.truth[t.left], flown.block.cameras[0], flown.block.ground, t.left_px)
        dry = np.hypot(*(at[:, :2] - LAKE_M).T) > radius_m
        sides = (t.left_px, t.right_px, t.left_feature, t.right_feature)
        out.append(TiePair(t.left, t.right, *(side[dry] for side in sides)))
    return TiePoints(tuple(out))


def adjusted(flown: Flown) -> Adjusted:
    n = len(flown.block.names)
    nothing: Any = ()
    return Adjusted(
        flown.truth, flown.block.cameras, ("tied",) * n, nothing, nothing, ground=flown.block.ground
    )


def test_a_lake_is_found_where_it_is(flown: Flown) -> None:
    outlines = bare_outlines(adjusted(flown), with_lake(flown, 30.0))
    lake, found = shapely.Point(*LAKE_M).buffer(30.0), shapely.Polygon(outlines[0])
    assert lake.buffer(1.0).contains(found), "but for errors of placing, nothing off it"
    assert found.area > 0.4 * lake.area, "cells on its shore have tie points"
    assert sum(shapely.Polygon(o).area for o in outlines[1:]) < 0.02 * lake.area


def test_no_word_where_tie_points_are_everywhere(flown: Flown) -> None:
    all_tied = bare_ground(adjusted(flown), flown.block.ties)
    assert all_tied.share < 0.01 and not all_tied.matters
    assert bare_outlines(adjusted(flown), flown.block.ties) == []


def test_a_pond_in_one_piece_is_worth_a_word_below_the_share(flown: Flown) -> None:
    """No twentieth of what is seen, but more than a tenth of a frame in one piece."""
    pond, puddle = (bare_ground(adjusted(flown), with_lake(flown, r)) for r in (22.0, 12.0))
    assert pond.matters and not puddle.matters
    assert 0.0 < puddle.share < pond.share < 0.05
    assert pond.worst()[:2] == [19, 20], "the frames above it"
