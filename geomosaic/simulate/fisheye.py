"""A lens that bends as fisheyes do, for frames whose tags tell of a perspective one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.camera.interior import Camera

Floats = NDArray[np.float64]
_WIDEST_RAD = np.radians(85.0)
_ROUNDS = 20


@dataclass(frozen=True)
class Fisheye(Camera):
    """Kannala and Brandt 2006, equation 6: the radius in the image is `f (t + k1 t³ + k2 t⁵ + k3 t⁷)` for a
    ray that is t (rad) off the axis; p1 and p2 are not used."""

    def image_from_camera(self, camera_m: ArrayLike) -> Floats:
        """Col and row of points in camera axes, shape (..., 2); NaN from 85 degrees off the axis on."""
        p = np.asarray(camera_m, dtype=np.float64)
        across = np.hypot(p[..., 0], p[..., 1])
        angle = np.arctan2(across, -p[..., 2])
        grown = np.where(angle < _WIDEST_RAD, self._grown(angle), np.nan)
        share = np.where(across > 0.0, grown / np.where(across > 0.0, across, 1.0), 0.0)
        share = np.where(np.isnan(grown), np.nan, share)
        return np.stack(
            [
                self.principal_col_px + self.focal_length_px * share * p[..., 0],
                self.principal_row_px - self.focal_length_px * share * p[..., 1],
            ],
            axis=-1,
        )

    def ray_from_image(self, image_px: ArrayLike) -> Floats:
        """Viewing directions in camera axes with z = -1, shape (..., 3), by Newton's method."""
        px = np.asarray(image_px, dtype=np.float64)
        xy = (px - [self.principal_col_px, self.principal_row_px]) / self.focal_length_px
        radius = np.linalg.norm(xy, axis=-1)
        angle = radius.copy()
        for _ in range(_ROUNDS):
            sq = angle * angle
            slope = 1.0 + sq * (3.0 * self.k1 + sq * (5.0 * self.k2 + sq * 7.0 * self.k3))
            angle = np.clip(angle - (self._grown(angle) - radius) / np.maximum(slope, 0.1), 0.0, _WIDEST_RAD)
        share = np.where(radius > 0.0, np.tan(angle) / np.where(radius > 0.0, radius, 1.0), 1.0)
        return np.stack([xy[..., 0] * share, -xy[..., 1] * share, -np.ones(radius.shape)], axis=-1)

    def _grown(self, angle: Floats) -> Floats:
        sq = angle * angle
        return np.asarray(angle * (1.0 + sq * (self.k1 + sq * (self.k2 + sq * self.k3))))
