"""Exterior orientation of frames, and the collinearity equations both ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation

Floats = NDArray[np.float64]
_READOUT_ROUNDS = 3  # each shrinks the error by the share of the frame that passes during a readout


@dataclass(frozen=True)
class Pose:
    """One frame's projection centre (east, north, up in m) and rotation in the work frame.

    velocity_m_per_s (3,): moves the projection centre while a rolling shutter reads its rows.
    """

    position_m: Floats
    rotation: Rotation
    velocity_m_per_s: Floats | None = None

    def image_from_ground(self, camera: Camera, ground_m: ArrayLike) -> Floats:
        """Col and row of ground points (..., 3): the collinearity equations. NaN where not seen."""
        d = np.asarray(ground_m, dtype=np.float64) - self.position_m
        image = camera.image_from_camera(d @ self.rotation.matrix)
        if self.velocity_m_per_s is not None and camera.readout_s:
            for _ in range(_READOUT_ROUNDS):
                moved = camera.read_after_s(image[..., 1:]) * self.velocity_m_per_s
                image = camera.image_from_camera((d - moved) @ self.rotation.matrix)
        return image

    def centre_at(self, camera: Camera, image_px: ArrayLike) -> Floats:
        """Projection centres (..., 3) from which cols and rows (..., 2) were taken."""
        image = np.asarray(image_px, dtype=np.float64)
        if self.velocity_m_per_s is None or not camera.readout_s:
            return np.broadcast_to(self.position_m, (*image.shape[:-1], 3))
        return self.position_m + camera.read_after_s(image[..., 1:]) * self.velocity_m_per_s

    def ray_from_image(self, camera: Camera, image_px: ArrayLike) -> Floats:
        """Viewing directions in the work frame, shape (..., 3), not of unit length."""
        return np.asarray(camera.ray_from_image(image_px) @ self.rotation.matrix.T)


@dataclass(frozen=True)
class Poses:
    """Exterior orientation of n frames in the work frame, with standard deviations.

    positions_m, positions_sd_m: (n, 3) east, north, up.
    rotations: (n, 3, 3) east-north-up from camera, see `Rotation`.
    rotations_sd_rad: (n, 3) about the east, north and up axes. NaN or inf where nothing is known.
    velocities_m_per_s: (n, 3) in the work frame, 0 where unknown.
    """

    positions_m: Floats
    rotations: Floats
    positions_sd_m: Floats
    rotations_sd_rad: Floats
    velocities_m_per_s: Floats | None = None

    def __len__(self) -> int:
        return len(self.positions_m)

    def __getitem__(self, i: int) -> Pose:
        velocity = None if self.velocities_m_per_s is None else self.velocities_m_per_s[i]
        return Pose(self.positions_m[i], Rotation(self.rotations[i]), velocity)
