"""The simulated flight: places and headings as planned, the paper's table, noise as stated."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Geod

from geomosaic.camera.rotation import Rotation
from geomosaic.errors import InputError, UnknownNameError
from geomosaic.projection.footprint import footprint, ground_from_image, ground_sampling_distance_m
from geomosaic_simulate.flight import fly, observe, paper_table
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import world_of

GEOD = Geod(ellps="WGS84")
STILL = {"wander_m": 0.0, "wander_tilt_deg": 0.0, "wander_yaw_deg": 0.0}


def test_a_block_lies_as_planned() -> None:
    plan = SurveyPlan(
        heading_deg=30.0, lines=3, frames_per_line=5, forward_overlap=0.8, side_overlap=0.4, **STILL
    )
    flight = fly(plan)
    at = flight.lon_lat_height
    azimuth, _, base = GEOD.inv(*at[0, :2], *at[1, :2])
    assert azimuth == pytest.approx(30.0, abs=0.01)
    assert base == pytest.approx(0.2 * 750 * 0.1, abs=0.003)
    azimuth, _, apart = GEOD.inv(*at[0, :2], *at[9, :2])
    assert azimuth == pytest.approx(120.0, abs=0.01)
    assert apart == pytest.approx(0.6 * 1000 * 0.1, abs=0.006)
    np.testing.assert_allclose(at[:, 2], 620.0)
    np.testing.assert_allclose(flight.yaw_pitch_roll_deg[[0, 5, 10], 0], [30.0, 210.0, 30.0])
    assert (np.diff(flight.time_s) > 1.0).all()
    assert at[:, 0].mean() == pytest.approx(11.3, abs=1e-7)


def test_without_serpentine_every_line_is_flown_alike() -> None:
    flight = fly(SurveyPlan(serpentine=False, lines=2, **STILL))
    np.testing.assert_allclose(flight.yaw_pitch_roll_deg[:, 0], 32.0)
    assert GEOD.inv(*flight.lon_lat_height[4, :2], *flight.lon_lat_height[5, :2])[0] == pytest.approx(
        32.0, abs=0.01
    )


def test_overlap_is_what_the_images_show() -> None:
    plan = SurveyPlan(kind="line", frames_per_line=3, forward_overlap=0.6, heading_deg=0.0, **STILL)
    flight, camera = fly(plan), plan.camera()
    ground = world_of(plan, flight).surface_under(flight.poses[0], camera)
    bounds = [footprint(flight.poses[i], camera, ground)[:, 1] for i in range(2)]
    length = np.ptp(bounds[0])
    assert (bounds[0].max() - bounds[1].min()) / length == pytest.approx(0.6, abs=0.01)
    assert ground_sampling_distance_m(flight.poses[1], camera, ground) == pytest.approx(0.1, abs=1e-4)


def test_the_papers_survey() -> None:
    table = paper_table()
    assert len(table) == 9
    assert table[4] == {"pitch_deg": 3.16, "roll_deg": 0.02, "heading_deg": 112.5597, "height_m": 1474.0,
                        "lon_deg": 87.4069, "lat_deg": 42.0911}  # fmt: skip
    plan = SurveyPlan(kind="paper", k1=0.0, k2=0.0, ground_height_m=0.0)
    flight, camera = fly(plan), plan.camera()
    assert (camera.width_px, camera.height_px, plan.frames) == (5344, 4008, 9)
    ground = world_of(plan, flight).surface_under(flight.poses[0], camera)
    assert ground_sampling_distance_m(flight.poses[0], camera, ground) == pytest.approx(0.1, abs=4e-4)
    apart = [
        GEOD.inv(*a[:2], *b[:2])[2]
        for a, b in zip(flight.lon_lat_height, flight.lon_lat_height[1:], strict=False)
    ]
    assert apart[0] == pytest.approx(511.7, abs=2.0)
    assert max(apart[1:]) < 400.0

    middle = np.array([camera.width_px / 2.0, camera.height_px / 2.0])
    seen = ground_from_image(flight.poses[0], camera, ground, middle)
    lon, lat, _ = flight.work_frame.geodetic_from_enu(seen)
    azimuth, _, ahead = GEOD.inv(*flight.lon_lat_height[0, :2], lon, lat)
    assert ahead == pytest.approx(1475.0 * np.tan(np.radians(3.01)), rel=0.01)
    assert azimuth == pytest.approx(-2.09, abs=0.3), "equation 1 tilts about west and north, before kappa"
    top = ground_from_image(flight.poses[0], camera, ground, middle - [0.0, 500.0])
    lon_top, lat_top, _ = flight.work_frame.geodetic_from_enu(top)
    assert GEOD.inv(lon, lat, lon_top, lat_top)[0] == pytest.approx(112.69, abs=0.05)


def test_the_paper_at_a_quarter() -> None:
    plan = SurveyPlan(kind="paper", scale=0.25)
    camera = plan.camera()
    assert (camera.width_px, camera.height_px) == (1336, 1002)
    assert plan.pixel_m == 0.4
    assert camera.focal_length_px == 1475.0 / 0.4


def test_noise_has_the_stated_size_and_no_bias() -> None:
    plan = SurveyPlan(lines=40, frames_per_line=50, position_sd_m=1.5, height_sd_m=4.0, tilt_sd_deg=0.3,
                      yaw_sd_deg=2.0)  # fmt: skip
    flight = fly(plan)
    observed = observe(plan, flight)
    said = flight.work_frame.enu_from_geodetic(*observed.lon_lat_height.T)
    errors = np.column_stack([
        said - flight.poses.positions_m,
        (observed.yaw_pitch_roll_deg - flight.yaw_pitch_roll_deg + 180.0) % 360.0 - 180.0,
    ])  # fmt: skip
    sd = np.array([1.5, 1.5, 4.0, 2.0, 0.3, 0.3])
    np.testing.assert_allclose(errors.std(axis=0) / sd, 1.0, atol=0.065)
    assert (np.abs(errors.mean(axis=0)) < 4.0 * sd / np.sqrt(2000)).all()
    correlation = np.corrcoef(errors.T) - np.eye(6)
    assert np.abs(correlation).max() < 0.1
    np.testing.assert_allclose(errors[:, :3], observed.position_errors_m, atol=1e-6)


def test_one_noise_does_not_disturb_another() -> None:
    plan = SurveyPlan()
    louder = SurveyPlan(position_sd_m=3.0, yaw_sd_deg=0.0)
    a, b = observe(plan, fly(plan)), observe(louder, fly(louder))
    np.testing.assert_allclose(b.position_errors_m, a.position_errors_m * [2.0, 2.0, 1.0])
    np.testing.assert_array_equal(b.attitude_errors_deg[:, 0], 0.0)
    np.testing.assert_array_equal(b.attitude_errors_deg[:, 1:], a.attitude_errors_deg[:, 1:])


def test_lies_on_purpose() -> None:
    quiet = {"position_sd_m": 0.0, "height_sd_m": 0.0, "tilt_sd_deg": 0.0, "yaw_sd_deg": 0.0}
    lies = {"gps_outliers": 2, "gps_outlier_m": 80.0, "yaw_wrong_share": 0.25, "gps_lag_s": 0.5}
    plan = SurveyPlan(
        lines=2, frames_per_line=8, heading_deg=90.0, speed_m_per_s=6.0, **lies, **quiet, **STILL
    )
    observed = observe(plan, fly(plan))
    assert observed.outlier.sum() == 2 and observed.yaw_wrong.sum() == 4
    far = np.linalg.norm(observed.position_errors_m[:, :2], axis=1)
    assert (far[observed.outlier] > 76.0).all()
    lagging = observed.position_errors_m[~observed.outlier]
    east = np.where(np.arange(16) < 8, -3.0, 3.0)[~observed.outlier]
    np.testing.assert_allclose(lagging, np.column_stack([east, 0.0 * east, 0.0 * east]), atol=1e-9)
    wrong = (observed.attitude_errors_deg[observed.yaw_wrong, 0] + 180.0) % 360.0 - 180.0
    assert (np.abs(wrong) >= 30.0).all()
    assert not observed.attitude_errors_deg[~observed.yaw_wrong].any()


def test_a_line_keeps_the_heading_of_the_one_before() -> None:
    plan = SurveyPlan(lines=3, frames_per_line=4, stale_yaw_line=2, heading_deg=20.0)
    flight = fly(plan)
    plain, observed = (
        observe(SurveyPlan(lines=3, frames_per_line=4, heading_deg=20.0), flight),
        observe(plan, flight),
    )
    kept = [0, 1, 2, 3, 8, 9, 10, 11]
    np.testing.assert_allclose(observed.yaw_pitch_roll_deg[4:8, 0], plain.yaw_pitch_roll_deg[3, 0])
    np.testing.assert_array_equal(observed.yaw_pitch_roll_deg[kept], plain.yaw_pitch_roll_deg[kept])
    np.testing.assert_array_equal(observed.yaw_wrong, [False] * 4 + [True] * 4 + [False] * 4)
    off = (observed.attitude_errors_deg[4:8, 0]) % 360.0
    np.testing.assert_allclose(off, 180.0, atol=12.0)
    np.testing.assert_array_equal(observed.attitude_errors_deg[:, 1:], plain.attitude_errors_deg[:, 1:])


def test_absolute_heights_drift_with_time() -> None:
    plan = SurveyPlan(lines=2, frames_per_line=3, height_bias_m=-40.0, height_drift_m=12.0, height_sd_m=0.0)
    flight = fly(plan)
    observed = observe(plan, flight)
    share = (flight.time_s - flight.time_s[0]) / np.ptp(flight.time_s)
    assert share[1] < 0.2 < share[3], "between the lines time passes"
    np.testing.assert_allclose(observed.position_errors_m[:, 2], -40.0 + 12.0 * share)
    above = flight.lon_lat_height[:, 2] - plan.ground_height_m
    np.testing.assert_allclose(observed.height_above_take_off_m, above, atol=1e-4)
    said = flight.work_frame.enu_from_geodetic(*observed.lon_lat_height.T)
    np.testing.assert_allclose((said - flight.poses.positions_m)[[0, -1], 2], [-40.0, -28.0], atol=1e-6)


def test_poses_stand_on_each_frames_own_vertical() -> None:
    plan = SurveyPlan(kind="line", frames_per_line=2, forward_overlap=0.0, height_px=20000, lat_deg=60.0,
                      heading_deg=90.0, **STILL)  # fmt: skip
    flight = fly(plan)
    yaw, pitch, _ = Rotation(flight.poses.rotations).yaw_pitch_roll()
    bend_deg = np.degrees(2000.0 / 6.39e6)
    assert np.degrees(yaw[1] - yaw[0]) == pytest.approx(-bend_deg * np.tan(np.radians(60.0)), rel=0.01)
    assert np.degrees(pitch[1] - pitch[0]) == pytest.approx(-bend_deg, rel=0.01)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"kind": "blok"}, "did you mean 'block'"),
        ({"format": "png"}, "unknown frame format 'png'"),
        ({"turned": "3-x"}, "'3-x' names no frames of 1 to 12"),
        ({"turned": "11-13"}, "'11-13' names no frames"),
        ({"lost": "0"}, "lost: '0' names no frames"),
        ({"lost": "1-12"}, "all frames are lost"),
        ({"stale_yaw_line": 1}, "stale_yaw_line is 1; give the number of a later flight line"),
        ({"stale_yaw_line": 4}, "stale_yaw_line is 4"),
        ({"kind": "line", "stale_yaw_line": 2}, "stale_yaw_line is 2"),
        ({"stated_sd_factor": 0.0}, "stated_sd_factor is 0"),
        ({"forward_overlap": 1.0}, "overlap"),
        ({"lines": 0}, "lines is 0"),
        ({"position_sd_m": -1.0}, "position_sd_m is -1.0"),
        ({"lon_deg": float("nan")}, "lon_deg is nan"),
        ({"format": "tiff8"}, "give pos_in csv"),
    ],
)
def test_impossible_plans_are_refused(wrong: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=says):
        SurveyPlan(**wrong)  # type: ignore[arg-type]


def test_turned_frames_are_counted_from_one() -> None:
    assert SurveyPlan(turned="4-6, 9").turned_frames() == {3, 4, 5, 8}
    with pytest.raises(UnknownNameError):
        SurveyPlan(pos_in="gpx")


def test_places_and_velocities_are_of_one_path() -> None:
    """A flight that strays from its lines by 2 m within 3 s. Steps of half a second agree with the velocities
    at both ends, which are 0.3 m/s and more off the lines, and upright too."""
    plan = SurveyPlan(seed=4, kind="line", lines=1, frames_per_line=400, forward_overlap=0.955,
                      ground_pixel_m=0.1, speed_m_per_s=9.0, wander_m=2.0, wander_s=3.0)  # fmt: skip
    flight = fly(plan)
    step_s = np.diff(flight.time_s)[:, None]
    assert step_s.max() < 0.5
    moved = np.diff(flight.poses.positions_m, axis=0) / step_s
    v = flight.velocity_m_per_s
    assert np.abs(moved - 0.5 * (v[:-1] + v[1:])).max() < 0.02
    strayed = (v - v.mean(axis=0)).std(axis=0)
    assert strayed == pytest.approx([2.0 / 3.0] * 3, rel=0.25)
