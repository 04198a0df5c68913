"""What to simulate of CCD strips: focal plane, motion, ground, clouds, sensor, faults, and reports."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geomosaic.arrays import Ints64
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import MEAN_RADIUS_M
from geomosaic.survey.strips import Ccd, StripGeometry

JITTER_HZ = (1.1, 4.7, 22.0)
_HIGHEST_M = 2e6


@dataclass(frozen=True)
class StripPlan:
    """Parameters of a simulated scene; 0 switches a thing off. The defaults are TH-1's, but narrow and short.

    CCDs and lines of `dead` ("3,5"), `short` ("ccd:lines"), `lost` and `repeated` ("ccd:line:count") count
    the CCDs from 1 and the lines of the file from 0. See docs/simulation.md.
    """

    seed: int = 1
    ccds: int = 8
    width_px: int = 512
    lines: int = 8192
    overlap_px: int = 96
    read_px: int = 110
    row_separation_lines: float = 2114.0
    first_row: int = 1
    ground_pixel_m: float = 2.0
    line_rate_hz: float = 3272.4
    parallax_m_per_line: float = 233.0

    jitter_1hz_px: float = 1.2
    jitter_5hz_px: float = 0.4
    jitter_22hz_px: float = 0.06
    drift_px_per_s: float = 2.0
    drift_angle_deg: float = 0.03
    mounting_px: float = 1.0
    thermal_px: float = 0.3
    motion: Path | None = None

    lon_deg: float = 100.4
    lat_deg: float = 38.2
    course_deg: float = 193.0
    ground_height_m: float = 900.0
    relief_m: float = 300.0
    relief_wavelength_m: float = 8000.0
    dem: Path | None = None
    texture: Path | None = None
    contrast: float = 0.12
    low_contrast: float = 0.01
    low_contrast_share: float = 0.0
    saturated_share: float = 0.0
    targets: int = 0

    cloud_cover: float = 0.0
    cloud_height_m: float = 3000.0
    wind_m_per_s: float = 15.0
    wind_deg: float = 60.0
    cloud_size_m: float = 3000.0

    bit_depth: int = 10
    brightness: float = 0.35
    gain_sd: float = 0.03
    offset_sd: float = 0.005
    column_sd: float = 0.005
    snr: float = 150.0

    dead: str = ""
    short: str = ""
    lost: str = ""
    repeated: str = ""

    attitude_hz: float = 400.0
    attitude_bias_urad: float = 0.0
    attitude_error_urad: float = 0.0
    attitude_noise_urad: float = 0.0
    dem_bias_m: float = 0.0
    dem_error_m: float = 0.0
    dem_pixel_m: float = 30.0

    def __post_init__(self) -> None:
        if self.overlap_px * 2 >= self.width_px or not self.overlap_px <= self.read_px <= self.width_px:
            raise InputError(
                f"an overlap of {self.overlap_px} px, read {self.read_px} px, doesn't fit strips of "
                f"{self.width_px} px",
                fix="overlap_px <= read_px <= width_px, and overlap_px below half of it",
            )
        if self.lines <= self.row_separation_lines:
            raise InputError(
                f"{self.lines} lines are no more than the rows' separation", fix="give more lines"
            )
        if not 0.0 < self.altitude_m < _HIGHEST_M:
            raise InputError(
                f"{self.parallax_m_per_line:g} m of height for a line between rows "
                f"{self.row_separation_lines:g} lines apart wants an orbit above 2000 km",
                fix="give a smaller parallax_m_per_line or row_separation_lines",
            )
        for name, each in (("dead", 1), ("short", 2), ("lost", 3), ("repeated", 3)):
            for fault in self.faults(name, each):
                if not 1 <= fault[0] <= self.ccds:
                    raise InputError(f"{name}: there is no CCD {fault[0]}", fix=f"give 1 to {self.ccds}")

    def faults(self, name: str, each: int) -> list[tuple[int, ...]]:
        """The entries of `dead`, `short`, `lost` or `repeated`: `each` whole numbers, first the CCD."""
        text = str(getattr(self, name)).replace(" ", "")
        found = []
        for part in filter(None, text.split(",")):
            if not re.fullmatch(r"\d+(:\d+)*", part) or part.count(":") != each - 1:
                form = ":".join(("ccd", "lines" if each == 2 else "line", "count")[:each])
                raise InputError(f"{name} is '{text}'", fix=f"give {form}, several with commas")
            found.append(tuple(int(v) for v in part.split(":")))
        return found

    @property
    def altitude_m(self) -> float:
        """Flying height above the ground, from the height of one line's parallax between the rows.

        The rows' rays meet the ground at an angle of separation * pixel * (1 / altitude + 1 / R). The second
        part is the turn of the vertical between the two places from which they look.
        """
        return 1.0 / (1.0 / (self.parallax_m_per_line * self.row_separation_lines) - 1.0 / MEAN_RADIUS_M)

    @property
    def pixel_rad(self) -> float:
        """The angle of a ground pixel."""
        return self.ground_pixel_m / self.altitude_m

    def row(self, ccd: int) -> int:
        """1 leading, 2 trailing; neighbours alternate."""
        return 1 + (self.first_row - 1 + ccd) % 2

    def acquired(self, ccd: int) -> Ints64:
        """The camera line (n,) that each line of a CCD's file is; with nothing wrong 0, 1, ... lines - 1.

        A lost line is in no file line, a repeated one in several. Empty for a dead CCD.
        """
        if (ccd + 1,) in self.faults("dead", 1):
            return np.empty(0, dtype=np.int64)
        lines = np.arange(self.lines, dtype=np.int64)
        events = [(line, count, "lost") for k, line, count in self.faults("lost", 3) if k == ccd + 1]
        events += [(line, count, "repeated") for k, line, count in self.faults("repeated", 3) if k == ccd + 1]
        for line, count, kind in sorted(events, reverse=True):
            if kind == "lost":
                lines = np.delete(lines, slice(line, line + count))
            else:
                lines = np.insert(lines, line, [lines[min(line, len(lines) - 1)]] * count)
        for k, length in self.faults("short", 2):
            if k == ccd + 1:
                lines = lines[:length]
        return lines

    def geometry(self) -> StripGeometry:
        """The focal plane as GEOMETRY.yaml says it, with the names of the strips' files."""
        lines = tuple(len(self.acquired(k)) for k in range(self.ccds))
        names = (Path(f"ccd{k + 1}.tif") if lines[k] else None for k in range(self.ccds))
        return StripGeometry(
            ccds=tuple(Ccd(name, self.row(k)) for k, name in enumerate(names)),
            width_px=self.width_px,
            lines=lines,
            overlap_px=self.overlap_px,
            read_px=self.read_px,
            row_separation_lines=self.row_separation_lines,
            ground_pixel_m=self.ground_pixel_m,
            line_rate_hz=self.line_rate_hz,
            altitude_m=self.altitude_m,
            bit_depth=self.bit_depth,
        )
