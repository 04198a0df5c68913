"""`joint` against the truth of simulated scenes: accuracy, clouds, low contrast, faults, honesty of what it states."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from geomosaic.ccd.expected import expected
from geomosaic.ccd.joint import far_from_nominal, joint
from geomosaic.ccd.lost_lines import LineStep, lasting
from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, CcdSettings
from geomosaic_simulate.strip_overlaps import simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan

SEPARATION = 2114
PLAN = StripPlan(width_px=512, lines=6000, ccds=4, seed=71)
THREE = replace(PLAN, ccds=3)
"""A pair to either side."""


@cache
def scene(plan):
    geometry, pairs = simulate_overlaps(plan)
    return geometry, tuple((pair.left, pair.right) for pair in pairs), tuple(pair.truth for pair in pairs)


def solved_anew(plan, window_lines=20000):
    geometry, simulated, _ = scene(plan)
    return joint(strips_in_memory(geometry, simulated), CcdSettings(), lambda done, of: None, window_lines)


solved = cache(solved_anew)


def errors(plan, offsets):
    """Of each pair: (n, 2) offsets less truth, (n, 2) deviations, labels, of the lines both strips have."""
    geometry, _, truths = scene(plan)
    out = []
    for found in offsets:
        truth = truths[found.pair]
        apart = geometry.side(found.pair) * geometry.row_separation_lines
        there = np.arange(len(truth.dcol_px)) + apart + truth.dline_px
        shared = (there >= 3) & (there < geometry.lines[found.pair + 1] - 3)
        off = np.stack([found.dcol_px - truth.dcol_px, found.dline_px - truth.dline_px], axis=1)
        sd = np.stack([found.sd_col_px, found.sd_line_px], axis=1)
        out.append((off[shared], sd[shared], found.label[shared]))
    return out


def rms(off):
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def pooled(plan, offsets=None):
    parts = errors(plan, offsets or solved(plan))
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def honest(off, sd):
    return float((np.abs(off) < 1.645 * sd).mean())


def test_clean_scene_to_hundredths_of_a_pixel():
    off, sd, label = pooled(PLAN)
    away = np.hypot(*off.T)
    assert rms(off) < 0.02
    assert np.quantile(away, 0.95) < 0.04 and away.max() < 0.25
    assert (label == MEASURED).mean() > 0.98
    assert 0.82 < honest(off, sd) < 0.97


def test_signs_and_sides():
    """Both strips' images of one ground, moved by hand: right = left + (dcol, side lag + dline)."""
    rng = np.random.default_rng(5)
    geometry = replace(PLAN.geometry(), lines=(4000, 4000, 4000, 4000), row_separation_lines=1000.0)
    fine = rng.normal(size=(6200, 160))
    ground = gaussian_filter(fine, 1.5) * 500 + 500
    edges, margin = [], 14
    for side in (1, -1, 1):
        # Left line i sees ground row 1100 + i; right line i + side 1000 + dline sees the same.
        dcol, dline = 3, -5
        left = ground[1100 : 1100 + 4000, 20:130]
        first = 1100 - side * 1000 - dline
        # A point in the left's overlap column c lies in the right's column c - margin + dcol.
        right = ground[
            np.clip(np.arange(first, first + 4000), 0, 6199), 20 + margin - dcol : 130 + margin - dcol
        ]
        edges.append(tuple(np.rint(x + rng.normal(0, 2, x.shape)).astype(np.uint16) for x in (left, right)))
    for found in joint(strips_in_memory(geometry, edges), CcdSettings(), lambda done, of: None):
        sure = found.label == MEASURED
        assert sure.sum() > 2500
        inside = np.flatnonzero(sure)[100:-100]
        assert np.abs(found.dcol_px[inside] - 3).max() < 0.1
        assert np.abs(found.dline_px[inside] + 5).max() < 0.1


def test_low_contrast():
    off, _, label = pooled(replace(THREE, low_contrast_share=0.4))
    assert rms(off) < 0.06
    assert np.hypot(*off[label == MEASURED].T).max() < 0.3


@pytest.mark.proof
@pytest.mark.parametrize(
    ("seed", "wind_m_per_s", "wind_deg", "height_m"),
    [
        (72, 15.0, 60.0, 3000.0),  # long gaps, in which own parts must go straight on
        (71, 49.0, 180.0, 8000.0),
        (77, 9.0, 20.0, 700.0),  # a pixel off the ground
    ],
)
def test_clouds_are_no_ground(seed, wind_m_per_s, wind_deg, height_m):
    plan = replace(
        PLAN,
        seed=seed,
        cloud_cover=0.4,
        wind_m_per_s=wind_m_per_s,
        wind_deg=wind_deg,
        cloud_height_m=height_m,
    )
    off, sd, label = pooled(plan)
    away = np.hypot(*off.T)
    assert rms(off) < 0.3
    assert 0.82 < honest(off, sd) < 0.98
    assert 0.3 < (label == MEASURED).mean() < 0.8
    assert away[label == MEASURED].max() < 1.0
    assert (away[label != UNRELIABLE] > 1.0).mean() < 0.01
    assert (label == BRIDGED).any()


