"""What stages tell of a solve, of pairs and of strips: the figures are those of what they saw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from geomosaic.adjustment.model import ImageResiduals, Round, SolveStep
from geomosaic.ccd.gaps import gaps
from geomosaic.ccd.model import BRIDGED, MEASURED, UNRELIABLE, PairOffsets
from geomosaic.estimation.robust import share_down_weighted, student_weight
from geomosaic.matching.match import PairMatch
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.pipeline.context import Context
from geomosaic.pipeline.stage_recorder import StageRecorder
from geomosaic.quality.ranking import worst_pairs
from geomosaic.quality.solved_tables import pair_columns, tie_weights
from geomosaic.recording import Recorder, messages
from geomosaic.recording.file.chips import SIDE_PX, Cut, chip, cuts, shown
from geomosaic.recording.file.pair_kinds import Iteration
from geomosaic.stages.reporting import record_steps


def test_methods_that_slide_frames_tell_each_round_as_a_step(tmp_path: Path) -> None:
    rounds = (
        Round(np.array([[3.0, 4.0], [np.nan, np.nan]]), np.array([[1.0, 0.0], [0.0, -2.0]])),
        Round(np.array([[0.0, 0.5], [np.nan, np.nan]]), np.zeros((2, 2))),
    )
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.stage_started("adjustment.solve", 1, {}, {})
        context = Context(tmp_path / "run", stage_id="adjustment.solve", recorder=StageRecorder(recorder))
        record_steps(context, SimpleNamespace(steps=(), rounds=rounds), "error_sharing")
        step = SolveStep("all tie points", 9.0, 0.5, 1e-9, 0.25, 0.1)
        record_steps(context, SimpleNamespace(steps=(step,), rounds=rounds), "bundle")
    reported = [Iteration.FromString(d) for _, _, d in messages(tmp_path / "run.mcap", "geomosaic.Iteration")]
    assert [(i.solve, i.cost, i.cost_unit, i.step_m) for i in reported] == [
        ("error_sharing", 5.0, "m", 2.0), ("error_sharing", 0.5, "m", 0.0), ("all tie points", 9.0, "", 0.25),
    ]  # fmt: skip
    assert (reported[2].sigma_px, reported[2].damping, reported[2].share_down_weighted) == (0.5, 1e-9, 0.1)
    assert np.isnan(reported[0].sigma_px)


NUMBERS = np.arange(3, dtype=np.int32)
LEFT = np.array([[10.5, 20.25], [30.0, 40.0], [50.0, 60.0]])
TIES = TiePoints(
    (
        TiePair(0, 1, LEFT, LEFT + 5.0, NUMBERS, NUMBERS),
        TiePair(1, 2, LEFT[:1], LEFT[:1], NUMBERS[:1] + np.int32(7), NUMBERS[:1]),
    )
)


def test_a_tie_point_has_the_lesser_weight_of_both_sides_and_none_if_the_solve_did_not_see_it() -> None:
    image = ImageResiduals(
        np.array([1, 0, 0, 1]),
        np.array([LEFT[1] + 5.0, LEFT[0], LEFT[1], LEFT[0] + 5.0]),
        np.zeros((4, 2)),
        np.array([0.25, 1.0, 0.75, 0.5]),
    )
    first, second = tie_weights(TIES, image)
    assert np.array_equal(first, [0.5, 0.25, np.nan], equal_nan=True)
    assert np.isnan(second).all() and np.isnan(tie_weights(TIES, None)[0]).all()


def test_pairs_in_figures_and_the_worst_of_them() -> None:
    residuals = (np.array([[3.0, 4.0], [0.0, 0.0], [0.0, 0.0]]), np.array([[np.nan, np.nan]]))
    weights = (np.array([0.1, 1.0, np.nan]), np.array([np.nan]))
    found = pair_columns(TIES, residuals, weights)
    assert found["rms_m"][0] == pytest.approx(5.0 / np.sqrt(3.0)) and found["largest_m"][0] == 5.0
    assert found["median_m"][0] == 0.0 and found["mean_e_m"][0] == 1.0
    assert found["share_down_weighted"][0] == 0.5 and np.isnan(found["share_down_weighted"][1])
    assert worst_pairs(np.array([0.1, np.nan, 0.3, 0.2]), 3) == [2, 3, 0]


def test_the_share_that_counts_for_less_than_half() -> None:
    assert student_weight(np.array([3.0]))[0] < student_weight(np.zeros(1))[0] / 2.0
    assert share_down_weighted(np.array([0.0, 1.0, 3.0, np.inf])) == 0.5
    assert np.isnan(share_down_weighted(np.zeros(0)))


@pytest.mark.parametrize(
    ("seen", "why"),
    [
        (((5000, 3), 900, 800), "too few keypoints: 5000 and 3"),
        (((5000, 5000), 7, 7), "too few look alike: 7, 16 are needed"),
        (((5000, 5000), 40, 9), "too few agree: 9 of 40, 16 are needed"),
        (((5000, 5000), 40, 20), "too few agree: 20 of 40, 24 are needed"),
    ],
)
def test_why_a_pair_is_not_tied(seen: tuple[tuple[int, int], int, int], why: str) -> None:
    nothing = np.zeros(0, np.int32)
    assert PairMatch(nothing, nothing, False, *seen).why_not(16) == why
    assert PairMatch(NUMBERS, NUMBERS, False, *seen).why_not(3) == ""


def test_runs_of_lines_that_were_not_measured_and_why() -> None:
    label = np.array([UNRELIABLE] * 3 + [MEASURED] * 4 + [BRIDGED] * 2 + [MEASURED] + [BRIDGED] * 2, np.uint8)
    sd = np.array([9.0] * 3 + [0.1] * 4 + [0.2, 0.3] + [0.1] + [0.4, 2.0])
    zero = np.zeros(len(label))
    everywhere = np.ones(len(label), dtype=bool)
    first, second, third = gaps(PairOffsets(0, zero, zero, sd, zero, label), everywhere)
    assert (first.first_line, first.last_line, first.label, first.largest_sd_px) == (0, 2, UNRELIABLE, 9.0)
    assert (second.first_line, second.last_line) == (7, 8) and "no texture" in second.why
    assert third.last_line == 11 and third.why == (
        "carried over from the one side that was measured, its deviation grows to 2 px"
    )
    none = PairOffsets(0, zero, zero, sd, zero, np.full(len(label), UNRELIABLE, np.uint8))
    (whole,) = gaps(none, everywhere)
    assert whole.why == "nothing was measured on any line"
    assert not gaps(replace(none, label=np.full(len(label), MEASURED, np.uint8)), everywhere)


def test_lines_that_one_strip_alone_has_are_named_so() -> None:
    """They were said to show nothing alike for too long, next to others that do."""
    label = np.array([UNRELIABLE] * 5 + [MEASURED] * 4 + [UNRELIABLE] * 3, np.uint8)
    zero = np.zeros(len(label))
    found = gaps(PairOffsets(0, zero, zero, zero + 10.0, zero, label), np.arange(len(label)) >= 3)
    assert [(gap.first_line, gap.last_line) for gap in found] == [(0, 2), (3, 4), (9, 11)]
    assert found[0].why == "only one strip has this ground"
    assert (
        found[1].why
        == found[2].why
        == ("nothing seen alike in both strips for too long: may be off by 10 px")
    )


def test_a_chip_shows_the_worst_tie_points_and_lays_the_right_frame_like_the_left() -> None:
    rng = np.random.default_rng(3)
    left = rng.uniform(300.0, 1700.0, (200, 2))
    right = np.column_stack([2000.0 - left[:, 1], left[:, 0]])  # turned clockwise by a quarter
    residual = np.where(np.hypot(*(left - [1200.0, 900.0]).T)[:, None] < 150.0, [0.5, 0.0], [0.01, 0.0])
    where = cuts(left, right, residual)
    assert where[1].quarters == 1
    frames = [np.zeros((2000, 2000, 1), np.uint8) for _ in range(2)]
    for frame, px in zip(frames, (left, right), strict=True):
        for col, row in px.astype(int):
            frame[row - 2 : row + 3, col - 2 : col + 3] = 255
    halves = tuple(np.repeat(cut.pixels(f), 3, axis=2) for cut, f in zip(where, frames, strict=True))
    made = chip((halves[0], halves[1]), where, (left, right), residual, np.ones(200))
    bad = made.residual_m[:, 0] == 0.5
    assert bad.sum() > 0.8 * (residual[:, 0] == 0.5).sum() and len(made.weight) < 60
    np.testing.assert_allclose(made.right_xy - made.left_xy, [[SIDE_PX, 0]] * len(bad), atol=1.1)
    both = np.concatenate(halves, axis=1)
    for x, y in np.concatenate([made.left_xy, made.right_xy]).astype(int):
        assert both[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].max() == 255, "a tie point next to its mark"


def test_beyond_a_frames_edge_a_chip_is_black() -> None:
    part = Cut((-100, 900)).pixels(np.full((1000, 1000, 3), 7, np.uint8))
    assert part.shape == (SIDE_PX, SIDE_PX, 3)
    assert part[50, 150].tolist() == [7, 7, 7] and not part[:, :100].any() and not part[100:].any()


def test_a_chip_shows_eight_bits_as_they_are() -> None:
    colour = np.arange(4 * 5 * 4, dtype=np.uint8).reshape(4, 5, 4)
    np.testing.assert_array_equal(
        shown(colour), colour[..., [2, 1, 0]], "red, green, blue, and one more band"
    )
    np.testing.assert_array_equal(shown(colour[..., :1]), np.repeat(colour[..., :1], 3, axis=2))
    deep = shown(np.linspace(0, 60000, 400, dtype=np.uint16).reshape(20, 20, 1))
    assert deep.dtype == np.uint8 and deep.shape == (20, 20, 3) and deep[0, 0, 0] < 9 < 240 < deep[-1, -1, 0]
