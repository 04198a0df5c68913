"""The rigorous model as a table of its lines: rays and images of many points in little time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.constants import MOST_ROUNDS, SLIGHT, tuned
from geomosaic.geodesy.ellipsoid import SEMI_MAJOR_M, SEMI_MINOR_M

STEP_LINES = tuned(4, "lines", "solved of a scene: 4 is off by 2e-3 px, 8 by 7e-3, 16 by 3e-2")
SPARE_LINES = tuned(128, "lines", "of poses past the wanted ones: attitudes jump by 80; more take time")
_SLOPES = tuned((0.4, 2.5), "usual slopes", "limits of a slope: closer slows steps; wider lets them run away")


class LinePoses:
    """Position and rotation of a model's camera at lines of a range, straight in between.

    Where a table of every line stands for the model's curves, jitter of 22 Hz and 0.06 px is off by less than
    0.0001 px. Beyond the model's table of attitudes its end values are used.

    Args: first, last: the range of camera lines; step: lines from one pose to the next.
    """

    def __init__(self, model: Pushbroom, first: float, last: float, step: int = 1) -> None:
        self.model = model
        self._first, self._step = float(np.floor(first)), float(step)
        count = max(int(np.ceil((last - self._first) / step)), 1) + 1
        line = self._first + step * np.arange(count)
        time_s = np.clip(line / model.line_rate_hz, model.attitude_time_s[0], model.attitude_time_s[-1])
        rotation = model.ecef_from_body(line, model.attitude_rad(time_s * model.line_rate_hz))
        self._table = np.concatenate([model.position_ecef_m(line), rotation.reshape(count, 9)], axis=1)

    def rays(self, ccd: int, col: ArrayLike, line: ArrayLike) -> tuple[Floats, Floats]:
        """Origins and directions (..., 3), Earth-fixed, of pixels; directions are of any length."""
        col_px, line_px = np.broadcast_arrays(np.asarray(col, float), np.asarray(line, float))
        pose, _ = self._at(line_px)
        look = self.model.look(ccd, col_px, line_px)
        rotation = pose[..., 3:].reshape(*line_px.shape, 3, 3)
        return pose[..., :3], np.einsum("...ij,...j->...i", rotation, look)

    def image(self, ccd: int, ecef_m: Floats, near_line: ArrayLike) -> tuple[Floats, Floats]:
        """Cols and lines (...) at which a CCD sees points (..., 3).

        NaN where it isn't found: attitudes that turn back faster than the ground goes by see a point often.
        """
        (f_0, f_col, f_s), (r_0, r_col, r_s) = self.model.forward_tan[ccd], self.model.right_tan[ccd]
        rate = self.model.line_rate_hz
        line = np.array(np.broadcast_to(np.asarray(near_line, dtype=np.float64), ecef_m.shape[:-1]))
        step = np.zeros_like(line)
        for _ in range(MOST_ROUNDS):
            line = line - step
            pose, change = self._at(line)
            away = ecef_m - pose[..., :3]
            body = _turned(pose, away)
            forward, right = body[..., 0] / body[..., 2], body[..., 1] / body[..., 2]
            col = (right - r_0 - r_s * line / rate) / r_col
            moved = _turned(change, away) - _turned(pose, change[..., :3])
            forward_by = (moved[..., 0] - forward * moved[..., 2]) / body[..., 2]
            col_by = ((moved[..., 1] - right * moved[..., 2]) / body[..., 2] - r_s / rate) / r_col
            rest = forward - f_0 - f_col * col - f_s * line / rate
            slope = forward_by - f_col * col_by - f_s / rate
            usual = np.nanmedian(slope) if slope.size else 0.0
            step = rest / (usual * np.clip(slope / usual, *_SLOPES))
            if not (np.abs(step) > SLIGHT).any():
                break
        lost = ~(np.abs(step) <= SLIGHT)
        return np.where(lost, np.nan, col), np.where(lost, np.nan, line)

    def _at(self, line: Floats) -> tuple[Floats, Floats]:
        """Poses (..., 12) at lines, and their change from line to line."""
        place = (line - self._first) / self._step
        before = np.clip(np.floor(np.nan_to_num(place)).astype(np.int64), 0, len(self._table) - 2)
        pose = self._table[before]
        change = self._table[before + 1] - pose
        return pose + (place - before)[..., None] * change, change / self._step


def _turned(pose: Floats, vector: Floats) -> Floats:
    """Vectors (..., 3) into the body's axes."""
    x, y, z = (vector[..., k] for k in range(3))
    return np.stack(
        [x * pose[..., 3 + k] + y * pose[..., 6 + k] + z * pose[..., 9 + k] for k in range(3)], -1
    )


def on_height(origin: Floats, ray: Floats, height_ellipsoidal_m: ArrayLike) -> Floats:
    """Where rays (..., 3) meet an ellipsoid larger than WGS 84's by heights (...): within centimetres.

    NaN where a ray passes the Earth.
    """
    height = np.asarray(height_ellipsoidal_m, dtype=np.float64)
    a, b = SEMI_MAJOR_M + height, SEMI_MINOR_M + height
    axes = np.stack([a, a, b], axis=-1)
    o, r = origin / axes, ray / axes
    rr, ro, oo = ((u * v).sum(axis=-1) for u, v in ((r, r), (o, r), (o, o)))
    with np.errstate(invalid="ignore"):
        away = (-ro - np.sqrt(ro * ro - rr * (oo - 1.0))) / rr
    return np.asarray(origin + away[..., None] * ray)
