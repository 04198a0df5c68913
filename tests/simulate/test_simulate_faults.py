"""What real flights do besides noise, each against what it should be: paths, tags, readout, lens, light, wind."""

from __future__ import annotations

import base64
import csv
import dataclasses
import json
import re
from pathlib import Path

import cv2
import exifread
import numpy as np
import pytest
import rasterio
from small_surveys import simulated

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.errors import GeomosaicError, InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic_simulate.changing import gusts, sway
from geomosaic_simulate.flight import fly, observe
from geomosaic_simulate.light import (
    MEAN_LIGHT,
    SHADE,
    WIND_M_PER_S,
    automatic_gain,
    clouds_shade,
    motion_blur,
    shaken,
)
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.readout import FrameReadout, readout_of
from geomosaic_simulate.relief import Relief
from geomosaic_simulate.render import World, haze, render, sight_of
from geomosaic_simulate.survey import smear_px
from geomosaic_simulate.write import opensfm_camera

TINY = {
    "width_px": 160,
    "height_px": 120,
    "height_above_ground_m": 20.0,
    "pixel_noise": 0.0,
    "k1": 0.0,
    "k2": 0.0,
}
STILL = {"wander_m": 0.0, "wander_tilt_deg": 0.0, "wander_yaw_deg": 0.0}
EXACT = {"position_sd_m": 0.0, "height_sd_m": 0.0}
CAMERA = Camera("c", 400, 600, 1000.0, 210.0, 295.0)
WORLD = World(LocalFrame(11.3, 48.1, 520.0), MapProjection("EPSG:32632"), Relief(1, 520.0))
POSE = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))


def shaking(axis: int, phase_rad: float = np.pi / 2.0) -> FrameReadout:
    """0.1 s of 0.05 rad/s at 8 Hz about one axis of the camera; by default the rate is a cosine."""
    rate = np.zeros(3)
    rate[axis] = 0.05
    return FrameReadout(0.1, np.zeros(3), rate, np.full(3, 8.0), np.full(3, phase_rad))


def shake_rad(row: float) -> float:
    """How far `shaking` has turned when a row of 600 is read."""
    return float(0.05 / (16.0 * np.pi) * np.sin(16.0 * np.pi * 0.1 * (row / 600.0 - 0.5)))


@pytest.mark.parametrize("row", [40.0, 300.0, 433.0])
def test_a_camera_that_nods_sees_rows_farther_ahead(row: float) -> None:
    """A right-handed turn about x, to the image's right, lifts the view to the image's top, here north."""
    sight = sight_of(CAMERA, POSE, WORLD, shaking(0))
    north_m = 100.0 * np.tan(np.arctan((295.0 - row) / 1000.0) + shake_rad(row))
    true = WORLD.map_from_enu(np.array([0.0, north_m, 0.0]))[:2]
    np.testing.assert_allclose(
        [float(s.ev(row, 210.0)) for s in (sight.easting, sight.northing)], true, atol=2e-3
    )


def test_the_image_is_rendered_row_by_row_as_the_platform_rolls() -> None:
    """A right-handed turn about y, to the image's top, moves the view to the left: what is below goes right."""
    readout = shaking(1)
    sight = sight_of(CAMERA, POSE, WORLD, readout)
    west_m, south_m, east_m, north_m = sight.bounds_m
    west_m, north_m = np.floor(west_m) - 2.0, np.ceil(north_m) + 2.0
    size = int((north_m - south_m) * 10.0) + 30, int((east_m - west_m) * 10.0) + 30
    middle = WORLD.map_from_enu(np.zeros(3))
    ahead = WORLD.map_from_enu(np.array([0.0, 20.0, 0.0]))
    lean = float((ahead - middle)[0] / (ahead - middle)[1])  # the meridian on the map
    texture = np.zeros((*size, 3), np.uint8)
    rows_north = north_m - (np.arange(size[0]) + 0.5) * 0.1
    col = (middle[0] + lean * (rows_north - middle[1]) - west_m) / 0.1 - 0.5
    texture[:] = (255.0 * np.exp(-(((np.arange(size[1]) - col[:, None]) / 3.0) ** 2)))[..., None]
    frame = render(CAMERA, POSE, WORLD, sight, texture, west_m, north_m, 0.1)[..., 1]
    seen = (frame * (np.arange(400) + 0.5)).sum(axis=1) / frame.sum(axis=1)
    rows = np.arange(600) + 0.5
    expected = 210.0 + 1000.0 * np.tan([shake_rad(r) for r in rows])
    assert np.ptp(expected) > 1.9, "two pixels to and fro"
    np.testing.assert_allclose(seen, expected, atol=0.03)


