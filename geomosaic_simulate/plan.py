"""What to simulate: every number of the flight, the camera, the ground and the noise."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomosaic.camera.interior import Camera
from geomosaic.camera.lens import LENSES
from geomosaic.errors import InputError, UnknownNameError

KINDS = {
    "block": "parallel flight lines",
    "line": "one flight line",
    "crossed": "parallel flight lines, then the same again across them",
    "spiral": "outward from the middle",
    "free": "flown by hand, wandering about",
    "paper": "Yue et al. 2021, table 2",
}
ALTITUDES = {
    "flown": "height above the datum, with its errors",
    "take_off": "height above the take-off",
    "constant": "that of the first frame in every frame",
    "ground": "the ground's, whatever the flying height",
}
POS_IN = ("both", "csv", "exif")
FORMATS = ("jpeg", "tiff8", "tiff16")
PAPER_SIZE_PX = (5344, 4008)
PAPER_PIXEL_M = 0.1
PAPER_HEIGHT_M = 1475.0


@dataclass(frozen=True)
class SurveyPlan:
    """Parameters of a simulated survey. Standard deviations are per axis; 0 switches a noise off.

    kind `paper` takes positions, attitudes, frame size (times `scale`), pixel and height from table 2
    of Yue et al. 2021 and ignores the flight's own numbers; its heights count from `ground_height_m`.
    With a `dem` (ellipsoidal heights) the ground is the DEM's, and `ground_height_m` its height in the
    survey's middle. Frames and lines are counted from 1. See docs/simulation.md.

    Surveys of one seed and several epochs show the same ground, each flown and disturbed anew; `changes`
    squares of change_px ground pixels were painted on the ground before this one.
    """

    seed: int = 1
    epoch: int = 0
    kind: str = "block"
    scale: float = 1.0

    lon_deg: float = 11.3
    lat_deg: float = 48.1
    ground_height_m: float = 520.0
    lines: int = 3
    frames_per_line: int = 4
    forward_overlap: float = 0.7
    side_overlap: float = 0.5
    heading_deg: float = 32.0
    serpentine: bool = True
    height_above_ground_m: float = 100.0
    ground_pixel_m: float = 0.1
    speed_m_per_s: float = 8.0
    wander_m: float = 1.0
    wander_s: float = 4.0
    wander_tilt_deg: float = 1.0
    wander_yaw_deg: float = 2.0
    take_off_frames: int = 0
    landing_frames: int = 0
    oblique_frames: int = 0
    horizon_frames: int = 0
    duplicates: int = 0

    width_px: int = 1000
    height_px: int = 750
    k1: float = -0.02
    k2: float = 0.005
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    principal_col_offset_px: float = 0.0
    principal_row_offset_px: float = 0.0
    lens: str = "brown"
    lens_reported: bool = True
    lens_in_tags: bool = False
    focal_error: float = 0.0

    dem: Path | None = None
    relief_m: float = 0.0
    relief_wavelength_m: float = 300.0
    buildings: float = 1.0
    buildings_stand: bool = False
    trees_stand: bool = False
    hipped_roofs: bool = False
    bridges: bool = False
    water_share: float = 0.0
    smooth_forest_share: float = 0.0
    moving_cars: float = 0.0
    wind_in_trees_m: float = 0.0
    clouds: float = 0.0
    changes: int = 0
    change_px: float = 10.0

    position_sd_m: float = 1.5
    height_sd_m: float = 2.0
    tilt_sd_deg: float = 0.3
    yaw_sd_deg: float = 1.0
    gps_lag_s: float = 0.0
    gps_outliers: int = 0
    gps_outlier_m: float = 100.0
    yaw_wrong_share: float = 0.0
    stale_yaw_line: int = 0
    turned: str = ""
    lost: str = ""
    stated_sd_factor: float = 1.0
    stated_yaw_sd_deg: float | None = None
    attitude_reported: bool = True
    height_reported: bool = True
    relative_height_reported: bool = True
    position_bias_m: float = 0.0
    height_bias_m: float = 0.0
    height_drift_m: float = 0.0
    altitude: str = "flown"
    altitude_step_m: float = 0.0
    take_off_up_m: float = 0.0
    battery_offset_m: float = 0.0
    battery_height_offset_m: float = 0.0
    no_gps: str = ""
    control_points: int = 0

    exposure_sd: float = 0.0
    auto_exposure: float = 0.0
    exposure_reported: bool = False
    vignetting: float = 0.0
    hot_spot: float = 0.0
    blur_px: float = 0.0
    exposure_time_s: float = 0.0
    blurred: str = ""
    rolling_shutter_s: float = 0.0
    readout_reported: bool = False
    shutter_reported: bool = True
    camera_model: str = "simulated"
    vibration_deg_per_s: float = 0.0
    vibration_hz: float = 6.0
    updraft_m_per_s: float = 0.0
    gyroscope_reported: bool = False
    gyroscope_sd_deg_per_s: float = 0.0
    pixel_noise: float = 1.0

    format: str = "jpeg"
    jpeg_quality: int = 92
    pos_in: str = "both"

    def __post_init__(self) -> None:
        for kind, name, known in (
            ("kind of survey", self.kind, KINDS),
            ("frame format", self.format, FORMATS),
            ("place for the POS", self.pos_in, POS_IN),
            ("altitude", self.altitude, ALTITUDES),
            ("lens", self.lens, LENSES),
        ):
            if name not in known:
                raise UnknownNameError(kind, name, known)
        positive = ("scale", "height_above_ground_m", "ground_pixel_m", "speed_m_per_s", "vibration_hz",
                    "relief_wavelength_m", "lines", "frames_per_line", "stated_sd_factor")  # fmt: skip
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not np.isfinite(value):
                raise InputError(f"{field.name} is {value}", fix="give a number")
            if field.name in positive and value <= 0:
                raise InputError(f"{field.name} is {value}", fix="give a number above 0")
            if field.name.endswith(("_sd", "_sd_m", "_sd_deg")) and value is not None and value < 0:
                raise InputError(f"{field.name} is {value}", fix="give 0 or more")
        self._check_shares()
        self._check_tags()
        if min(self.width_px, self.height_px) < 64:
            raise InputError("frames smaller than 64 pixels", fix="give a larger width_px and height_px")
        lines = self.lines if self.kind in ("block", "crossed") else 1
        if self.stale_yaw_line and not 2 <= self.stale_yaw_line <= lines * (1 + (self.kind == "crossed")):
            raise InputError(
                f"stale_yaw_line is {self.stale_yaw_line}",
                fix="give the number of a later flight line, or 0",
            )
        for listed in ("lost", "turned", "no_gps", "blurred"):
            self.numbered(listed)
        if not self.kept:
            raise InputError("all frames are lost", fix="leave some of them in")
        if self.duplicates > len(self.kept):
            raise InputError("more duplicates than frames", fix="give fewer duplicates")

    def _check_shares(self) -> None:
        if not (0.0 <= self.forward_overlap < 1.0 and 0.0 <= self.side_overlap < 1.0):
            raise InputError("an overlap is outside 0 to 1", fix="give a share such as 0.7")
        if min(self.water_share, self.smooth_forest_share, self.moving_cars, self.rolling_shutter_s,
               self.wind_in_trees_m, self.exposure_time_s, self.vibration_deg_per_s,
               self.updraft_m_per_s, self.altitude_step_m, self.gyroscope_sd_deg_per_s,
               self.hot_spot) < 0.0:  # fmt: skip
            raise InputError("a share, number or time is below 0", fix="give 0 or more")
        if min(self.take_off_frames, self.landing_frames, self.oblique_frames, self.horizon_frames,
               self.duplicates, self.epoch, self.changes) < 0:  # fmt: skip
            raise InputError("a number of frames, changes or the epoch is below 0", fix="give 0 or more")
        if not (0.0 <= self.clouds <= 1.0 and 0.0 <= self.auto_exposure <= 1.0):
            raise InputError("a share is outside 0 to 1", fix="give a share such as 0.3")
        if self.water_share + self.smooth_forest_share > 1.0:
            raise InputError("water and forest cover more than all land", fix="give shares that sum to 1")
        if self.dem is not None and self.relief_m:
            raise InputError("both a DEM and hills are given", fix="leave out dem or relief_m")

    def _check_tags(self) -> None:
        if self.format != "jpeg" and self.pos_in != "csv":
            raise InputError("TIFF frames are written without EXIF", fix="give pos_in csv")
        if self.pos_in == "csv" and (self.gyroscope_reported or self.readout_reported or self.lens_in_tags):
            raise InputError("tags are asked for in frames without tags", fix="give pos_in exif or both")
        if not (self.camera_model.isascii() and self.camera_model.isprintable()):
            raise InputError("a camera model is plain text", fix="give a name such as FC330")
        if self.rolling_shutter_s == 0.0:
            for needing in (
                "vibration_deg_per_s",
                "updraft_m_per_s",
                "readout_reported",
                "gyroscope_reported",
            ):
                if getattr(self, needing):
                    raise InputError(
                        f"{needing} without a rolling shutter", fix="give rolling_shutter_s above 0"
                    )
        if self.lens == "fisheye" and (self.p1 or self.p2):
            raise InputError("a simulated fisheye has no decentring", fix="leave p1 and p2 at 0")
        if self.lens == "fisheye" and self.lens_reported and self.lens_in_tags and (self.k2 or self.k3):
            raise InputError("a fisheye's tags hold k1 alone", fix="leave k2 and k3 at 0")

    @property
    def frames(self) -> int:
        """How many frames were taken in all; copies of files (`duplicates`) don't count."""
        others = self.take_off_frames + self.oblique_frames + self.horizon_frames + self.landing_frames
        return self.planned_frames + others

    @property
    def planned_frames(self) -> int:
        """How many frames the survey itself has, without those at take-off, at landing and of the view."""
        n = self.lines * self.frames_per_line
        return {"paper": 9, "line": self.frames_per_line, "crossed": 2 * n}.get(self.kind, n)

    @property
    def kept(self) -> tuple[int, ...]:
        """Indices (from 0) of the frames that aren't lost."""
        lost = self.numbered("lost")
        return tuple(i for i in range(self.frames) if i not in lost)

    def camera(self) -> Camera:
        """The camera that really took the frames."""
        width, height, focal = self.width_px, self.height_px, self.height_above_ground_m / self.ground_pixel_m
        if self.kind == "paper":
            width, height = (round(n * self.scale) for n in PAPER_SIZE_PX)
            focal = PAPER_HEIGHT_M / PAPER_PIXEL_M * self.scale
        return Camera(
            name="simulated",
            kind=self.lens,
            width_px=width,
            height_px=height,
            focal_length_px=focal,
            principal_col_px=width / 2.0 + self.principal_col_offset_px,
            principal_row_px=height / 2.0 + self.principal_row_offset_px,
            k1=self.k1,
            k2=self.k2,
            k3=self.k3,
            p1=self.p1,
            p2=self.p2,
        )

    def reported_camera(self) -> Camera:
        """The camera as the camera file reports it: perhaps a wrong focal length, perhaps no distortion."""
        true = self.camera()
        focal = true.focal_length_px * (1.0 + self.focal_error)
        if self.lens_reported:
            return dataclasses.replace(true, focal_length_px=focal)
        middle = true.width_px / 2.0, true.height_px / 2.0
        return Camera(true.name, true.width_px, true.height_px, focal, *middle)

    def reported_readout_s(self) -> float | None:
        """What the camera file reports of the shutter, None for nothing."""
        known = self.readout_reported if self.rolling_shutter_s else self.shutter_reported
        return self.rolling_shutter_s if known else None

    @property
    def pixel_m(self) -> float:
        """Ground pixel of the frames and of the true ortho."""
        return PAPER_PIXEL_M / self.scale if self.kind == "paper" else self.ground_pixel_m

    def turned_frames(self) -> frozenset[int]:
        """Indices (from 0) of the frames whose pixels are turned."""
        return self.numbered("turned")

    def numbered(self, field: str) -> frozenset[int]:
        """Indices (from 0) of the frames that a field names in text such as `4-6, 9` (from 1)."""
        found: set[int] = set()
        for part in filter(None, (p.strip() for p in getattr(self, field).split(","))):
            match = re.fullmatch(r"(\d+)(?:\s*-\s*(\d+))?", part)
            first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
            if not 1 <= first <= last <= self.frames:
                raise InputError(
                    f"{field}: '{part}' names no frames of 1 to {self.frames}", fix="write it like 4-6,9"
                )
            found.update(range(first - 1, last))
        return frozenset(found)

    def rng(self, purpose: str, frame: int = 0) -> np.random.Generator:
        """A generator of its own for each purpose (and frame), all from the one seed and the epoch."""
        key = (*purpose.encode(), frame, *((self.epoch,) if self.epoch else ()))
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))
