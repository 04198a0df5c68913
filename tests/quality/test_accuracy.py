"""Accuracy in metres: by check points, by the covariance of places; the standard's sentence."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from geomosaic.adjustment.ground_places import GroundPlaces
from geomosaic.adjustment.model import Adjusted, ControlResidual
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.geodesy.local import LocalFrame
from geomosaic.projection.ground import flat_ground
from geomosaic.quality.accuracy import (
    AbsoluteAccuracy,
    RelativeAccuracy,
    Requirement,
    accuracy_of,
    usual_requirement,
)
from geomosaic.quality.seam_check import SeamCheck
from geomosaic.quality.statement import answers, asprs_class_cm, asprs_statement

HOME = LocalFrame(8.5, 47.3, 400.0)
SQUARE = np.array([[0.0, 0.0, 0.0], [120.0, 0.0, 1.0], [0.0, 90.0, 2.0], [120.0, 90.0, 3.0]])
NO_SEAMS = SeamCheck(
    *(np.zeros(0, dtype=np.int64),) * 2, np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros((0, 2))
)


def adjusted(places: GroundPlaces | None, *control: ControlResidual, spread_m: float = 30.0) -> Adjusted:
    """Five frames in a line 2 spread_m long."""
    line = np.column_stack([np.linspace(-spread_m, spread_m, 5), np.zeros(5), np.full(5, 80.0)])
    poses = Poses(line, np.tile(np.eye(3), (5, 1, 1)), np.ones((5, 3)), np.ones((5, 3)))
    ground = flat_ground(HOME, 100.0, 100.0)
    camera = Camera("cam", 800, 600, 700.0, 400.0, 300.0)
    status = ("tied",) * 5
    return Adjusted(poses, (camera,) * 5, status, (), (), ground, control=control, places=places)


def place_errors(*columns: np.ndarray) -> GroundPlaces:
    """Places that are off by each of these (k, 3), one deviation, independently."""
    design = np.stack([c.ravel() for c in columns], axis=1)
    return GroundPlaces(SQUARE, design @ design.T)


def check(residual_m: tuple[float, float, float], surveyed_m: float = 0.0) -> ControlResidual:
    return ControlResidual("c", True, 3, np.array(residual_m), np.full(3, 0.05), np.full(3, surveyed_m))


def test_a_shift_in_common_is_absolute_alone() -> None:
    shift = np.tile([1.2, -0.5, 0.0], (4, 1))
    found = accuracy_of(adjusted(place_errors(shift)), float("nan"), 0.02)
    assert found.absolute.rmse_h_m == pytest.approx(1.3)
    assert found.absolute.ce90_m == pytest.approx(np.sqrt(np.log(10.0)) * 1.3)
    assert found.absolute.rmse_v_m == pytest.approx(0.0) and found.absolute.how == "estimated"
    assert found.relative.scale_permille == pytest.approx(0.0, abs=1e-9)
    assert found.relative.rmse_100m_m == pytest.approx(0.0, abs=1e-7)


def test_a_scale_is_relative_and_a_turn_is_not() -> None:
    """2 per mille: 0.24 m over 120 m, 0.3 m over the diagonal of 150 m; a turn keeps every length."""
    centred = SQUARE - SQUARE.mean(axis=0)
    scaled = accuracy_of(adjusted(place_errors(2e-3 * centred * [1, 1, 0])), float("nan"), 0.02).relative
    assert scaled.scale_permille == pytest.approx(2.0)
    assert scaled.whole_m == pytest.approx(150.0)
    assert scaled.permille == pytest.approx(2.0, rel=0.12)
    # of sides of 90 and 120 m, all within 70 to 140 m
    assert scaled.rmse_100m_m == pytest.approx(2e-3 * np.sqrt((90.0**2 + 120.0**2) / 2.0))
    free = accuracy_of(adjusted(place_errors(2e-3 * centred * [1, 1, 0])), float("nan"), 0.02, placed=False)
    assert free.relative.scale_permille == pytest.approx(2.0)
    assert free.relative.rmse_whole_m == pytest.approx(0.0, abs=1e-7)
    turned = np.column_stack([-centred[:, 1], centred[:, 0], np.zeros(4)]) * 3e-3
    still = accuracy_of(adjusted(place_errors(turned)), float("nan"), 0.02).relative
    assert still.scale_permille == pytest.approx(0.0, abs=1e-9)
    assert still.rmse_100m_m == pytest.approx(0.0, abs=1e-7)


def test_a_stretch_along_east_is_of_lengths_along_east() -> None:
    east = (SQUARE - SQUARE.mean(axis=0)) * [5e-3, 0.0, 0.0]
    found = accuracy_of(adjusted(place_errors(east)), float("nan"), 0.02).relative
    assert found.rmse_100m_m == pytest.approx(5e-3 * 120.0 / np.sqrt(2.0))
    # least squares of scale over a rectangle: east's share of the inertia
    assert found.scale_permille == pytest.approx(5.0 * 60.0**2 / (60.0**2 + 45.0**2))


def test_what_seams_miss_is_in_distances_and_half_of_it_in_places() -> None:
    """2 px of 0.05 m, median of a plane error: 0.0849 m a coordinate between two frames."""
    none = place_errors(np.zeros((4, 3)))
    found = accuracy_of(adjusted(none), 2.0, 0.05)
    of_two_m = 0.1 / np.sqrt(2.0 * np.log(2.0))
    assert found.relative.rmse_100m_m == pytest.approx(np.sqrt(2.0) * of_two_m)
    assert found.absolute.rmse_h_m == pytest.approx(np.sqrt(2.0) * of_two_m)


def test_check_points_measure_with_shift_scatter_and_their_own_accuracy() -> None:
    """Residuals are surveyed minus map: the map's errors are their opposites."""
    points = check((-0.3, 0.1, 0.2)), check((-0.5, 0.1, 0.2)), check((-0.4, 0.4, 0.2))
    found = accuracy_of(adjusted(None, *points), float("nan"), 0.02).absolute
    assert found.how == "measured" and found.check_points == 3
    assert found.shift_m == pytest.approx([0.4, -0.2, -0.2])
    assert found.scatter_m == pytest.approx([np.sqrt(0.02 / 3), np.sqrt(0.06 / 3), 0.0])
    assert found.rmse_h_m == pytest.approx(np.sqrt((0.09 + 0.25 + 0.16 + 0.01 + 0.01 + 0.16) / 3.0))
    known_to = [replace(p, surveyed_sd_m=np.full(3, 0.3)) for p in points]
    more = accuracy_of(adjusted(None, *known_to), float("nan"), 0.02).absolute
    assert more.rmse_h_m == pytest.approx(np.hypot(found.rmse_h_m, np.sqrt(2.0) * 0.3))
    assert accuracy_of(adjusted(None, *points[:2]), float("nan"), 0.02).absolute.how == "not stated"


