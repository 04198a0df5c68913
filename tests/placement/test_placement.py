"""Predicted poses of frames before they are matched, and who is compared with whom."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geomosaic.camera.exterior import Poses, Turns
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic.pipeline.recipe import load_recipe
from geomosaic.pipeline.registry import installed
from geomosaic.pipeline.runner import run
from geomosaic.placement.graph import connected_parts, flight_lines, overlapping_pairs
from geomosaic.placement.heights import (
    FrameHeights,
    frame_heights_m,
    ground_height_m,
    possible_heights,
)
from geomosaic.placement.prior import FORMULAS, courses_deg, prior_poses
from geomosaic.placement.reach import half_extent_m, misplacement_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.positions import read_poses
from geomosaic.survey.model import Attitude, Frame, Position, Survey
from geomosaic_simulate.flight import paper_table
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import simulate_frames
from geomosaic_simulate.write import frame_name, write_csv

HOME = LocalFrame(11.3, 48.1, 520.0)
CAMERA = Camera("cam", 800, 600, 1000.0, 400.0, 300.0)
FLAT = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))


def frame_at(
    enu: tuple[float, float, float],
    yaw: float | None = 0.0,
    pitch: float | None = 0.0,
    sd_vertical_m: float = 1.0,
) -> Frame:
    lon, lat, height = (float(v) for v in HOME.geodetic_from_enu(np.array([enu]))[0])
    return Frame(
        "a.jpg", "/a.jpg", 800, 600, 3, "uint8", "cam",
        Position(lon, lat, height, None, 1.5, 1.5, sd_vertical_m, "test"),
        Attitude(yaw, pitch, 0.0, 1.0, 0.3, "test"),
    )  # fmt: skip


def survey_of(*frames: Frame) -> Survey:
    return Survey(frames, (CAMERA,), HOME, "EPSG:32632")


def with_height(absolute: float | None, above: float | None, sd_m: float) -> Frame:
    frame = frame_at((0.0, 0.0, 100.0))
    position = replace(
        frame.position, height_ellipsoidal_m=absolute, height_above_ground_m=above, sd_vertical_m=sd_m
    )
    return replace(frame, position=position)


def test_a_known_attitude_is_kept_with_its_deviations() -> None:
    """120 m east and 50 m north of the origin the verticals differ by 20 microradians only."""
    poses = prior_poses(
        survey_of(frame_at((120.0, 50.0, 80.0), yaw=35.0, pitch=4.0)),
        FrameHeights(np.array([600.0]), np.ones(1)),
        (0,),
    )
    yaw, pitch, roll = (float(np.degrees(a)) for a in poses[0].rotation.yaw_pitch_roll())
    assert (yaw, pitch, roll) == pytest.approx((35.0, 4.0, 0.0), abs=2e-3)
    assert poses.positions_m[0] == pytest.approx([120.0, 50.0, 80.0], abs=0.01)
    assert poses.positions_sd_m[0] == pytest.approx([1.5, 1.5, 1.0])
    assert np.degrees(poses.rotations_sd_rad[0]) == pytest.approx([0.3, 0.3, 1.0])


def test_reported_velocities_and_turns_of_some_frames() -> None:
    """Turns over one span, the longest; a frame that tells neither flies as its neighbours say and doesn't turn."""
    frames = [replace(frame_at((40.0 * i, 0.0, 100.0)), time_s=10.0 * i) for i in range(3)]
    turns = Turns(0.2, np.array([[-0.01, 0.0, 0.02], [0.0, 0.0, 0.0], [0.01, 0.0, -0.02]]))
    frames[1] = replace(frames[1], velocity_m_per_s=(1.0, 7.0, -0.5), turns=turns)
    frames[2] = replace(frames[2], turns=Turns(0.1, turns.rad))
    poses = prior_poses(survey_of(*frames), FrameHeights(np.full(3, 620.0), np.ones(3)), (0, 0, 0))
    assert poses.velocities_m_per_s == pytest.approx(
        np.array([[4.0, 0, 0], [1.0, 7.0, -0.5], [4.0, 0, 0]]), abs=1e-3
    )
    assert poses.turns is not None
    at_50_ms = [poses[i].turns.at(0.05)[0][0] for i in range(3)]
    assert at_50_ms == pytest.approx([0.0, 0.005, 0.01])
    assert prior_poses(survey_of(frames[0]), FrameHeights(np.full(1, 620.0), np.ones(1)), (0,)).turns is None