def camera_tags(path: Path) -> dict[str, str]:
    """Attributes of Pix4D's namespace, read as text."""
    return {k.decode(): v.decode() for k, v in re.findall(rb'\sCamera:(\w+)="([^"]*)"', path.read_bytes())}


def test_the_gyroscopes_tag_tells_how_the_platform_turned(tmp_path: Path) -> None:
    plan = SurveyPlan(
        seed=3, lines=1, frames_per_line=2, rolling_shutter_s=0.0857, vibration_deg_per_s=4.0, vibration_hz=7.0,
        gyroscope_reported=True, readout_reported=True, **TINY,
    )  # fmt: skip
    survey = simulated(tmp_path, plan)
    truth = json.loads(survey.truth.read_text())["frames"][1]["vibration"]
    tags = camera_tags(survey.frames / "F0002.jpg")
    assert int(tags["LineReadoutTime"]) * 120 == pytest.approx(0.0857e9, abs=60)
    data = base64.b64decode(tags["IMUAngularVelocity"])
    records = np.frombuffer(data, dtype=[("us", "<u8"), ("rad_per_s", "<f4", 3), ("more", "<u4")])
    assert len(data) == 24 * 86, "a record each millisecond, as long as the frame is read"
    assert set(np.diff(records["us"].astype(np.int64))) == {1000}
    t = np.arange(86) / 1000.0 - 0.0857 / 2.0 - 0.0425
    rate, hz, phase = (np.array(truth[k]) for k in ("rate_rad_per_s", "frequency_hz", "phase_rad"))
    assert (np.abs(np.degrees(rate) / 4.0 - 1.0) <= 0.3).all()
    assert (np.abs(hz / 7.0 - 1.0) <= 0.3).all()
    forward, right, down = records["rad_per_s"].T
    for axis, said in enumerate((right, forward, -down)):
        np.testing.assert_allclose(
            said, rate[axis] * np.sin(2.0 * np.pi * hz[axis] * t + phase[axis]), atol=1e-7
        )
    turned = readout_of(plan, fly(plan), 1).turned_rad(t[[0, -1]])
    summed = np.trapezoid(np.stack([right, forward, -down], axis=1), t, axis=0)
    np.testing.assert_allclose(turned[1] - turned[0], summed, atol=2e-6)


def test_updrafts_move_frames_while_they_are_read_and_no_places() -> None:
    plan = SurveyPlan(kind="block", lines=10, frames_per_line=40, rolling_shutter_s=0.1, updraft_m_per_s=0.7)
    lifted, still = fly(plan), fly(dataclasses.replace(plan, updraft_m_per_s=0.0))
    np.testing.assert_array_equal(lifted.poses.positions_m, still.poses.positions_m)
    more = lifted.velocity_m_per_s - still.velocity_m_per_s
    assert not more[:, :2].any() and np.std(more[:, 2]) == pytest.approx(0.7, rel=0.1)
    moved = readout_of(plan, lifted, 5).velocity_m_per_s - readout_of(plan, still, 5).velocity_m_per_s
    assert moved[2] == more[5, 2] != 0.0


def test_crossed_lines_are_flown_again_across() -> None:
    plan = SurveyPlan(
        kind="crossed", lines=2, frames_per_line=3, heading_deg=0.0, lat_deg=0.0, lon_deg=9.0, **STILL
    )
    flight = fly(plan)
    once, again = flight.poses.positions_m[:6, :2], flight.poses.positions_m[6:, :2]
    np.testing.assert_allclose(once[0], [-25.0, -22.5], atol=0.01)
    np.testing.assert_allclose(again, np.column_stack([once[:, 1], -once[:, 0]]), atol=0.01)
    np.testing.assert_allclose(
        flight.yaw_pitch_roll_deg[6:, 0], (flight.yaw_pitch_roll_deg[:6, 0] + 90.0) % 360.0
    )
    np.testing.assert_allclose(flight.velocity_m_per_s[6], [8.0, 0.0, 0.0], atol=1e-9)
    assert list(flight.line) == [0] * 3 + [1] * 3 + [2] * 3 + [3] * 3


