"""Gains and offsets of CCDs against those that the simulation gave them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from geomosaic.ccd.columns import column_gains
from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, PairOffsets, StripOffsets
from geomosaic.ccd.overlaps import Strips
from geomosaic.ccd.radiometry import Blocks, Radiometry, radiometry, straight_line
from geomosaic_simulate.strip_overlaps import SimulatedPair, simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_sensor import CcdSensor

PLAN = StripPlan(seed=4, ccds=4, lines=6600, gain_sd=0.05, offset_sd=0.01)


def silent(done: int, total: int) -> None:
    assert 0 < done <= total


@cache
def simulated(plan: StripPlan) -> tuple[Strips, StripOffsets, tuple[SimulatedPair, ...]]:
    geometry, pairs = simulate_overlaps(plan)
    strips = strips_in_memory(geometry, [(p.left, p.right) for p in pairs])
    return strips, true_offsets(strips, pairs), pairs


def true_offsets(strips: Strips, pairs: tuple[SimulatedPair, ...], labels: bool = True) -> StripOffsets:
    found = []
    for k in strips.pairs:
        truth = pairs[k].truth
        cloudy = (truth.cloud_left + truth.cloud_right > 0) & labels
        sd = np.full(len(cloudy), 0.05)
        label = np.where(cloudy, BRIDGED, MEASURED).astype(np.uint8)
        found.append(PairOffsets(k, truth.dcol_px, truth.dline_px, sd, sd, label))
    return StripOffsets("truth", tuple(found))


def ratio_errors(plan: StripPlan, found: Radiometry) -> np.ndarray:
    """Relative errors of the ratio between neighbours' gains (ccds - 1,)."""
    gain = np.array([CcdSensor.of(plan, k).gain for k in range(plan.ccds)])
    whole = found.gain * gain
    return whole[1:] / whole[:-1] - 1.0


def steps(plan: StripPlan, found: Radiometry, brightness: float = 0.35) -> np.ndarray:
    """Steps between neighbours after the correction, of the grey at a brightness (ccds - 1,)."""
    sensors = [CcdSensor.of(plan, k) for k in range(plan.ccds)]
    grey = brightness * CcdSensor.full_of(plan)
    counts = np.array([s.gain * grey + s.offset for s in sensors])
    return np.diff(found.gain * counts + found.offset) / grey


@pytest.mark.parametrize(
    "change",
    [
        {},
        pytest.param({"bit_depth": 8}, marks=pytest.mark.proof),
        pytest.param({"bit_depth": 12, "first_row": 2}, marks=pytest.mark.proof),
        pytest.param({"low_contrast_share": 0.4}, marks=pytest.mark.proof),
        {"column_sd": 0.01},
        {"saturated_share": 0.2},
    ],
    ids=str,
)
def test_gains_and_steps_are_those_of_the_sensors(change):
    plan = replace(PLAN, **change)
    strips, offsets, _ = simulated(plan)
    found = radiometry(strips, offsets, silent)
    before = np.abs(steps(plan, Radiometry(np.ones(4), np.zeros(4))))
    assert before.max() > 0.05
    pattern = 3.0 * plan.column_sd * (2.0 / plan.overlap_px) ** 0.5  # of the overlap's columns as a whole
    assert np.abs(ratio_errors(plan, found)).max() < max(0.004, pattern)
    assert np.abs(steps(plan, found)).max() < max(0.003, pattern)
    assert found.gain.mean() == pytest.approx(1.0, abs=1e-12)
    assert found.offset.mean() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("labels", [pytest.param(True, marks=pytest.mark.proof), False])
def test_moving_clouds_are_kept_out(labels):
    plan = replace(PLAN, cloud_cover=0.5, cloud_size_m=1500.0, seed=6)
    strips, _, pairs = simulated(plan)
    found = radiometry(strips, true_offsets(strips, pairs, labels), silent)
    assert np.abs(steps(plan, found)).max() < 0.003