def test_two_drones_that_fly_at_once_have_velocities_of_their_own() -> None:
    """One flies east at 5 m/s, the other north at 8 m/s, 200 m away; their frames alternate, a second apart."""
    frames = []
    for k in range(6):
        for name, offset_s, at in (("A", 0.0, (10.0 * k, 0.0, 100.0)), ("B", 1.0, (200.0, 16.0 * k, 100.0))):
            frames.append(replace(frame_at(at), platform=name, time_s=1.7e9 + 2.0 * k + offset_s + 0.25))
    survey = survey_of(*frames)
    found = prior_poses(survey, FrameHeights(np.full(12, 620.0), np.ones(12)), (0,) * 12).velocities_m_per_s
    assert found is not None
    assert found[0::2] == pytest.approx(np.tile([5.0, 0.0, 0.0], (6, 1)), abs=0.01)
    assert found[1::2] == pytest.approx(np.tile([0.0, 8.0, 0.0], (6, 1)), abs=0.01)
    alone = survey_of(*(replace(f, platform="") for f in frames))
    assert alone.clock_times_s[-1] - alone.clock_times_s[0] == pytest.approx(11.0)


def test_an_unknown_yaw_is_the_course_and_says_how_little_it_is_worth() -> None:
    """A flight to the east-north-east: 40 m east and 30 m north a step is a course of 53.13 degrees."""
    frames = [frame_at((40.0 * i, 30.0 * i, 100.0), yaw=None, pitch=None) for i in range(3)]
    poses = prior_poses(survey_of(*frames), FrameHeights(np.full(3, 620.0), np.full(3, 3.0)), (0, 0, 0))
    yaw, pitch, _ = (np.degrees(a) for a in Rotation(poses.rotations).yaw_pitch_roll())
    assert yaw == pytest.approx(np.full(3, 53.1301), abs=0.01)
    assert pitch == pytest.approx(np.zeros(3), abs=0.01)
    assert np.degrees(poses.rotations_sd_rad[:, 2]) == pytest.approx(np.full(3, 20.0))


def test_a_yaw_without_any_course_may_be_anything() -> None:
    poses = prior_poses(
        survey_of(frame_at((0.0, 0.0, 100.0), yaw=None)),
        FrameHeights(np.array([620.0]), np.array([3.0])),
        (0,),
    )
    assert np.degrees(poses.rotations_sd_rad[0, 2]) == pytest.approx(180.0)


def test_courses_do_not_cross_flight_lines() -> None:
    at = np.array([[0.0, 0.0], [0.0, 10.0], [5.0, 10.0], [5.0, 0.0], [90.0, 90.0]])
    assert courses_deg(at, (0, 0, 1, 1, 2)) == pytest.approx([0.0, 0.0, 180.0, 180.0, np.nan], nan_ok=True)


def test_heights() -> None:
    """A good absolute height is taken; a weak one gives way to take-off (the median ground below the
    frames that say) plus height above ground; without either nothing is invented."""
    frames = (
        with_height(631.0, 95.0, 1.0),
        with_height(700.0, 95.0, 10.0),
        with_height(None, 90.0, 10.0),
        with_height(644.0, None, 10.0),
        with_height(None, None, 10.0),
    )
    ground = np.array([520.0, 530.0, 524.0, 9.0, 9.0])
    assert frame_heights_m(survey_of(*frames), ground) == pytest.approx(
        [631.0, 619.0, 614.0, 644.0, np.nan], nan_ok=True
    )
    assert frame_heights_m(survey_of(*frames[3:]), ground[3:]) == pytest.approx([644.0, np.nan], nan_ok=True)


