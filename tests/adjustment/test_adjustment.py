"""The paper's method and its rivals on nets whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.paper import offsets
from geomosaic.adjustment.paper.misalignment import OffsetNet, fullest_bin_mean
from geomosaic.adjustment.paper.offsets import chain, least_squares
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.estimation.similarity import fit_similarity
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface


def net_of(errors_m: np.ndarray, pairs: list[tuple[int, int]], spacing_m: float = 50.0) -> OffsetNet:
    """Frames in a line, misplaced by errors_m (n, 2), tied by 40 exact points a pair."""
    rng = np.random.default_rng(5)
    plan_m = []
    for a, b in pairs:
        truth = rng.uniform(-10, 10, (40, 2)) + [spacing_m * (a + b) / 2, 0.0]
        plan_m += [truth + errors_m[a], truth + errors_m[b]]
    ends = np.arange(80 * len(pairs), dtype=np.int32).reshape(-1, 2, 40)
    return OffsetNet(len(errors_m), np.array(pairs, dtype=np.intp), np.concatenate(plan_m), tuple(ends), 0.1)


def line(n: int) -> list[tuple[int, int]]:
    return [(i, i + 1) for i in range(n - 1)]


def test_fullest_bin_by_hand() -> None:
    """East: three of 2.x px, mean 2.4; north: two of -0.x (floor -1), mean -0.5, against single others."""
    d = np.array([[2.1, -0.4], [2.9, -0.6], [2.2, 7.0], [9.5, 3.3]])
    assert fullest_bin_mean(d) == pytest.approx([2.4, -0.5])
    assert fullest_bin_mean(d * 0.1, step=0.1) == pytest.approx([0.24, -0.05])


@given(st.integers(-3000, 3000), st.integers(-3000, 3000))
def test_fullest_bin_finds_the_offset_among_wrong_matches(east: int, north: int) -> None:
    rng = np.random.default_rng(9)
    good = rng.uniform(0.1, 0.9, (30, 2)) + [east, north]
    wrong = rng.uniform(-4000, 4000, (40, 2))
    assert fullest_bin_mean(np.concatenate([good, wrong])) == pytest.approx(good.mean(axis=0), abs=0.3)


def test_error_sharing_moves_by_half_the_difference() -> None:
    """Equation 6 for three frames. Right minus left is +2 m and then -4 m in east. So the first moves by 2/2,
    the middle by (-4 - 2)/2, the last by -(-4)/2, all at once."""
    errors = np.array([[0.0, 0.0], [2.0, 0.0], [-2.0, 0.0]])
    _, rounds = offsets.error_sharing(net_of(errors, line(3)), 0.01, 1)
    assert rounds[0].misalignments_m[:, 0] == pytest.approx([2.0, -4.0])
    assert rounds[0].moves_m[:, 0] == pytest.approx([1.0, -3.0, 2.0])


def test_error_sharing_has_no_base_and_ends_below_epsilon() -> None:
    """30 m of misplacement at 0.1 m a pixel is the paper's own bound; the mean of all moves is zero."""
    errors = np.random.default_rng(2).uniform(-30, 30, (9, 2))
    net = net_of(errors, line(9))
    moves, rounds = offsets.error_sharing(net, epsilon_m=1.0, max_rounds=200)
    assert moves.mean(axis=0) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert np.abs(net.misalignments_m(moves)).max() < 1.0
    largest = [np.abs(r.misalignments_m).max() for r in rounds]
    assert largest[0] > 20.0 and largest[-1] < 1.0 and not rounds[-1].moves_m.any()


def test_error_sharing_on_a_net_of_lines_contracts() -> None:
    """A 3 x 4 grid is bipartite: halves for each pair would alternate for ever."""
    pairs = [(r * 4 + c, r * 4 + c + 1) for r in range(3) for c in range(3)]
    pairs += [(r * 4 + c, r * 4 + c + 4) for r in range(2) for c in range(4)]
    chequers = np.array([[(-1.0) ** (r + c) * 5.0, 3.0 * r] for r in range(3) for c in range(4)])
    net = net_of(chequers, pairs)
    moves, _ = offsets.error_sharing(net, 0.05, 300)
    assert np.abs(net.misalignments_m(moves)).max() < 0.05
    assert moves.mean(axis=0) == pytest.approx([0, 0], abs=1e-9)


