"""Implausible tags: heights on the ground, quarter turns of images that lie as all others do."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mosaic_scenes import HOME, make_survey

from geomosaic.camera.interior import Camera
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.turned import possible_quarters, turned_frames
from geomosaic.pipeline.reporter import warning_lines
from geomosaic.pipeline.stage import Context
from geomosaic.placement.graph import adjacent_frames
from geomosaic.placement.heights import FrameHeights, ground_height_m, possible_heights, with_any_height
from geomosaic.stages.placement_pos import placement_pos
from geomosaic.survey.model import Attitude, Frame, Position, Survey


def frame(height_m: float | None, above_m: float | None) -> Frame:
    position = Position(11.0, 48.0, height_m, above_m, 5.0, 5.0, 15.0, "exif")
    attitude = Attitude(None, None, None, 180.0, 10.0, "none")
    return Frame("a.jpg", "a.jpg", 800, 600, 3, "uint8", "plain", position, attitude, None)


def test_heights_that_drift_below_the_ground_are_implausible_where_they_are_far_off() -> None:
    """Over ground at 300 m: reported are 290, 310, 365, 370, 380, 420, 600 m; 65 to 80 m above it is usual."""
    reported = np.array([290.0, 310.0, 365.0, 370.0, 380.0, 420.0, 600.0])
    heights, implausible = possible_heights(FrameHeights(reported, np.full(7, 15.0)), np.full(7, 300.0))
    assert implausible.tolist() == [True, True, False, False, False, False, True]
    assert heights.m.tolist() == [370.0, 370.0, 365.0, 370.0, 380.0, 420.0, 370.0]
    assert heights.sd_m.tolist() == [35.0, 35.0, 15.0, 15.0, 15.0, 15.0, 35.0]


def test_a_frame_on_the_ground_is_called_taken_to_fly_as_others_do(tmp_path: Path) -> None:
    """Before take-off, 0.3 m above it; the others fly 48 m above the ground."""
    survey, poses, ground = make_survey(tmp_path / "frames", lines=1, per_line=4)
    ups = [0.3, 48.0, 48.0, 48.0]
    high = HOME.geodetic_from_enu(np.column_stack([poses.positions_m[:, :2], ups]))[:, 2]
    frames = tuple(
        replace(f, position=replace(f.position, height_ellipsoidal_m=float(h)))
        for f, h in zip(survey.frames, high, strict=True)
    )
    context = Context(tmp_path / "run")
    asked = {"levelled_survey": replace(survey, frames=frames), "prior_ground": ground}
    placed = placement_pos().run(asked, placement_pos.Params(), context)["prior_placement"]
    assert placed.poses.positions_m[:, 2] == pytest.approx([48.0] * 4, abs=0.01)
    (warning,) = [w for w in context.notes.warnings if w["code"] == "height-implausible"]
    assert warning["frame"] == "frame 00.tif"
    assert "taken to fly 48 m above the ground, as others do" in warning["text"]


def test_heights_above_the_ground_stay_as_reported() -> None:
    """A climb from 12 m to 120 m is no fault; nor is a whole survey under its DEM one of the frames'."""
    climb, ground = np.array([312.0, 350.0, 400.0, 420.0]), np.full(4, 300.0)
    assert not possible_heights(FrameHeights(climb, np.full(4, 15.0)), ground)[1].any()
    assert not possible_heights(FrameHeights(climb - 300.0, np.full(4, 15.0)), ground)[1].any()


def test_a_height_of_nothing_above_the_take_off_says_no_ground() -> None:
    assert ground_height_m((frame(420.0, 80.0), frame(424.0, 82.0))) == pytest.approx(341.0)
    assert ground_height_m((frame(420.0, 0.0), frame(424.0, 0.0))) is None
    assert ground_height_m((frame(420.0, None),)) is None


@pytest.mark.parametrize(
    ("reported", "flown_m"),
    [((None, None, None), 120.0), ((None, 58.0, 62.0), 60.0), ((0.0, 0.0, 0.0), 120.0)],
)
def test_a_survey_without_positions_flies_as_high_as_frames_report(
    reported: tuple[float | None, ...], flown_m: float
) -> None:
    """A unit is near a metre, so that limits in metres and in metres a second hold."""
    lens = Camera("plain", 800, 600, 700.0, 400.0, 300.0)
    frames = tuple(frame(None, above_m) for above_m in reported)
    survey, level = with_any_height(Survey(frames, (lens,), LocalFrame(11.0, 48.0, 0.0), "EPSG:32632"))
    assert {f.position.height_above_ground_m for f in survey.frames} == {flown_m} and level == 0.0


def test_only_an_image_that_lies_across_can_have_been_turned_by_a_quarter() -> None:
    possible = possible_quarters([(3600, 2700), (3600, 2700), (2700, 3600), (1000, 1000), (800, 600)])
    half, any_of = [True, False, True, False], [True] * 4
    assert possible.tolist() == [half, half, any_of, any_of, half]
    costs = np.full((4, 4), 28.0)
    costs[1, 0] = 1.0
    pairs = [(0, 1, costs), (0, 2, costs)]
    assert turned_frames(3, pairs, 30.0) == {0: 1}
    assert turned_frames(3, pairs, 30.0, possible_quarters([(800, 600)] * 3)) == {}


def test_many_alike_warnings_are_one_line() -> None:
    """More than three frames with one code; what concerns no frame, and other codes, stay apart."""
    many = [{"code": "yaw-wrong", "frame": f"F{i}", "text": f"its heading is {i}"} for i in range(1, 6)]
    few = [{"code": "horizon", "frame": f"F{i}", "text": "looks up"} for i in (1, 2)]
    none = [{"code": "scale-doubtful", "frame": "", "text": "too large"}]
    assert warning_lines([*few[:1], *many, *none, *few[1:]]) == [
        "F1: looks up",
        "5 frames alike (F1, F2, F3 and 2 more), such as F1: its heading is 1",
        "too large",
        "F2: looks up",
    ]


def test_a_frame_that_overlaps_none_is_tried_with_those_flown_before_and_after() -> None:
    order = (4, 2, 0, 1, 3)
    assert adjacent_frames({0}, order, []) == [(0, 1), (0, 2), (0, 3), (0, 4)]
    assert adjacent_frames({4}, order, [(2, 4)]) == [(0, 4)]
    assert adjacent_frames((), order, []) == []
