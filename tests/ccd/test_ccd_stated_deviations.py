"""`joint` states what it does not know: lakes, first lines, coarse knots, terraces of a DEM, narrow overlaps."""

from functools import cache

import numpy as np
import pytest

from geomosaic.ccd.joint import joint
from geomosaic.ccd.model import MEASURED, UNRELIABLE, CcdSettings
from geomosaic_simulate.strip_overlaps import simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan

PLAN = StripPlan(width_px=512, lines=4500, ccds=3, seed=71)


@cache
def scene(plan):
    geometry, pairs = simulate_overlaps(plan)
    return geometry, tuple((pair.left, pair.right) for pair in pairs), tuple(pair.truth for pair in pairs)


def solved(strips, knot_lines=0):
    return joint(strips, CcdSettings(knot_lines=knot_lines), lambda done, of: None)


def errors(plan, found):
    """Offsets less truth (n, 2), deviations (n, 2) and labels (n,) of the lines that both strips have."""
    geometry, _, truths = scene(plan)
    parts = []
    for pair, truth in zip(found, truths, strict=True):
        there = np.arange(len(pair.label)) + geometry.side(pair.pair) * geometry.row_separation_lines
        shared = (there + truth.dline_px >= 3) & (there + truth.dline_px < plan.lines - 3)
        off = np.stack([pair.dcol_px - truth.dcol_px, pair.dline_px - truth.dline_px], axis=1)
        sd = np.stack([pair.sd_col_px, pair.sd_line_px], axis=1)
        parts.append((off[shared], sd[shared], pair.label[shared]))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def honest(off, sd):
    return float((np.abs(off) < 1.645 * sd).mean())


def test_what_curves_between_far_knots_miss_is_stated():
    geometry, edges, _ = scene(PLAN)
    off, sd, label = errors(PLAN, solved(strips_in_memory(geometry, edges), knot_lines=96))
    measured = label == MEASURED
    assert measured.mean() > 0.9
    assert honest(off[measured], sd[measured]) > 0.85
    assert np.sqrt((sd[measured] ** 2).mean()) < 2.0 * np.sqrt((off[measured] ** 2).mean())


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


def test_narrow_overlaps_are_searched_as_far_as_they_reach():
    plan = StripPlan(
        width_px=256,
        lines=2500,
        ccds=3,
        seed=71,
        overlap_px=24,
        read_px=32,
        row_separation_lines=700.0,
        parallax_m_per_line=704.0,
    )
    geometry, edges, _ = scene(plan)
    off, _, label = errors(plan, solved(strips_in_memory(geometry, edges)))
    assert (label == MEASURED).mean() > 0.95
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.05


def wide_pixels(folder, **more):
    """A camera of 5 m pixels whose motion at 9 Hz rises by a pixel within 64 lines."""
    time_s = np.arange(-2.0, 8.0, 0.0025)
    waves = ((0.7, 1.0, 0.4), (9.0, 0.25, 1.9), (38.0, 0.05, 2.8))
    along, across = (
        sum(share * px * np.sin(2.0 * np.pi * hz * time_s + at + turn) for hz, px, at in waves)
        for share, turn in ((1.0, 0.0), (0.6, 2.0))
    )
    path = folder / "jitter.csv"
    table = np.stack([time_s, along, across], axis=1)
    np.savetxt(path, table, fmt="%.6f", delimiter=",", header="time_s,along_px,across_px", comments="")
    return StripPlan(
        width_px=512,
        lines=4500,
        ccds=3,
        seed=702,
        overlap_px=64,
        read_px=80,
        first_row=2,
        bit_depth=12,
        ground_pixel_m=5.0,
        line_rate_hz=1400.0,
        row_separation_lines=700.0,
        parallax_m_per_line=830.0,
        drift_px_per_s=1.0,
        motion=path,
        **more,
    )


def test_steep_motion_is_no_lost_line(tmp_path):
    """Straight lines before and after a rise pass for a step, unless the curve explains it better."""
    plan = wide_pixels(tmp_path)
    geometry, edges, _ = scene(plan)
    off, _, label = errors(plan, solved(strips_in_memory(geometry, edges)))
    assert (label != UNRELIABLE).all()
    assert np.hypot(*off.T).max() < 0.15


def test_lines_without_contrast_are_not_called_measured(tmp_path):
    """Two images of noise are alike by chance, and the curve's prior alone is sure of some lines more."""
    plan = wide_pixels(tmp_path, low_contrast=1e-6, low_contrast_share=0.4)
    geometry, edges, _ = scene(plan)
    off, _, label = errors(plan, solved(strips_in_memory(geometry, edges)))
    assert 0.5 < (label == MEASURED).mean() < 0.7
    assert np.hypot(*off[label == MEASURED].T).max() < 0.6


def test_lines_before_the_first_knot_have_larger_deviations():
    """Line 0 is 7.5 of 16 lines before the first knot: a line through two knots is worth 1.54 of their sd."""
    geometry, edges, _ = scene(PLAN)
    leading = next(p for p in solved(strips_in_memory(geometry, edges)) if geometry.side(p.pair) > 0)
    assert leading.sd_col_px[0] / leading.sd_col_px[7:9].mean() == pytest.approx(1.54, abs=0.05)


def test_clouds_are_rather_the_brighter_part():
    """Wind carries clouds against what their height does, so that their place alone passes for the ground's."""
    plan = StripPlan(
        width_px=512,
        lines=6000,
        ccds=4,
        seed=412,
        cloud_cover=0.5,
        cloud_height_m=6446.0,
        wind_m_per_s=17.6,
        wind_deg=207.0,
    )
    geometry, edges, _ = scene(plan)
    off, _, label = errors(plan, solved(strips_in_memory(geometry, edges)))
    assert (label == MEASURED).mean() > 0.3
    assert np.hypot(*off[label == MEASURED].T).max() < 0.2
