"""Strips of unequal brightness, with blank lines or dead columns, are matched as well as all others."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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


def on_a_pedestal(edges: Edges, sides: list[int]) -> None:
    """The middle CCD has a dark level of 200."""
    edges[0][1] = edges[0][1] + np.uint16(200)
    edges[1][0] = edges[1][0] + np.uint16(200)


def quarter(edges: Edges, sides: list[int]) -> None:
    """The middle CCD has fewer TDI stages."""
    edges[0][1], edges[1][0] = (np.rint(0.25 * e).astype(np.uint16) for e in (edges[0][1], edges[1][0]))


def half(edges: Edges, sides: list[int]) -> None:
    """The middle CCD has half the gain."""
    edges[0][1], edges[1][0] = (np.rint(0.5 * e).astype(np.uint16) for e in (edges[0][1], edges[1][0]))


def solved(plan: StripPlan, change: Callable[[Edges, list[int]], None]) -> Iterator[tuple[float, float]]:
    """Of each pair: the share of measured lines and the root mean square error, of those both strips have."""
    g, overlaps = simulate_overlaps(plan)
    edges = [[o.left.copy(), o.right.copy()] for o in overlaps]
    change(edges, [0 if g.side(k) > 0 else 1 for k in range(2)])
    g = replace(g, bit_depth=12, nodata=0.0)
    found = joint(strips_in_memory(g, [tuple(e) for e in edges]), CcdSettings(), lambda done, of: None)
    for of, overlap in zip(found, overlaps, strict=True):
        side = g.side(of.pair)
        there = np.arange(len(of.label)) + side * g.row_separation_lines + overlap.truth.dline_px
        shared = (there >= 3) & (there < g.lines[of.pair + 1] - 3)
        off_px = np.hypot(of.dcol_px - overlap.truth.dcol_px, of.dline_px - overlap.truth.dline_px)
        yield float((of.label[shared] == MEASURED).mean()), float(np.sqrt((off_px[shared] ** 2).mean()))


@pytest.mark.parametrize(
    ("change", "column_sd", "share"), [(brighter, 0.005, 0.99), (blanked, 0.005, 0.85), (stuck, 0.02, 0.99)]
)
def test_what_is_uneven_is_no_cloud(
    change: Callable[[Edges, list[int]], None], column_sd: float, share: float
) -> None:
    """The brighter or the whole part of the scene passed for a cloud, and nearly no line was measured."""
    plan = StripPlan(width_px=512, lines=4500, ccds=3, seed=71, column_sd=column_sd)
    for measured, rms_px in solved(plan, change):
        assert measured > share
        assert rms_px < 0.05


@pytest.mark.parametrize("change", [on_a_pedestal, quarter])
def test_gain_and_dark_level_cost_no_accuracy(change: Callable[[Edges, list[int]], None]) -> None:
    """0.015 px as of equal strips. A gain by mean greys of 0.5 to 2 left 0.04 px."""
    for measured, rms_px in solved(
        StripPlan(width_px=512, lines=3600, ccds=3, seed=71, column_sd=0.005), change
    ):
        assert measured > 0.98
        assert rms_px < 0.02


def test_lines_lost_by_a_ccd_of_half_the_gain_are_found() -> None:
    """No line was measured. Lines within the step itself are off by its 5 lines."""
    plan = StripPlan(width_px=512, lines=3600, ccds=3, seed=71, column_sd=0.005, lost="2:2800:5")
    for measured, rms_px in solved(plan, half):
        assert measured > 0.95
        assert rms_px < 0.3
