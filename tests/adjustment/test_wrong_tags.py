"""Wrong headings and heights: distinguished from turned images, corrected with their tilts, named."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import fly, hills, level

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.blunder_detection import wrong_tags
from geomosaic.adjustment.procedure.reported_corrections import height_drift
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import Rotation, about_z, exp_turn
from geomosaic.matching.turned import PairOnMap, flown_courses_rad, reheaded, turn_costs_m


def test_another_heading_takes_the_tilt_along_and_is_known_as_a_course_is() -> None:
    """Reported 40 degrees, looking 6 degrees forward and 2 left: so it did, from another heading."""
    reported = Rotation.from_yaw_pitch_roll(*np.radians([[40.0, 40.0], [6.0, 6.0], [2.0, 2.0]])).matrix
    poses = Poses(np.zeros((2, 3)), reported, np.ones((2, 3)), np.radians(np.tile([0.3, 0.3, 1.0], (2, 1))))
    right = reheaded(poses, {1: np.radians(155.0)})
    yaw, pitch, roll = (float(np.degrees(a)) for a in right[1].rotation.yaw_pitch_roll())
    assert (yaw, pitch, roll) == pytest.approx((155.0, 6.0, 2.0))
    np.testing.assert_array_equal(right.rotations[0], reported[0])
    np.testing.assert_allclose(np.degrees(right.rotations_sd_rad), [[0.3, 0.3, 1.0], [0.3, 0.3, 20.0]])


def test_heights_that_drift_are_named_with_both_ends_and_do_no_harm() -> None:
    flown = fly(4, lines=2, per_line=6)
    drift = np.zeros((12, 3))
    drift[:, 2] = np.linspace(-22.0, 6.0, 12)
    poses = replace(flown.block.poses, positions_m=flown.block.poses.positions_m + drift)
    block = replace(flown.block, poses=poses)
    adjusted = METHODS["bundle"](block, Settings(model="given"))
    (warning,) = [w for w in adjusted.warnings if w.code == "heights-drift"]
    assert (
        warning.frame == "000.jpg" and "011.jpg" in warning.text and "stated deviation 2.0 m" in warning.text
    )
    up = adjusted.poses.positions_m[:, 2] - flown.truth.positions_m[:, 2]
    assert np.std(up) < 0.5
    honest = METHODS["bundle"](flown.block, Settings(model="given"))
    assert not [w for w in honest.warnings if w.code == "heights-drift"]
    assert not height_drift(block, adjusted.poses, np.arange(3)).parts, "three frames say nothing"


def test_a_slope_and_a_jump_of_heights_are_solved_for_together() -> None:
    """A barometer that sinks by 24 m over twelve frames, and a second battery's zero 15 m up."""
    flown = fly(6, lines=2, per_line=6)
    drift = np.linspace(12.0, -12.0, 12) + np.where(np.arange(12) < 6, 0.0, 15.0)
    at = flown.truth.positions_m + np.outer(drift, [0.0, 0.0, 1.0])
    at[:, 2] += np.random.default_rng(2).normal(0.0, 0.5, 12)
    block = replace(flown.block, poses=replace(flown.block.poses, positions_m=at))
    found = height_drift(block, flown.truth, np.arange(12))
    (slope_m, none), (jump_m, behind) = found.parts
    assert none is None and behind == 5
    assert slope_m == pytest.approx(-24.0, abs=3.0)
    assert jump_m == pytest.approx(15.0, abs=3.0)
    freed = found.freed(block).poses.positions_m[:, 2] - flown.truth.positions_m[:, 2]
    assert freed.std() < 1.0
    assert freed.mean() == pytest.approx((at - flown.truth.positions_m)[:, 2].mean(), abs=1e-9), "kept"


def test_a_wrong_position_bends_no_course() -> None:
    """Frame 3 lies 60 m aside of its line: its neighbours' courses are the line's, and it has none itself."""
    at = np.column_stack([np.zeros(7), 20.0 * np.arange(7.0)])
    reported = at.copy()
    reported[3, 0] = 60.0
    apart = np.linalg.norm(reported - at, axis=1)
    costs = [
        (a, b, np.full((4, 4), 2.0 + abs(apart[a] - apart[b]))) for a in range(7) for b in range(a + 1, 7)
    ]
    course = np.degrees(flown_courses_rad(reported, costs))
    assert course == pytest.approx([0.0, 0.0, 0.0, np.nan, 0.0, 0.0, 0.0], nan_ok=True)
    honest = np.degrees(flown_courses_rad(at, [(a, b, np.full((4, 4), 2.0)) for a, b, _ in costs]))
    assert honest == pytest.approx(np.zeros(7))