def test_what_nothing_states_is_not_stated() -> None:
    found = accuracy_of(adjusted(None), 0.3, 0.02)
    assert math.isnan(found.absolute.rmse_h_m) and math.isnan(found.relative.permille)
    asked = Requirement(0.05, math.nan, 1.0, "as asked for", 0.05)
    said = dict(answers(found, asked, NO_SEAMS, 0.02))
    assert said["required"] == "horizontal RMSE 5.0 cm, distances 1 per mille: as asked for"
    assert said["absolute accuracy"].startswith("not stated: ")
    assert said["relative accuracy"] == "not stated by this adjustment method"
    some = dict(answers(found, replace(asked, permille=147.3), NO_SEAMS, 0.02))["required"]
    assert "distances 150 per mille" in some
    at_one_place = dict(answers(found, replace(asked, permille=3800.0), NO_SEAMS, 0.02))["required"]
    assert "distances none" in at_one_place and "3.8e+03" not in at_one_place
    assert asprs_statement(found.absolute) == ""


def test_the_usual_requirement_is_what_the_inputs_can_give() -> None:
    """Five metres over frames that spread by 67 m (root of the sum of squares) are 75 per mille."""
    gnss = usual_requirement(adjusted(None), np.full(5, 5.0), 0.02)
    assert gnss.rmse_h_m == pytest.approx(np.sqrt(2.0) * 5.0) and math.isnan(gnss.rmse_v_m)
    spread_m = np.sqrt(2 * 30.0**2 + 2 * 15.0**2)
    assert gnss.permille == pytest.approx(1000.0 * 5.0 / spread_m)
    assert usual_requirement(adjusted(None, spread_m=3000.0), np.full(5, 2.0), 0.02).permille == 3.0
    rtk = usual_requirement(adjusted(None), np.full(5, 0.03), 0.02)
    assert rtk.rmse_h_m == pytest.approx(0.06) and rtk.permille == pytest.approx(1000.0 * 0.03 / spread_m)
    wide = usual_requirement(adjusted(None, spread_m=3000.0), np.full(5, 0.03), 0.02)
    assert wide.permille == pytest.approx(0.6)
    used = [replace(check((0.0, 0.0, 0.0)), check=False)] * 3
    assert usual_requirement(adjusted(None, *used), np.full(5, 5.0), 0.03).rmse_h_m == pytest.approx(0.09)
    nothing = usual_requirement(adjusted(None), np.zeros(0), 0.03)
    assert math.isnan(nothing.rmse_h_m) and math.isnan(nothing.permille)
    said = dict(answers(accuracy_of(adjusted(None), 0.3, 0.03), nothing, NO_SEAMS, 0.03))
    assert said["required"] == "nothing: no frame has a position"

    def unscaled(relative: RelativeAccuracy) -> str:
        accuracy = replace(accuracy_of(adjusted(None), 0.3, 0.03), relative=relative)
        return answers(accuracy, nothing, NO_SEAMS, 0.03)[1][1]

    within = RelativeAccuracy(5.0, 0.5, 0.9, 180.0)
    assert unscaled(within) == "RMSE of distances 30.0 px over 6000 px once it is scaled; scale unknown"
    assert "not determined: give a calibrated lens" in unscaled(replace(within, rmse_whole_m=15_000.0))
    handheld = [replace(p, surveyed_sd_m=np.array([2.0, 2.5, 5.0])) for p in used]
    by_hand = usual_requirement(adjusted(None, *handheld), np.full(5, 5.0), 0.03)
    assert by_hand.rmse_h_m == pytest.approx(np.sqrt(2.0) * 2.5) and "control points" in by_hand.why


