"""Strips of unequal brightness, with blank lines or dead columns, are matched as well as all others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from geomosaic.ccd.joint import joint
from geomosaic.ccd.model import MEASURED, CcdSettings
from geomosaic_simulate.strip_overlaps import simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan

Edges = list[list[np.ndarray]]


def brighter(edges: Edges, sides: list[int]) -> None:
    """One CCD takes half as much light again."""
    edges[0][sides[0]] = (1.5 * edges[0][sides[0]].astype(np.float64)).round().astype(np.uint16)


def blanked(edges: Edges, sides: list[int]) -> None:
    """300 lines of the leading strips are missing."""
    for pair, side in enumerate(sides):
        edges[pair][side][1000:1300] = 0


def stuck(edges: Edges, sides: list[int]) -> None:
    """A column of the first strip shows nothing."""
    edges[0][0][:, 60] = 0


@pytest.mark.parametrize(
    ("change", "column_sd", "share"), [(brighter, 0.005, 0.99), (blanked, 0.005, 0.85), (stuck, 0.02, 0.99)]
)
def test_what_is_uneven_is_no_cloud(
    change: Callable[[Edges, list[int]], None], column_sd: float, share: float
) -> None:
    """The brighter or the whole part of the scene passed for a cloud, and nearly no line was measured."""
    g, overlaps = simulate_overlaps(StripPlan(width_px=512, lines=4500, ccds=3, seed=71, column_sd=column_sd))
    edges = [[o.left.copy(), o.right.copy()] for o in overlaps]
    change(edges, [0 if g.side(k) > 0 else 1 for k in range(2)])
    g = replace(g, bit_depth=12, nodata=0.0)
    found = joint(strips_in_memory(g, [tuple(e) for e in edges]), CcdSettings(), lambda done, of: None)
    for of, overlap in zip(found, overlaps, strict=True):
        side = g.side(of.pair)
        there = np.arange(len(of.label)) + side * g.row_separation_lines + overlap.truth.dline_px
        shared = (there >= 3) & (there < g.lines[of.pair + 1] - 3)
        assert (of.label[shared] == MEASURED).mean() > share
        off_px = np.hypot(of.dcol_px - overlap.truth.dcol_px, of.dline_px - overlap.truth.dline_px)
        assert np.sqrt((off_px[shared] ** 2).mean()) < 0.05