@pytest.mark.proof
def test_stated_deviations_hold_where_lines_are_bridged():
    parts = [pooled(replace(THREE, cloud_cover=0.3, low_contrast_share=0.3, seed=seed)) for seed in (81, 82)]
    off, sd, label = (np.concatenate(part) for part in zip(*parts, strict=True))
    assert 0.82 < honest(off, sd) < 0.98
    bridged = label == BRIDGED
    assert honest(off[bridged], sd[bridged]) > 0.75
    assert sd[bridged].mean() > 1.5 * sd[label == MEASURED].mean()


def test_stated_deviations_hold_where_one_pair_stands_alone():
    off, sd, label = pooled(replace(PLAN, ccds=2))
    assert rms(off) < 0.02
    assert 0.85 < honest(off, sd) < 0.99
    assert (label == MEASURED).mean() > 0.98


@pytest.mark.proof
def test_clouds_alone_are_no_ground():
    plan = replace(
        PLAN, cloud_cover=0.99, cloud_height_m=4000.0, wind_m_per_s=20.0, wind_deg=100.0, lines=8192, seed=77
    )
    found = solved(plan)
    off, sd, label = pooled(plan, found)
    far = far_from_nominal(plan.geometry(), found)
    assert far is not None and far[1] < -10.0
    assert (label == UNRELIABLE).all()
    assert honest(off, sd) > 0.85
    assert far_from_nominal(PLAN.geometry(), solved(PLAN)) is None


@pytest.mark.proof
def test_low_clouds_as_dark_as_the_ground_are_not_called_measured():
    """3 px off the ground: which of the two layers is the ground can't be known."""
    plan = replace(
        PLAN,
        seed=36,
        brightness=0.75,
        cloud_cover=0.3,
        cloud_height_m=700.0,
        wind_m_per_s=12.0,
        wind_deg=70.0,
    )
    off, sd, label = pooled(plan)
    away = np.hypot(*off.T)
    assert (away > 1.0).mean() > 0.05
    assert away[label == MEASURED].max(initial=0.0) < 1.0
    assert (label == UNRELIABLE).mean() > 0.5
    assert honest(off, sd) > 0.85


@pytest.mark.proof
def test_bright_ground_is_ground():
    off, _, label = pooled(replace(PLAN, seed=32, brightness=0.15, saturated_share=0.3))
    assert rms(off) < 0.02
    assert (label == MEASURED).mean() > 0.95


@pytest.mark.proof
def test_another_camera():
    """5 m pixels, three CCDs, a quarter of TH-1's parallax: knots, clouds and relief by its own geometry."""
    plan = replace(
        PLAN,
        seed=35,
        ccds=3,
        ground_pixel_m=5.0,
        line_rate_hz=1400.0,
        row_separation_lines=700.0,
        parallax_m_per_line=830.0,
        cloud_cover=0.3,
        cloud_height_m=2000.0,
    )
    off, sd, label = pooled(plan)
    assert honest(off, sd) > 0.82
    assert np.hypot(*off[label == MEASURED].T).max(initial=0.0) < 1.0


def test_expected_pixels_are_the_cameras_own():
    likely = expected(PLAN.geometry())
    assert likely.knot_lines == 16  # 4.9 ms at 3272.4 Hz
    assert likely.clouds_px == pytest.approx([0.0, -3500.0 / 233.0])
    # Rows 0.646 s apart: wind of 19 m/s moves clouds by 6.1 px of 2 m.
    assert likely.clouds_sd_px == pytest.approx([6.2, 12.4], abs=0.05)
    half = expected(replace(PLAN.geometry(), line_rate_hz=6544.8, ground_pixel_m=1.0))
    assert half.knot_lines == 32
    assert half.clouds_px == pytest.approx(likely.clouds_px)
    assert half.steepest_px_per_line == pytest.approx(0.5 * likely.steepest_px_per_line)


def test_steps_that_come_and_go_are_no_lost_lines():
    away, back, lost = LineStep(0, 900, 3), LineStep(0, 1500, -3), LineStep(1, 2000, 2)
    shared = LineStep(0, 2010, 2)
    assert lasting([away, back, lost]) == [lost]
    assert lasting([away, lost, shared]) == [away, lost, shared]


