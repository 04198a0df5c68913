"""How the camera hangs in its platform: what makes every frame's POS differ from its pose in one way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import exp_turn, log_turn
from geomosaic.constants import sourced

Floats = NDArray[np.float64]

MOUNTING = (
    "boresight_roll_deg",
    "boresight_pitch_deg",
    "boresight_yaw_deg",
    "lever_arm_forward_m",
    "lever_arm_right_m",
    "lever_arm_down_m",
    "gps_lag_s",
)
UNIT: Floats = sourced(
    np.array([np.radians(1.0)] * 3 + [1.0] * 4),
    "rad, m, s",
    "one of each name's unit: degrees, m and s",
    "definition",
)

_CAMERA_FROM_BODY = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class Mounting:
    """Prior deviations of the seven numbers of MOUNTING, in rad, m and s; 0 for those held at nothing.

    The camera's own axes are the body's: forward is the image's top, right its right side, down the view.
    Boresight: the reported attitude is the camera's, turned further by roll, pitch and yaw about the body's
    forward, right and down axes. Lever arm: from the projection centre to where positions are reported, along
    forward, right and down. Lag: a reported position is where the platform was so long before.
    """

    sd: Floats

    @property
    def asked(self) -> NDArray[np.bool_]:
        """Which numbers are unknown, (7,)."""
        return np.asarray(self.sd > 0.0)


def pose_miss(reported: Poses, positions_m: Floats, rotations: Floats, mounting: Floats) -> Floats:
    """Reported position and attitude minus what poses and mounting (7,) make of them, (f, 6)."""
    boresight, lever, lag_s = mounting[:3], mounting[3:6], mounting[6]
    at = positions_m + rotations @ (_CAMERA_FROM_BODY @ lever)
    if reported.velocities_m_per_s is not None:
        at = at - lag_s * reported.velocities_m_per_s
    straight = reported.rotations @ exp_turn(-(_CAMERA_FROM_BODY @ boresight)[None])[0]
    return np.column_stack([reported.positions_m - at, log_turn(straight @ np.swapaxes(rotations, 1, 2))])


def mounting_derivatives(reported: Poses, rotations: Floats, mounting: Floats) -> tuple[Floats, Floats]:
    """Derivatives of what poses and mounting make of the reported numbers, by pose (f, 6, 6) and by mounting
    (f, 6, 7); turns from the left as in `collinearity.project`, for small misses."""
    f = len(rotations)
    lever = rotations @ (_CAMERA_FROM_BODY @ mounting[3:6])
    by_pose = np.broadcast_to(np.eye(6), (f, 6, 6)).copy()
    by_pose[:, :3, 3:] = -np.cross(np.eye(3), lever[:, None, :])
    by_mounting = np.zeros((f, 6, 7))
    by_mounting[:, 3:, :3] = rotations @ _CAMERA_FROM_BODY
    by_mounting[:, :3, 3:6] = rotations @ _CAMERA_FROM_BODY
    if reported.velocities_m_per_s is not None:
        by_mounting[:, :3, 6] = -reported.velocities_m_per_s
    return by_pose, by_mounting