def test_a_spiral_goes_outward_in_rings_as_far_apart_as_lines() -> None:
    plan = SurveyPlan(kind="spiral", lines=4, frames_per_line=40, heading_deg=0.0, **STILL)
    at = fly(plan).poses.positions_m[:, :2]
    base_m, apart_m = 0.3 * 75.0, 0.5 * 100.0
    step_m = np.linalg.norm(np.diff(at, axis=0), axis=1)
    np.testing.assert_allclose(step_m[30:], base_m, rtol=0.01)
    radius_m, azimuth = np.hypot(*at.T), np.unwrap(np.arctan2(at[:, 0], at[:, 1]))
    assert (np.diff(azimuth) > 0.0).all(), "clockwise"
    np.testing.assert_allclose(radius_m, apart_m * (0.25 + azimuth / (2.0 * np.pi)), atol=0.05)


def test_a_free_path_wanders_without_leaving_its_place() -> None:
    plan = SurveyPlan(kind="free", lines=1, frames_per_line=30, **STILL)
    flight = fly(plan)
    at = flight.poses.positions_m[:, :2]
    base_m, apart_m = 0.3 * 75.0, 0.5 * 100.0
    step_m = np.linalg.norm(np.diff(at, axis=0), axis=1)
    assert step_m.max() <= 1.25 * base_m + 0.01
    assert np.hypot(*at.T).max() < 1.2 * np.sqrt(30 * base_m * apart_m)
    course = np.unwrap(np.arctan2(*flight.velocity_m_per_s[:, :2].T))
    nose = np.unwrap(np.radians(flight.yaw_pitch_roll_deg[:, 0]))
    assert np.ptp(course) > 2.0
    off_deg = np.degrees((nose - course + np.pi) % (2.0 * np.pi) - np.pi)
    assert 3.0 < off_deg.std() < 25.0
    other = fly(dataclasses.replace(plan, seed=2)).poses.positions_m[:, :2]
    assert np.abs(other - at).max() > base_m


STRAYS = SurveyPlan(
    seed=2, lines=1, frames_per_line=3, take_off_frames=2, landing_frames=1, oblique_frames=1, horizon_frames=1,
    duplicates=2, blurred="4", no_gps="3,5", pos_in="both", **TINY,
)  # fmt: skip


def test_frames_that_belong_in_no_map_are_there_and_named(tmp_path: Path) -> None:
    survey = simulated(tmp_path, STRAYS)
    truth = json.loads(survey.truth.read_text())
    flight = fly(STRAYS)
    roles = ["take_off", "take_off", "survey", "survey", "survey", "oblique", "horizon", "landing"]
    assert list(flight.role) == roles
    above_m = flight.lon_lat_height[:, 2] - 520.0
    np.testing.assert_allclose(above_m[:2] / above_m[2], [0.175, 0.525])
    assert above_m[7] / above_m[4] == pytest.approx(0.35)
    assert (np.diff(flight.time_s) > 0.0).all()
    assert 35.0 <= flight.yaw_pitch_roll_deg[5, 1] <= 60.0
    assert 75.0 <= flight.yaw_pitch_roll_deg[6, 1] <= 88.0
    out = {entry["frame"]: entry["reason"] for entry in truth["leave_out"]}
    copies = [name for name, reason in out.items() if reason == "duplicate"]
    assert out == {
        "F0001.jpg": "take_off", "F0002.jpg": "take_off", "F0004.jpg": "blurred", "F0006.jpg": "oblique",
        "F0007.jpg": "horizon", "F0008.jpg": "landing", **dict.fromkeys(copies, "duplicate"),
    }  # fmt: skip
    assert len(copies) == 2 and sorted(p.name for p in survey.frames.iterdir()) == sorted(
        [*(f"F000{k}.jpg" for k in range(1, 9)), *copies]
    )
    for copy in copies:
        original = copy.replace(" (1)", "")
        assert (survey.frames / copy).read_bytes() == (survey.frames / original).read_bytes()
    with survey.positions.open(newline="") as file:
        assert [r["frame"] for r in csv.DictReader(file)] == [*(f"F000{k}.jpg" for k in range(1, 9)), *copies]
    blurred, sharp = (
        cv2.Laplacian(cv2.imread(str(survey.frames / f"F000{k}.jpg"), 0), cv2.CV_64F).std() for k in (4, 3)
    )
    assert blurred < 0.4 * sharp
    with rasterio.open(survey.ortho) as ortho:
        shown_m2 = float((ortho.dataset_mask() > 0).sum()) * ortho.transform.a**2
    assert shown_m2 < 2.5 * 16.0 * 12.0, "the map is what the survey's own frames see"


