"""Where a bundle begins: the images' own shape, georeferenced as one by the positions, whatever single tags say."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly
from test_control import surveyed

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.adjustment.procedure.georeference_parts import Fixes, PlanPriors, georeferenced
from geomosaic.adjustment.procedure.initialisation import start_poses
from geomosaic.adjustment.procedure.outcome import unplaced_parts
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import about_z
from geomosaic.matching.relative import averaged, joints_of
from geomosaic.quality.figures import best_similarity

EXIF_SD_M = np.array([5.0, 5.0, 15.0])


def with_reported(flown: Flown, **changes: np.ndarray) -> Block:
    return replace(flown.block, poses=replace(flown.block.poses, **changes))


def begun(block: Block) -> Poses:
    return start_poses(block, offset_net(block))


def turned_deg(poses: Poses, truth: Poses) -> np.ndarray:
    """About the vertical, against the truth."""
    between = poses.rotations @ np.swapaxes(truth.rotations, 1, 2)
    return np.degrees(np.arctan2(between[:, 1, 0], between[:, 0, 0]))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.proof)])
def test_no_heading_at_all(seed: int) -> None:
    """Every heading drawn anew: the images turn the frames to each other, the positions turn the whole."""
    flown = fly(seed, lines=3, per_line=6)
    any_way = flown.rng.uniform(-np.pi, np.pi, 18)
    poses = flown.block.poses
    block = with_reported(
        flown,
        rotations=about_z(any_way) @ poses.rotations,
        rotations_sd_rad=np.column_stack([poses.rotations_sd_rad[:, :2], np.full(18, np.pi)]),
        positions_sd_m=np.tile(EXIF_SD_M, (18, 1)),
    )
    start = begun(block)
    assert np.abs(turned_deg(start, flown.truth)).max() < 4.0
    assert np.abs(start.positions_m - flown.truth.positions_m)[:, :2].max() < 5.0


def test_heights_by_any_factor_come_from_the_images() -> None:
    """Reported from 35 m to 160 m in the course of the flight, true are 100 m."""
    flown = fly(4, lines=3, per_line=6)
    at = flown.block.poses.positions_m.copy()
    at[:, 2] = np.linspace(35.0, 160.0, 18)
    start = begun(with_reported(flown, positions_m=at, positions_sd_m=np.tile(EXIF_SD_M, (18, 1))))
    off = start.positions_m[:, 2] - flown.truth.positions_m[:, 2]
    assert np.std(off) < 2.5
    assert abs(off.mean()) < 5.0, "the level from positions 1.5 m off over 90 m"


def test_the_scale_is_that_of_the_positions() -> None:
    """Focal length and heights say 12 % too large, to 15 %; the positions know it to 1 %."""
    flown = fly(5, lines=3, per_line=8, position_sd_m=np.array([0.5, 0.5, 0.5]))
    at = flown.block.poses.positions_m.copy()
    at[:, 2] *= 1.12
    start = begun(with_reported(flown, positions_m=at, positions_sd_m=np.tile(EXIF_SD_M, (24, 1))))
    left = best_similarity(
        flown.truth.positions_m[:, :2], (start.positions_m - flown.truth.positions_m)[:, :2]
    )[1]
    assert np.sqrt(np.mean(left**2)) < 1.0
    extent = np.ptp(start.positions_m[:, :2], axis=0) / np.ptp(flown.truth.positions_m[:, :2], axis=0)
    assert extent == pytest.approx([1.0, 1.0], abs=0.03)


@pytest.mark.parametrize("sd_m", [5e3, 2e4])
def test_positions_stated_to_kilometres_begin_as_those_that_nobody_states(sd_m: float) -> None:
    """100 m up. Their weights in the first step were so small that no level of the adjustment could be
    solved, and positions stayed as given, 1.1 m off each way."""
    flown = fly(3)
    stated_m = np.tile([sd_m, sd_m, 2.0], (18, 1))
    block = with_reported(flown, positions_sd_m=stated_m)
    assert np.abs(begun(block).positions_m - flown.truth.positions_m)[:, :2].max() < 2.0
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    off_m = (adjusted.poses.positions_m - flown.truth.positions_m)[:, :2]
    assert np.sqrt(np.mean(off_m**2)) < 0.4 and not adjusted.warnings


def test_positions_that_lie_don_t_pull() -> None:
    """The block lies where it would if the two wrong positions had not been reported."""
    flown = fly(6, lines=3, per_line=6)
    at = flown.block.poses.positions_m.copy()
    at[[4, 13], :2] += [[80.0, -60.0], [-90.0, 45.0]]
    wide = flown.block.poses.positions_sd_m.copy()
    wide[[4, 13], :2] = 1e4
    lying = METHODS["bundle"](with_reported(flown, positions_m=at), Settings(model="given"))
    without = METHODS["bundle"](
        with_reported(flown, positions_m=at, positions_sd_m=wide), Settings(model="given")
    )
    named = {w.frame for w in lying.warnings if w.code == "position-wrong"}
    assert named == {"004.jpg", "013.jpg"}
    apart = lying.poses.positions_m - without.poses.positions_m
    assert np.abs(apart[:, :2]).max() < 0.1


def test_what_all_frames_miss_in_common_excuses_none() -> None:
    """Stated as good to 5 m, drawn with 1.5 m: the factor comes out near 0.3 whatever the scale of the start."""
    flown = fly(7, lines=3, per_line=8)
    block = with_reported(flown, positions_sd_m=np.tile(EXIF_SD_M, (24, 1)))
    adjusted = METHODS["bundle"](block, Settings())
    assert adjusted.figures["sigma_horizontal"] == pytest.approx(0.3, abs=0.1)
    error = (adjusted.poses.positions_m - flown.truth.positions_m)[:, :2].mean(axis=0)
    assert np.abs(error).max() < 3.0 * 1.5 / np.sqrt(24.0)


def test_an_assumed_heading_is_never_called_wrong() -> None:
    """Taken from a course that was flown backward: 20 degrees said, 180 off."""
    flown = fly(8, lines=2, per_line=6)
    poses = flown.block.poses
    sd = np.column_stack([poses.rotations_sd_rad[:, :2], np.full(12, np.radians(20.0))])
    back = about_z(np.where(np.arange(12) < 6, np.pi, 0.0))
    adjusted = METHODS["bundle"](
        with_reported(flown, rotations=back @ poses.rotations, rotations_sd_rad=sd), Settings()
    )
    assert not [w for w in adjusted.warnings if w.code in ("yaw-wrong", "frame-turned")]
    assert np.abs(turned_deg(adjusted.poses, flown.truth)).max() < 3.0


def test_a_frame_of_which_nothing_is_known_is_rejected() -> None:
    """No tie point, no deviation that counts: it is a part that nothing places; the others are solved."""
    flown = fly(9, lines=2, per_line=6)
    ties = tuple(t for t in flown.block.ties.pairs if 5 not in (t.left, t.right))
    sd, turn_sd = flown.block.poses.positions_sd_m.copy(), flown.block.poses.rotations_sd_rad.copy()
    sd[5], turn_sd[5] = np.inf, np.inf
    block = replace(
        with_reported(flown, positions_sd_m=sd, rotations_sd_rad=turn_sd),
        ties=replace(flown.block.ties, pairs=ties),
    )
    adjusted = METHODS["bundle"](block, Settings())
    assert [block.names[i] for part in unplaced_parts(block) for i in part] == ["005.jpg"]
    assert adjusted.status[5] == "rejected" and adjusted.status.count("tied") == 11
    others = np.arange(12) != 5
    assert np.abs(adjusted.poses.positions_m - flown.truth.positions_m)[others].max() < 4.0


def test_wrong_pairs_are_outvoted() -> None:
    """Frames turned and scaled at random, each pair right but for one in eight, drawn anew."""
    rng = np.random.default_rng(3)
    n = 20
    truth = np.exp(rng.normal(0.0, 0.2, n) + 1j * rng.uniform(-np.pi, np.pi, n))
    pairs = [(i, j) for i in range(n) for j in range(i + 1, min(i + 5, n))]
    left, right = [], []
    for k, (i, j) in enumerate(pairs):
        w = rng.normal(0.0, 20.0, 30) + 1j * rng.normal(0.0, 20.0, 30)
        turn = truth[j] / truth[i] if k % 8 else np.exp(1j * rng.uniform(-np.pi, np.pi))
        left.append(turn * w + 3.0 + rng.normal(0.0, 0.1, 30))
        right.append(w)
    found = averaged(n, joints_of(pairs, zip(left, right, strict=True))) / truth
    assert np.abs(found / found.mean() - 1.0).max() < 0.02


@pytest.mark.parametrize("whole", [1.0 + 0j, 0.7 * np.exp(2.9j)])
def test_a_part_is_georeferenced_as_one(whole: complex) -> None:
    """A third of the positions wrong; headings and heights all reported wrong by the same amount."""
    rng = np.random.default_rng(1)
    place = rng.uniform(-80.0, 80.0, 21) + 1j * rng.uniform(-40.0, 40.0, 21)
    nadir = whole * place + (12.0 - 5.0j) + rng.normal(0.0, 1.0, 21) + 1j * rng.normal(0.0, 1.0, 21)
    nadir[::3] += rng.uniform(60.0, 200.0, 7) * np.exp(1j * rng.uniform(0.0, 6.0, 7))
    beliefs = PlanPriors(nadir, np.full(21, 5.0), np.full(21, 0.05), np.full(21, 0.15), np.full(21, 1e4))
    fixes = Fixes(np.arange(21), np.zeros(21, np.complex128), nadir, np.full(21, 5.0))
    found, shift, trust = georeferenced(np.ones(21, np.complex128), place, beliefs, fixes)
    assert found == pytest.approx(whole, abs=0.02)
    assert shift == pytest.approx(12.0 - 5.0j, abs=1.5)
    assert trust[::3].max() < 1e-3 and np.delete(trust, np.s_[::3]).min() > 0.5


@pytest.mark.parametrize("seed", range(10))
def test_frames_of_an_ascent_on_the_spot_keep_the_scale_of_their_heights(seed: int) -> None:
    """Six frames taken at one place, 40 to 240 m up. Tilts of some 5 degrees move what is taken for their
    nadir points. Least squares would bring these together by shrinking the part."""
    rng = np.random.default_rng(seed)
    height_m = np.linspace(40.0, 240.0, 6)
    place = np.radians(5.0) * height_m * (rng.normal(size=6) + 1j * rng.normal(size=6))
    at = 0.2 * (rng.normal(size=6) + 1j * rng.normal(size=6))
    beliefs = PlanPriors(
        at, np.hypot(5.0, 0.05 * height_m), np.full(6, 0.05), 15.0 / height_m, 100.0 * height_m
    )
    fixes = Fixes(np.arange(6), np.zeros(6, np.complex128), at, beliefs.position_sd_m)
    found, _, _ = georeferenced(np.ones(6, np.complex128), place, beliefs, fixes)
    assert abs(found) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(("apart_m", "scale"), [(0.5, 1.0), (60.0, 1.2)])
def test_two_positions_give_the_scale_if_they_are_farther_apart_than_their_deviations(
    apart_m: float, scale: float
) -> None:
    at = np.array([0j, apart_m + 0j])
    beliefs = PlanPriors(at, *np.full((2, 4), [5.0, 0.05, 0.3, 1e4]).T)
    place = np.array([0j, 50.0 + 0j])
    fixes = Fixes(np.arange(2), np.zeros(2, np.complex128), beliefs.nadir, beliefs.position_sd_m)
    found, _, _ = georeferenced(np.ones(2, np.complex128), place, beliefs, fixes)
    assert abs(found) == pytest.approx(scale, rel=0.05)


def test_one_control_point_shifts_a_part_without_positions_and_leaves_its_scale() -> None:
    """Two images of one point, which least squares brought together: 18 frames shrank to 0.08."""
    flown = fly(3)
    unknown = with_reported(
        flown,
        positions_m=np.tile([40.0, 40.0, 100.0], (18, 1)),
        positions_sd_m=np.full((18, 3), 1e5),
        rotations_sd_rad=np.tile([0.17, 0.17, np.pi], (18, 1)),
    )
    block = replace(unknown, control=surveyed(flown, np.array([[40.0, 45.0]]), noise_px=0.3))
    for poses in (begun(block), METHODS["bundle"](block, Settings(model="given")).poses):
        from_end_to_end_m = [p.positions_m[-1, :2] - p.positions_m[0, :2] for p in (poses, flown.truth)]
        found_m, true_m = np.linalg.norm(from_end_to_end_m, axis=1)
        assert found_m == pytest.approx(true_m, rel=0.02)
        assert poses.positions_m[:, 2] == pytest.approx(np.full(18, 100.0), abs=5.0)
        assert np.abs(poses.positions_m - flown.truth.positions_m)[:, :2].max() < 6.0
