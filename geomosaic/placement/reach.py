"""How far frames reach over the ground, and how far POS may put them off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.placement.heights import LEAST_HEIGHT_M
from geomosaic.projection.ground import GroundSurface

_MOST = tuned(0.5, "rad, share", "cap of a tilt's or focal deviation: more pairs in vain; less misses pairs")
_MOST_YAW_RAD = tuned(1.0, "rad", "cap of a heading's deviation: more pairs distant frames; less misses near")


def half_extent_m(camera: Camera, height_m: float) -> float:
    """Distance on flat ground from the nadir point to the corner of a level frame."""
    return float(np.hypot(camera.width_px, camera.height_px) / 2.0 / camera.focal_length_px * height_m)


def ground_pixel_m(cameras: Sequence[Camera], height_m: Floats) -> float:
    """The finest pixel of level frames, at the middle of their heights (n,) above ground; 0.01 m or more."""
    known = height_m[np.isfinite(height_m) & (height_m > 0.0)]
    height = float(np.median(known)) if known.size else 100.0
    return max(0.01, height / max(camera.focal_length_px for camera in cameras))


def heights_above_ground_m(poses: Poses, ground: GroundSurface) -> Floats:
    """Each projection centre above the surface below it, (n,)."""
    return np.asarray(poses.positions_m[:, 2] - ground.up_at(*poses.positions_m[:, :2].T))


def flying_heights_m(poses: Poses, ground: GroundSurface) -> Floats:
    """As `heights_above_ground_m`, but no frame lower than LEAST_HEIGHT_M: a length to scale by."""
    return np.maximum(heights_above_ground_m(poses, ground), LEAST_HEIGHT_M)


def misplacement_m(
    poses: Poses, cameras: Sequence[Camera], ground: GroundSurface, sigmas: float = 3.0
) -> Floats:
    """How far a frame's ground points may lie off at `sigmas` standard deviations, (n,).

    From the position's, the tilt's, and at half of the frame's reach the yaw's and the focal length's
    deviation.
    """
    height = heights_above_ground_m(poses, ground)
    reach = np.array([half_extent_m(c, h) for c, h in zip(cameras, height, strict=True)]) / 2.0
    tilt = height * np.minimum(poses.rotations_sd_rad[:, :2].max(axis=1), _MOST)
    yaw = reach * np.minimum(poses.rotations_sd_rad[:, 2], _MOST_YAW_RAD)
    focal = np.array([c.focal_length_sd_px / c.focal_length_px for c in cameras])
    lens = reach * np.minimum(focal, _MOST)
    position = poses.positions_sd_m[:, :2].max(axis=1)
    return np.asarray(sigmas * np.sqrt(position**2 + tilt**2 + yaw**2 + lens**2))