def test_frames_without_gps_have_no_position_anywhere(tmp_path: Path) -> None:
    survey = simulated(tmp_path, STRAYS)
    assert survey.pos is not None
    with survey.pos.open(newline="") as file:
        reported = {row["frame"] for row in csv.DictReader(file)}
    assert {"F0004.jpg", "F0006.jpg"} < reported and not reported & {"F0003.jpg", "F0005.jpg"}
    for name, there in (("F0003.jpg", False), ("F0004.jpg", True), ("F0005.jpg", False)):
        with (survey.frames / name).open("rb") as file:
            tags = exifread.process_file(file, details=False)
        data = (survey.frames / name).read_bytes()
        assert ("GPS GPSLatitude" in tags, b"AbsoluteAltitude" in data) == (there, there)
        assert b"GimbalYawDegree" in data


def test_the_horizon_is_sky_above_and_land_below() -> None:
    pose = dataclasses.replace(POSE, rotation=Rotation.from_yaw_pitch_roll(0.5, np.radians(80.0), 0.0))
    sight = sight_of(CAMERA, pose, WORLD)
    west, south, east, north = sight.bounds_m
    assert max(east - west, north - south) < 2.0 * 3.0 * 100.0, "no farther than three times the height"
    light = np.full((600, 400, 3), (90.0, 110.0, 60.0), dtype=np.float32)
    haze(light, sight)
    horizon = 295.0 - 1000.0 * np.tan(np.radians(10.0))
    assert light[int(horizon) - 100, 200, 2] > light[int(horizon) - 100, 200, 0] + 20.0, "blue"
    np.testing.assert_allclose(light[int(horizon) + 20, 200], [198.0, 206.0, 212.0], atol=1.0)
    near = np.full((600, 400, 3), 90.0, dtype=np.float32)
    haze(near, sight_of(CAMERA, POSE, WORLD))
    np.testing.assert_array_equal(near, 90.0)


@pytest.mark.parametrize(
    ("plan", "reported_m"),
    [
        ({}, [640.0, 640.0, 640.0, 640.0]),
        ({"altitude": "take_off", "take_off_up_m": 30.0}, [90.0] * 4),
        ({"altitude_step_m": 50.0, "height_drift_m": 90.0}, [650.0, 650.0, 700.0, 750.0]),
        ({"battery_height_offset_m": -7.0}, [640.0, 640.0, 633.0, 633.0]),
        ({"altitude": "constant", "height_drift_m": 90.0}, [640.0] * 4),
    ],
)
def test_altitudes_are_reported_as_cameras_tell_them(plan: dict, reported_m: list[float]) -> None:
    whole = SurveyPlan(lines=1, frames_per_line=4, height_above_ground_m=120.0, **EXACT, **STILL, **plan)
    flight = fly(whole)
    observed = observe(whole, flight)
    np.testing.assert_allclose(observed.lon_lat_height[:, 2], reported_m, atol=0.01)
    np.testing.assert_allclose(observed.position_errors_m[:, 2], np.subtract(reported_m, 640.0), atol=0.01)
    up = plan.get("take_off_up_m", 0.0)
    np.testing.assert_allclose(observed.height_above_take_off_m, 120.0 - up, atol=0.01)


def test_altitudes_on_the_ground_say_nothing_of_the_flight() -> None:
    plan = SurveyPlan(lines=4, frames_per_line=25, height_above_ground_m=68.0, altitude="ground")
    reported = observe(plan, fly(plan)).lon_lat_height[:, 2]
    assert reported.mean() == pytest.approx(520.0, abs=0.2)
    assert 0.3 < reported.std() < 0.7


def test_the_second_battery_has_positions_of_its_own() -> None:
    plan = SurveyPlan(lines=1, frames_per_line=5, battery_offset_m=4.0, battery_height_offset_m=3.0, **EXACT)
    flight = fly(plan)
    assert list(flight.battery) == [0, 0, 0, 1, 1]
    assert flight.time_s[3] - flight.time_s[2] > 600.0
    off = observe(plan, flight).position_errors_m
    np.testing.assert_allclose(off[:3], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*off[3:, :2].T), 4.0)
    np.testing.assert_allclose(off[3:, 2], 3.0)


