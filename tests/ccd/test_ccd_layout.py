"""Where strips' pixels lie in the scene: signs by absolute numbers, and simulated truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geomosaic.ccd.layout import ImageSpaceLayout, image_space_layout
from geomosaic.ccd.model import PairOffsets, StripOffsets
from geomosaic.errors import InputError
from geomosaic.survey.strips import Ccd, StripGeometry
from geomosaic_simulate.strip_files import target_rows
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import StripWorld


def scene_from_strip(layout: ImageSpaceLayout, ccd: int, col, line):
    """Scene col and scene line (2, n) of a strip's cols and lines (n,): the layout's lookup the other way."""
    first, last = layout.cols(ccd)
    overlap = layout.geometry.overlap_px
    x, t = col + first, line - layout._nominal(ccd)
    for _ in range(12):
        edges = layout._edges(ccd, t)
        share = np.clip((x - first - overlap) / (last - first - 2 * overlap), 0.0, 1.0)
        there = edges[..., 0] + share * (edges[..., 1] - edges[..., 0])
        x, t = col + first - there[0], t + line - there[1]
    return np.stack([x, t])


def geometry(ccds=3, lines=400, width=200, overlap=40, separation=100.0, first_row=1, dead=()):
    rows = [1 + (first_row - 1 + k) % 2 for k in range(ccds)]
    return StripGeometry(
        ccds=tuple(Ccd(None if k in dead else Path(f"{k}.tif"), row) for k, row in enumerate(rows)),
        width_px=width,
        lines=tuple(0 if k in dead else lines for k in range(ccds)),
        overlap_px=overlap,
        read_px=overlap + 10,
        row_separation_lines=separation,
        line_rate_hz=3000.0,
        bit_depth=10,
    )


def offsets(g, by_pair):
    pairs = []
    for k, (dcol, dline) in by_pair.items():
        n = np.zeros(g.lines[k])
        pairs.append(PairOffsets(k, n + dcol, n + dline, n + 0.1, n + 0.1, np.zeros(len(n), np.uint8)))
    return StripOffsets("given", tuple(pairs))


def image(layout, ccd, col, row):
    """Strip col and line at the middle of a raster row and at a raster col, bilinear between the knots."""
    places = layout.places(ccd, row, row + 1)
    return tuple(float(np.interp(col, places.knots_px, v[0])) for v in places.image_px)


def test_nominal_rows_are_lines_and_columns_are_columns():
    g = geometry()
    layout = image_space_layout(g, StripOffsets("none", ()))
    assert (layout.first_line, layout.width_px, layout.height_px) == (-50.0, 520, 500)
    assert layout.seams_px == (180.0, 340.0)
    assert [layout.cols(k) for k in range(3)] == [(0, 200), (160, 360), (320, 520)]
    assert image(layout, 0, 7.0, 130) == (7.0, 30.5)  # leading: line u at scene line u + 50
    assert image(layout, 1, 167.0, 130) == (7.0, 130.5)  # trailing: at u - 50
    common = image_space_layout(g, StripOffsets("none", ()), "common")
    assert (common.first_line, common.height_px) == (50.0, 300)


@pytest.mark.parametrize(("separation", "first"), [(101.0, -50.5), (100.4, -50.0), (101.6, -51.0)])
def test_first_line_is_a_whole_or_half_number(separation, first):
    layout = image_space_layout(geometry(separation=separation), StripOffsets("none", ()))
    assert layout.first_line == first


@pytest.mark.parametrize(("first_row", "side"), [(1, 1), (2, -1)])
def test_halves_signs(first_row, side):
    """dcol 3, dline 5: what the left strip has at (180, u) the right one has at (20 + 3, u + side 100 + 5)."""
    g = geometry(ccds=2, first_row=first_row)
    layout = image_space_layout(g, offsets(g, {0: (3.0, 5.0)}))
    # Left line 200.5 lies nominally at scene line 200.5 + side 50, right line 200.5 + side 100 + 5 five lower.
    row = 250 - layout.first_line if side == 1 else 150 - layout.first_line
    row = int(row + 3)  # middle at scene line 253.5 (153.5): left line 201.0, right line 306.0 (106.0)
    assert image(layout, 0, 180.0, row) == pytest.approx((178.5, 201.0))
    assert image(layout, 1, 180.0, row) == pytest.approx((21.5, 306.0 if side == 1 else 106.0))
    there = [
        scene_from_strip(layout, k, np.array([c]), np.array([u]))[:, 0]
        for k, c, u in ((0, 180.0, 200.5), (1, 23.0, 200.5 + side * 100.0 + 5.0))
    ]
    assert there[0] == pytest.approx([181.5, 200.5 + side * 50.0 + 2.5])
    assert there[1] == pytest.approx(there[0])


def test_within_a_strip_from_seam_to_seam_and_constant_in_the_overlaps():
    g = geometry()
    layout = image_space_layout(g, offsets(g, {0: (2.0, 4.0), 1: (-6.0, 8.0)}))
    row = 250
    # CCD 2 of 3 is the right one of pair 0 (+ half) and the left one of pair 1 (- half).
    nominal = image(image_space_layout(g, StripOffsets("none", ())), 1, 260.0, row)
    shift = row + layout.first_line - (row - 50.0)
    at = [image(layout, 1, c, row) for c in (160.0, 200.0, 260.0, 320.0, 360.0)]
    lines = [line - nominal[1] - shift for _, line in at]
    cols = [col - c + 160.0 for (col, _), c in zip(at, (160.0, 200.0, 260.0, 320.0, 360.0), strict=True)]
    assert lines == pytest.approx([2.0, 2.0, -1.0, -4.0, -4.0])
    assert cols == pytest.approx([1.0, 1.0, 2.0, 3.0, 3.0])
    # The outer CCDs keep their only seam's.
    assert image(layout, 0, 0.0, row)[0] == pytest.approx(-1.0)
    assert image(layout, 2, 520.0, row)[0] == pytest.approx(200.0 - 3.0)


def test_nothing_accumulates_over_eight_ccds():
    g = geometry(ccds=8)
    layout = image_space_layout(g, offsets(g, dict.fromkeys(range(7), (4.0, 6.0))))
    for k in range(8):
        got = scene_from_strip(layout, k, np.array([20.0, 180.0]), np.array([200.0, 200.0]))
        off = got - [[160.0 * k + 20.0, 160.0 * k + 180.0], [200.0 + (50.0 if k % 2 == 0 else -50.0)] * 2]
        assert np.abs(off).max() <= 3.0 + 1e-9  # half of an offset, however far right


def test_dead_ccd_leaves_a_gap_and_its_neighbours_to_their_other_seam():
    g = geometry(ccds=4, dead=(1,))
    layout = image_space_layout(g, offsets(g, {2: (2.0, 4.0)}))
    assert layout.seams_px == (180.0, 340.0, 500.0)
    assert layout.cols(0) == (0, 200)
    assert layout.cols(2) == (320, 520)
    row = 250
    assert image(layout, 0, 100.0, row) == (100.0, row + 0.5 + layout.first_line - 50.0)  # nominal
    for col in (320.0, 420.0, 520.0):
        got = image(layout, 2, col, row)
        assert got == pytest.approx((col - 320.0 - 1.0, row + 0.5 + layout.first_line - 50.0 - 2.0))


def test_lost_and_repeated_lines_stay_in_order():
    g = geometry(ccds=2)
    for step in (6.0, -6.0):
        dline = np.where(np.arange(400) < 200, 0.0, step)
        pair = PairOffsets(0, 0 * dline, dline, 0 * dline, 0 * dline, np.zeros(400, np.uint8))
        layout = image_space_layout(g, StripOffsets("given", (pair,)))
        for k in range(2):
            lines = layout.places(k, 0, layout.height_px).image_px[1, :, 0]
            assert (np.diff(lines) >= 0.0).all()
        left, right = (layout.places(k, 0, layout.height_px).image_px[1, :, 0] for k in range(2))
        off = right - left - 100.0
        assert off[[100, -100]] == pytest.approx([0.0, step])
        assert ((off >= min(step, 0.0) - 1e-9) & (off <= max(step, 0.0) + 1e-9)).all()


def test_no_lines_in_common():
    g = replace(geometry(ccds=2, lines=400), lines=(400, 90))
    with pytest.raises(InputError, match="no lines in common"):
        image_space_layout(g, StripOffsets("none", ()), "common")


@pytest.fixture(scope="module")
def world():
    plan = StripPlan(seed=5, lines=4200, targets=1500, drift_angle_deg=0.05, relief_m=300.0)
    scene = StripWorld(plan)
    g = plan.geometry()
    truth = [scene.truth(k) for k in g.pairs]
    n = np.zeros(plan.lines)
    pairs = tuple(PairOffsets(t.pair, t.dcol_px, t.dline_px, n, n, n.astype(np.uint8)) for t in truth)
    return scene, g, image_space_layout(g, StripOffsets("truth", pairs))


def test_true_offsets_bring_both_strips_together(world):
    _, g, layout = world
    for pair in layout.seams:
        assert np.abs(pair.right_line - pair.left_line).max() < 2114.0 + 20.0  # not vacuous
    for k in g.pairs:
        offs = layout.seams[k]
        seen = (offs.right_line > 0) & (offs.right_line < g.lines[k + 1])
        col = np.full(seen.sum(), g.width_px - g.overlap_px / 2.0)
        left = scene_from_strip(layout, k, col, offs.left_line[seen])
        right = scene_from_strip(
            layout, k + 1, np.full_like(col, g.overlap_px / 2.0) + offs.dcol_px[seen], offs.right_line[seen]
        )
        assert np.abs(left - right).max() < 0.02


def test_targets_seen_twice_land_on_one_place(world):
    """Points of the ground by the rigorous model, anywhere in the overlaps."""
    scene, _, layout = world
    seen = {}
    for target, *_, ccd, col, line in target_rows(scene):
        at = scene_from_strip(layout, int(ccd) - 1, np.array([float(col)]), np.array([float(line)]))
        seen.setdefault(target, []).append(at[:, 0])
    twice = np.array([places for places in seen.values() if len(places) == 2])
    assert len(twice) > 60
    apart = twice[:, 1] - twice[:, 0]
    assert np.abs(apart).max() < 0.02  # relief and yaw change a little across the overlap