def test_two_frames_meet_in_the_middle_in_one_round() -> None:
    moves, _ = offsets.error_sharing(net_of(np.array([[0.0, 0], [6.0, -2.0]]), line(2)), 0.01, 5)
    assert moves == pytest.approx(np.array([[3.0, -1.0], [-3.0, 1.0]]))


def test_base_frame_stays_and_passes_its_error_on() -> None:
    errors = np.array([[1.0, 2.0], [-3.0, 0.5], [7.0, -4.0], [0.0, 0.0], [2.0, 2.0]])
    moves, _ = offsets.base_frame(net_of(errors, line(5)), range(5))
    assert errors + moves == pytest.approx(np.tile(errors[2], (5, 1)), abs=1e-9)


def test_layered_takes_the_drift_out_evenly() -> None:
    """Exact ties: only a ramp is left, the first and the last frame end with equal moves."""
    errors = np.random.default_rng(4).normal(0, 3, (9, 2))
    moves, _ = offsets.layered(net_of(errors, line(9)), range(9))
    assert moves[0] == pytest.approx(moves[-1])
    steps = np.diff(errors + moves, axis=0)
    assert steps == pytest.approx(np.tile(steps[0], (8, 1)), abs=1e-9)


def test_fit_similarity_among_outliers() -> None:
    rng = np.random.default_rng(0)
    z = rng.uniform(-100, 100, (200, 2))
    turn, shift = 1.02 * np.exp(0.03j), 12.0 - 7.0j
    w = (z @ [1, 1j]) * turn + shift
    w[:40] += rng.uniform(20, 50, 40)
    found = fit_similarity(z, np.column_stack([w.real, w.imag]), rounds=15)
    assert found[0] == pytest.approx(turn, abs=2e-3) and found[1] == pytest.approx(shift, abs=0.2)


def test_chain_follows_the_first_frame() -> None:
    errors = np.random.default_rng(8).normal(0, 3, (6, 2))
    turn, shift = chain(net_of(errors, line(6)), range(6))
    assert np.abs(turn) == pytest.approx(np.ones(6))
    estimated = errors @ [1, 1j] + shift
    assert estimated == pytest.approx(np.full(6, estimated[0]), abs=1e-6)


def test_least_squares_by_hand() -> None:
    """Two frames 6 m apart, priors of 1 m, pair of 1 m (Huber beyond 1.5). Minimising
    `x1² + x2² + w (x2 - x1 + 6)²` with the pair's weight w gives `x1 = -x2 = 6 w / (1 + 2 w)`."""
    net = net_of(np.array([[0.0, 0.0], [1.2, 0.0]]), line(2))
    moves, sd = least_squares(net, np.ones(2), np.ones(1))
    assert moves[:, 0] == pytest.approx([0.4, -0.4], abs=1e-9)
    assert sd == pytest.approx(np.sqrt(np.linalg.inv([[2.0, -1.0], [-1.0, 2.0]]).diagonal()))


def test_least_squares_states_its_own_error_and_does_not_grow() -> None:
    """200 lines of 40 frames: the error's deviation is the stated one, at the ends and in the middle."""
    rng = np.random.default_rng(11)
    ends, middles = [], []
    for _ in range(200):
        errors = rng.normal(0, 2.0, (40, 2))
        net = net_of(errors, line(40))
        noise = np.repeat([[0.0, 0.3]], 39, axis=0).reshape(-1, 1) * rng.normal(0, 1.0, (78, 2))
        noisy = replace(net, plan_m=net.plan_m + np.repeat(noise, 40, axis=0))
        moves, sd = least_squares(noisy, np.full(40, 2.0), np.full(39, 0.3))
        left = errors + moves
        ends.append(left[[0, -1]] / sd[[0, -1], None])
        middles.append(left[20] / sd[20])
    assert 0.85 < np.std(ends) < 1.15
    assert 0.85 < np.std(middles) < 1.2