def test_the_flat_ground_lies_at_the_median_of_absolute_minus_relative() -> None:
    both = tuple(with_height(a, r, 1.0) for a, r in ((620.0, 100.0), (625.0, 101.0), (700.0, 99.0)))
    assert ground_height_m(both) == pytest.approx(524.0)
    assert ground_height_m((with_height(620.0, None, 1.0), with_height(None, 100.0, 1.0))) is None


def test_the_papers_map_is_a_plane_at_the_ellipsoid() -> None:
    """A kilometre at 2000 m of height is 0.31 m longer than below it on the ellipsoid, where equation 4
    measures. At 1 km the Earth has sunk by 78 mm, which the plane doesn't follow."""
    high = LocalFrame(11.3, 48.1, 2000.0)
    llh = high.geodetic_from_enu(np.array([[1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0]]))
    plane, turn = FORMULAS["mid_latitude"](high, llh)
    exact, _ = FORMULAS["rigorous"](high, llh)
    assert exact == pytest.approx(np.array([[1000.0, 0.0, 0.0], [0.0, 1000.0, 0.0]]), abs=1e-6)
    assert [plane[0, 0], plane[1, 1]] == pytest.approx([999.687, 999.686], abs=0.003)
    assert plane[:, 2] == pytest.approx([0.078, 0.078], abs=0.001)
    assert turn == pytest.approx(np.tile(np.eye(3), (2, 1, 1)))


def grid(lines: int, each: int, serpentine: bool) -> np.ndarray:
    out = []
    for k in range(lines):
        east = np.arange(each) * 10.0
        out += [(e, 15.0 * k) for e in (east[::-1] if serpentine and k % 2 else east)]
    turn = np.radians(32.0)
    return np.array(out) @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])


@pytest.mark.parametrize("serpentine", [True, False])
@given(seed=st.integers(0, 10_000))
def test_flight_lines_of_a_block(serpentine: bool, seed: int) -> None:
    """Three lines of five frames each, flown to and fro or always the same way, 1 m off the plan."""
    at = grid(3, 5, serpentine) + np.random.default_rng(seed).uniform(-1.0, 1.0, (15, 2))
    assert flight_lines(at) == (0,) * 5 + (1,) * 5 + (2,) * 5


def test_a_gentle_curve_is_one_line_and_a_gap_begins_another() -> None:
    course = np.radians(np.arange(12) * 10.0)
    curve = np.cumsum(np.column_stack([np.sin(course), np.cos(course)]) * 8.0, axis=0)
    assert flight_lines(curve) == (0,) * 12
    gap = np.array([[0.0, 0], [10, 0], [20, 0], [61, 0], [71, 0]])
    assert flight_lines(gap) == (0, 0, 0, 1, 1)
    assert flight_lines(gap, gap=4.5) == (0,) * 5
    assert flight_lines(np.zeros((1, 2))) == (0,)


def test_hovering_is_no_turn() -> None:
    at = np.array([[0.0, 0], [10, 0], [20, 0], [20.1, 0.2], [20.0, 0.1], [30, 0], [40, 0]])
    assert flight_lines(at) == (0,) * 7


def square(east: float, side: float = 10.0) -> np.ndarray:
    return np.array([[east, 0.0], [east + side, 0.0], [east + side, side], [east, side]])


def test_pairs_come_by_falling_overlap() -> None:
    """Squares of 10 m at 0, 7, 12 and 60 m: the second and third share 5 m, the first two 3 m."""
    squares = [square(e) for e in (0.0, 7.0, 12.0, 60.0)]
    assert overlapping_pairs(squares, 0.0) == ((1, 2), (0, 1))
    assert overlapping_pairs(squares, 3.0) == ((1, 2), (0, 1), (0, 2))
    assert overlapping_pairs(squares, 3.0, most=1) == ((1, 2), (0, 1))
    assert overlapping_pairs(squares, 30.0)[-2:] == ((1, 3), (0, 3))
    assert overlapping_pairs([squares[0], squares[0][:2]], 1.0) == ()


