"""`joint` states what it does not know: lines without contrast, coarse knots, terraces of a DEM, narrow overlaps."""

from functools import cache

import numpy as np

from geomosaic.ccd.joint import joint
from geomosaic.ccd.model import UNRELIABLE, CcdSettings
from geomosaic_simulate.strip_overlaps import simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan

PLAN = StripPlan(width_px=512, lines=4500, ccds=3, seed=71)


@cache
def scene(plan):
    geometry, pairs = simulate_overlaps(plan)
    return geometry, tuple((pair.left, pair.right) for pair in pairs), tuple(pair.truth for pair in pairs)


def solved(strips, knot_lines=0):
    return joint(strips, CcdSettings(knot_lines=knot_lines), lambda done, of: None)


def test_terraces_of_a_dem_are_no_lost_lines():
    geometry, edges, _ = scene(PLAN)
    rise = (np.arange(PLAN.lines) // 300) % 2
    seen = np.clip(np.arange(PLAN.lines) - round(geometry.row_separation_lines), 0, None)
    left, right = edges[0]
    moved = right[np.clip(np.arange(PLAN.lines) - rise[seen], 0, None)]
    strips = strips_in_memory(geometry, [(left, moved), edges[1]])
    strips.relief_px = {0: rise.astype(np.float64)}
    found = solved(strips)[0]
    shared = slice(0, PLAN.lines - round(geometry.row_separation_lines) - 40)
    assert (found.label[shared] != UNRELIABLE).all()
    assert found.sd_line_px[shared].max() < 0.1
