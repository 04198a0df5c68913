"""Control points of simulated surveys: where frames show them, what is reported of them, who reads it."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest

from geomosaic.errors import InputError
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.read import read_survey
from geomosaic_simulate.control import MEASURED_SD_PX, SURVEYED_SD_M, surveyed, true_points
from geomosaic_simulate.flight import fly
from geomosaic_simulate.landscape import Landscape
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.readout import FrameReadout, readout_of
from geomosaic_simulate.render import sight_of
from geomosaic_simulate.survey import simulate_frames, world_of

PLAN = SurveyPlan(
    seed=5, lines=2, frames_per_line=3, width_px=320, height_px=240, height_above_ground_m=40.0, turned="2",
    lost="5", k1=-0.05, principal_col_offset_px=4.0, control_points=7, pos_in="csv",
)  # fmt: skip


@pytest.mark.parametrize("ground", ["flat, rolling shutter", "flat, shaken fisheye", "hills"])
def test_rays_through_the_measured_pixels_meet_the_points(ground: str) -> None:
    more = {
        "flat, rolling shutter": {"rolling_shutter_s": 0.08},
        "flat, shaken fisheye": {"rolling_shutter_s": 0.08, "vibration_deg_per_s": 9.0, "lens": "fisheye"},
        "hills": {"relief_m": 8.0, "relief_wavelength_m": 60.0},
    }[ground]
    plan = dataclasses.replace(PLAN, **more)
    flight, camera = fly(plan), plan.camera()
    world = world_of(plan, flight)
    readouts = [readout_of(plan, flight, i) for i in range(plan.frames)]
    sights = [sight_of(camera, flight.poses[i], world, readouts[i]) for i in range(plan.frames)]
    bounds = [s.bounds_m for s in sights]
    points = true_points(plan, camera, flight.poses, readouts, world, bounds)
    assert [p.name for p in points] == ["GCP-01", "GCP-02", "CHK-03", "GCP-04", "GCP-05", "CHK-06", "GCP-07"]
    assert [p.check for p in points] == [False, False, True, False, False, True, False]
    frames = {i for p in points for i, _, _ in p.seen}
    assert 1 in frames and 4 not in frames, "the turned frame sees some, the lost one none"
    for p in points:
        assert len(p.seen) >= 2
        for i, col, row in p.seen:
            taken = (320.0 - col, 240.0 - row) if i == 1 else (col, row)
            at = [float(s.ev(taken[1], taken[0])) for s in (sights[i].easting, sights[i].northing)]
            np.testing.assert_allclose(at, p.map_m[:2], atol=5e-3)


def test_what_is_reported_has_the_stated_noise() -> None:
    plan = dataclasses.replace(PLAN, control_points=60, lost="")
    flight, camera = fly(plan), plan.camera()
    world = world_of(plan, flight)
    bounds = [sight_of(camera, p, world).bounds_m for p in (flight.poses[i] for i in range(6))]
    points = true_points(plan, camera, flight.poses, [FrameReadout()] * 6, world, bounds)
    reported = surveyed(plan, points)
    off_m = np.array([b.map_m - a.map_m for a, b in zip(points, reported, strict=True)])
    off_px = np.array([
        np.subtract(m[1:], t[1:])
        for a, b in zip(points, reported, strict=True) for t, m in zip(a.seen, b.seen, strict=True)
    ])  # fmt: skip
    np.testing.assert_allclose(off_m.std(axis=0) / [SURVEYED_SD_M[0], *SURVEYED_SD_M], 1.0, atol=0.3)
    np.testing.assert_allclose(off_px.std(axis=0) / MEASURED_SD_PX, 1.0, atol=0.2)


def test_both_files_are_read_as_the_same_points(tmp_path: Path) -> None:
    survey = simulate_frames(tmp_path, PLAN)
    assert survey.control is not None and survey.gcp_list is not None and survey.true_control is not None
    given = {"pos": survey.pos, "camera": survey.camera}
    table = read_survey(SurveyInputs(survey.frames, **given, gcp=survey.control))
    listed = read_survey(SurveyInputs(survey.frames, **given, gcp=survey.gcp_list))
    assert len(table.control) == len(listed.control) == 7
    with survey.true_control.open(newline="") as f:
        truth = {row["name"]: row for row in csv.DictReader(f)}
    for a, b in zip(table.control, listed.control, strict=True):
        assert (a.name, a.check) == (b.name, b.check)
        assert a.check == (truth[a.name]["kind"] == "check")
        assert (a.sd_horizontal_m, a.sd_vertical_m) == SURVEYED_SD_M
        np.testing.assert_allclose([a.lon_deg, a.lat_deg], [b.lon_deg, b.lat_deg], atol=1e-9)
        assert a.height_ellipsoidal_m == pytest.approx(b.height_ellipsoidal_m, abs=1e-3)
        assert a.height_ellipsoidal_m == pytest.approx(float(truth[a.name]["height_ellipsoidal_m"]), abs=0.15)
        assert a.images == b.images and len(a.images) >= 2
        assert "F0005.jpg" not in {image[0] for image in a.images}


def test_points_keep_clear_of_what_stands() -> None:
    plan = dataclasses.replace(PLAN, buildings=3.0, buildings_stand=True, trees_stand=True, control_points=5)
    flight, camera = fly(plan), plan.camera()
    world = world_of(plan, flight)
    bounds = [sight_of(camera, p, world).bounds_m for p in (flight.poses[i] for i in range(6))]
    low, high = np.min(bounds, axis=0)[:2], np.max(bounds, axis=0)[2:]
    points = true_points(plan, camera, flight.poses, [FrameReadout()] * 6, world, bounds)
    land = Landscape(plan.seed, plan.buildings)
    everything = (low[0] - 30.0, low[1] - 30.0, high[0] + 30.0, high[1] + 30.0)
    roofs, trees = land.buildings_in(everything), land.trees_in(everything)
    assert len(roofs) + len(trees) > 3, "there is something to keep clear of"
    for p in points:
        for b in roofs:
            assert (
                np.hypot(p.map_m[0] - b.easting_m, p.map_m[1] - b.northing_m)
                > b.half_width_m + 0.4 * b.height_m
            )
        for x, y, radius, height in trees:
            assert np.hypot(p.map_m[0] - x, p.map_m[1] - y) > radius + 0.4 * height


def test_more_points_than_there_is_room_for_are_refused() -> None:
    plan = dataclasses.replace(PLAN, lines=1, frames_per_line=2, forward_overlap=0.0, turned="", lost="")
    flight, camera = fly(plan), plan.camera()
    world = world_of(plan, flight)
    bounds = [sight_of(camera, flight.poses[i], world).bounds_m for i in range(2)]
    with pytest.raises(InputError, match=r"room for \d control points.*fewer control_points"):
        true_points(plan, camera, flight.poses, [FrameReadout()] * 2, world, bounds)