@pytest.mark.parametrize("off_deg", [0.0, 180.0, 50.0])
def test_a_wrong_position_has_the_course_of_where_its_neighbours_see_it(off_deg: float) -> None:
    """A line to the north-east; frame 3, 60 m aside, sees the same ground as 1, 2, 4 and 5, whatever its heading."""
    at = np.outer(20.0 * np.arange(7.0), [0.6, 0.8])
    reported = at + np.outer(np.arange(7) == 3, [60.0, -20.0])
    rng = np.random.default_rng(5)
    spots = rng.uniform(-15.0, 15.0, (40, 2))

    def sees(i: int, ground: np.ndarray) -> np.ndarray:
        place = (ground - at[i]) @ about_z(np.radians(off_deg * (i == 3)))[:2, :2].T
        return reported[i] + place + rng.normal(0.0, 0.5, place.shape)

    seen = [
        PairOnMap(a, b, *(sees(i, (at[a] + at[b]) / 2.0 + spots) for i in (a, b)))
        for a in range(7)
        for b in range(a + 1, min(a + 3, 7))
    ]
    costs = [
        (s.left, s.right, turn_costs_m(s.left_m, s.right_m, reported[s.left], reported[s.right]))
        for s in seen
    ]
    course = np.degrees(flown_courses_rad(reported, costs, seen))
    assert course == pytest.approx(np.full(7, np.degrees(np.arctan2(0.6, 0.8))), abs=2.0)


def test_an_image_on_its_head_whose_heading_fits_its_line_was_turned() -> None:
    """Its position was wrong too, so that matching couldn't see it; the adjustment does."""
    flown = fly(4, lines=2, per_line=6)
    upside_down = flown.truth.rotations.copy()
    upside_down[3] = about_z(np.pi) @ upside_down[3]
    reported = replace(flown.truth, rotations_sd_rad=np.radians(np.full((12, 3), 2.0)))
    found = replace(reported, rotations=upside_down)
    for given, adjusted, code in ((reported, found, "frame-turned"), (found, reported, "yaw-wrong")):
        said = wrong_tags(replace(flown.block, poses=given), adjusted)
        assert [(w.code, w.frame) for w in said] == [(code, "003.jpg")]


@pytest.mark.parametrize("given_tilt_deg", [0.0, 88.0])
def test_a_roll_about_the_view_at_the_horizon_is_no_wrong_heading(given_tilt_deg: float) -> None:
    """The frame looks north as given, rolled by 100 degrees about its view: there yaw and roll are one."""
    flown = fly(4, lines=2, per_line=6)
    given, found = flown.truth.rotations.copy(), flown.truth.rotations.copy()
    given[3] = Rotation.from_yaw_pitch_roll(0.0, np.radians(given_tilt_deg), 0.0).matrix
    ahead = Rotation.from_yaw_pitch_roll(0.0, np.radians(80.0), 0.0).matrix
    found[3] = exp_turn(np.radians(-100.0) * ahead[None, :, 2])[0] @ ahead
    reported = replace(flown.truth, rotations=given, rotations_sd_rad=np.radians(np.full((12, 3), 2.0)))
    assert not wrong_tags(replace(flown.block, poses=reported), replace(reported, rotations=found))


def test_an_oblique_frame_that_looks_elsewhere_has_a_wrong_heading() -> None:
    flown = fly(4, lines=2, per_line=6)
    given, found = flown.truth.rotations.copy(), flown.truth.rotations.copy()
    given[3] = Rotation.from_yaw_pitch_roll(0.0, np.radians(70.0), 0.0).matrix
    found[3] = Rotation.from_yaw_pitch_roll(np.radians(60.0), np.radians(70.0), 0.0).matrix
    reported = replace(flown.truth, rotations=given, rotations_sd_rad=np.radians(np.full((12, 3), 2.0)))
    (warning,) = wrong_tags(replace(flown.block, poses=reported), replace(reported, rotations=found))
    assert (warning.code, warning.frame) == ("yaw-wrong", "003.jpg")
    assert "given as 0 degrees and is 60" in warning.text


@pytest.mark.parametrize("relief", [pytest.param(level, marks=pytest.mark.proof), hills])
def test_attitudes_of_the_platform_given_for_the_cameras_do_no_harm(relief) -> None:  # type: ignore[no-untyped-def]
    """The camera is mounted 3 degrees aside and 4 aslant, and nobody says so. Tilts that all frames miss in
    common, at 0.3 stated, are no reason to lean the block. Counted against it, a survey flown there and back
    came out 8 m aside, bent by 2.9 px and called good."""
    flown = fly(5, lines=3, per_line=5, relief=relief, there_and_back=True)
    aside = exp_turn(np.radians([[3.0, -4.0, 0.0]]))[0]
    given = replace(flown.block.poses, rotations=flown.block.poses.rotations @ aside)
    adjusted = METHODS["bundle"](replace(flown.block, poses=given), Settings(model="given"))
    turned = np.einsum("fij,fkj->fik", adjusted.poses.rotations, flown.truth.rotations)
    lean = np.degrees(np.column_stack([turned[:, 2, 1], turned[:, 0, 2]]))
    assert np.abs(lean.mean(axis=0)).max() < 1.0
    assert np.std(adjusted.poses.positions_m[:, 2] - flown.truth.positions_m[:, 2]) < 1.0
