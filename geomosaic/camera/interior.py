"""Interior orientation: a focal length, a principal point and a lens."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.arrays import Floats
from geomosaic.camera.lens import LENSES, TERMS, Lens
from geomosaic.constants import tuned
from geomosaic.errors import UnknownNameError

_SAME_PLACES_BYTES = tuned(1 << 15, "bytes", "of places whose rays are kept; more: keys cost as much")


@dataclass(frozen=True)
class Camera:
    """A frame camera, in pixels of the full frame with GDAL's corner origin.

    `col = principal_col_px + f x'`, `row = principal_row_px + f y'`, with x' and y' as the lens of its kind
    (a name in `lens.LENSES`, where the terms k1 to p2 are defined) bends x and y.

    focal_length_sd_px, distortion_sd: how well they are known beforehand, 0 where nothing says; that of the
    distortion is a share of the corner's radius.
    readout_s: time from reading the first row to the last, 0 for a global shutter; a pose is that of the
    middle row. Negative if the last row is read first, as in an image turned by 180 degrees.
    readout_sd_s: how well it is known, 0 where it is; without a readout, how long an unreported one
    might be.
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
    kind: str = "brown"
    readout_sd_s: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in LENSES:
            raise UnknownNameError("kind of lens", str(self.kind), LENSES)

    def check(self) -> None:
        """Raises ValueError if it can't be one."""
        if not math.isfinite(self.focal_length_px) or self.focal_length_px == 0.0:
            raise ValueError("a camera without focal length")
        if min(self.width_px, self.height_px) < 1:
            raise ValueError("a camera without pixels")

    def turned(self, quarters: int) -> Camera:
        """The camera of an image that was turned clockwise by quarter turns after it was taken.

        The principal point, the decentring terms and the order of the rows turn with the pixels. After an odd
        number of quarter turns the readout is left out, since columns would be read one after the other.
        """
        if quarters % 2 and (self.readout_s or self.readout_sd_s):
            return replace(self, readout_s=0.0, readout_sd_s=0.0).turned(quarters)
        camera = self
        for _ in range(quarters % 4):
            p1, p2 = (camera.p2, -camera.p1) if camera.lens.decentring else (camera.p1, camera.p2)
            camera = replace(
                camera,
                width_px=camera.height_px,
                height_px=camera.width_px,
                principal_col_px=camera.height_px - camera.principal_row_px,
                principal_row_px=camera.principal_col_px,
                p1=p1,
                p2=p2,
            )
        return replace(camera, readout_s=-self.readout_s) if quarters % 4 == 2 else camera

    @property
    def lens(self) -> Lens:
        """The formulas of its kind."""
        return LENSES[self.kind]

    @property
    def terms(self) -> Floats:
        """The lens's, (5,) in the order of `lens.TERMS`."""
        return np.array([getattr(self, name) for name in TERMS])

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
    def radius_limit(self) -> float:
        """The ideal radius past which the lens is none any more, see `Lens.limit`."""
        far = np.linalg.norm(self.corners_px - [self.principal_col_px, self.principal_row_px], axis=1).max()
        return self.lens.limit(self.terms, float(far) / self.focal_length_px)

    def read_after_s(self, row_px: NDArray[Any]) -> NDArray[Any]:
        """When rows are read, from the middle one on, in the precision of the rows."""
        return np.asarray(self.readout_s * (row_px / self.height_px - 0.5))

    def image_from_camera(self, camera_m: ArrayLike) -> Floats:
        """Col and row of points in camera axes (x right, y top, z against the view), shape (..., 2).

        NaN behind the camera and far outside the image, where the polynomial would fold back.
        """
        p = np.asarray(camera_m, dtype=np.float64)
        depth = np.where(p[..., 2] < 0.0, -p[..., 2], np.nan)
        ideal = np.stack([p[..., 0] / depth, -p[..., 1] / depth], axis=-1)
        x, y = ideal[..., 0], ideal[..., 1]
        r_sq = x * x + y * y
        ideal[r_sq > self.radius_limit**2] = np.nan
        bent = np.stack(self.lens.bent(self.terms, x, y, r_sq), axis=-1)
        return np.asarray(bent * self.focal_length_px + [self.principal_col_px, self.principal_row_px])

    def ray_from_image(self, image_px: ArrayLike) -> Floats:
        """Viewing directions in camera axes with z = -1, shape (..., 3), of cols and rows."""
        px = np.asarray(image_px, dtype=np.float64)
        if px.nbytes > _SAME_PLACES_BYTES:
            return _rays(self, px)
        return _rays_again(self, px.tobytes(), px.shape).copy()


def _rays(camera: Camera, px: Floats) -> Floats:
    """See `Camera.ray_from_image`."""
    xy = (px - [camera.principal_col_px, camera.principal_row_px]) / camera.focal_length_px
    ideal = camera.lens.straightened(camera.terms, xy, camera.radius_limit)
    return np.stack([ideal[..., 0], -ideal[..., 1], -np.ones(ideal.shape[:-1])], axis=-1)


@lru_cache
def _rays_again(camera: Camera, px: bytes, shape: tuple[int, ...]) -> Floats:
    """The same of places that frames of one camera have in common."""
    return _rays(camera, np.frombuffer(px).reshape(shape))