def test_a_touch_of_grown_outlines_is_no_overlap() -> None:
    """13 m apart and grown by 1.6 m each they share 0.2 m x 13.2 m, 2.6 % of a square; at 1.55 m 1.3 %."""
    apart = [square(0.0), square(13.0)]
    assert overlapping_pairs(apart, 1.6) == ((0, 1),)
    assert overlapping_pairs(apart, 1.55) == ()


def test_connected_parts() -> None:
    assert connected_parts(7, [(5, 1), (1, 3), (0, 6)]) == [[1, 3, 5], [0, 6], [2], [4]]
    assert connected_parts(0, []) == []


def test_misplacement_by_hand() -> None:
    """At 100 m, position gives 1.5 m and tilt 100 m * 0.3 degrees = 0.524 m. Yaw gives half of the 50 m to a
    corner * 1 degree = 0.436 m. Together these are 1.648 m, and three times that is 4.943 m."""
    assert half_extent_m(CAMERA, 100.0) == pytest.approx(50.0)
    poses = Poses(
        np.array([[5.0, -3.0, 100.0]] * 2),
        np.tile(np.eye(3), (2, 1, 1)),
        np.array([[1.5, 1.5, 9.0], [0.0, 0.0, 0.0]]),
        np.radians([[0.3, 0.3, 1.0], [0.0, 0.0, 180.0]]),
    )
    assert misplacement_m(poses, [CAMERA] * 2, FLAT) == pytest.approx([4.9428, 75.0], abs=1e-3)
    assert misplacement_m(poses, [CAMERA] * 2, FLAT, sigmas=1.0)[0] == pytest.approx(1.6476, abs=1e-3)


@pytest.mark.proof
def test_the_papers_nine_frames_by_the_papers_recipe(tmp_path: Path) -> None:
    """Table 2 as it is printed. Between the first two frames lies a gap, so that the first stands alone and
    is named. Pitch, roll and heading as phi, omega and -kappa put the others on one another."""
    small = SurveyPlan(seed=3, kind="paper", scale=0.05, pos_in="csv", buildings=0.0)
    survey = simulate_frames(tmp_path / "survey", small)
    keys = ("lon_deg", "lat_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg")
    plan = SurveyPlan(kind="paper")
    rows = [
        [frame_name(plan, i), *(r[k] + (plan.ground_height_m if k == "height_m" else 0.0) for k in keys)]
        for i, r in enumerate(paper_table())
    ]
    columns = ("frame", "lon_deg", "lat_deg", "height_ellipsoidal_m", "yaw_deg", "pitch_deg", "roll_deg")
    write_csv(tmp_path / "table2.csv", columns, rows)
    recipe = load_recipe(
        Path(__file__).parents[2] / "recipes" / "paper.yaml",
        installed(),
        [
            f"survey.read.frames={survey.frames}",
            f"survey.read.pos={tmp_path / 'table2.csv'}",
            f"survey.read.camera={survey.camera}",
            f"projection.ground.height_m={plan.ground_height_m}",
        ],
    )
    summary = run(recipe, tmp_path / "run")
    assert [w["frame"] for w in summary["warnings"] if w["code"] == "no-tie-points"] == ["F0001.jpg"]
    assert summary["frames"] == {"total": 9, "tied": 8, "placed": 1, "rejected": 0}
    names = [row[0] for row in rows]
    true, found = (
        read_poses(path, names, HOME) for path in (survey.positions, tmp_path / "run" / "positions.csv")
    )
    apart = np.linalg.norm((found.positions_m - true.positions_m)[:, :2], axis=1)
    assert apart.max() < 1.5
    turned = np.arccos(
        np.clip((np.einsum("nij,nij->n", true.rotations, found.rotations) - 1.0) / 2.0, -1.0, 1.0)
    )
    assert np.degrees(turned).max() < 0.1


