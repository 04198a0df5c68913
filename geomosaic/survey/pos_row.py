"""What a POS file says of the frames, whatever form it has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from geomosaic.survey.model import Warn


@dataclass(frozen=True)
class PosRow:
    """What a POS file says of one frame: geodetic WGS 84, body angles (`Attitude`), None where silent."""

    name: str
    line: int
    lon_deg: float
    lat_deg: float
    height_ellipsoidal_m: float | None = None
    height_above_ground_m: float | None = None
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float | None = None
    sd_east_m: float | None = None
    sd_north_m: float | None = None
    sd_vertical_m: float | None = None
    sd_yaw_deg: float | None = None
    sd_tilt_deg: float | None = None
    camera: str | None = None
    attitude_source: str = "pos-yaw-pitch-roll"


@dataclass(frozen=True)
class PosFile:
    """Rows in the file's order, what was assumed in reading them, and whether the file says what its heights
    count from."""

    path: Path
    rows: tuple[PosRow, ...]
    warnings: tuple[Warn, ...]
    datum_stated: bool = True