@pytest.mark.parametrize(("rmse_m", "class_cm"), [(0.0312, 3.2), (0.03, 3.0), (0.996, 100.0), (3.557, 360.0)])
def test_a_class_is_met_by_two_digits_upwards(rmse_m: float, class_cm: float) -> None:
    assert asprs_class_cm(rmse_m) == pytest.approx(class_cm)


def test_the_standards_sentence_says_how_many_points_there_were() -> None:
    none = np.full(3, np.nan)
    estimated = asprs_statement(AbsoluteAccuracy(0.05, 0.08, "estimated", 0, none, none))
    assert "produced to meet" in estimated and "5 cm RMSEH" in estimated and "check points" not in estimated
    few = asprs_statement(AbsoluteAccuracy(0.05, 0.08, "measured", 12, none, none))
    assert "minimum of 30" in few and "only 12 check points" in few and "RMSEV = 8.0 cm" in few
    tested = asprs_statement(AbsoluteAccuracy(0.05, 0.08, "measured", 30, none, none))
    assert "tested to meet" in tested and "only" not in tested


def test_a_shift_that_check_points_measured_does_not_widen_ce90() -> None:
    """Errors are 2 m east, 0.5 m south and 3 m up in common, with 5 cm of scatter. 90 % of 100,000 drawn
    errors are shorter than 2.126 m, and of heights than 3.064 m."""
    spread = 0.05 * np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0], [-1.0, -1.0, 1.0]])
    points = tuple(check((-2.0 + e, 0.5 + n, -3.0 + u)) for e, n, u in spread)
    absolute = accuracy_of(adjusted(None, *points), float("nan"), 0.02).absolute
    assert absolute.shifted
    assert absolute.ce90_m == pytest.approx(2.126, abs=0.002)
    assert absolute.ce90_m < absolute.circle_m(0.95) < 1.7308 * absolute.rmse_h_m
    assert absolute.le90_m == pytest.approx(3.064, abs=0.002)
    scattered = tuple(check((1.3 * e / 0.05, 0.0, u)) for e, _, u in spread)
    absolute = accuracy_of(adjusted(None, *scattered), float("nan"), 0.02).absolute
    assert not absolute.shifted and absolute.ce90_m == pytest.approx(np.sqrt(np.log(10.0)) * 1.3)


def test_land_is_as_accurate_relative_to_the_land_around_as_distances_are_asked_to() -> None:
    """By GNSS 3 per mille of 100 m, however small the block; by RTK three pixels; else what a user asks."""
    gnss = usual_requirement(adjusted(None), np.full(5, 5.0), 0.02)
    assert gnss.local_m == pytest.approx(0.3)
    assert usual_requirement(adjusted(None), np.full(5, 0.03), 0.02).local_m == pytest.approx(0.06)
    assert usual_requirement(adjusted(None), np.full(5, 5.0), 0.5).local_m == pytest.approx(1.5)
    assert gnss.asked(0.05, None, None) == Requirement(
        0.05, pytest.approx(math.nan, nan_ok=True), gnss.permille, "as asked for", 0.05
    )
    assert gnss.asked(None, None, 1.0).local_m == pytest.approx(0.1)
    assert gnss.asked(0.5, None, 1.0).local_m == pytest.approx(0.1)
    assert gnss.asked(None, None, None) is gnss