def test_a_fisheye_frame_shows_the_ground_by_the_angle() -> None:
    plan = SurveyPlan(lens="fisheye", k1=0.05, k2=-0.01, principal_col_offset_px=10.0)
    angle = np.radians(27.0)
    radius = 1000.0 * angle * (1.0 + 0.05 * angle**2 - 0.01 * angle**4)
    sight = sight_of(plan.camera(), POSE, WORLD)
    true = WORLD.map_from_enu(100.0 * np.tan(angle) * np.array([0.8, -0.6, 0.0]))[:2]
    at = 375.0 + 0.6 * radius, 510.0 + 0.8 * radius
    np.testing.assert_allclose([float(s.ev(*at)) for s in (sight.easting, sight.northing)], true, atol=2e-3)


def test_the_tags_tell_the_reported_lens_and_not_the_true_one(tmp_path: Path) -> None:
    plan = SurveyPlan(
        seed=3, lines=1, frames_per_line=1, lens="fisheye", lens_in_tags=True, **{**TINY, "k1": 0.04}
    )
    tags = camera_tags(simulated(tmp_path / "reported", plan).frames / "F0001.jpg")
    assert tags["ModelType"] == "fisheye"
    half_turn_px = [float(v) for v in tags["FisheyeAffineMatrix"].split(",")]
    np.testing.assert_allclose(half_turn_px, np.array([1.0, 0.0, 0.0, 1.0]) * 200.0 * np.pi / 2.0, atol=1e-5)
    poly = [float(v) for v in tags["FisheyePolynomial"].split(",")]
    share = 2.0 / np.pi * np.radians(35.0)
    radius = half_turn_px[0] * sum(p * share**k for k, p in enumerate(poly))
    assert radius == pytest.approx(200.0 * np.radians(35.0) * (1.0 + 0.04 * np.radians(35.0) ** 2), abs=1e-5)
    hidden = dataclasses.replace(plan, lens_reported=False, focal_error=0.03)
    survey = simulated(tmp_path / "hidden", hidden)
    tags = camera_tags(survey.frames / "F0001.jpg")
    assert tags["ModelType"] == "perspective"
    assert float(tags["PerspectiveFocalLength"]) == pytest.approx(206.0 * 13.2 / 160.0, abs=1e-5)
    assert tags["PerspectiveDistortion"] == ",".join(["0.000000000"] * 5)
    (true,) = json.loads((tmp_path / "hidden" / "truth" / "cameras.json").read_text()).values()
    assert (true["projection_type"], true["focal_x"], true["k1"]) == ("fisheye_opencv", 200.0 / 160.0, 0.04)
    (reported,) = opensfm_camera(hidden.reported_camera(), "simulated").values()
    assert reported["projection_type"] == "brown"


def test_motion_smears_along_the_flight() -> None:
    plan = SurveyPlan(lines=1, frames_per_line=2, speed_m_per_s=10.0, exposure_time_s=0.05, **STILL, **TINY)
    smear = smear_px(plan, plan.camera(), fly(plan), 0)
    np.testing.assert_allclose(smear, [0.0, 5.0], atol=0.02)  # 0.5 m of 0.1 m pixels, downward
    dot = np.zeros((41, 41, 3), dtype=np.float32)
    dot[20, 20] = 1000.0
    line = motion_blur(dot, np.array([3.0, -8.0]))[..., 0]
    rows, cols = np.mgrid[-20:21, -20:21]
    assert line.sum() == pytest.approx(1000.0, rel=1e-4)
    moments = [float((line * a * b).sum() / 1000.0) for a, b in ((cols, cols), (rows, rows), (cols, rows))]
    grid = 1.0 / 6.0  # what a point between pixels spreads by
    np.testing.assert_allclose(moments, [9.0 / 12.0 + grid, 64.0 / 12.0 + grid, -24.0 / 12.0], atol=0.02)


def test_a_shaken_frame_is_blurred_by_ten_to_twenty_pixels() -> None:
    dot = np.zeros((81, 81, 3), dtype=np.float32)
    dot[40, 40] = 1000.0
    rows, cols = np.mgrid[-40:41, -40:41]
    for i in range(5):
        line = shaken(SurveyPlan(), dot, i)[..., 0] / 1000.0
        spread = float((line * (rows**2 + cols**2)).sum()) - 2.0 * 1.5**2
        assert 10.0 - 0.5 < np.sqrt(12.0 * spread) < 20.0 + 0.5


