"""What is left between frames after an adjustment, and each frame's error where the truth is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats, Ints64
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.matching.model import TiePoints
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface


@dataclass(frozen=True)
class PairMisalignments:
    """One row a tied pair. left, right, points: (k,). mean_m: (k, 2) east and north of right minus left.

    rms_m and max_m: (k,) of the lengths of the pair's residuals.
    """

    left: Ints64
    right: Ints64
    points: Ints64
    mean_m: Floats
    rms_m: Floats
    max_m: Floats

    @property
    def length_m(self) -> Floats:
        """The pairs' misalignments as lengths, (k,): what the paper compares with its epsilon."""
        return np.asarray(np.linalg.norm(self.mean_m, axis=1))


def pair_misalignments(ties: TiePoints, residuals_m: Sequence[Floats]) -> PairMisalignments:
    """What `Adjusted.residuals_m` says of each pair of ties.pairs; NaN for a pair without residuals."""
    lengths = [np.linalg.norm(r, axis=1) for r in residuals_m]
    empty = np.full(2, np.nan)
    left, right = np.array(ties.frames, dtype=np.int64).reshape(-1, 2).T
    return PairMisalignments(
        left,
        right,
        np.array([len(r) for r in residuals_m], dtype=np.int64),
        np.array([r.mean(axis=0) if len(r) else empty for r in residuals_m]).reshape(-1, 2),
        np.array([np.sqrt((x**2).mean()) if x.size else np.nan for x in lengths]),
        np.array([x.max() if x.size else np.nan for x in lengths]),
    )


@dataclass(frozen=True)
class FramesOverGround:
    """Poses and cameras (n,) of frames, and the ground that they show."""

    poses: Poses
    cameras: Sequence[Camera]
    ground: GroundSurface


def frame_ground_errors(found: FramesOverGround, true: FramesOverGround) -> Floats:
    """How far from the truth each frame's middle pixel lands on the ground, (n, 2) east and north in m.

    Adjusted minus true. This is the error the mosaic shows; a projection centre's own error may be
    made good by its tilt. NaN where a ray misses the ground.
    """
    out = np.full((len(found.poses), 2), np.nan)
    for i, (camera, true_camera) in enumerate(zip(found.cameras, true.cameras, strict=True)):
        middle = np.array([[camera.width_px / 2.0, camera.height_px / 2.0]])
        here = ground_from_image(found.poses[i], camera, found.ground, middle)
        there = ground_from_image(true.poses[i], true_camera, true.ground, middle)
        out[i] = (here - there)[0, :2]
    return out


@dataclass(frozen=True)
class Trend:
    """A straight line through errors against frame number: `error = intercept + slope * number`."""

    slope: float
    slope_sd: float
    intercept: float

    @property
    def grows(self) -> bool:
        """True where the slope differs from zero by more than twice its standard deviation."""
        return abs(self.slope) > 2.0 * self.slope_sd


def trend(number: ArrayLike, error: ArrayLike) -> Trend:
    """Least-squares line with the slope's standard deviation; NaN pairs are left out, 4 must be left.

    Errors of neighbouring frames are alike, which makes the usual deviation too small. So the number of
    values is reduced to `n (1 - r) / (1 + r)`, r the residuals' correlation at lag 1, not below 3 (Santer et
    al. 2000, J. Geophys. Res. 105, equations 4 to 6).
    """
    x, y = np.asarray(number, dtype=np.float64), np.asarray(error, dtype=np.float64)
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if x.size < 4:
        return Trend(float("nan"), float("nan"), float("nan"))
    dx = x - x.mean()
    slope = float(dx @ y / (dx @ dx))
    left = y - y.mean() - slope * dx
    total = float(left @ left)
    r = max(float(left[1:] @ left[:-1]) / total, 0.0) if total > 0.0 else 0.0
    effective = max(x.size * (1.0 - r) / (1.0 + r), 3.0)
    slope_sd = float(np.sqrt(total / (effective - 2.0) / (dx @ dx)))
    return Trend(slope, slope_sd, float(y.mean() - slope * x.mean()))
