"""Heights that drift bend no block, and what all heights may be off in common is stated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from adjustment_blocks import fly
from survey_files import survey_folder

from geomosaic.adjustment.height_datum import common_height_sd_m, with_common_height
from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Settings
from geomosaic.camera.exterior import Poses
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import ControlPoint, Survey
from geomosaic.survey.read import read_survey


@pytest.mark.parametrize("batteries", [False, True])
def test_heights_that_drift_by_twice_the_flying_height(batteries: bool) -> None:
    """100 m above the ground; no attitude. The positions in plan give the scale, to half a per cent here."""
    flown = fly(7, lines=2, per_line=4, points=250)
    n, poses = 8, flown.block.poses
    drift = np.where(np.arange(n) < 4, 0.0, 120.0) if batteries else np.linspace(0.0, 200.0, n)
    at = np.column_stack([poses.positions_m[:, :2], flown.truth.positions_m[:, 2] + drift])
    unknown = replace(
        poses,
        positions_m=at,
        rotations=np.tile(np.eye(3), (n, 1, 1)),
        positions_sd_m=np.tile([5.0, 5.0, 15.0], (n, 1)),
        rotations_sd_rad=np.radians(np.tile([10.0, 10.0, 180.0], (n, 1))),
    )
    adjusted = METHODS["bundle"](replace(flown.block, poses=unknown), Settings())
    (warning,) = [w for w in adjusted.warnings if w.code == "heights-drift"]
    told = ("jump by +120", "between 003.jpg and 004.jpg") if batteries else ("drift by +200", "to 007.jpg")
    assert all(words in warning.text for words in told)
    off = adjusted.poses.positions_m - flown.truth.positions_m
    assert off[:, 2].std() < 0.2
    z, w = (p.positions_m[:, :2] @ [1, 1j] for p in (adjusted.poses, flown.truth))
    turn = ((w - w.mean()) * (z - z.mean()).conj()).sum() / (np.abs(z - z.mean()) ** 2).sum()
    assert abs(turn) == pytest.approx(1.0, abs=0.05)


@pytest.fixture
def survey(tmp_path: Path) -> Survey:
    return read_survey(survey_folder(tmp_path, 6))


def test_a_survey_has_no_deviation_that_is_no_number(survey: Survey) -> None:
    """A replay fell where frames' reach was drawn. Found by `tools/fuzz.py`, seed 922, case 3535."""
    first, *others = survey.frames
    for wrong in (
        replace(first, attitude=replace(first.attitude, sd_tilt_deg=float("nan"))),
        replace(first, position=replace(first.position, sd_north_m=float("nan"))),
    ):
        with pytest.raises(ValueError, match="deviation"):
            replace(survey, frames=(wrong, *others))


def outcome(survey: Survey, off_m: np.ndarray) -> Adjusted:
    """All frames tied, and found so much below the heights they were given."""
    lonlat = np.array([[f.position.lon_deg, f.position.lat_deg] for f in survey.frames])
    heights = np.array([f.position.height_ellipsoidal_m or 0.0 for f in survey.frames]) - off_m
    n = len(survey.frames)
    poses = Poses(
        survey.work_frame.enu_from_geodetic(*lonlat.T, heights),
        np.tile(np.eye(3), (n, 1, 1)), np.full((n, 3), 0.2), np.full((n, 3), 0.01),
    )  # fmt: skip
    flat = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    cameras = tuple(survey.camera_of(i) for i in range(n))
    covariance = np.tile(np.diag([0.04] * 3 + [1e-4] * 3), (n, 1, 1))
    return Adjusted(poses, cameras, ("tied",) * n, (), (), flat, pose_covariance=covariance)


def test_an_unknown_datum_is_shared_by_all_frames(survey: Survey) -> None:
    """15 m of a receiver's own and 30 m of the sea's level about the ellipsoid."""
    adjusted = outcome(survey, np.full(6, 3.0))
    assert common_height_sd_m(survey, adjusted) == pytest.approx(np.hypot(15.0, 30.0), abs=1e-3)
    stated = with_common_height(adjusted, 15.0)
    assert stated.poses.positions_sd_m[3] == pytest.approx([0.2, 0.2, np.hypot(0.2, 15.0)])
    assert stated.pose_covariance is not None
    assert np.diag(stated.pose_covariance[3])[:3] == pytest.approx([0.04, 0.04, 225.04])


@pytest.mark.parametrize(
    ("ground_m", "stated_m"), [(-40.0, 800.0), (0.0, 800.0), (40.0, 800.0), (60.0, 30.0)]
)
def test_heights_that_may_count_from_the_take_off_tell_no_datum(
    survey: Survey, ground_m: float, stated_m: float
) -> None:
    """100 m above the ground. Dirty survey 1727 was 522 m higher than it said, with 15 m stated."""
    low = tuple(
        replace(f, position=replace(f.position, height_ellipsoidal_m=100.0 + ground_m)) for f in survey.frames
    )
    low_survey = replace(survey, frames=low)
    adjusted = outcome(low_survey, np.zeros(6))
    ground = replace(adjusted.ground, up_m=adjusted.poses.positions_m[:1, 2:] - 100.0)
    found_m = common_height_sd_m(low_survey, replace(adjusted, ground=ground))
    assert found_m == pytest.approx(np.hypot(15.0, stated_m), rel=1e-4)


def test_a_drift_is_shared_too_and_control_holds_all(survey: Survey) -> None:
    adjusted = outcome(survey, np.arange(6) * 20.0)
    assert common_height_sd_m(survey, adjusted) == pytest.approx(
        np.hypot(np.hypot(15.0, 30.0), 1.4826 * 30.0), rel=0.01
    )
    image = (survey.frames[0].name, 10.0, 10.0)
    point = ControlPoint("A", 9.12, 48.77, 400.0, 0.03, 0.05, check=False, images=(image,))
    assert common_height_sd_m(replace(survey, control=(point,)), adjusted) == 0.0
    in_plan = replace(point, plan_only=True)
    assert common_height_sd_m(replace(survey, control=(in_plan,)), adjusted) > 30.0
    pos = tuple(
        replace(f, position=replace(f.position, source="pos", sd_vertical_m=3.0)) for f in survey.frames
    )
    assert common_height_sd_m(replace(survey, frames=pos), outcome(survey, np.arange(6) * 1.0)) == 0.0
    assert common_height_sd_m(replace(survey, frames=pos), adjusted) == pytest.approx(1.4826 * 30.0, rel=0.01)
