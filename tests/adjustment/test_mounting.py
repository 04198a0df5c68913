"""Boresight, lever arm, delay and readout: conventions by absolute numbers, and found again in blocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, frame_terms

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Settings
from geomosaic.adjustment.problem.estimate import Estimate, UnknownLayout
from geomosaic.adjustment.terms.attitudes import Attitudes
from geomosaic.adjustment.terms.gnss_positions import GnssPositions
from geomosaic.adjustment.terms.terrain import level_unknown
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation, exp_turn

EAST = np.array([[0.0, 12.0, 3.0]])


def poses_of(
    yaw: float, pitch: float, roll: float, at: list[float], velocity: np.ndarray | None = None
) -> Poses:
    rotation = Rotation.from_yaw_pitch_roll(*np.radians([yaw, pitch, roll])).matrix
    return Poses(np.array([at]), rotation[None], np.ones((1, 3)), np.ones((1, 3)), velocity)


def estimate_of(poses: Poses, terms: tuple[GnssPositions, Attitudes], values: dict[str, float]) -> Estimate:
    """The poses and the shared unknowns at values by name, in the units of their names."""
    layout = UnknownLayout((), level_unknown(1.0), tuple(u for term in terms for u in term.unknowns()))
    shared = np.array([values.get(name, 0.0) for _, name in layout.names]) * layout.unit
    assert set(values) <= {name for _, name in layout.names}
    none = np.zeros((0, 3)), shared, np.zeros((len(poses), 0, 3)), np.zeros((len(poses), 3))
    return Estimate(layout, poses.positions_m, poses.rotations, *none)


def miss_of(terms: tuple[GnssPositions, Attitudes], at: Estimate) -> np.ndarray:
    """Residuals of positions and attitudes, (f, 6)."""
    return np.concatenate([term.miss(at) for term in terms], axis=1)


def test_each_number_means_what_its_name_says() -> None:
    """Heading east: forward is east, right is south. The reported attitude is turned further than the
    camera's."""
    camera = poses_of(90.0, 0.0, 0.0, [10.0, 20.0, 100.0])
    for name, value, reported in (
        ("boresight_roll_deg", 2.0, poses_of(90.0, 0.0, 2.0, [10.0, 20.0, 100.0])),
        ("boresight_pitch_deg", -3.0, poses_of(90.0, -3.0, 0.0, [10.0, 20.0, 100.0])),
        ("boresight_yaw_deg", 4.0, poses_of(94.0, 0.0, 0.0, [10.0, 20.0, 100.0])),
        ("lever_arm_forward_m", 0.7, poses_of(90.0, 0.0, 0.0, [10.7, 20.0, 100.0])),
        ("lever_arm_right_m", 0.4, poses_of(90.0, 0.0, 0.0, [10.0, 19.6, 100.0])),
        ("lever_arm_down_m", -0.3, poses_of(90.0, 0.0, 0.0, [10.0, 20.0, 100.3])),
        ("gps_lag_s", 0.5, poses_of(90.0, 0.0, 0.0, [10.0, 14.0, 98.5], EAST)),
        ("offset_east_m", 1.5, poses_of(90.0, 0.0, 0.0, [11.5, 20.0, 100.0])),
        ("offset_north_m", -0.6, poses_of(90.0, 0.0, 0.0, [10.0, 19.4, 100.0])),
        ("offset_up_m", 2.5, poses_of(90.0, 0.0, 0.0, [10.0, 20.0, 102.5])),
    ):
        terms = frame_terms(reported)
        miss = miss_of(terms, estimate_of(camera, terms, {name: value}))
        np.testing.assert_allclose(miss, 0.0, atol=1e-12, err_msg=name)


def test_derivatives_are_those_of_finite_differences() -> None:
    """Of the computed positions and attitudes: the residual falls as these rise."""
    turn = np.array([[0.01, -0.02, 0.015]])
    camera = poses_of(33.0, 5.0, -7.0, [1.0, 2.0, 90.0], EAST)
    reported = replace(camera, rotations=exp_turn(turn * 1e-3) @ camera.rotations)
    terms = frame_terms(reported)
    at = estimate_of(camera, terms, {})
    platform = slice(at.layout.level + 1, None)
    values = [0.3, -0.2, 0.5, 0.4, 0.6, -0.7, 0.9, 1e-4, -2e-4, 1e-4]
    at = replace(at, shared=np.array([0.0, *values]))
    by = np.zeros((6, 6 + len(values)))
    for term, rows in zip(terms, (slice(0, 3), slice(3, 6)), strict=True):
        by_pose, shared = term.derivatives(at)
        assert by_pose is not None
        by[rows, :6] = by_pose[0]
        for name, its in shared:
            columns = at.layout.platform_columns(name)
            assert columns is not None
            by[rows, 6:][:, columns] = its[0]

    def miss(step: np.ndarray) -> np.ndarray:
        shared = at.shared.copy()
        shared[platform] += step[6:]
        rotations = exp_turn(step[None, 3:6]) @ camera.rotations
        moved = replace(at, positions_m=at.positions_m + step[:3], rotations=rotations, shared=shared)
        return miss_of(terms, moved)[0]

    for k in range(16):
        step = np.zeros(16)
        step[k] = 1e-5
        np.testing.assert_allclose(by[:, k], -(miss(step) - miss(-step)) / 2e-5, atol=1e-3)


