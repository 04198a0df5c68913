"""Blocks that no survey should have end with finite poses and named losses, never with an exception."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, hills

from geomosaic.adjustment.model import Adjusted, Block, GroundControl, Settings
from geomosaic.adjustment.problem.usable_block import usable
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.procedure.control_points import control_residuals
from geomosaic.adjustment.procedure.fallback import with_fallbacks
from geomosaic.errors import NotSolvableError
from tools.trials.trial_degenerate import problems, tried

EACH_WAY = (1, 3, 4, 8, 10, 20, 23, 24, 32, 33, 38, 39)
"""Draws of which each way to be degenerate has one."""
AGAIN = (0, 2, 5, 7, 12, 27, 28, 34)
"""With these each way has two, unless 40 have but one."""


@pytest.mark.parametrize("draws", [EACH_WAY, pytest.param(AGAIN, marks=pytest.mark.proof)])
def test_degenerate_blocks_end_finite(draws: tuple[int, ...]) -> None:
    """`make trial-degenerate` draws 10,000."""
    wrong = [(20_000 + k, kind, why) for k in draws for _, kind, why, *_ in [tried(20_000 + k)] if why]
    assert not wrong


@pytest.mark.proof
def test_a_point_behind_all_its_cameras_does_not_end_the_solve() -> None:
    """Wrong matches across parallel rays throw points of a large block above the cameras."""
    flown = fly(5, 4, 8, points=5200, noise_px=0.2)
    rng, pairs = np.random.default_rng(5), []
    for pair in flown.block.ties.pairs:
        wrong = rng.random(len(pair)) < 0.08
        shift = np.where(wrong[:, None], rng.normal(0.0, 250.0, (len(pair), 2)), 0.0)
        pairs.append(replace(pair, right_px=pair.right_px + shift))
    adjusted = pose_block(
        replace(flown.block, ties=replace(flown.block.ties, pairs=tuple(pairs))), Settings()
    )
    assert not problems(adjusted, 32)
    assert "bundle-failed" not in {w.code for w in adjusted.warnings}
    off_m = np.linalg.norm((adjusted.poses.positions_m - flown.truth.positions_m)[:, :2], axis=1)
    assert np.median(off_m) < 1.5


def test_a_control_point_of_parallel_rays_is_not_placed_and_all_else_goes_on() -> None:
    flown = fly(2, 2, 3)
    (frame, col, row), *_ = flown.seen(np.array([20.0, 20.0, 0.0]))
    again = tuple((frame, col + step, row) for step in (0.0, 1e-9))
    twice = replace(flown.block, names=(*flown.block.names,), control=())
    point = GroundControl("P", np.array([20.0, 20.0, 0.0]), np.full(3, 0.02), False, again)
    block = replace(twice, control=(point,))
    poses = flown.truth
    together = replace(poses, positions_m=np.tile(poses.positions_m[frame], (len(poses.positions_m), 1)))
    other = (frame + 1) % 6
    rays = GroundControl("Q", point.enu_m, point.sd_m, False, ((frame, col, row), (other, 1e9, 1e9)))
    for control in (point, rays):
        found = control_residuals(replace(block, control=(control,)), together)
        assert all(np.isfinite(r.residual_m).all() and np.isfinite(r.sd_m).all() for r in found)
    adjusted = pose_block(block, Settings())
    assert not problems(adjusted, 6)


def test_each_level_that_fails_is_one_warning_and_the_next_takes_over() -> None:
    block = fly(1, 1, 4).block
    asked: list[Settings] = []

    def fails_with_a_lens(its: Block, settings: Settings) -> Adjusted:
        asked.append(settings)
        if settings.self_calibration:
            raise NotSolvableError("singular here")
        return pose_block(its, replace(settings, model="given"))

    adjusted = with_fallbacks(block, Settings(), fails_with_a_lens)
    assert [w.code for w in adjusted.warnings][:1] == ["self-calibration-failed"]
    assert "singular here" in adjusted.warnings[0].text
    assert [s.self_calibration for s in asked] == [True, False]

    def fails(its: Block, settings: Settings) -> Adjusted:
        raise NotSolvableError("no digits left")

    solved_anyway = with_fallbacks(block, Settings(), fails)
    codes = [w.code for w in solved_anyway.warnings]
    assert codes == ["self-calibration-failed", "self-calibration-failed", "bundle-failed"]
    assert not problems(solved_anyway, 4)


def test_without_self_calibration_the_lens_stays_as_given_and_its_doubt_counts() -> None:
    block = fly(3, 3, 4, crossed=True, relief=hills).block
    free, fixed_lens = (
        pose_block(block, Settings(model="given", self_calibration=own)) for own in (True, False)
    )
    for camera, given in zip(fixed_lens.cameras, block.cameras, strict=True):
        assert camera.focal_length_px == given.focal_length_px and camera.k1 == given.k1
    assert any(
        (a.focal_length_px, a.k1) != (b.focal_length_px, b.k1)
        for a, b in zip(free.cameras, block.cameras, strict=True)
    )
    assert (fixed_lens.poses.positions_sd_m[:, 2] > 0.0).all()


def test_what_is_no_number_is_removed_by_name() -> None:
    block = fly(4, 1, 4).block
    poses = block.poses
    at, sd, rotations = poses.positions_m.copy(), poses.positions_sd_m.copy(), poses.rotations.copy()
    at[1, 2], sd[2], rotations[3] = np.nan, 0.0, 1.0
    pairs = list(block.ties.pairs)
    left = pairs[0].left_px.copy()
    left[:2] = np.nan
    pairs[0] = replace(pairs[0], left_px=left)
    broken = replace(
        block,
        poses=replace(poses, positions_m=at, positions_sd_m=sd, rotations=rotations),
        ties=replace(block.ties, pairs=tuple(pairs)),
        control=(GroundControl("bad", np.array([np.nan, 0.0, 0.0]), np.ones(3), False, ((0, 1.0, 1.0),)),),
    )
    sound, warnings = usable(broken)
    texts = {w.code: w.text for w in warnings}
    assert "bad" in texts["control-not-finite"] and not sound.control
    assert int(texts["tie-points-not-finite"].split()[0]) >= 2
    assert (sound.poses.positions_sd_m > 0.0).all() and np.isfinite(sound.poses.positions_m).all()
    assert sound.poses.positions_sd_m[1, 0] >= 1e4
    assert sound.poses.rotations_sd_rad[3, 0] == pytest.approx(np.pi)
    assert not problems(pose_block(broken, Settings()), 4)
    whole, nothing = usable(block)
    assert not nothing and whole.poses.positions_m is not None
    assert np.array_equal(whole.poses.positions_sd_m, poses.positions_sd_m)
