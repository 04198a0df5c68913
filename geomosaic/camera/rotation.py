"""One rotation type for every way an attitude is written down."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats

CAMERA_FROM_BODY = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Forward is the image's top, right its right side, down the view."""

_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_ENU_FROM_NWU = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_BODY_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_GIMBAL_FROM_CAMERA = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_TOP_LEFT_UP_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _axis(angle_rad: ArrayLike, i: int, j: int) -> Floats:
    angle = np.asarray(angle_rad, dtype=np.float64)
    out = np.zeros((*angle.shape, 3, 3))
    out[..., [0, 1, 2], [0, 1, 2]] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(angle)
    out[..., j, i] = np.sin(angle)
    out[..., i, j] = -np.sin(angle)
    return out


def about_x(angle_rad: ArrayLike) -> Floats:
    """Right-handed rotation about x, shape (..., 3, 3)."""
    return _axis(angle_rad, 1, 2)


def about_y(angle_rad: ArrayLike) -> Floats:
    """Right-handed rotation about y, shape (..., 3, 3)."""
    return _axis(angle_rad, 2, 0)


def about_z(angle_rad: ArrayLike) -> Floats:
    """Right-handed rotation about z, shape (..., 3, 3)."""
    return _axis(angle_rad, 0, 1)


def exp_turn(turn_rad: Floats) -> Floats:
    """Rotation matrices (n, 3, 3) of rotation vectors (n, 3), Rodrigues' formula."""
    angle = np.linalg.norm(turn_rad, axis=1)
    safe = np.maximum(angle, 1e-12)
    axis = turn_rad / safe[:, None]
    k = np.zeros((len(turn_rad), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    k -= np.swapaxes(k, 1, 2)
    sin, cos = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.asarray(np.eye(3) + sin * k + (1.0 - cos) * (k @ k))


def log_turn(rotations: Floats) -> Floats:
    """Rotation vectors (n, 3) of rotation matrices (n, 3, 3), lengths of 0 to pi. By way of quaternions,
    since the matrix's own skew part vanishes at half a turn."""
    from scipy.spatial.transform import Rotation as Turn  # half a second that most commands needn't wait

    return np.asarray(Turn.from_matrix(rotations).as_rotvec())


def turned_by(turn_rad: Any, vectors: Any) -> Any:
    """Vectors turned by rotation vectors of half a radian at most, each three components of arrays.

    Rodrigues' formula by its series, to 1e-10; the components' precision is kept.
    """
    (a, b, c), (x, y, z) = turn_rad, vectors
    square = a * a + b * b + c * c
    sine = 1 - square * (1 / 6 - square * (1 / 120 - square * (1 / 5040 - square / 362880)))
    versine = 1 / 2 - square * (1 / 24 - square * (1 / 720 - square * (1 / 40320 - square / 3628800)))
    u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
    return (
        x + sine * u + versine * (b * w - c * v),
        y + sine * v + versine * (c * u - a * w),
        z + sine * w + versine * (a * v - b * u),
    )


@dataclass(frozen=True)
class Rotation:
    """Rotation(s) from camera axes to east-north-up axes: `enu = matrix @ camera`.

    Camera axes are the photogrammetric ones: x to the image's right, y to its top, z against the
    viewing direction, so that the camera looks along -z. East-north-up is local and true, not grid.

    Ways in and out (angles in radians; Rx, Ry, Rz are right-handed; signs for a nadir camera):

    - omega, phi, kappa: `Rx(omega) Ry(phi) Rz(kappa)`. kappa turns the image's right side from east
      to north; the heading of the image's top is -kappa.
    - phi, omega, kappa of the Chinese order (Yue et al. 2021, equation 1): axes X north, Y west, Z
      up; image x to the top, y to the left; `Ry(-phi) Rx(omega) Rz(kappa)`. phi > 0 lifts the image's top
      side, omega > 0 its left side, and the heading of the top is -kappa. The paper puts the true heading
      into kappa, which with Y west needs the minus sign.
    - yaw, pitch, roll of a body that carries a camera looking down, the image's top forward:
      north-east-down from forward-right-down is `Rz(yaw) Ry(pitch) Rx(roll)`. yaw is the true heading of the
      image's top. pitch > 0 lifts the nose, so that the camera looks forward; roll > 0 lowers the right side,
      so that it looks left.
    - gimbal yaw, pitch, roll: the same product for axes along view, right, image bottom; pitch is -90
      degrees at the nadir. Body pitch p without roll is gimbal pitch p - 90 degrees. A gimbal roll of
      180 degrees at the nadir turns the heading around; it never turns the camera up.
    """

    matrix: Floats

    @classmethod
    def from_omega_phi_kappa(cls, omega_rad: ArrayLike, phi_rad: ArrayLike, kappa_rad: ArrayLike) -> Rotation:
        """From omega (about east), phi (about north once turned), kappa."""
        return cls(about_x(omega_rad) @ about_y(phi_rad) @ about_z(kappa_rad))

    @classmethod
    def from_phi_omega_kappa(cls, phi_rad: ArrayLike, omega_rad: ArrayLike, kappa_rad: ArrayLike) -> Rotation:
        """From the phi-primary angles with X north and Y west (Yue et al. 2021, equation 1)."""
        nwu = about_y(-np.asarray(phi_rad)) @ about_x(omega_rad) @ about_z(kappa_rad)
        return cls(_ENU_FROM_NWU @ nwu @ _TOP_LEFT_UP_FROM_CAMERA)

    @classmethod
    def from_yaw_pitch_roll(cls, yaw_rad: ArrayLike, pitch_rad: ArrayLike, roll_rad: ArrayLike) -> Rotation:
        """From a body's angles; the camera looks down, the image's top is forward."""
        ned = about_z(yaw_rad) @ about_y(pitch_rad) @ about_x(roll_rad)
        return cls(_ENU_FROM_NED @ ned @ _BODY_FROM_CAMERA)

    @classmethod
    def from_gimbal(cls, yaw_rad: ArrayLike, pitch_rad: ArrayLike, roll_rad: ArrayLike) -> Rotation:
        """From gimbal angles; pitch is -pi/2 when the camera looks down."""
        ned = about_z(yaw_rad) @ about_y(pitch_rad) @ about_x(roll_rad)
        return cls(_ENU_FROM_NED @ ned @ _GIMBAL_FROM_CAMERA)

    def omega_phi_kappa(self) -> tuple[Floats, Floats, Floats]:
        """omega, phi, kappa in radians; phi within ±pi/2."""
        m = self.matrix
        phi = np.arcsin(np.clip(m[..., 0, 2], -1.0, 1.0))
        return np.arctan2(-m[..., 1, 2], m[..., 2, 2]), phi, np.arctan2(-m[..., 0, 1], m[..., 0, 0])

    def phi_omega_kappa(self) -> tuple[Floats, Floats, Floats]:
        """phi, omega, kappa in radians of the phi-primary order; omega within ±pi/2."""
        m = _ENU_FROM_NWU.T @ self.matrix @ _TOP_LEFT_UP_FROM_CAMERA.T
        omega = np.arcsin(np.clip(-m[..., 1, 2], -1.0, 1.0))
        return np.arctan2(-m[..., 0, 2], m[..., 2, 2]), omega, np.arctan2(m[..., 1, 0], m[..., 1, 1])

    def yaw_pitch_roll(self) -> tuple[Floats, Floats, Floats]:
        """Body yaw, pitch, roll in radians; yaw is the true heading of the image's top edge."""
        m = _ENU_FROM_NED @ self.matrix @ _BODY_FROM_CAMERA
        pitch = np.arcsin(np.clip(-m[..., 2, 0], -1.0, 1.0))
        return np.arctan2(m[..., 1, 0], m[..., 0, 0]), pitch, np.arctan2(m[..., 2, 1], m[..., 2, 2])

    def turned(self, quarter_turns: ArrayLike) -> Rotation:
        """The rotation of the same camera whose image was turned clockwise by quarter turns.

        An image turned in a viewer by 180 degrees shows at its top what the camera saw at its bottom.
        """
        return Rotation(self.matrix @ about_z(np.asarray(quarter_turns) * (np.pi / 2.0)))