def test_a_dead_ccd_parts_the_runs_and_has_no_correction_itself():
    plan = replace(PLAN, ccds=6, dead="3", lines=4600, relief_m=0.0)
    strips, offsets, _ = simulated(plan)
    found = radiometry(strips, offsets, silent)
    assert found.gain[2] == 1.0 and found.offset[2] == 0.0
    for run in (slice(0, 2), slice(3, 6)):
        assert found.gain[run].mean() == pytest.approx(1.0, abs=1e-12)
        assert found.offset[run].mean() == pytest.approx(0.0, abs=1e-9)
    assert np.abs(steps(plan, found)[[0, 3, 4]]).max() < 0.003


def test_a_dead_column_and_a_bright_one_do_not_count():
    strips, offsets, pairs = simulated(PLAN)
    edges = [(p.left.copy(), p.right.copy()) for p in pairs]
    edges[0][0][:, 40] = 3
    edges[0][1][:, 70] += 200
    spoilt = radiometry(strips_in_memory(strips.geometry, edges), offsets, silent)
    assert np.abs(steps(PLAN, spoilt)).max() < 0.003


def test_where_all_is_of_one_grey_the_ratio_of_means_is_the_gain():
    rng = np.random.default_rng(1)
    left = 400.0 + 0.1 * rng.standard_normal((200, 12))
    right = 380.0 + 0.1 * rng.standard_normal((200, 12))
    every = Blocks(left, right, np.ones(left.shape, dtype=bool), np.ones(200, dtype=bool))
    line = straight_line([every], 1023.0)
    assert line is not None
    assert line[0] == pytest.approx(0.95, abs=0.01)
    assert line[0] * 400.0 + line[1] == pytest.approx(380.0, abs=0.05)
    assert straight_line([], 1023.0) is None
    few = Blocks(left[:1], right[:1], np.ones((1, 12), dtype=bool), np.ones(1, dtype=bool))
    assert straight_line([few], 1023.0) is None


def test_the_slope_does_not_lean_with_noise_on_either_side():
    """Ordinary least squares would give 0.8 * 1.1 here: noise of half the signal's deviation."""
    rng = np.random.default_rng(2)
    signal = 300.0 + 30.0 * rng.standard_normal((3000, 12))
    columns = 1.0 + 0.03 * rng.standard_normal((2, 12))
    left = columns[0] * signal + 15.0 * rng.standard_normal(signal.shape)
    right = columns[1] * (1.1 * signal - 8.0) + 15.0 * rng.standard_normal(signal.shape)
    line = straight_line(
        [Blocks(left, right, np.ones(left.shape, dtype=bool), np.ones(3000, dtype=bool))], 1023.0
    )
    assert line is not None
    assert line[0] == pytest.approx(1.1 * columns[1].mean() / columns[0].mean(), abs=0.03)


def test_labels_leave_lines_out_unless_too_few_are_left():
    strips, offsets, pairs = simulated(PLAN)
    edges = [(p.left.copy(), p.right) for p in pairs]
    edges[1][0][2114:4300] = edges[1][0][2114:4300] * 0.8  # pair 1 sees lines from 2114 on
    label = offsets.pairs[1].label.copy()
    label[2114:4300] = BRIDGED
    reported = replace(
        offsets, pairs=(offsets.pairs[0], replace(offsets.pairs[1], label=label), offsets.pairs[2])
    )
    spoilt = strips_in_memory(strips.geometry, edges)
    assert np.abs(steps(PLAN, radiometry(spoilt, reported, silent))).max() < 0.003
    none = tuple(replace(p, label=np.full_like(p.label, BRIDGED)) for p in offsets.pairs)
    assert np.abs(steps(PLAN, radiometry(strips, replace(offsets, pairs=none), silent))).max() < 0.003


@pytest.mark.parametrize("noise", [0.0, 3.0])
@pytest.mark.parametrize("grey", [500, 90])
def test_a_ccd_stuck_at_one_grey_leaves_the_others_alone(grey, noise):
    """CCD 3 of 5 gives one grey, though labelled measured: it ends the runs as a dead one does."""
    plan = replace(PLAN, ccds=5)
    strips, offsets, pairs = simulated(plan)
    rng = np.random.default_rng(5)
    edges = [[p.left, p.right] for p in pairs]
    for pair, side in ((1, 1), (2, 0)):
        stuck = grey + noise * rng.standard_normal(edges[pair][side].shape)
        edges[pair][side] = np.rint(stuck).astype(np.uint16)
    found = radiometry(strips_in_memory(strips.geometry, [tuple(e) for e in edges]), offsets, silent)
    assert found.gain[2] == 1.0 and found.offset[2] == 0.0
    assert np.abs(steps(plan, found)[[0, 3]]).max() < 0.003
    for run in (slice(0, 2), slice(3, 5)):
        assert found.gain[run].mean() == pytest.approx(1.0, abs=1e-12)