def test_most_of_the_ground_hidden():
    plan = replace(THREE, cloud_cover=0.8, cloud_height_m=2500.0, wind_m_per_s=10.0, seed=78)
    off, sd, label = pooled(plan)
    assert honest(off, sd) > 0.8
    away = np.hypot(*off.T)
    assert away[label == MEASURED].max(initial=0.0) < 1.0


@pytest.mark.proof
def test_far_mounted_ccds_are_within_the_search():
    plan = StripPlan(seed=77, width_px=1024, lines=6000, mounting_px=4.0)
    assert max(np.abs(truth.dcol_px).max() for truth in scene(plan)[2]) > 13.0
    off, _, _ = pooled(plan)
    assert rms(off) < 0.03


def test_missing_ccd_and_shorter_strip():
    geometry, edges, _ = scene(PLAN)
    lines = (6000, 6000, 0, 5000)
    found = joint(
        strips_in_memory(replace(geometry, lines=lines), edges), CcdSettings(), lambda done, of: None
    )
    assert [part.pair for part in found] == [0]
    assert rms(errors(PLAN, found)[0][0]) < 0.03
    lines = (6000, 6000, 6000, 5000)
    cut = [*edges[:2], (edges[2][0], edges[2][1][:5000])]
    found = joint(strips_in_memory(replace(geometry, lines=lines), cut), CcdSettings(), lambda done, of: None)
    assert [len(part.label) for part in found] == [6000, 6000, 6000]
    assert (found[2].label[5000 - SEPARATION + 20 :] == UNRELIABLE).all()
    assert (found[2].label[: 5000 - SEPARATION - 40] == MEASURED).mean() > 0.95
    assert rms(errors(PLAN, found)[1][0]) < 0.03


@pytest.mark.parametrize(
    "fault",
    [
        pytest.param({"lost": "1:3200:5"}, marks=pytest.mark.proof),
        pytest.param({"repeated": "2:3500:7"}, marks=pytest.mark.proof),
        {"lost": "3:2800:1"},
    ],
)
def test_lost_and_repeated_lines(fault):
    plan = replace(THREE, **fault)
    for off, _, label in errors(plan, solved(plan)):
        assert np.hypot(*off[label == MEASURED].T).max() < 0.7
        assert rms(off[label != UNRELIABLE]) < 0.05
        assert (label == MEASURED).mean() > 0.95


def test_saturated_parts_and_nodata():
    plan = replace(THREE, saturated_share=0.2)
    geometry, edges, _ = scene(plan)
    edges = [(left.copy(), right.copy()) for left, right in edges]
    edges[1][0][2500:3300] = 0
    strips = strips_in_memory(replace(geometry, nodata=0.0), edges)
    found = joint(strips, CcdSettings(), lambda done, of: None)
    for off, _, label in errors(plan, found):
        assert np.hypot(*off[label == MEASURED].T).max() < 0.3
    assert (found[1].label[2550:3250] != MEASURED).all()


def test_heights_known_beforehand_are_given_back():
    geometry, edges, _ = scene(PLAN)
    strips = strips_in_memory(geometry, edges)
    bump = 9.0 * np.sin(np.arange(6000) / 700.0)
    strips.relief_px = {0: bump}
    with_relief = joint(strips, CcdSettings(), lambda done, of: None)
    off, _, label = errors(PLAN, with_relief)[0]
    # What was taken out wrongly is measured, and so put right.
    assert rms(off[label == MEASURED]) < 0.1


def test_windows_agree_with_one_piece():
    one, many = solved(PLAN), solved(PLAN, window_lines=2000)
    for whole, parts in zip(one, many, strict=True):
        both = (whole.label == MEASURED) & (parts.label == MEASURED)
        assert both.mean() > 0.6
        assert np.abs(whole.dcol_px - parts.dcol_px)[both].max() < 0.05
        assert np.abs(whole.dline_px - parts.dline_px)[both].max() < 0.05


def test_second_run_is_byte_identical():
    plan = replace(THREE, low_contrast_share=0.4)
    for first, second in zip(solved(plan), solved_anew(plan), strict=True):
        for name in ("dcol_px", "dline_px", "sd_col_px", "sd_line_px", "label"):
            assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_nothing_to_match():
    geometry = replace(PLAN.geometry(), lines=(2300,) * 4)
    empty = np.full((2300, 110), 300, dtype=np.uint16)
    for found in joint(
        strips_in_memory(geometry, [(empty, empty)] * 3), CcdSettings(), lambda done, of: None
    ):
        assert len(found.label) == 2300 and (found.label == UNRELIABLE).all()


def test_progress_may_stop_it():
    def stop(done, of):
        raise KeyboardInterrupt

    geometry, edges, _ = scene(PLAN)
    with pytest.raises(KeyboardInterrupt):
        joint(strips_in_memory(geometry, edges), CcdSettings(), stop)