def test_check_points_without_a_height_say_nothing_of_heights() -> None:
    """Four are surveyed to 1 cm; the fifth has no height, whose deviation is 100 km."""
    nowhere = check((0.02, 0.01, 0.0))
    unknown = np.array([0.01, 0.01, 1e5])
    nowhere = replace(nowhere, sd_m=unknown, surveyed_sd_m=unknown)
    points = [check((0.02, 0.01, 0.03 * s), 0.01) for s in (1.0, -1.0, 1.0, -1.0)]
    nothing = Requirement(math.nan, math.nan, math.nan, "nobody's demand", 0.06)
    found = accuracy_of(adjusted(None, *points, nowhere), float("nan"), 0.02)
    assert found.absolute.rmse_v_m == pytest.approx(np.hypot(0.03, 0.01))
    said = dict(answers(found, nothing, NO_SEAMS, 0.02))["absolute accuracy"]
    assert "m up" in said and "nan" not in said
    only = accuracy_of(adjusted(None, *[nowhere] * 4), float("nan"), 0.02)
    assert "north; scatter" in dict(answers(only, nothing, NO_SEAMS, 0.02))["absolute accuracy"]


def test_what_is_asked_of_a_map_without_scale_stays_in_pixels() -> None:
    nothing = Requirement(math.nan, math.nan, math.nan, "no frame has a position", 0.06, scaled=False)
    asked = nothing.asked(0.05, None, None)
    assert not asked.scaled and asked.rmse_h_m == 0.05 and asked.local_m == 0.06


def test_a_map_that_nothing_places_states_no_absolute_accuracy() -> None:
    found = accuracy_of(adjusted(place_errors(np.tile([1.2, -0.5, 0.0], (4, 1)))), np.nan, 0.02, placed=False)
    assert found.absolute.how == "not stated" and np.isnan(found.absolute.rmse_h_m)
    assert found.relative.rmse_100m_m == pytest.approx(0.0, abs=1e-7)


def test_heights_that_may_count_from_anywhere_state_no_accuracy() -> None:
    """800 m is what land may lie above the sea, which heights above the take-off leave out."""
    nothing = Requirement(math.nan, math.nan, math.nan, "GNSS positions", math.nan)
    for rmse_m, says in ((45.0, "vertical RMSE 45.00 m"), (800.0, "heights not known")):
        unmeasured = np.full(3, np.nan)
        absolute = AbsoluteAccuracy(1.0, rmse_m, "estimated", 0, unmeasured, unmeasured)
        its = replace(accuracy_of(adjusted(None), math.nan, 0.02), absolute=absolute)
        said = dict(answers(its, nothing, NO_SEAMS, 0.02))["absolute accuracy"]
        assert says in said
        assert "800" not in said


def test_large_maps_state_distances_too() -> None:
    """Places 1 km apart, whose errors are a scale of 1 per mille: 0.1 m over 100 m between them."""
    corners = np.array([[0.0, 0.0, 0.0], [3000.0, 0.0, 0.0], [0.0, 3000.0, 0.0], [3000.0, 3000.0, 0.0]])
    middle = np.array([[1000.0, 1000.0, 0.0], [2000.0, 1000.0, 0.0], [1500.0, 2000.0, 0.0]])
    at_m = np.concatenate([corners, middle])
    errors_m = (1e-3 * (at_m - at_m.mean(axis=0)))[None]
    places = GroundPlaces(at_m, np.einsum("na,nb->ab", *[errors_m.reshape(1, -1)] * 2))
    found = accuracy_of(adjusted(places), math.nan, 0.02).relative
    assert found.rmse_100m_m == pytest.approx(0.1, rel=1e-3)
    assert found.permille == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize(("shift_m", "shifted"), [(0.06, False), (1.0, True)])
def test_few_check_points_show_a_common_shift_where_chance_does_not(shift_m: float, shifted: bool) -> None:
    """Three points with a scatter of 0.05 m."""
    scatter_m = np.full(3, 0.05)
    its = AbsoluteAccuracy(0.1, 0.1, "measured", 3, np.array([shift_m, 0.0, 9.0]), scatter_m)
    assert its.shifted is shifted