def _survey_line(n: int, seed: int, sd_m: float = 2.0, yaw_sd_deg: float = 1.0) -> tuple[Block, np.ndarray]:
    """A line of n nadir frames of 800 x 600 px at 100 m with disturbed poses; exact tie pixels."""
    rng = np.random.default_rng(seed)
    camera = Camera("plain", 800, 600, 1000.0, 400.0, 300.0)
    ground = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    truth = np.column_stack([np.zeros(n), 25.0 * np.arange(n), np.full(n, 100.0)])
    level = Rotation.from_yaw_pitch_roll(np.zeros(n), np.zeros(n), np.zeros(n)).matrix
    true_poses = Poses(truth, level, np.zeros((n, 3)), np.zeros((n, 3)))
    ties = []
    for i in range(n - 1):
        px = rng.uniform([20, 20], [780, 340], (60, 2))
        at = ground_from_image(true_poses[i], camera, ground, px)
        other = true_poses[i + 1].image_from_ground(camera, at)
        numbers = np.arange(60, dtype=np.int32)
        ties.append(TiePair(i, i + 1, px, other, numbers, numbers + 60))
    yaw = np.radians(rng.normal(0, yaw_sd_deg, n))
    poses = Poses(
        truth + rng.normal(0, sd_m, (n, 3)) * [1, 1, 0],
        Rotation.from_yaw_pitch_roll(yaw, np.zeros(n), np.zeros(n)).matrix,
        np.tile([sd_m, sd_m, 1.0], (n, 1)),
        np.radians(np.tile([0.1, 0.1, yaw_sd_deg], (n, 1))),
    )
    names = tuple(f"{i:03d}.jpg" for i in range(n))
    block = Block(names, (camera,) * n, poses, ground, TiePoints(tuple(ties)), tuple(range(n)), (0,) * n, 0.1)
    return block, truth


def _centre_errors_m(adjusted: Adjusted, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm((adjusted.poses.positions_m - truth)[:, :2], axis=1)


@pytest.mark.proof
def test_chain_accumulates_and_the_others_do_not() -> None:
    """Over 20 lines of 40 frames with POS of 2 m and 1 degree the end of a chain is far off. The methods that
    tie each frame to its own position stay at the noise."""
    last = {m: [] for m in METHODS if m != "bundle"}
    for seed in range(20):
        block, truth = _survey_line(40, seed)
        for method in last:
            last[method].append(_centre_errors_m(METHODS[method](block, Settings()), truth)[-3:])
    rms = {m: float(np.sqrt(np.mean(np.square(v)))) for m, v in last.items()}
    assert rms["none"] == pytest.approx(2.8, rel=0.25)
    assert rms["chain"] > 5.0
    assert rms["error_sharing"] < 3.0
    assert rms["least_squares"] < 0.8 * rms["none"]


@pytest.mark.parametrize("method", sorted(METHODS))
def test_every_method_reports_the_same_things(method: str) -> None:
    block, _ = _survey_line(5, 1)
    adjusted = METHODS[method](block, Settings())
    assert adjusted.status == ("tied",) * 5
    assert len(adjusted.residuals_m) == 4 and adjusted.residuals_m[0].shape == (60, 2)
    assert all(r.misalignments_m.shape == (4, 2) and r.moves_m.shape == (5, 2) for r in adjusted.rounds)
    lonely = Block(
        (*block.names, "alone.jpg"), (*block.cameras, block.cameras[0]),
        Poses(*(np.concatenate([a, a[-1:] + 0.0]) for a in (block.poses.positions_m, block.poses.rotations, block.poses.positions_sd_m, block.poses.rotations_sd_rad))),
        block.ground, block.ties, tuple(range(6)), (0,) * 6, 0.1,
    )  # fmt: skip
    alone = METHODS[method](lonely, Settings())
    assert alone.status[5] == "placed"
    moved = alone.poses.positions_m - lonely.poses.positions_m
    assert np.all(moved[5] <= moved[:5].max(axis=0) + 1e-9) and np.all(
        moved[5] >= moved[:5].min(axis=0) - 1e-9
    )
    assert np.all(alone.poses.positions_sd_m[5] >= 0.5 * moved[:5].std(axis=0))
