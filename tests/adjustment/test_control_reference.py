"""Blocks that control points alone place: tilted as kites hang, and with marks of reduced images."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import Flown, fly, hills
from hypothesis import given
from hypothesis import strategies as st

from geomosaic.adjustment.model import Block, GroundControl, Settings
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.procedure.control_points import with_marks_of_whole_images
from geomosaic.camera.rotation import about_x, about_z
from geomosaic.estimation.similarity import Similarity3D
from geomosaic.quality.control import control_warnings

PLACES = np.array([[0.0, 5.0], [78.0, 12.0], [10.0, 80.0], [75.0, 85.0], [40.0, 45.0]])


def without_positions(flown: Flown, marks: float = 1.0) -> Block:
    """The block as a kite delivers it: nothing known of poses, five control points, marks reduced."""
    block = flown.block
    n = len(block.names)
    control = []
    for k, (east, north) in enumerate(PLACES):
        at = np.array([east, north, float(hills(east, north))])
        seen = [(i, col / marks, row / marks) for i, col, row in flown.seen(at, 0.3)]
        control.append(GroundControl(f"P{k}", at, np.full(3, 0.05), False, tuple(seen)))
    poses = replace(
        block.poses,
        positions_m=np.tile([40.0, 40.0, 100.0], (n, 1)),
        rotations=np.tile(np.eye(3), (n, 1, 1)),
        positions_sd_m=np.full((n, 3), 1e5),
        rotations_sd_rad=np.tile([0.17, 0.17, np.pi], (n, 1)),
    )
    return replace(block, poses=poses, control=tuple(control))


def tilted(seed: int) -> Flown:
    """Three lines of five frames that all look 14 degrees ahead."""
    return fly(seed, 3, 5, relief=hills, noise_px=0.3, aslant_deg=dict.fromkeys(range(15), 14.0))


@pytest.mark.proof
@pytest.mark.parametrize("marks", [1.0, 1.92])
def test_a_tilted_block_without_positions_lies_on_its_control(marks: float) -> None:
    flown = tilted(3)
    adjusted = pose_block(without_positions(flown, marks), Settings())
    off_m = adjusted.poses.positions_m - flown.truth.positions_m
    assert np.sqrt((off_m**2).sum(axis=1)).max() < 1.5
    codes = [w.code for w in (*adjusted.warnings, *control_warnings(adjusted.control))]
    assert "control-disagrees" not in codes
    assert ("control-marks-enlarged" in codes) == (marks != 1.0)


def test_marks_of_whole_images_stay_even_where_they_happen_to_lie_in_a_corner() -> None:
    flown = tilted(4)
    block = without_positions(flown)
    near = [
        replace(c, observations=tuple(o for o in c.observations if o[1] < 520.0 and o[2] < 390.0))
        for c in block.control
    ]
    cornered = replace(block, control=tuple(c for c in near if len(c.observations) > 1))
    assert sum(len(c.observations) for c in cornered.control) >= 6
    kept, notes = with_marks_of_whole_images(cornered, lambda its: (flown.truth, its.cameras))
    assert not notes
    assert kept is cornered


def test_marks_between_0_and_1_are_shares_of_the_image() -> None:
    flown = tilted(4)
    block = without_positions(flown)
    shares = [
        replace(c, observations=tuple((i, col / 800.0, row / 600.0) for i, col, row in c.observations))
        for c in block.control
    ]
    found, (note,) = with_marks_of_whole_images(
        replace(block, control=tuple(shares)), lambda its: (flown.truth, its.cameras)
    )
    assert note.code == "control-marks-enlarged"
    for its, before in zip(found.control, block.control, strict=True):
        assert np.array(its.observations) == pytest.approx(np.array(before.observations))


def test_a_control_point_above_the_cameras_costs_a_rolling_shutter_nothing() -> None:
    """One of six is surveyed 400 m too high, which is behind all cameras: its images alone are disregarded."""
    flown = fly(3, 2, 4, points=250, relief=hills, readout_s=0.03)
    control = []
    for k, (east, north) in enumerate(np.array([[5, 10], [30, 20], [20, 45], [8, 50], [35, 55], [22, 30]])):
        at = np.array([east, north, float(hills(east, north))])
        too_high = np.array([0.0, 0.0, 400.0 if k == 2 else 0.0])
        control.append(
            GroundControl(f"P{k}", at + too_high, np.full(3, 0.05), False, tuple(flown.seen(at, 0.3)))
        )
    adjusted = pose_block(replace(flown.block, control=tuple(control)), Settings(model="given"))
    assert not [
        w.code for w in adjusted.warnings if w.code in ("self-calibration-failed", "adjustment-step-failed")
    ]
    off_m = np.linalg.norm(adjusted.poses.positions_m - flown.truth.positions_m, axis=1)
    assert off_m.max() < 0.6 and adjusted.poses.positions_sd_m.max() < 1.0


def test_a_similarity_takes_known_points_where_they_go() -> None:
    points = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 1.0], [0.0, 20.0, -2.0], [5.0, 8.0, 3.0]])
    to = np.array([[100.0, 50.0, 7.0], [100.0, 70.0, 9.0], [60.0, 50.0, 3.0], [84.0, 60.0, 13.0]])
    found = Similarity3D.through(points, to)
    assert found is not None
    assert found.scale == pytest.approx(2.0)
    assert np.allclose(found.rotation, [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(found.shift, [100.0, 50.0, 7.0])


@given(
    st.floats(0.01, 100.0), st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_one_blunder_among_six_points_moves_no_similarity(
    scale: float, yaw: float, tilt: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-50.0, 50.0, (6, 3))
    truth = Similarity3D(scale, about_z(np.array(yaw)) @ about_x(np.array(tilt)), rng.uniform(-1e3, 1e3, 3))
    to = truth.of(points)
    to[2] += 300.0 * scale
    found = Similarity3D.through(points, to)
    assert found is not None
    assert found.scale == pytest.approx(scale, rel=2e-2)
    assert np.abs(found.rotation - truth.rotation).max() < 0.05


def test_points_on_a_line_have_no_similarity() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 0.5])
    assert Similarity3D.through(line, 2.0 * line) is None
    assert Similarity3D.through(line[:2], line[:2]) is None


@pytest.mark.parametrize("plan_only", [True, pytest.param(False, marks=pytest.mark.proof)])
def test_control_by_a_handheld_receiver_does_not_turn_a_block_over(plan_only: bool) -> None:
    """Five points along a line, 2 m off each: in plan alone with 0 for their heights, or with heights.

    What turns the block about the line by a tenth of a radian moves frames 100 m above by 10 m.
    """
    flown = fly(5, 3, 5, relief=hills, noise_px=0.3)
    block, rng = without_positions(flown), np.random.default_rng(8)
    control = []
    for k, along in enumerate(np.linspace(0.0, 80.0, 5)):
        at = np.array([along, along + 3.0 * (-1) ** k, 0.0])
        at[2] = hills(at[0], at[1])
        seen = tuple(flown.seen(at, 0.3))
        stated = at + rng.normal(0.0, 2.0, 3)
        sd_m = np.array([0.03, 0.03, 1e5 if plan_only else 0.03])
        control.append(GroundControl(f"P{k}", stated * [1, 1, 1 - plan_only], sd_m, False, seen))
    adjusted = pose_block(replace(block, control=tuple(control)), Settings())
    assert adjusted.poses.rotations[:, 2, 2].min() > 0.9
    assert adjusted.figures["sigma_px"] < 1.0
    off_m = adjusted.poses.positions_m - flown.truth.positions_m
    assert np.median(np.hypot(*off_m[:, :2].T)) < 10.0
