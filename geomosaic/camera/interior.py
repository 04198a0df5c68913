"""Interior orientation: pinhole with Brown's distortion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A frame camera, in pixels of the full frame with GDAL's corner origin.

    Brown 1971 as OpenCV and OpenSfM write it: with x to the right and y to the image's bottom, both
    divided by the depth, and r² = x² + y²,
    `x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)`,
    `y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2 y²) + 2 p2 x y`,
    `col = principal_col_px + f x'`, `row = principal_row_px + f y'`.

    focal_length_sd_px, distortion_sd: how well they are known beforehand, 0 where nothing says; that of the
    distortion is a share of the corner's radius.
    readout_s: time from reading the first row to the last, 0 for a global shutter; a pose is that of the
    middle row. Negative if the last row is read first, as in a picture turned by 180 degrees.
    """

    name: str
    width_px: int
    height_px: int
    focal_length_px: float
    principal_col_px: float
    principal_row_px: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    focal_length_sd_px: float = 0.0
    readout_s: float = 0.0
    distortion_sd: float = 0.0

    def turned(self, quarters: int) -> Camera:
        """The camera of a picture that was turned clockwise by quarter turns after it was taken.

        The principal point, the decentring terms and the order of the rows turn with the pixels; of a
        quarter turn, whose columns would be read one after the other, the readout is left out.
        """
        if quarters % 2 and self.readout_s:
            return replace(self, readout_s=0.0).turned(quarters)
        camera = self
        for _ in range(quarters % 4):
            camera = replace(
                camera,
                width_px=camera.height_px,
                height_px=camera.width_px,
                principal_col_px=camera.height_px - camera.principal_row_px,
                principal_row_px=camera.principal_col_px,
                p1=camera.p2,
                p2=-camera.p1,
            )
        return replace(camera, readout_s=-self.readout_s) if quarters % 4 == 2 else camera

    @property
    def distortion(self) -> Floats:
        """k1, k2, p1, p2, k3: OpenCV's order."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3])

    @property
    def corners_px(self) -> Floats:
        """The outer corners, clockwise from the top left, shape (4, 2)."""
        w, h = float(self.width_px), float(self.height_px)
        return np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])

    def border_px(self, per_side: int = 8) -> Floats:
        """Points along the outer border, clockwise from the top left, shape (4 * per_side, 2)."""
        corners = self.corners_px
        t = np.arange(per_side)[:, None] / per_side
        sides = [a + (b - a) * t for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        return np.concatenate(sides)

    @cached_property
    def _radius_limit_sq(self) -> float:
        """Square of the undistorted radius past which the polynomial is no lens any more.

        Either where it stops growing, or a little outside the frame's farthest corner.
        """
        far = np.linalg.norm(self.corners_px - [self.principal_col_px, self.principal_row_px], axis=1).max()
        radius = np.linspace(0.0, 3.0 * far / self.focal_length_px, 4096)
        grown = radius * (1.0 + self._radial(radius**2))
        falling = np.flatnonzero(np.diff(grown) <= 0.0)
        end = int(falling[0]) if falling.size else radius.size - 1
        outside = np.flatnonzero(grown[: end + 1] > 1.1 * far / self.focal_length_px)
        return float(radius[outside[0] if outside.size else end] ** 2)

    def _radial(self, r_sq: Floats) -> Floats:
        return np.asarray(r_sq * (self.k1 + r_sq * (self.k2 + r_sq * self.k3)))

    def read_after_s(self, row_px: NDArray[Any]) -> NDArray[Any]:
        """When rows are read, from the middle one on, in the precision of the rows."""
        return np.asarray(self.readout_s * (row_px / self.height_px - 0.5))

    def distort(self, xy: Floats) -> Floats:
        """Distorted from ideal normalised coordinates (x right, y down), shape (..., 2)."""
        x, y = xy[..., 0], xy[..., 1]
        r_sq = x * x + y * y
        scale = 1.0 + self._radial(r_sq)
        return np.stack(
            [
                x * scale + 2.0 * self.p1 * x * y + self.p2 * (r_sq + 2.0 * x * x),
                y * scale + self.p1 * (r_sq + 2.0 * y * y) + 2.0 * self.p2 * x * y,
            ],
            axis=-1,
        )

    def undistort(self, xy: Floats) -> Floats:
        """Ideal from distorted normalised coordinates by fixed-point iteration, to 1e-12."""
        ideal = np.array(xy, dtype=np.float64)
        if not np.any(self.distortion):
            return ideal
        for _ in range(50):
            r_sq = np.minimum(ideal[..., 0] ** 2 + ideal[..., 1] ** 2, self._radius_limit_sq)
            slope = (
                1.0 + self._radial(r_sq) + 2.0 * r_sq * (self.k1 + r_sq * (2 * self.k2 + 3 * self.k3 * r_sq))
            )
            step = (xy - self.distort(ideal)) / np.maximum(slope, 0.2)[..., None]
            ideal += step
            if np.nanmax(np.abs(step), initial=0.0) < 1e-12:
                break
        return ideal

    def image_from_camera(self, camera_m: ArrayLike) -> Floats:
        """Col and row of points in camera axes (x right, y top, z against the view), shape (..., 2).

        NaN behind the camera and far outside the picture, where the polynomial would fold back.
        """
        p = np.asarray(camera_m, dtype=np.float64)
        depth = np.where(p[..., 2] < 0.0, -p[..., 2], np.nan)
        ideal = np.stack([p[..., 0] / depth, -p[..., 1] / depth], axis=-1)
        outside = (ideal**2).sum(axis=-1) > self._radius_limit_sq
        ideal[outside] = np.nan
        return np.asarray(
            self.distort(ideal) * self.focal_length_px + [self.principal_col_px, self.principal_row_px]
        )

    def ray_from_image(self, image_px: ArrayLike) -> Floats:
        """Viewing directions in camera axes with z = -1, shape (..., 3), of cols and rows."""
        px = np.asarray(image_px, dtype=np.float64)
        xy = (px - [self.principal_col_px, self.principal_row_px]) / self.focal_length_px
        ideal = self.undistort(xy)
        return np.stack([ideal[..., 0], -ideal[..., 1], -np.ones(ideal.shape[:-1])], axis=-1)
