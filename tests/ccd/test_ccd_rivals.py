"""The published chains on simulated scenes with known truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rasterio.env import get_gdal_config

from geomosaic.ccd.image_registration import image_registration, mean_offset
from geomosaic.ccd.methods import Method
from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, CcdSettings, PairOffsets, StripOffsets
from geomosaic.ccd.overlaps import StripFiles, Strips
from geomosaic.ccd.radiometry import radiometry
from geomosaic.ccd.sift_chains import (
    bridging_sd,
    consensus,
    matched_points,
    pieces,
    piecewise_linear,
    segments,
    steady,
    whole_scene,
)
from geomosaic.constants import varied
from geomosaic.survey.strips import read_geometry
from geomosaic_simulate.strip_overlaps import SimulatedPair, simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import simulate_strips

STILL = StripPlan(
    seed=3,
    ccds=3,
    lines=4600,
    jitter_1hz_px=0.0,
    jitter_5hz_px=0.0,
    jitter_22hz_px=0.0,
    drift_px_per_s=0.0,
    drift_angle_deg=0.12,
    thermal_px=0.0,
    relief_m=0.0,
    mounting_px=0.7,
)
MOVING = replace(STILL, jitter_1hz_px=0.8, drift_px_per_s=2.0, lines=6600, relief_m=200.0)


@cache
def simulated(plan: StripPlan) -> tuple[Strips, tuple[SimulatedPair, ...]]:
    geometry, pairs = simulate_overlaps(plan)
    return strips_in_memory(geometry, [(p.left, p.right) for p in pairs]), pairs


@cache
def found_by(method: Method, plan: StripPlan) -> tuple[PairOffsets, ...]:
    return method(simulated(plan)[0], CcdSettings(), silent)


def silent(done: int, total: int) -> None:
    assert 0 < done <= total


def shared(strips: Strips, pair: int) -> slice:
    """The left strip's lines whose ground both have, nominally."""
    g = strips.geometry
    lag = round(g.row_separation_lines)
    return slice(0, g.lines[pair + 1] - lag) if g.side(pair) > 0 else slice(lag, g.lines[pair])


def errors(strips: Strips, pairs: tuple[SimulatedPair, ...], found: PairOffsets) -> np.ndarray:
    """(2, n) found minus true over the shared lines."""
    truth, lines = pairs[found.pair].truth, shared(strips, found.pair)
    assert len(found.dcol_px) == len(found.sd_line_px) == len(found.label) == strips.lines(found.pair)
    return np.stack([found.dcol_px - truth.dcol_px, found.dline_px - truth.dline_px])[:, lines]


def rms(e: np.ndarray) -> float:
    return float(np.sqrt((e**2).sum(axis=0).mean()))


@pytest.mark.parametrize(
    ("method", "limit"),
    [
        pytest.param(whole_scene, 0.25, marks=pytest.mark.proof),
        (piecewise_linear, 0.08),
        (image_registration, 0.12),
        pytest.param(mean_offset, 0.25, marks=pytest.mark.proof),
    ],
)
def test_a_still_scene_is_found_with_the_signs_of_either_side(method, limit):
    """Drift angle and mounting alone: offsets of some pixels that no two pairs share. The left strip
    leads in the first pair, the right one in the second."""
    strips, pairs = simulated(STILL)
    assert [strips.geometry.side(k) for k in (0, 1)] == [1, -1]
    dcol = [float(p.truth.dcol_px.mean()) for p in pairs]
    assert np.sign(dcol[0]) == -np.sign(dcol[1]) == -1
    assert min(np.abs(dcol)) > 2.5 and max(abs(float(p.truth.dline_px.mean())) for p in pairs) > 0.5
    for found in found_by(method, STILL):
        assert rms(errors(strips, pairs, found)) < limit
        inside = shared(strips, found.pair)
        assert (found.label[inside] == MEASURED).mean() > 0.95
        outside = np.delete(found.label, np.arange(inside.start, inside.stop))
        assert outside.size and (outside == UNRELIABLE).all()


def test_a_fraction_of_a_line_in_the_row_separation_is_no_offset():
    """Rows 2100.4 lines apart: the strips are set against each other by whole lines, the offsets are not."""
    strips, pairs = simulated(replace(STILL, row_separation_lines=2100.4, lines=3200, ccds=2))
    for method in (whole_scene, piecewise_linear, image_registration, mean_offset):
        for found in method(strips, CcdSettings(), silent):
            assert abs(errors(strips, pairs, found)[1].mean()) < 0.12


@pytest.mark.proof
def test_segments_follow_a_motion_that_one_offset_cannot():
    strips, pairs = simulated(MOVING)
    old, mean, new, dense = (
        [rms(errors(strips, pairs, found)) for found in found_by(method, MOVING)]
        for method in (whole_scene, mean_offset, piecewise_linear, image_registration)
    )
    assert min(old) > 0.8 and min(mean) > 0.8
    assert max(new) < 0.35
    assert max(dense) < 0.1


