"""Where the CCDs look on the scene's map, fast: the rigorous model at nodes, smooth curves in between.

The rigorous model (`Pushbroom`) is asked at a few lines and columns for the ground, and for how it moves with
the attitude and with height. In between, it is smooth. What jitters is added line by line.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

from geomosaic.arrays import Floats
from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.geodesy.mapcrs import MapProjection

Heights = Callable[[Floats, Floats], Floats]
_NODE_LINES = 400
_NODE_COLS = 4
_STEP_RAD = 2e-5
_STEP_M = 2000.0
_RELIEF_ROUNDS = 4  # heights move a ray's foot by less than a fifteenth of themselves


class CcdView:
    """Map coordinates that one CCD of a model looks at.

    Convention: cols and lines are corner-origin coordinates, as in `Pushbroom`. Within a few pixels of the
    slow attitude, lines from first to last, and heights within some km of base_m the result is within 1 mm
    of the rigorous model.
    """

    def __init__(
        self,
        model: Pushbroom,
        ccd: int,
        projection: MapProjection,
        slow_rad: CubicSpline | None,
        base_m: float,
        altitude_m: float,
        width_px: int,
        lines: tuple[float, float],
    ) -> None:
        self._model, self._slow = model, slow_rad
        self.base_m, self._altitude_m = base_m, altitude_m
        count = max(int(np.ceil((lines[1] - lines[0]) / _NODE_LINES)), 4) + 1
        at = np.linspace(lines[0], lines[1], count)
        turn = (np.arange(_NODE_COLS) + 0.5) * np.pi / _NODE_COLS
        self._cols = width_px * (0.5 - 0.5 * np.cos(turn))
        slow = self._slow_at(at)

        def xy(height_m: float, *turned: float) -> Floats:
            attitude = (slow + np.array(turned or (0.0, 0.0, 0.0)))[:, None, :]
            angles = np.broadcast_to(attitude, (count, _NODE_COLS, 3))
            ground = model.ground_from_image(ccd, self._cols, at[:, None], height_m, angles)
            return projection.map_from_geodetic(ground[..., 0], ground[..., 1])

        middle = xy(base_m)
        low, high = xy(base_m - _STEP_M), xy(base_m + _STEP_M)
        slopes = [
            (xy(base_m, *(_STEP_RAD * unit)) - xy(base_m, *(-_STEP_RAD * unit))) / (2.0 * _STEP_RAD)
            for unit in np.eye(3)
        ]
        rise, bend = (high - low) / (2.0 * _STEP_M), (high - 2.0 * middle + low) / (2.0 * _STEP_M**2)
        self._nodes = CubicSpline(at, np.stack([middle, rise, bend, *slopes], axis=-2))

    def _slow_at(self, line: Floats) -> Floats:
        if self._slow is None:
            return np.zeros((*line.shape, 3))
        return np.asarray(self._slow(line / self._model.line_rate_hz))

    def rays(self, cols: Floats, lines: Floats) -> Rays:
        """The rays of cols (m,) of every line, or (n, m) line by line, at lines (n,)."""
        nodes = self._nodes(lines)
        fast = self._model.attitude_rad(lines) - self._slow_at(lines)
        moved = np.einsum("nk,nckd->ncd", fast, nodes[:, :, 3:])
        lines_of = np.concatenate([nodes[:, :, :3], moved[:, :, None]], axis=2)
        weights = self._weights(np.asarray(cols, dtype=np.float64))
        how = "ncqd,mc->qdnm" if weights.ndim == 2 else "ncqd,nmc->qdnm"
        middle, rise, bend, moved_xy = np.ascontiguousarray(np.einsum(how, lines_of, weights, optimize=True))
        return Rays(middle + moved_xy, rise - moved_xy / self._altitude_m, bend, self.base_m)

    def _weights(self, cols: Floats) -> Floats:
        """Lagrange's weights (..., nodes) of the column nodes."""
        out = np.ones((*cols.shape, _NODE_COLS))
        for k, node in enumerate(self._cols):
            for j, other in enumerate(self._cols):
                if j != k:
                    out[..., k] *= (cols - other) / (node - other)
        return out


class Rays:
    """Rays as map coordinates over height: xy (2, n, m) = middle + rise * dh + bend * dh², dh from base_m."""

    def __init__(self, middle: Floats, rise: Floats, bend: Floats, base_m: float) -> None:
        self._middle, self._rise, self._bend, self._base_m = middle, rise, bend, base_m

    def at_height(self, height_m: Floats | float) -> Floats:
        """Map coordinates (2, n, m) at heights (n, m)."""
        dh = np.asarray(height_m) - self._base_m
        return np.asarray(self._middle + dh * (self._rise + dh * self._bend))

    def on(self, heights: Heights | None) -> tuple[Floats, Floats]:
        """Map coordinates (2, n, m) and heights (n, m) where they meet the ground; None is level ground."""
        height = np.full(self._middle.shape[1:], self._base_m)
        if heights is None:
            return self._middle, height
        for _ in range(_RELIEF_ROUNDS):
            height = heights(*self.at_height(height))
        return self.at_height(height), height