def flown_at(level_m: float, above_m: float, minute: int) -> list[Frame]:
    """Ten frames of a flight that took off level_m high, each second."""
    frames = [with_height(level_m + above_m, above_m, 15.0) for _ in range(10)]
    return [
        replace(f, name=f"DJI_{minute // 3 + k:04d}.JPG", time_s=1.7e9 + 60.0 * minute + k)
        for k, f in enumerate(frames)
    ]


@pytest.mark.parametrize(("second_m", "apart_m"), [(560.0, 60.0), (508.0, 0.0)])
def test_flights_count_from_their_own_take_off(second_m: float, apart_m: float) -> None:
    """Both 200 m above the first take-off; GNSS alone makes two flights differ by some metres."""
    frames = (*flown_at(500.0, 200.0, 0), *flown_at(second_m, 700.0 - second_m, 30))
    heights_m = frame_heights_m(survey_of(*frames), np.full(20, 500.0))
    assert heights_m[:10] == pytest.approx(np.full(10, 700.0 - apart_m / 2.0))
    assert heights_m[10:] - heights_m[:10] == pytest.approx(np.full(10, 500.0 + apart_m - second_m))


def test_a_frame_on_the_ground_leaves_a_low_flight_its_height() -> None:
    above_m = np.r_[np.full(60, 120.0), np.full(30, 30.0), 0.5]
    heights, replaced = possible_heights(FrameHeights(400.0 + above_m, np.full(91, 3.0)), np.full(91, 400.0))
    assert np.flatnonzero(replaced).tolist() == [90]
    assert heights.m[60:90] == pytest.approx(np.full(30, 430.0))


def test_frames_on_the_spot_ask_for_neighbours_too() -> None:
    """150 frames about one point: each meets all others, of which the nearest are enough."""
    rng = np.random.default_rng(2)
    at_m = rng.normal(0.0, 3.0, (150, 1, 2))
    square = np.array([[-20.0, -15.0], [20.0, -15.0], [20.0, 15.0], [-20.0, 15.0]])
    pairs = overlapping_pairs(list(square + at_m), 5.0)
    counts = np.bincount(np.ravel(pairs), minlength=150)
    assert counts.min() >= 12 and len(pairs) < 150 * 12
    apart_m = [float(np.linalg.norm(at_m[i] - at_m[j])) for i, j in pairs]
    everyone = np.linalg.norm(at_m[:, 0, None] - at_m[None, :, 0], axis=2)
    assert np.median(apart_m) < 0.5 * np.median(everyone)


def test_frames_that_hover_or_rise_have_no_course() -> None:
    """A line along 90 degrees with a stop of eight frames in it, by positions good to 0.2 m."""
    rng = np.random.default_rng(4)
    east_m = np.r_[np.arange(6) * 20.0, np.full(8, 100.0), 100.0 + np.arange(1, 7) * 20.0]
    at_m = np.column_stack([east_m, np.zeros(20)]) + rng.normal(0.0, 0.2, (20, 2))
    course = courses_deg(at_m, (0,) * 20)
    assert course[:5] == pytest.approx(np.full(5, 90.0), abs=3.0)
    assert np.isnan(course[7:13]).all() and not np.isnan(course[-5:]).any()
    assert np.isnan(courses_deg(rng.normal(0.0, 0.1, (20, 2)), (0,) * 20)).all()


def test_the_frames_of_a_capture_lie_in_one_line() -> None:
    """Five cameras, 1 cm apart by their tags, each 20 m."""
    rng = np.random.default_rng(5)
    at_m = np.repeat(np.column_stack([np.arange(30) * 20.0, np.zeros(30)]), 5, axis=0)
    assert max(flight_lines(at_m + rng.normal(0.0, 0.01, (150, 2)))) == 0