@pytest.mark.proof
@pytest.mark.parametrize("method", [whole_scene, piecewise_linear, image_registration, mean_offset])
def test_stated_deviations_hold_the_errors(method):
    strips, pairs = simulated(MOVING)
    inside = []
    for found in found_by(method, MOVING):
        sd = np.stack([found.sd_col_px, found.sd_line_px])[:, shared(strips, found.pair)]
        inside.append(np.abs(errors(strips, pairs, found)) <= 1.645 * sd)
    assert np.concatenate(inside, axis=1).mean() > 0.8


def test_enhancement_finds_more_points_in_low_contrast_and_as_many_elsewhere():
    for contrast, least in ((0.012, 12), (0.12, 200)):
        strips, pairs = simulated(replace(STILL, contrast=contrast, lines=3400, ccds=2))
        overlap = strips.overlap(0, 200, 1224)
        plain, enhanced = (matched_points(overlap, strips.geometry, CcdSettings(), e) for e in (False, True))
        assert len(enhanced) >= least
        truth = pairs[0].truth
        shift, inside = consensus(enhanced.moved_px)
        assert np.abs(shift - [truth.dcol_px[700], truth.dline_px[700]]).max() < 0.5
        assert inside.sum() >= 0.5 * len(enhanced)
        if contrast < 0.1:
            assert len(enhanced) >= 3 * max(len(plain), 1)
        else:
            assert 0.7 < len(enhanced) / len(plain) < 1.6


@pytest.mark.proof
def test_low_contrast_segments_need_the_enhancement():
    strips, pairs = simulated(replace(STILL, contrast=0.012, lines=4200, ccds=2))
    with_it, without = (
        segments(strips, replace(CcdSettings(), enhance=enhance), silent)[0] for enhance in (True, False)
    )
    assert with_it.kept.sum() >= 3 > without.kept.sum()
    (found,) = piecewise_linear(strips, CcdSettings(), silent)
    assert rms(errors(strips, pairs, found)) < 0.5


def test_matched_points_are_given_in_the_strips_own_lines_and_read_columns():
    strips, pairs = simulated(STILL)
    overlap = strips.overlap(1, 2300, 2812)
    points = matched_points(overlap, strips.geometry, CcdSettings(), True)
    assert 2300 < points.left_px[:, 1].min() < 2400 and 2700 < points.left_px[:, 1].max() < 2812
    assert points.left_px[:, 0].min() > 0 and points.left_px[:, 0].max() < 110
    line = points.left_px[:, 1].astype(int)
    true = np.stack([pairs[1].truth.dcol_px[line], pairs[1].truth.dline_px[line]], axis=1)
    assert np.abs(np.median(points.moved_px - true, axis=0)).max() < 0.05


def test_abnormal_segments_are_not_kept():
    at = np.arange(10) * 512.0
    fast = np.stack([0.0 * at + 1.5, 1.9 * np.sin(at * 2 * np.pi / 2975 + 0.4)], axis=1)
    given = np.ones(10, dtype=bool)
    assert steady(at, fast, given).all()
    off = fast.copy()
    off[0, 0] += 3.0
    off[4, 1] += 5.0
    off[7, 0] -= 4.0
    given[9] = False
    assert np.flatnonzero(~steady(at, off, given)).tolist() == [0, 4, 7, 9]
    assert given.sum() == 9


def test_the_line_is_bridged_over_a_segment_without_texture():
    plan = replace(STILL, ccds=2, lines=5700)
    geometry, (pair,) = simulate_overlaps(plan)
    left = pair.left.copy()
    left[1024:2048] = 300
    strips = strips_in_memory(geometry, [(left, pair.right)])
    (found,) = piecewise_linear(strips, CcdSettings(), silent)
    assert (found.label[1100:2000] == BRIDGED).all() and (found.label[2700:3500] == MEASURED).all()
    assert rms(errors(strips, (pair,), found)) < 0.15
    short = replace(geometry, lines=(3200,) * 2)
    nothing = strips_in_memory(short, [(np.full_like(left[:3200], 300), pair.right[:3200])])
    for method in (whole_scene, piecewise_linear, image_registration):
        (none,) = method(nothing, CcdSettings(), silent)
        assert (none.label != MEASURED).all() and (none.sd_line_px >= 10.0).all()
        assert np.isfinite(none.dline_px).all()


