"""A survey with known truth, written to a folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from geomosaic.camera.lens import LENSES
from geomosaic.errors import InputError
from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param
from geomosaic_simulate.dirty import dirty_survey
from geomosaic_simulate.plan import ALTITUDES, FORMATS, KINDS, POS_IN, SurveyPlan
from geomosaic_simulate.survey import simulate_frames

_PLAN = SurveyPlan()


class SimulateFrames(Stage):
    """Simulates a survey of aerial frames: frames, pos.csv, cameras.json, and the truth."""

    id = "simulate.frames"
    display_name = "Simulate a survey of frames"
    group = "Simulation"
    version = 7
    outputs: ClassVar[dict[str, type]] = {"truth_file": RunFile}

    class Params(StageParams):
        """The numbers of `SurveyPlan`, which holds their defaults. Standard deviations are per axis."""

        FORMERLY: ClassVar[dict[str, str]] = {
            "lens_told": "lens_reported",
            "attitude_told": "attitude_reported",
            "height_told": "height_reported",
            "relative_height_told": "relative_height_reported",
            "readout_told": "readout_reported",
            "shutter_told": "shutter_reported",
            "gyroscope_told": "gyroscope_reported",
        }
        dirty: int | None = param(
            None, help="draw a survey as people deliver them, with its faults; what else is given holds", ge=0
        )
        without: str = param("", help="faults that a dirty survey is not to have, like clouds,vibration")
        kind: str = param(_PLAN.kind, help="how the survey is flown", choices=KINDS)
        scale: float = param(_PLAN.scale, help="size of the paper's frames, 1 for full", ge=0.05, le=1)
        lon_deg: float = param(_PLAN.lon_deg, help="longitude of the middle", unit="deg", ge=-180, le=180)
        lat_deg: float = param(_PLAN.lat_deg, help="latitude of the middle", unit="deg", ge=-80, le=80)
        ground_height_m: float = param(
            _PLAN.ground_height_m, help="ellipsoidal height of the ground", unit="m", ge=-500, le=9000
        )
        lines: int = param(
            _PLAN.lines, help="flight lines of a block; of a free path or a spiral, a factor", ge=1, le=200
        )
        frames_per_line: int = param(_PLAN.frames_per_line, help="frames in each line", ge=1, le=5000)
        forward_overlap: float = param(_PLAN.forward_overlap, help="overlap along a line", ge=0, le=0.95)
        side_overlap: float = param(_PLAN.side_overlap, help="overlap of neighbouring lines", ge=0, le=0.95)
        heading_deg: float = param(
            _PLAN.heading_deg, help="true heading of the first line", unit="deg", ge=-360, le=360
        )
        serpentine: bool = param(_PLAN.serpentine, help="fly every second line backward")
        height_above_ground_m: float = param(
            _PLAN.height_above_ground_m, help="flying height above the ground", unit="m", ge=5, le=20000
        )
        ground_pixel_m: float = param(
            _PLAN.ground_pixel_m, help="ground pixel, which sets the focal length", unit="m", ge=0.005, le=10
        )
        speed_m_per_s: float = param(_PLAN.speed_m_per_s, help="ground speed", unit="m/s", ge=0.5, le=300)
        wander_m: float = param(
            _PLAN.wander_m, help="how far the flight strays from its plan (sd)", unit="m", ge=0, le=100
        )
        wander_s: float = param(
            _PLAN.wander_s, help="in what time it strays (correlation time)", unit="s", ge=0.1, le=1000
        )
        wander_tilt_deg: float = param(
            _PLAN.wander_tilt_deg, help="true pitch and roll (sd)", unit="deg", ge=0, le=20
        )
        wander_yaw_deg: float = param(
            _PLAN.wander_yaw_deg, help="true heading off the line's (sd)", unit="deg", ge=0, le=45
        )
        take_off_frames: int = param(_PLAN.take_off_frames, help="frames taken on the way up", ge=0, le=100)
        landing_frames: int = param(_PLAN.landing_frames, help="frames taken on the way down", ge=0, le=100)
        oblique_frames: int = param(
            _PLAN.oblique_frames, help="frames that look 35 to 60 degrees off the nadir", ge=0, le=100
        )
        horizon_frames: int = param(_PLAN.horizon_frames, help="frames that show the horizon", ge=0, le=100)
        duplicates: int = param(_PLAN.duplicates, help="frames whose files are there twice", ge=0, le=1000)
        width_px: int = param(_PLAN.width_px, help="width of a frame", unit="px", ge=64, le=20000)
        height_px: int = param(_PLAN.height_px, help="height of a frame", unit="px", ge=64, le=20000)
        k1: float = param(_PLAN.k1, help="radial distortion (Brown)", ge=-0.5, le=0.5)
        k2: float = param(_PLAN.k2, help="radial distortion, second", ge=-0.5, le=0.5)
        k3: float = param(_PLAN.k3, help="radial distortion, third", ge=-0.5, le=0.5)
        p1: float = param(_PLAN.p1, help="decentring distortion", ge=-0.05, le=0.05)
        p2: float = param(_PLAN.p2, help="decentring distortion, second", ge=-0.05, le=0.05)
        principal_col_offset_px: float = param(
            _PLAN.principal_col_offset_px, help="principal point right of the middle", unit="px"
        )
        principal_row_offset_px: float = param(
            _PLAN.principal_row_offset_px, help="principal point below the middle", unit="px"
        )
        lens: str = param(_PLAN.lens, help="how the lens bends", choices=LENSES)
        lens_reported: bool = param(
            _PLAN.lens_reported, help="the reported camera has lens, distortion and centre as they are"
        )
        lens_in_tags: bool = param(
            _PLAN.lens_in_tags, help="frames hold the reported camera as the maker's calibration (XMP)"
        )
        focal_error: float = param(
            _PLAN.focal_error, help="share by which the reported focal length is too long", ge=-0.5, le=0.5
        )
        dem: Path | None = param(
            _PLAN.dem, help="ground from this DEM (ellipsoidal heights), which must hold lon_deg, lat_deg"
        )
        relief_m: float = param(
            _PLAN.relief_m, help="hills: highest minus lowest ground, 0 for flat", unit="m", ge=0, le=3000
        )
        relief_wavelength_m: float = param(
            _PLAN.relief_wavelength_m, help="from hill to hill", unit="m", ge=20, le=20000
        )
        buildings: float = param(_PLAN.buildings, help="how many villages, 1 is usual", ge=0, le=3)
        buildings_stand: bool = param(_PLAN.buildings_stand, help="buildings rise above the ground")
        trees_stand: bool = param(_PLAN.trees_stand, help="trees rise above the ground")
        hipped_roofs: bool = param(
            _PLAN.hipped_roofs, help="standing roofs rise to a ridge from all four walls"
        )
        bridges: bool = param(_PLAN.bridges, help="some roads run over bridges")
        water_share: float = param(
            _PLAN.water_share, help="share of the land under water, other in every frame", ge=0, le=1
        )
        smooth_forest_share: float = param(
            _PLAN.smooth_forest_share, help="share of the land under forest without texture", ge=0, le=1
        )
        epoch: int = param(
            _PLAN.epoch, help="number of the survey of the same ground: each is flown anew", ge=0, le=1000
        )
        changes: int = param(
            _PLAN.changes, help="squares painted on the ground before this epoch", ge=0, le=1000
        )
        change_px: float = param(
            _PLAN.change_px, help="side of these squares", unit="ground px", ge=1, le=1000
        )
        moving_cars: float = param(
            _PLAN.moving_cars, help="cars under way on each 80 m of road, on average", ge=0, le=10
        )
        wind_in_trees_m: float = param(
            _PLAN.wind_in_trees_m, help="how far wind moves crowns from frame to frame (sd)", unit="m",
            ge=0, le=5,
        )  # fmt: skip
        clouds: float = param(_PLAN.clouds, help="share of the land in passing clouds' shadow", ge=0, le=1)
        position_sd_m: float = param(
            _PLAN.position_sd_m, help="noise of the position, east and north each", unit="m", ge=0, le=500
        )
        height_sd_m: float = param(_PLAN.height_sd_m, help="noise of the height", unit="m", ge=0, le=500)
        tilt_sd_deg: float = param(
            _PLAN.tilt_sd_deg, help="noise of pitch and of roll", unit="deg", ge=0, le=20
        )
        yaw_sd_deg: float = param(_PLAN.yaw_sd_deg, help="noise of the heading", unit="deg", ge=0, le=90)
        gps_lag_s: float = param(_PLAN.gps_lag_s, help="the position is this late", unit="s", ge=-5, le=5)
        gps_outliers: int = param(_PLAN.gps_outliers, help="frames with a position far off", ge=0)
        gps_outlier_m: float = param(_PLAN.gps_outlier_m, help="how far off those are", unit="m", ge=0)
        yaw_wrong_share: float = param(
            _PLAN.yaw_wrong_share, help="share of the frames with any heading", ge=0, le=1
        )
        stale_yaw_line: int = param(
            _PLAN.stale_yaw_line, help="flight line whose heading stays that of the line before, 0 none", ge=0
        )
        turned: str = param(
            _PLAN.turned, help="frames whose pixels are turned by 180 degrees, tags unchanged, like 4-6,9"
        )
        lost: str = param(_PLAN.lost, help="frames that were flown but are missing, like 4-6,9")
        stated_sd_factor: float = param(
            _PLAN.stated_sd_factor, help="stated over true standard deviations of the POS", ge=0.001, le=1000
        )
        stated_yaw_sd_deg: float | None = param(
            _PLAN.stated_yaw_sd_deg,
            help="what the POS states of its heading; none: the truth",
            unit="deg",
            ge=0.001,
        )
        attitude_reported: bool = param(_PLAN.attitude_reported, help="the POS holds yaw, pitch and roll")
        height_reported: bool = param(_PLAN.height_reported, help="the POS holds heights")
        relative_height_reported: bool = param(
            _PLAN.relative_height_reported, help="frames report their height above the take-off too (XMP)"
        )
        position_bias_m: float = param(
            _PLAN.position_bias_m, help="error that all positions share, in one direction", unit="m", ge=0
        )
        height_bias_m: float = param(
            _PLAN.height_bias_m, help="error that all absolute heights share", unit="m", ge=-200, le=200
        )
        height_drift_m: float = param(
            _PLAN.height_drift_m,
            help="how far absolute heights drift over the flight",
            unit="m",
            ge=-200,
            le=200,
        )
        altitude: str = param(
            _PLAN.altitude,
            help="what the tags give as altitude: absolute, or something else",
            choices=ALTITUDES,
        )
        altitude_step_m: float = param(
            _PLAN.altitude_step_m, help="reported altitudes are rounded to it, 0 not", unit="m", ge=0, le=1000
        )
        take_off_up_m: float = param(
            _PLAN.take_off_up_m, help="the take-off above the middle's ground", unit="m", ge=-1000, le=1000
        )
        battery_offset_m: float = param(
            _PLAN.battery_offset_m,
            help="by how much the second half's positions are off those of the first",
            unit="m",
            ge=0,
            le=500,
        )
        battery_height_offset_m: float = param(
            _PLAN.battery_height_offset_m, help="the same of absolute heights", unit="m", ge=-500, le=500
        )
        no_gps: str = param(_PLAN.no_gps, help="frames without a position, like 4-6,9")
        control_points: int = param(
            _PLAN.control_points,
            help="surveyed points on the ground, every third a check point",
            ge=0,
            le=1000,
        )
        exposure_sd: float = param(
            _PLAN.exposure_sd, help="noise of each frame's exposure (logarithm of the gain)", ge=0, le=1
        )
        auto_exposure: float = param(
            _PLAN.auto_exposure, help="how far the camera evens out each frame's brightness", ge=0, le=1
        )
        exposure_reported: bool = param(
            _PLAN.exposure_reported, help="frames hold the exposure time by which the camera evens them out"
        )
        vignetting: float = param(_PLAN.vignetting, help="light lost in the corners", ge=0, le=0.9)
        hot_spot: float = param(
            _PLAN.hot_spot, help="how much brighter ground looks with the sun behind the camera", ge=0, le=3
        )
        blur_px: float = param(_PLAN.blur_px, help="blur (sd)", unit="px", ge=0, le=10)
        exposure_time_s: float = param(
            _PLAN.exposure_time_s,
            help="exposure, which smears what moves; 0 an instant",
            unit="s",
            ge=0,
            le=1,
        )
        blurred: str = param(_PLAN.blurred, help="frames that came out blurred, like 4-6,9")
        rolling_shutter_s: float = param(
            _PLAN.rolling_shutter_s, help="time from reading the first row to the last", unit="s", ge=0, le=1
        )
        readout_reported: bool = param(
            _PLAN.readout_reported, help="frames hold the time that a line takes (XMP)"
        )
        shutter_reported: bool = param(
            _PLAN.shutter_reported, help="frames hold whether the shutter is mechanical (DJI's XMP)"
        )
        camera_model: str = param(_PLAN.camera_model, help="the camera's model in EXIF")
        vibration_deg_per_s: float = param(
            _PLAN.vibration_deg_per_s,
            help="angular rate, about each axis, by which the platform shakes while rows are read",
            unit="deg/s",
            ge=0,
            le=100,
        )
        vibration_hz: float = param(_PLAN.vibration_hz, help="how often it shakes", unit="Hz", ge=0.1, le=200)
        updraft_m_per_s: float = param(
            _PLAN.updraft_m_per_s,
            help="how fast frames rise or sink while they are read, off their path, standard deviation",
            unit="m/s",
            ge=0.0,
            le=20.0,
        )
        gyroscope_reported: bool = param(
            _PLAN.gyroscope_reported, help="frames hold the gyroscope's rates while they are read (XMP)"
        )
        gyroscope_sd_deg_per_s: float = param(
            _PLAN.gyroscope_sd_deg_per_s, help="noise of those rates", unit="deg/s", ge=0, le=100
        )
        pixel_noise: float = param(_PLAN.pixel_noise, help="noise of a pixel, of 255 (sd)", ge=0, le=50)
        format: str = param(_PLAN.format, help="file format of the frames", choices=FORMATS)
        jpeg_quality: int = param(_PLAN.jpeg_quality, help="quality of JPEG frames", ge=10, le=100)
        pos_in: str = param(_PLAN.pos_in, help="where the POS is written: EXIF and XMP, CSV", choices=POS_IN)

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Write the survey; what is wrong with it on purpose is in truth.json, not in warnings."""
        options = params.model_dump(exclude={"dirty", "without"})
        drawn = None
        if params.dirty is None:
            if params.without:
                raise InputError("without is for dirty surveys", fix="give dirty too, or leave it away")
            plan = SurveyPlan(seed=context.seed, **options)
        else:
            if context.seed:
                raise InputError("both dirty and a seed are given", fix="leave the seed away")
            given = {name: options[name] for name in options if name in params.model_fields_set}
            without = [name.strip() for name in params.without.split(",") if name.strip()]
            drawn = dirty_survey(params.dirty, given, without)
            plan = drawn.plan
        paths = simulate_frames(
            context.run_folder, plan, context.progress, drawn.summary() if drawn else None
        )
        for path in dataclasses.astuple(paths):
            if path is not None and path.is_file():
                context.keep(path)
        for path in sorted(paths.frames.glob("F*")):
            context.keep(path)
        context.metric("simulate.frames", len(plan.kept))
        return {"truth_file": context.run_file("truth/truth.json")}