def _found(adjusted: Adjusted, name: str) -> tuple[float, float, bool]:
    assert adjusted.shared is not None
    k = adjusted.shared.names.index(name)
    return adjusted.shared.found[k], adjusted.shared.sd[k], bool(adjusted.shared.fixed[k])


SHARP = np.array([0.1, 0.1, 0.15])


@pytest.mark.proof
def test_boresight_and_lag_are_found_where_lines_run_both_ways() -> None:
    flown = fly(5, 4, 6, noise_px=0.1, there_and_back=True, position_sd_m=SHARP)
    assert flown.block.poses.velocities_m_per_s is not None
    poses = replace(
        flown.block.poses,
        positions_m=flown.block.poses.positions_m - 0.4 * flown.block.poses.velocities_m_per_s,
        rotations=flown.block.poses.rotations
        @ Rotation.from_yaw_pitch_roll(*np.radians([1.5, -0.8, 2.0])).matrix,
    )
    block = replace(flown.block, poses=poses)
    adjusted = METHODS["bundle"](block, Settings(boresight=True, gps_lag=True))
    for name, truth in (
        ("boresight_yaw_deg", 1.5), ("boresight_pitch_deg", -0.8), ("boresight_roll_deg", 2.0), ("gps_lag_s", 0.4),
    ):  # fmt: skip
        found, sd, fixed = _found(adjusted, name)
        assert not fixed and abs(found - truth) < 3.5 * sd, name
    assert _found(adjusted, "gps_lag_s")[1] < 0.01
    off = np.linalg.norm((adjusted.poses.positions_m - flown.truth.positions_m)[:, :2], axis=1)
    without = METHODS["bundle"](block, Settings(model="given")).poses.positions_m - flown.truth.positions_m
    assert np.median(off) < 0.2 < 0.5 < np.median(np.linalg.norm(without[:, :2], axis=1))


def test_a_horizontal_lever_arm_is_found_and_a_vertical_one_is_fixed() -> None:
    flown = fly(6, 4, 6, noise_px=0.1, there_and_back=True, position_sd_m=SHARP)
    shift = flown.truth.rotations @ np.array([-0.5, 0.9, 0.0])  # 0.5 m to the left, 0.9 m ahead
    poses = replace(flown.block.poses, positions_m=flown.block.poses.positions_m + shift)
    adjusted = METHODS["bundle"](replace(flown.block, poses=poses), Settings(model="given", lever_arm=True))
    for name, truth in (("lever_arm_forward_m", 0.9), ("lever_arm_right_m", -0.5)):
        found, sd, fixed = _found(adjusted, name)
        assert not fixed and abs(found - truth) < 3.5 * sd < 0.4, name
    assert _found(adjusted, "lever_arm_down_m")[2]
    assert [w.code for w in adjusted.warnings if "lever_arm_down_m" in w.text] == ["not-determined"]


@pytest.mark.parametrize("reported_s", [0.0, pytest.param(0.06, marks=pytest.mark.proof)])
def test_a_rolling_shutter_is_found_from_what_was_reported(reported_s: float) -> None:
    """15 m/s for 0.06 s: 9 px of stretch along the flight."""
    flown = fly(7, 4, 6, noise_px=0.1, there_and_back=True, position_sd_m=SHARP, readout_s=0.06)
    cameras = tuple(replace(c, readout_s=reported_s) for c in flown.block.cameras)
    adjusted = METHODS["bundle"](
        replace(flown.block, cameras=cameras), Settings(model="given", rolling_shutter=True)
    )
    found, sd, fixed = _found(adjusted, "readout_s")
    assert not fixed and abs(found - 0.06) < 3.5 * sd < 0.02
    assert adjusted.cameras[0].readout_s == found
    assert adjusted.figures["sigma_px"] < 0.13


def test_without_velocities_a_lag_is_fixed_and_named() -> None:
    flown = fly(8, 2, 5)
    poses = replace(flown.block.poses, velocities_m_per_s=None)
    adjusted = METHODS["bundle"](replace(flown.block, poses=poses), Settings(gps_lag=True))
    assert _found(adjusted, "gps_lag_s")[::2] == (0.0, True)
    assert "gps_lag_s" in " ".join(w.text for w in adjusted.warnings)


@pytest.mark.parametrize("position_sd_m", [0.3, 2.5])
@pytest.mark.parametrize("seed", [31, 32, pytest.param(33, marks=pytest.mark.proof)])
def test_attitudes_that_promise_too_much_are_found_with_a_boresight(seed: int, position_sd_m: float) -> None:
    """Attitudes stated to 0.05 degrees are off by 0.3, headings by 1 degree. A frame's attitude and the
    boresight compensate each other; what is observed, their sum, is known far better."""
    flown = fly(seed, position_sd_m=np.full(3, position_sd_m))
    poses = replace(flown.block.poses, rotations_sd_rad=np.full((18, 3), np.radians(0.05)))
    adjusted = METHODS["bundle"](replace(flown.block, poses=poses), Settings(model="given", boresight=True))
    assert adjusted.figures["sigma_tilt"] == pytest.approx(6.0, rel=0.35)
    assert adjusted.figures["sigma_yaw"] == pytest.approx(10.0, rel=0.4)
    assert adjusted.figures["sigma_px"] == pytest.approx(0.3, rel=0.15)
    error_m = (adjusted.poses.positions_m - flown.truth.positions_m)[:, :2]
    assert np.sqrt((error_m**2).mean()) < 2.0 * np.sqrt((adjusted.poses.positions_sd_m[:, :2] ** 2).mean())
