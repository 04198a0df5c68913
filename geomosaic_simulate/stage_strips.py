"""A scene of CCD strips with known truth, written to a folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from geomosaic.pipeline.stage import Context, RunFile, Stage, StageParams, param
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import simulate_strips

_PLAN = StripPlan()


class SimulateStrips(Stage):
    """Simulates a scene of staggered TDI-CCDs: strips, geometry.yaml, model, RPC, DEM, and the truth."""

    id = "simulate.strips"
    display_name = "Simulate CCD strips"
    group = "Simulation"
    version = 1
    outputs: ClassVar[dict[str, type]] = {"truth_file": RunFile}

    class Params(StageParams):
        """The numbers of `StripPlan`, which holds their defaults. Pixels and lines are ground pixels."""

        ccds: int = param(_PLAN.ccds, help="how many CCDs", ge=2, le=64)
        width_px: int = param(
            _PLAN.width_px, help="width of a strip; TH-1 has 4096", unit="px", ge=32, le=20000
        )
        lines: int = param(_PLAN.lines, help="lines of a strip; TH-1 has some 35000", ge=64, le=1000000)
        overlap_px: int = param(_PLAN.overlap_px, help="what neighbours share", unit="px", ge=8, le=4000)
        read_px: int = param(_PLAN.read_px, help="what is read of each side", unit="px", ge=8, le=4000)
        row_separation_lines: float = param(
            _PLAN.row_separation_lines, help="lines between the two rows", ge=1, le=50000
        )
        first_row: int = param(
            _PLAN.first_row, help="row of the leftmost CCD: 1 leading, 2 trailing", ge=1, le=2
        )
        ground_pixel_m: float = param(_PLAN.ground_pixel_m, help="ground pixel", unit="m", ge=0.1, le=100)
        line_rate_hz: float = param(_PLAN.line_rate_hz, help="lines a second", unit="Hz", ge=10, le=100000)
        parallax_m_per_line: float = param(
            _PLAN.parallax_m_per_line,
            help="height that is one line between the rows; sets the flying height",
            unit="m",
            ge=1,
            le=5000,
        )
        jitter_1hz_px: float = param(
            _PLAN.jitter_1hz_px, help="jitter at 1.1 Hz: amplitude along the track", unit="px", ge=0, le=50
        )
        jitter_5hz_px: float = param(
            _PLAN.jitter_5hz_px, help="jitter at 4.7 Hz: amplitude along the track", unit="px", ge=0, le=20
        )
        jitter_22hz_px: float = param(
            _PLAN.jitter_22hz_px, help="jitter at 22 Hz: amplitude along the track", unit="px", ge=0, le=5
        )
        drift_px_per_s: float = param(
            _PLAN.drift_px_per_s, help="slow drift of pitch and roll: rate (rms)", unit="px/s", ge=0, le=50
        )
        drift_angle_deg: float = param(
            _PLAN.drift_angle_deg, help="drift angle: yaw against the track", unit="deg", ge=-1, le=1
        )
        mounting_px: float = param(
            _PLAN.mounting_px, help="each CCD off its nominal place (sd)", unit="px", ge=0, le=50
        )
        thermal_px: float = param(
            _PLAN.thermal_px, help="each CCD moving within the scene (sd)", unit="px", ge=0, le=20
        )
        motion: Path | None = param(
            _PLAN.motion, help="CSV of time_s,along_px,across_px added to drift and jitter"
        )
        lon_deg: float = param(_PLAN.lon_deg, help="longitude of the middle", unit="deg", ge=-180, le=180)
        lat_deg: float = param(_PLAN.lat_deg, help="latitude of the middle", unit="deg", ge=-80, le=80)
        course_deg: float = param(
            _PLAN.course_deg, help="true course in the middle", unit="deg", ge=-360, le=360
        )
        ground_height_m: float = param(
            _PLAN.ground_height_m, help="mean ellipsoidal height of the ground", unit="m", ge=-500, le=9000
        )
        relief_m: float = param(
            _PLAN.relief_m, help="hills: highest minus lowest ground, 0 for level", unit="m", ge=0, le=6000
        )
        relief_wavelength_m: float = param(
            _PLAN.relief_wavelength_m, help="from hill to hill", unit="m", ge=200, le=100000
        )
        dem: Path | None = param(
            _PLAN.dem, help="ground from this DEM (ellipsoidal heights), which must hold lon_deg, lat_deg"
        )
        texture: Path | None = param(
            _PLAN.texture, help="raster placed on the ground pixel on pixel, mirrored at its edges"
        )
        contrast: float = param(
            _PLAN.contrast, help="sd of the ground's brightness over its mean", ge=0, le=0.5
        )
        low_contrast: float = param(
            _PLAN.low_contrast, help="the same where contrast is low", ge=0.0001, le=0.5
        )
        low_contrast_share: float = param(
            _PLAN.low_contrast_share, help="share of the overlaps' lines with low contrast", ge=0, le=1
        )
        saturated_share: float = param(
            _PLAN.saturated_share, help="share of the overlaps' lines that glare", ge=0, le=1
        )
        targets: int = param(_PLAN.targets, help="point targets in the overlaps", ge=0, le=10000)
        cloud_cover: float = param(
            _PLAN.cloud_cover, help="share of the overlaps' lines under clouds", ge=0, le=0.95
        )
        cloud_height_m: float = param(
            _PLAN.cloud_height_m, help="height of the clouds above the ground", unit="m", ge=0, le=15000
        )
        wind_m_per_s: float = param(_PLAN.wind_m_per_s, help="wind that moves them", unit="m/s", ge=0, le=80)
        wind_deg: float = param(
            _PLAN.wind_deg,
            help="where it blows to: 0 ahead with the flight, 90 to higher columns",
            unit="deg",
            ge=-360,
            le=360,
        )
        cloud_size_m: float = param(_PLAN.cloud_size_m, help="size of a cloud", unit="m", ge=50, le=50000)
        bit_depth: int = param(_PLAN.bit_depth, help="bits of a count", ge=8, le=16)
        brightness: float = param(_PLAN.brightness, help="mean ground, of full scale", ge=0.02, le=0.95)
        gain_sd: float = param(_PLAN.gain_sd, help="gains of the CCDs (sd)", ge=0, le=0.3)
        offset_sd: float = param(
            _PLAN.offset_sd, help="offsets of the CCDs, of full scale (sd)", ge=0, le=0.1
        )
        column_sd: float = param(_PLAN.column_sd, help="gains of the columns (sd)", ge=0, le=0.2)
        snr: float = param(
            _PLAN.snr, help="signal to noise at the mean brightness, 0 for no noise", ge=0, le=10000
        )
        dead: str = param(_PLAN.dead, help="dead CCDs, counted from 1, like 3,5")
        short: str = param(_PLAN.short, help="CCDs whose strip ends early, as ccd:lines, like 4:6000")
        lost: str = param(_PLAN.lost, help="lines lost, as ccd:line:count, like 2:3000:5")
        repeated: str = param(_PLAN.repeated, help="lines written again, as ccd:line:count")
        attitude_hz: float = param(
            _PLAN.attitude_hz, help="samples a second of the attitude", unit="Hz", ge=100, le=20000
        )
        attitude_bias_urad: float = param(
            _PLAN.attitude_bias_urad, help="reported attitude: constant error of each axis", unit="urad", ge=0
        )
        attitude_error_urad: float = param(
            _PLAN.attitude_error_urad,
            help="reported attitude: error that changes in 2 s (sd)",
            unit="urad",
            ge=0,
        )
        attitude_noise_urad: float = param(
            _PLAN.attitude_noise_urad, help="reported attitude: noise of each sample (sd)", unit="urad", ge=0
        )
        dem_bias_m: float = param(
            _PLAN.dem_bias_m, help="given DEM: constant error", unit="m", ge=-1000, le=1000
        )
        dem_error_m: float = param(_PLAN.dem_error_m, help="given DEM: bumps (sd)", unit="m", ge=0, le=500)
        dem_pixel_m: float = param(
            _PLAN.dem_pixel_m, help="pixel of the DEMs written", unit="m", ge=1, le=1000
        )
        true_scene: bool = param(True, help="write truth/scene.tif, what one unbroken line would see")

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Write the scene; what is wrong with it on purpose is in truth.json, not in warnings."""
        values = params.model_dump()
        scene = values.pop("true_scene")
        plan = StripPlan(seed=context.seed, **values)
        paths = simulate_strips(context.run_folder, plan, scene=scene, progress=context.progress)
        for path in paths.files():
            context.keep(path)
        context.metric("simulate.strips", len(paths.strips))
        return {"truth_file": context.run_file("truth/truth.json")}
