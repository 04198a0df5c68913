"""Exterior orientation of frames, and the collinearity equations both ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Pose:
    """One frame's projection centre (east, north, up in m) and rotation in the work frame."""

    position_m: Floats
    rotation: Rotation

    def image_from_ground(self, camera: Camera, ground_m: ArrayLike) -> Floats:
        """Col and row of ground points (..., 3): the collinearity equations. NaN where not seen."""
        d = np.asarray(ground_m, dtype=np.float64) - self.position_m
        return camera.image_from_camera(d @ self.rotation.matrix)

    def ray_from_image(self, camera: Camera, image_px: ArrayLike) -> Floats:
        """Viewing directions in the work frame, shape (..., 3), not of unit length."""
        return np.asarray(camera.ray_from_image(image_px) @ self.rotation.matrix.T)


@dataclass(frozen=True)
class Poses:
    """Exterior orientation of n frames in the work frame, with standard deviations.

    positions_m, positions_sd_m: (n, 3) east, north, up.
    rotations: (n, 3, 3) east-north-up from camera, see `Rotation`.
    rotations_sd_rad: (n, 3) about the east, north and up axes. NaN or inf where nothing is known.
    """

    positions_m: Floats
    rotations: Floats
    positions_sd_m: Floats
    rotations_sd_rad: Floats

    def __len__(self) -> int:
        return len(self.positions_m)

    def __getitem__(self, i: int) -> Pose:
        return Pose(self.positions_m[i], Rotation(self.rotations[i]))
