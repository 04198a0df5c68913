"""The nouns of a survey. What isn't known is None: nothing is invented here."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Turns
from geomosaic.camera.interior import Camera
from geomosaic.constants import DAY_S
from geomosaic.doors.files import printable
from geomosaic.geodesy.local import LocalFrame
from geomosaic.radiometry.calibration import Calibration
from geomosaic.radiometry.quantity import Quantity


@dataclass(frozen=True)
class Position:
    """Where a frame's projection centre was, as observed.

    Geodetic WGS 84. Either height may be unknown. Standard deviations always have a value: the
    observation's own, or the default of its source (see `survey.accuracy`); `source` says which. A position
    that nobody observed has the source `none`: it lies between the frames before and after, as good as
    anywhere. datum_stated: whether the source says what `height_ellipsoidal_m` counts from; where it doesn't,
    the heights of all frames may be off by one offset.
    """

    lon_deg: float
    lat_deg: float
    height_ellipsoidal_m: float | None
    height_above_ground_m: float | None
    sd_east_m: float
    sd_north_m: float
    sd_vertical_m: float
    source: str
    datum_stated: bool = True

    @property
    def deviations_m(self) -> tuple[float, float, float]:
        """East, north and up."""
        return self.sd_east_m, self.sd_north_m, self.sd_vertical_m

    @property
    def known(self) -> bool:
        """Whether it was observed."""
        return self.source != "none"


@dataclass(frozen=True)
class Attitude:
    """How a frame was turned, as observed: body angles of a camera that looks down (`Rotation`).

    yaw_deg is the true heading of the image's top edge, pitch_deg > 0 looks forward (0 is nadir),
    roll_deg > 0 looks left. Each may be unknown by itself.
    """

    yaw_deg: float | None
    pitch_deg: float | None
    roll_deg: float | None
    sd_yaw_deg: float
    sd_tilt_deg: float
    source: str

    @property
    def deviations_deg(self) -> tuple[float, float]:
        """Of yaw, and of pitch and roll."""
        return self.sd_yaw_deg, self.sd_tilt_deg


@dataclass(frozen=True)
class Frame:
    """One image: its file, its camera's name, and what the platform said of it.

    `name` is the file's name, with its folder's in front where two files have one; `path` is absolute.
    `valid_mask` names a raster of the same size whose zeros are invalid pixels. `time_s` is seconds since
    1970 UTC. Of a damaged frame that is used none the less, only the first `whole_rows` count.
    velocity_m_per_s: east, north, up; turns: while its rows were read. platform: serial number of the
    drone or the camera, as far as tags report one. calibration: of the recorded values to reflectance,
    which decoding then gives. exposure: time in s that takes as much light at f/1 and ISO 100, as the
    tags report it.
    """

    name: str
    path: str
    width_px: int
    height_px: int
    bands: int
    dtype: str
    camera: str
    position: Position
    attitude: Attitude
    time_s: float | None = None
    valid_mask: str | None = None
    nodata: float | None = None
    velocity_m_per_s: tuple[float, float, float] | None = None
    turns: Turns | None = None
    whole_rows: int | None = None
    platform: str = ""
    calibration: Calibration | None = None
    exposure: float | None = None


@dataclass(frozen=True)
class UnusedImage:
    """An image of the folder that isn't used, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class ElevationModel:
    """A DEM raster and what must be added to its values to have ellipsoidal heights.

    `vertical` says how that was decided: the CRS's own vertical datum, an offset given, or assumed.
    """

    path: str
    offset_m: float
    vertical: str


@dataclass(frozen=True)
class ControlPoint:
    """A point known on the ground. `check` points are never used in a solve. plan_only: its height is not
    known, and that of the others stands for it. sd_assumed: nothing states how precise it is, its deviations
    are defaults."""

    name: str
    lon_deg: float
    lat_deg: float
    height_ellipsoidal_m: float
    sd_horizontal_m: float
    sd_vertical_m: float
    check: bool
    images: tuple[tuple[str, float, float], ...]
    """(frame name, col_px, row_px) of each image it was measured in."""
    plan_only: bool = False
    sd_assumed: bool = False


@dataclass(frozen=True)
class MapPlaces:
    """Places of a reference map that frames show: control points in plan."""

    points: tuple[ControlPoint, ...]


@dataclass(frozen=True)
class Band:
    """A band of a rig that `Survey.frames` don't show: its camera, and its file of each capture.

    wavelength_nm: of its middle, None where unknown. frames[i] was taken with `Survey.frames[i]`; None where
    the file is missing. Its position and attitude are the capture's. quantity: what its values mean.
    """

    name: str
    wavelength_nm: float | None
    camera: Camera
    frames: tuple[Frame | None, ...]
    quantity: Quantity | None = None


@dataclass(frozen=True)
class Warn:
    """Something the user should know: a stable code, the frame it is about (or ''), one line."""

    code: str
    frame: str
    text: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "text", printable(self.text))


@dataclass(frozen=True)
class Survey:
    """Frames in order of capture (time, then name), their cameras, and where all of it lies.

    band, other_bands: of a rig that writes a file a band, what the frames show, and what else it took.
    quantity: what the frames' values mean, None where nobody asked.
    """

    frames: tuple[Frame, ...]
    cameras: tuple[Camera, ...]
    work_frame: LocalFrame
    map_crs: str
    elevation: ElevationModel | None = None
    control: tuple[ControlPoint, ...] = ()
    warnings: tuple[Warn, ...] = ()
    left_out: tuple[UnusedImage, ...] = ()
    band: str = ""
    other_bands: tuple[Band, ...] = ()
    quantity: Quantity | None = None

    def __post_init__(self) -> None:
        """Raises ValueError where a frame has no known camera, or where a camera or a deviation can't be."""
        if not {f.camera for f in self.frames} <= {c.name for c in self.cameras}:
            raise ValueError("frames of no known camera")
        for camera in self.cameras:
            camera.check()
        for frame in self.frames:
            if math.isnan(sum((*frame.position.deviations_m, *frame.attitude.deviations_deg))):
                raise ValueError("a deviation that is no number")

    @property
    def clock_times_s(self) -> Floats:
        """Capture times (n,) in s, NaN where unknown, with a day between the frames of one platform and those
        of the next. Two drones that fly at once are no neighbours in time."""
        times_s = np.array([f.time_s for f in self.frames], dtype=np.float64)
        platform = np.array([f.platform for f in self.frames])
        end_s = 0.0
        for one in np.unique(platform):
            its = np.flatnonzero((platform == one) & np.isfinite(times_s))
            if len(its):
                times_s[its] += end_s - np.floor(times_s[its].min())
                end_s = np.ceil(times_s[its].max()) + DAY_S
        return times_s

    @property
    def located(self) -> tuple[bool, ...]:
        """Which frames have a position that was observed."""
        return tuple(f.position.known for f in self.frames)

    def camera_of(self, i: int) -> Camera:
        """The camera that took frame i."""
        return next(c for c in self.cameras if c.name == self.frames[i].camera)