def test_clouds_shade_their_share_and_drift_with_the_wind() -> None:
    plan = SurveyPlan(seed=8, clouds=0.3, height_above_ground_m=900.0, ground_pixel_m=2.0)
    camera = Camera("c", 400, 400, 450.0, 200.0, 200.0)
    pose = Pose(np.array([0.0, 0.0, 900.0]), POSE.rotation)
    shade = clouds_shade(plan, sight_of(camera, pose, WORLD), 50_000.0, 400, 400)
    assert (shade.min(), shade.max()) == (pytest.approx(SHADE, abs=0.01), pytest.approx(1.0, abs=0.01))
    assert np.mean(shade < 0.7) == pytest.approx(0.3, abs=0.1)
    direction = plan.rng("wind").uniform(0.0, 2.0 * np.pi)
    moved = pose.position_m + 30.0 * WIND_M_PER_S * np.array([np.sin(direction), np.cos(direction), 0.0])
    later = clouds_shade(plan, sight_of(camera, Pose(moved, POSE.rotation), WORLD), 50_030.0, 400, 400)
    assert np.abs(later - shade).mean() < 0.02, "who drifts along sees the same clouds"
    assert np.abs(clouds_shade(plan, sight_of(camera, pose, WORLD), 50_030.0, 400, 400) - shade).mean() > 0.05


def test_the_cameras_automatic_evens_out_the_mean() -> None:
    dark = np.full((10, 10, 3), 40.0, dtype=np.float32)
    assert automatic_gain(1.0, dark) * 40.0 == pytest.approx(MEAN_LIGHT)
    assert automatic_gain(0.5, dark) ** 2 * 40.0 == pytest.approx(MEAN_LIGHT)
    assert automatic_gain(0.0, dark) == 1.0


def test_wind_moves_crowns_and_nothing_else() -> None:
    window = np.zeros((200, 300, 3), dtype=np.uint8)
    for col, row in ((100, 80), (220, 150)):
        cv2.circle(window, (col, row), 3, (250, 250, 250), -1)
    trees = np.array([[1000.0 + 100.5 * 0.1, 2000.0 - 80.5 * 0.1, 2.5, 6.0]])
    moved = sway(window, 1000.0, 2000.0, 0.1, trees, np.array([[0.3, -0.2]]))
    for (col, row), (right, down) in (((100, 80), (3.0, 2.0)), ((220, 150), (0.0, 0.0))):
        part = moved[row - 20 : row + 21, col - 20 : col + 21, 0].astype(float)
        rows, cols = np.mgrid[-20:21, -20:21]
        found = [(part * cols).sum() / part.sum(), (part * rows).sum() / part.sum()]
        np.testing.assert_allclose(found, [right, down], atol=0.15)
    many = gusts(np.zeros((4000, 4)), 0.2, np.random.default_rng(1))
    assert (many - many.mean(axis=0)).std() == pytest.approx(0.8 * 0.2, rel=0.05)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"vibration_deg_per_s": 2.0}, "vibration_deg_per_s without a rolling shutter"),
        ({"gyroscope_reported": True}, "gyroscope_reported without a rolling shutter"),
        ({"rolling_shutter_s": 0.1, "gyroscope_reported": True, "pos_in": "csv"}, "frames without tags"),
        ({"lens": "fisheye", "p1": 0.01}, "no decentring"),
        ({"lens": "fisheye", "lens_in_tags": True, "k1": 0.01, "k2": 0.01}, "k1 alone"),
        ({"lens": "mirror"}, "mirror"),
        ({"altitude": "high"}, "high"),
        ({"kind": "zigzag"}, "zigzag"),
        ({"no_gps": "13"}, "no_gps: '13' names no frames"),
        ({"blurred": "x"}, "blurred: 'x' names no frames"),
        ({"duplicates": 13}, "more duplicates than frames"),
        ({"take_off_frames": -1}, "number of frames, changes or the epoch is below 0"),
        ({"clouds": 1.2}, "share is outside"),
        ({"exposure_time_s": -0.1}, "below 0"),
        ({"stale_yaw_line": 2, "kind": "free"}, "stale_yaw_line"),
    ],
)  # fmt: skip
def test_what_can_not_be_is_refused_in_one_line(wrong: dict, words: str) -> None:
    with pytest.raises((InputError, GeomosaicError), match=re.escape(words)) as caught:
        SurveyPlan(**wrong)
    assert "\n" not in str(caught.value)
