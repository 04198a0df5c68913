"""Exterior orientation of frames, and the collinearity equations both ways."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.arrays import Floats, Ints
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, about_z, turned_by
from geomosaic.constants import MOST_ROUNDS, tuned

_CONVERGED_PX = tuned(1e-4, "px", "row step that ends the search: tie points show a hundred times as much")

LEAST_RECORDED = tuned(-0.4, "share", "of the height, from the middle row: less leaves a tenth of the rows")


def row_moved_px(camera: Camera, before_px: NDArray[Any], row_px: NDArray[Any]) -> NDArray[Any]:
    """By how much a round has moved rows that lie in the image or near it; others by nothing."""
    near = np.abs(row_px - camera.height_px / 2.0) <= camera.height_px
    return np.asarray(np.where(near, np.abs(row_px - before_px), row_px.dtype.type(0.0)))


@dataclass(frozen=True, eq=False)
class Turns:
    """How a frame (or many) turns while a rolling shutter reads its rows, against its middle row.

    rad (k, 3) or (n, k, 3): rotation vectors in camera axes, `R(row) = R exp(turn)`, at k >= 2 even times
    over span_s about the time of the middle row. They are linear between and beyond these times.
    recorded_until_s, () or (n,): how long after the middle row a gyroscope's record ends, beyond which turns
    are guessed. It is NaN where there is no record.
    """

    span_s: float
    rad: Floats
    recorded_until_s: Floats = field(default_factory=lambda: np.array(np.nan))

    def __getitem__(self, i: int | Ints) -> Turns:
        until_s = self.recorded_until_s
        return Turns(self.span_s, self.rad[i], until_s[i] if until_s.ndim else until_s)

    def at(self, after_s: ArrayLike, frame: Ints | None = None) -> tuple[Floats, Floats]:
        """Turns and their rates per second (..., 3) so long after the middle row. frame: of many, whose."""
        last = self.rad.shape[-2] - 1
        step = np.nan_to_num((np.asarray(after_s, dtype=np.float64) / self.span_s + 0.5) * last)
        low = np.clip(step, 0, last - 1).astype(np.intp)
        rad = self.rad.reshape(-1, 3)
        first = low if frame is None else low + frame * (last + 1)
        by_step = rad[first + 1] - rad[first]
        return rad[first] + (step - low)[..., None] * by_step, by_step * (last / self.span_s)

    def tabled(self, span_s: float, times: int) -> Turns:
        """The same of one frame over another span and at so many times."""
        rad = self.at(np.linspace(-0.5, 0.5, times) * span_s)[0]
        return Turns(span_s, rad, self.recorded_until_s)

    def turned(self, frames: list[int], quarters: int) -> Turns:
        """Of many, with those of images that were turned clockwise, as by `Camera.turned`."""
        rad = self.rad.copy()
        rad[frames] = rad[frames] @ about_z(quarters * np.pi / 2.0)
        return replace(self, rad=rad)


@dataclass(frozen=True)
class Pose:
    """One frame's projection centre (east, north, up in m) and rotation in the work frame.

    velocity_m_per_s (3,), turns: how the projection centre moves and the camera turns while a rolling shutter
    reads its rows; both stand for the middle row.
    """

    position_m: Floats
    rotation: Rotation
    velocity_m_per_s: Floats | None = None
    turns: Turns | None = None

    def image_from_ground(self, camera: Camera, ground_m: ArrayLike) -> Floats:
        """Col and row of ground points (..., 3): the collinearity equations. NaN where not seen."""
        d = np.asarray(ground_m, dtype=np.float64) - self.position_m
        image = camera.image_from_camera(d @ self.rotation.matrix)
        if not self.rolls(camera):
            return image
        for _ in range(MOST_ROUNDS):
            before = image
            turn, moved_m = self.since_middle(camera, image[..., 1])
            seen = (d - moved_m) @ self.rotation.matrix
            if turn is not None:
                seen = np.stack(turned_by(-np.moveaxis(turn, -1, 0), np.moveaxis(seen, -1, 0)), axis=-1)
            image = camera.image_from_camera(seen)
            if not (row_moved_px(camera, before[..., 1], image[..., 1]) > _CONVERGED_PX).any():
                break
        return image

    def centre_at(self, camera: Camera, image_px: ArrayLike) -> Floats:
        """Projection centres (..., 3) from which cols and rows (..., 2) were taken."""
        image = np.asarray(image_px, dtype=np.float64)
        if self.velocity_m_per_s is None or not camera.readout_s:
            return np.broadcast_to(self.position_m, (*image.shape[:-1], 3))
        return self.position_m + self.since_middle(camera, image[..., 1])[1]

    def ray_from_image(self, camera: Camera, image_px: ArrayLike) -> Floats:
        """Viewing directions in the work frame, shape (..., 3), not of unit length."""
        image = np.asarray(image_px, dtype=np.float64)
        ray = camera.ray_from_image(image)
        if self.turns is not None and camera.readout_s:
            turn, _ = self.turns.at(camera.read_after_s(image[..., 1]))
            ray = np.stack(turned_by(np.moveaxis(turn, -1, 0), np.moveaxis(ray, -1, 0)), axis=-1)
        return np.asarray(ray @ self.rotation.matrix.T)

    def rolls(self, camera: Camera) -> bool:
        """Whether rows are seen from elsewhere or elsewhere to."""
        return bool(camera.readout_s) and not (self.velocity_m_per_s is None and self.turns is None)

    def since_middle(self, camera: Camera, row_px: ArrayLike) -> tuple[Floats | None, Floats]:
        """Turns (..., 3), if any, and moves in the work frame (..., 3) from the middle row to rows."""
        after_s = camera.read_after_s(np.asarray(row_px, dtype=np.float64))
        velocity = np.zeros(3) if self.velocity_m_per_s is None else self.velocity_m_per_s
        return None if self.turns is None else self.turns.at(after_s)[0], after_s[..., None] * velocity


@dataclass(frozen=True)
class Poses:
    """Exterior orientation of n frames in the work frame, with standard deviations.

    positions_m, positions_sd_m: (n, 3) east, north, up.
    rotations: (n, 3, 3) east-north-up from camera, see `Rotation`.
    rotations_sd_rad: (n, 3) about the east, north and up axes. NaN or inf where nothing is known.
    velocities_m_per_s: (n, 3) in the work frame, 0 where unknown. turns: of all frames, 0 where unknown.
    """

    positions_m: Floats
    rotations: Floats
    positions_sd_m: Floats
    rotations_sd_rad: Floats
    velocities_m_per_s: Floats | None = None
    turns: Turns | None = None

    def __len__(self) -> int:
        return len(self.positions_m)

    def __getitem__(self, i: int) -> Pose:
        velocity = None if self.velocities_m_per_s is None else self.velocities_m_per_s[i]
        turns = None if self.turns is None else self.turns[i]
        return Pose(self.positions_m[i], Rotation(self.rotations[i]), velocity, turns)

    def of(self, frames: Ints) -> Poses:
        """Those of some frames."""
        return Poses(
            self.positions_m[frames],
            self.rotations[frames],
            self.positions_sd_m[frames],
            self.rotations_sd_rad[frames],
            None if self.velocities_m_per_s is None else self.velocities_m_per_s[frames],
            None if self.turns is None else self.turns[frames],
        )
