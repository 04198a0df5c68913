"""Surveys without any height above the ground: it is taken from the images, and said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_surveys import mosaic, small_survey, summary, warned

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.errors import InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.matching.features import Features
from geomosaic.matching.flying_height import flying_height_m
from geomosaic.pipeline.stage import Context
from geomosaic.placement.heights import height_is_unknown, neighbours, with_heights_above_ground
from geomosaic.recording.file.reader import read_recording
from geomosaic.stages.matching_flying_height import matching_flying_height
from geomosaic.stages.projection_ground import projection_ground
from geomosaic.survey.model import Attitude, Frame, Position, Survey


def _survey(heights: list[float | None]) -> Survey:
    """Frames 0.0005 degrees of latitude (55.6 m) apart; the third hangs 2 m behind the second."""
    lat = [48.0, 48.0005, 48.00052, 48.001]
    frames = tuple(
        Frame(
            f"{i}.jpg", f"/{i}.jpg", 640, 480, 3, "uint8", "camera",
            Position(11.0, y, h, None, 1.5, 1.5, 2.0, "test"), Attitude(None, None, None, 3.0, 3.0, "test"),
        )
        for i, (y, h) in enumerate(zip(lat, heights, strict=True))
    )  # fmt: skip
    camera = Camera("camera", 640, 480, 600.0, 320.0, 240.0)
    return Survey(frames, (camera,), LocalFrame(11.0, 48.0, 0.0), "EPSG:32632")


def test_neighbours_are_apart() -> None:
    pairs = neighbours(_survey([None] * 4).frames, 10)
    assert [(a, b) for a, b, _ in pairs] == [(0, 1), (2, 3)]
    assert pairs[0][2] == pytest.approx(55.6, abs=0.1)


def test_known_heights_stay_and_put_the_ground_below() -> None:
    reported, level = with_heights_above_ground(_survey([610.0, 612.0, None, 608.0]), 110.0)
    assert level == pytest.approx(500.0)
    assert [f.position.height_above_ground_m for f in reported.frames] == [None, None, 110.0, None]


def test_without_any_height_the_ground_is_at_zero() -> None:
    reported, level = with_heights_above_ground(_survey([None] * 4), 110.0)
    assert level == 0.0 and reported.frames[0].position.height_above_ground_m == 110.0
    assert reported.frames[0].position.sd_vertical_m == pytest.approx(11.0)


def test_a_survey_without_heights_becomes_a_mosaic(tmp_path: Path) -> None:
    survey = small_survey(
        tmp_path / "survey", frames_per_line=3, width_px=320, height_px=240, height_reported=False
    )
    run = tmp_path / "run"
    quick = ("--adjust", "least_squares", "--set", "matching.sift.keypoints=800")
    assert mosaic(survey.frames, run, "--pos", survey.pos, "--camera", survey.camera, *quick) == 0
    assert warned(run, "height-estimated")
    assert summary(run)["frames"]["tied"] == 6
    true_pixel_m = 0.1
    assert summary(run)["mosaic"]["gsd_m"] == pytest.approx(true_pixel_m, rel=0.3)


def test_heights_that_are_given_are_not_measured(tmp_path: Path) -> None:
    """Neither where POS tells heights above the ground nor where the command tells the ground's."""
    survey = small_survey(tmp_path / "survey", lines=1, frames_per_line=3, height_reported=False)
    run = tmp_path / "run"
    given = ("--pos", survey.pos, "--camera", survey.camera, "--ground-height", 0)
    assert mosaic(survey.frames, run, *given) == 2
    recorded = read_recording(run / "run.mcap")
    assert [s.stage_id for s in recorded.stages][:2] == ["survey.read", "projection.ground"]
    reported = _survey([600.0] * 4)
    frames = tuple(
        replace(f, position=replace(f.position, height_above_ground_m=100.0)) for f in reported.frames
    )
    assert height_is_unknown(reported) and not height_is_unknown(replace(reported, frames=frames))
    stage = matching_flying_height()
    found = stage.run(
        {"survey": replace(reported, frames=frames)}, stage.Params(), Context(tmp_path / "stage")
    )
    assert np.isnan(found["flying_height"].above_ground_m)


def test_a_recipe_that_measures_no_height_names_the_stage_that_does(tmp_path: Path) -> None:
    stage = projection_ground()
    with pytest.raises(InputError, match="nothing measures it") as raised:
        stage.run({"survey": _survey([600.0] * 4)}, stage.Params(), Context(tmp_path))
    assert "matching.flying_height before projection.ground" in str(raised.value)


def test_hovers_and_rigs_hide_no_flight() -> None:
    """Twenty frames on the spot before ten in a line, each by two cameras at once."""
    survey = _survey([None] * 4)
    (first, *_), north = survey.frames, 48.0 + np.r_[1e-6 * np.arange(20), 5e-4 * np.arange(1, 11)]
    frames = [
        replace(first, position=replace(first.position, lat_deg=float(lat)), camera=camera)
        for lat in north
        for camera in ("camera", "other")
    ]
    pairs = neighbours(frames, 16)
    assert len(pairs) == 16 and min(base_m for *_, base_m in pairs) > 50.0
    assert {b - a for a, b, _ in pairs} == {2}


@pytest.mark.parametrize("along", [True, False])
@pytest.mark.parametrize("pitch_deg", [0.0, 30.0, 45.0])
def test_tilted_cameras_measure_their_height_too(pitch_deg: float, along: bool) -> None:
    """Points on flat ground 100 m below two frames 20 m apart."""
    rng = np.random.default_rng(3)
    camera = Camera("camera", 640, 480, 600.0, 320.0, 240.0)
    tilt = Rotation.from_yaw_pitch_roll(0.0, np.radians(pitch_deg), 0.0)
    step_m = np.array([0.0, 20.0, 0.0] if along else [20.0, 0.0, 0.0])
    ahead_m = 100.0 * np.tan(np.radians(pitch_deg))
    land_m = np.column_stack([rng.uniform(-40, 60, 300), ahead_m + rng.uniform(-40, 60, 300), np.zeros(300)])
    seen = [
        Pose(np.array([0.0, 0.0, 100.0]) + at, tilt).image_from_ground(camera, land_m)
        for at in (np.zeros(3), step_m)
    ]
    words = rng.uniform(0.0, 255.0, (300, 128)).astype(np.float32)
    features = [Features(px.astype(np.float32), np.full(300, 4.0, np.float32), words) for px in seen]
    found = flying_height_m((features[0], features[1]), (camera,) * 2, (tilt.matrix,) * 2, 20.0, 3.0)
    assert found == pytest.approx(100.0, rel=0.01)