def test_two_neighbours_stuck_have_no_ratio():
    strips, offsets, pairs = simulated(PLAN)
    edges = [(np.full_like(p.left, 500), np.full_like(p.right, 700)) for p in pairs]
    found = radiometry(strips_in_memory(strips.geometry, edges), offsets, silent)
    assert (found.gain == 1.0).all() and (found.offset == 0.0).all()


def test_where_no_offset_can_be_relied_on_no_gain_is_fitted():
    strips, offsets, _ = simulated(PLAN)
    lost = replace(offsets.pairs[1], label=np.full_like(offsets.pairs[1].label, UNRELIABLE))
    found = radiometry(strips, replace(offsets, pairs=(offsets.pairs[0], lost, offsets.pairs[2])), silent)
    assert np.abs(steps(PLAN, found)[[0, 2]]).max() < 0.003
    for run in (slice(0, 2), slice(2, 4)):
        assert found.gain[run].mean() == pytest.approx(1.0, abs=1e-12)
    # A few lines that are bridged are enough.
    label = lost.label.copy()
    label[3000:3400] = BRIDGED
    some = replace(offsets, pairs=(offsets.pairs[0], replace(lost, label=label), offsets.pairs[2]))
    assert np.abs(steps(PLAN, radiometry(strips, some, silent))).max() < 0.01


@pytest.mark.parametrize("overlap_px", [4, 7, 8, 20])
def test_an_overlap_of_a_few_columns_is_no_crash(overlap_px):
    strips, offsets, pairs = simulated(PLAN)
    geometry = replace(strips.geometry, overlap_px=overlap_px)
    margin = geometry.read_px - strips.geometry.overlap_px
    width = overlap_px + margin
    geometry = replace(geometry, read_px=width)
    edges = [(p.left[:, :width].copy(), p.right[:, :width].copy()) for p in pairs]
    found = radiometry(strips_in_memory(geometry, edges), offsets, silent)
    assert np.isfinite(found.gain).all()
    if overlap_px < 8:
        assert (found.gain == 1.0).all() and (found.offset == 0.0).all(), "no block fits"


def test_column_gains_are_read_off_over_the_ground():
    rng = np.random.default_rng(3)
    true = (1.0 + 0.02 * rng.standard_normal(110)).astype(np.float32)
    image = (400.0 + 40.0 * rng.standard_normal((1500, 1)) + np.zeros((1, 110))) * true
    valid = np.ones(image.shape, dtype=bool)
    valid[::3, 5] = False
    image[::3] = 7.0
    gains = column_gains(image.astype(np.float32), valid)
    assert np.corrcoef(gains, true)[0, 1] > 0.95
    assert (column_gains(image.astype(np.float32), np.zeros_like(valid)) == 1.0).all()


def test_long_strips_are_seen_in_few_pieces():
    """64 pieces of 512 lines and their surroundings are the most that is read of a pair."""
    lines = 200_000
    geometry = replace(
        simulated(PLAN)[0].geometry, ccds=simulated(PLAN)[0].geometry.ccds[:2], lines=(lines,) * 2
    )
    read = []

    def columns(ccd: int, edge: str, start: int, stop: int) -> np.ndarray:
        read.append(stop - start)
        rng = np.random.default_rng(start + (2114 if ccd == 0 else 0))
        grey = rng.uniform(300, 500, (stop - start, 1)) * (1.0 if ccd == 0 else 1.03)
        return np.rint(grey + np.zeros((1, 110))).astype(np.uint16)

    still, sd = np.zeros(lines), np.full(lines, 0.05)
    offsets = PairOffsets(0, still, still, sd, sd, np.full(lines, MEASURED, dtype=np.uint8))
    found = radiometry(Strips(geometry, columns), StripOffsets("truth", (offsets,)), silent)
    assert sum(read) <= 2 * 64 * (512 + 64)
    assert found.gain[0] / found.gain[1] == pytest.approx(1.03, abs=0.002)