def test_pieces_are_even_and_meet_the_lines_that_both_strips_have():
    nothing = np.zeros((MOVING.lines, MOVING.geometry().read_px), np.uint16)
    strips = strips_in_memory(MOVING.geometry(), [(nothing, nothing)] * 2)
    seen = {0: [], 1: []}
    for pair, first, stop, total in pieces(strips, 512):
        seen[pair].append((first, stop))
        assert total == 18
    # 6600 - 2114 = 4486 lines: eight of 512, and 390 more for the last
    assert seen[0][0] == (0, 512) and seen[0][-1] == (4096, 4486)
    assert seen[1][0] == (2114, 2626) and seen[1][-1] == (6210, 6600)
    assert len(seen[0]) == len(seen[1]) == 9


@pytest.mark.proof
def test_methods_hold_no_more_than_a_piece_of_the_strips():
    """However long the strips, none asks for more lines at once than a piece and its surroundings."""
    strips, _ = simulated(STILL)

    class Watched(Strips):
        most = 0

        def overlap(self, pair: int, start: int = 0, stop: int | None = None):
            assert stop is not None
            self.most = max(self.most, stop - start)
            return super().overlap(pair, start, stop)

    watched = Watched(strips.geometry, strips._columns)
    for method, most in ((whole_scene, 768), (piecewise_linear, 768), (image_registration, 1700)):
        watched.most = 0
        with varied("ccd.overlaps", PIECE_LINES=1024):
            method(watched, CcdSettings(), silent)
        assert 0 < watched.most <= most


def test_files_are_read_once_for_both_their_edges(tmp_path, monkeypatch):
    plan = replace(STILL, width_px=224, lines=3150)
    geometry = read_geometry(simulate_strips(tmp_path, plan, scene=False).geometry)
    read: list[tuple[int, int, int]] = []
    edges = StripFiles._edges

    def watched(self: StripFiles, ccd: int, start: int, stop: int):
        read.append((ccd, start, stop))
        return edges(self, ccd, start, stop)

    monkeypatch.setattr(StripFiles, "_edges", watched)
    truth = [p.truth for p in simulated(plan)[1]]
    for method, most in ((piecewise_linear, 1036), (image_registration, 1036 + 96)):
        read.clear()
        with StripFiles(geometry) as strips:
            assert get_gdal_config("GDAL_CACHEMAX") >= 1 << 20, "in bytes, or blocks are decoded twice"
            offsets = method(strips, CcdSettings(), silent)
        for found, true in zip(offsets, truth, strict=True):
            lines = shared(strips, found.pair)
            assert abs(np.median((found.dcol_px - true.dcol_px)[lines])) < 0.1
            assert abs(np.median((found.dline_px - true.dline_px)[lines])) < 0.1
        assert sum(stop - start for ccd, start, stop in read if ccd == 1) <= most
    read.clear()
    with StripFiles(geometry) as strips:
        found_gains = radiometry(strips, StripOffsets("image_registration", offsets), silent)
    assert len(found_gains.gain) == 3
    middle = [(start, stop) for ccd, start, stop in read if ccd == 1]
    assert len(middle) == len(set(middle))


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(whole_scene, marks=pytest.mark.proof),
        piecewise_linear,
        pytest.param(image_registration, marks=pytest.mark.proof),
    ],
)
def test_a_dead_ccd_and_a_short_strip_leave_the_others_alone(method):
    plan = replace(STILL, ccds=5, lines=3300, dead="2", short="5:3000")
    strips, pairs = simulated(plan)
    found = method(strips, CcdSettings(), silent)
    assert [f.pair for f in found] == [2, 3] == list(strips.pairs)
    for one in found:
        assert len(one.dcol_px) == 3300
        lines = shared(strips, one.pair)
        if one.pair == 3:  # trailing left, leading right
            lines = slice(2114, 3300)
        truth = pairs[one.pair].truth
        e = np.hypot(one.dcol_px - truth.dcol_px, one.dline_px - truth.dline_px)[lines]
        assert np.sqrt((e**2).mean()) < 0.3


def test_consensus_takes_the_shift_most_agree_on():
    rng = np.random.default_rng(5)
    moved = np.concatenate([rng.normal([3.2, -7.1], 0.2, (30, 2)), rng.uniform(-10, 10, (40, 2))])
    shift, inside = consensus(moved)
    assert np.abs(shift - [3.2, -7.1]).max() < 0.12
    assert 30 <= inside.sum() <= 34 and inside[:30].all()
    assert consensus(np.zeros((0, 2)))[1].shape == (0,)


def test_deviation_of_a_bridged_line_grows_with_the_way_to_the_next_value():
    at = np.concatenate([np.arange(10), np.arange(20, 30)]) * 512.0
    values = 0.01 * np.random.default_rng(2).standard_normal(20) + at / 2560.0
    t = np.array([5 * 512.0, 10.5 * 512.0, 14.5 * 512.0])
    near, off, far = bridging_sd(t, at, values, np.full(3, 0.05), 512.0)
    assert 0.05 <= near < 0.1 < off < far
    # 4.5 segments beyond reach at about 0.2 px a segment
    assert far == pytest.approx(0.9, abs=0.4)
