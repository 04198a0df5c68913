"""How a reference has to be shifted and tilted to lie on a surface best: what two georeferences differ by.

The method is least Z-difference matching (Rosenholm and Torlegard 1988, Three-dimensional absolute
orientation of stereo models using digital elevation models, PE&RS 54), without scale and turn. Slopes of the
surface show a shift in plan, as in Nuth and Kaeaeb 2011 (The Cryosphere 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import NORMAL_PER_MAD, ROUNDS, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.survey.accuracy import POSITION

HeightsAt = Callable[[Floats, Floats], Floats]
"""Heights of a surface at x (east) and y (north) in m, NaN where there are none."""
MOST_POINTS = tuned(200_000, "points", "of a fit or a test, evenly: more take time and change millimetres")
_CONVERGED = tuned(0.01, "pixels", "plan step that ends it: larger shows in the report")
_STEEPEST = tuned(1.0, "m per m", "slope limit: beyond, heights next to walls and crowns are chance")


@dataclass(frozen=True)
class HeightFit:
    """What the reference has to be given: a shift (m), and a tilt (m per m to the east and north) about the
    middle of what was compared. NaN where nothing could be fitted."""

    east_m: float
    north_m: float
    up_m: float
    tilt_east: float
    tilt_north: float
    middle_m: tuple[float, float]

    def moved(self, x_m: Floats, y_m: Floats, height_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Points (n,) of the reference."""
        tilt = self.tilt_east * (x_m - self.middle_m[0]) + self.tilt_north * (y_m - self.middle_m[1])
        return x_m + self.east_m, y_m + self.north_m, height_m + self.up_m + tilt


def fitted(surface: HeightsAt, x_m: Floats, y_m: Floats, height_m: Floats, pixel_m: float) -> HeightFit:
    """The fit of points (n,) to a surface of pixels."""
    step = -(-len(x_m) // MOST_POINTS)
    x, y, z = (values[::step] for values in (x_m, y_m, height_m))
    middle = float(x.mean()), float(y.mean())
    found = np.zeros(5)
    reach_m = max(float(np.ptp(x)), float(np.ptp(y)), pixel_m)
    across = np.column_stack([np.ones(len(x)), (x - middle[0]) / reach_m, (y - middle[1]) / reach_m])
    for _ in range(ROUNDS):
        east, north = x + found[3], y + found[4]
        off = surface(east, north) - z - across @ found[:3]
        slopes = np.column_stack(
            [
                (surface(east + pixel_m, north) - surface(east - pixel_m, north)) / (2.0 * pixel_m),
                (surface(east, north + pixel_m) - surface(east, north - pixel_m)) / (2.0 * pixel_m),
            ]
        )
        known = np.isfinite(off) & np.isfinite(slopes).all(axis=1)
        known[known] = (np.abs(slopes[known]) <= _STEEPEST).all(axis=1)
        if known.sum() < len(found):
            nan = float("nan")
            return HeightFit(nan, nan, nan, nan, nan, middle)
        spread = np.abs(off[known] - np.median(off[known]))
        sd = max(NORMAL_PER_MAD * float(np.median(spread)), 1e-3 * pixel_m)
        known[known] = spread <= THREE_SIGMA * sd
        terms = np.column_stack([across[known], -slopes[known]])
        prior = np.diag([0.0, 0.0, 0.0, 1.0, 1.0]) * (sd / POSITION["exif"].sd_horizontal_m)
        step_by = np.linalg.lstsq(
            np.vstack([terms, prior]), np.concatenate([off[known], -prior @ found]), rcond=None
        )[0]
        found += step_by
        if np.abs(step_by[3:]).max() < _CONVERGED * pixel_m:
            break
    up, tilt_east, tilt_north, east_m, north_m = (float(v) for v in found)
    return HeightFit(east_m, north_m, up, tilt_east / reach_m, tilt_north / reach_m, middle)
