"""What ground, clouds and motion may do in a camera's pixels: from what they do in metres and seconds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.ccd.volumes import BLOCK_LINES
from geomosaic.constants import tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.survey.strips import StripGeometry


@dataclass(frozen=True)
class ScenePriors:
    """What holds for every camera; what is of one is in its `StripGeometry`.

    cloud_height_m, cloud_height_sd_m: clouds lie from the ground to some 13 km. Low, middle and high ones
    reach up to 2, 7 and 13 km at middle latitudes (WMO, International Cloud Atlas, 2017). Most that hide the
    ground are low or middle ones. wind_sd_m_per_s: of each component, at their height; jet streams reach 50.
    slope: root mean square of the ground's along the track over some 100 m; steep: in mountains; steepest:
    what ground doesn't exceed over some 100 m.
    ground_sd_m: of heights about those that the nominal row separation holds for.
    pointing_rad_per_s: change of the pointing within hundredths of a second, including jitter such as TH-1's.
    That is 1.2 px at 1.1 Hz to 0.06 px at 22 Hz, where a pixel is 3.7 microradians.
    drift_rad_per_s: of its mean between the rows, as platforms that are stabilised on three axes hold it
    (1e-3 degrees a second).
    knot_s: jitter of up to 100 Hz, as reaction wheels make it, needs a knot every 5 ms (Nyquist).
    """

    cloud_height_m: float = 3500.0
    cloud_height_sd_m: float = 2500.0
    wind_sd_m_per_s: float = 19.0
    slope: float = 0.083
    steep: float = 0.45
    steepest: float = 1.0
    ground_sd_m: float = 500.0
    pointing_rad_per_s: float = 5.4e-5
    drift_rad_per_s: float = 2.0e-5
    knot_s: float = 0.0049


NOMINAL_SD_PX = tuned(2.0, "px", "mounting of CCDs: less takes ground for cloud; more, cloud for ground")
_LEAST_KNOT_LINES = tuned(8, "lines", "knot spacing: with less, cells have too few pixels to be measured")
NOISE_SHARE = tuned(0.3, "share", "of noise in a step: less misses noisy steps; more finds false ones")
LEAST_STEP_PX = tuned(0.5, "px", "of a step or a break: ground has 0.1, 0.35 at low contrast; more misses")
_MOST_PX = tuned(1e3, "px", "cap: an odd geometry file would give any deviation; less binds real cameras")


@dataclass(frozen=True)
class Expected:
    """A camera's pixels and lines; pairs of numbers are columns and lines, trailing minus leading.

    knot_lines: between knots, even; jitter_lines: the most that follow jitter. ground_sd_px: of the ground's
    level about the nominal geometry; far_px: what is further off is rather a cloud. clouds_px, clouds_sd_px:
    clouds against the ground.
    moves_px_per_line, bends_px_per_line, steep_px_per_line, steepest_px_per_line: usual change of the
    motion; usual, large and utmost change of what pairs have for themselves, by relief.
    """

    knot_lines: int
    jitter_lines: int
    ground_sd_px: Floats
    far_px: float
    clouds_px: Floats
    clouds_sd_px: Floats
    moves_px_per_line: float
    bends_px_per_line: float
    steep_px_per_line: float
    steepest_px_per_line: float

    def steep_px(self, lines: float, alone: bool) -> float:
        """More than a pair's curve rises within so many lines, against the other pairs' or alone."""
        motion = 2.1 * self.moves_px_per_line if alone else 0.0
        return max(LEAST_STEP_PX, lines * max(self.steep_px_per_line, motion))


def expected(geometry: StripGeometry, knot_lines: int = 0, priors: ScenePriors | None = None) -> Expected:
    """What may be expected of a camera's strips; knot_lines 0: as jitter needs them."""
    g, n = geometry, priors or ScenePriors()
    rows_s, px_per_rad = g.row_separation_lines / g.line_rate_hz, g.altitude_m / g.ground_pixel_m
    line_m = min(1.0 / g.height_m_per_line if g.height_m_per_line > 0.0 else 0.0, _MOST_PX)
    drift_px, wind_px = n.drift_rad_per_s * rows_s * px_per_rad, n.wind_sd_m_per_s * rows_s / g.ground_pixel_m
    ground_sd = np.hypot(np.hypot(NOMINAL_SD_PX, drift_px), [0.0, n.ground_sd_m * line_m])
    jitter_lines = _even(n.knot_s * g.line_rate_hz)
    clouds_sd = np.hypot(np.hypot(1.0, wind_px), [0.0, n.cloud_height_sd_m * line_m])
    return Expected(
        knot_lines=max(knot_lines // 2 * 2, 4) if knot_lines else jitter_lines,
        jitter_lines=jitter_lines,
        ground_sd_px=np.minimum(ground_sd, _MOST_PX),
        far_px=THREE_SIGMA * float(ground_sd[0]),
        clouds_px=np.array([0.0, -n.cloud_height_m * line_m]),
        clouds_sd_px=np.minimum(clouds_sd, _MOST_PX),
        moves_px_per_line=n.pointing_rad_per_s * px_per_rad / g.line_rate_hz,
        bends_px_per_line=n.slope * g.ground_pixel_m * line_m,
        steep_px_per_line=n.steep * g.ground_pixel_m * line_m,
        steepest_px_per_line=n.steepest * g.ground_pixel_m * line_m,
    )


def _even(lines: float) -> int:
    return int(np.clip(2 * round(lines / 2), _LEAST_KNOT_LINES, 2 * BLOCK_LINES))
