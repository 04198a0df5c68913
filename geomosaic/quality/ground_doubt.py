"""How far the ground's own deviations may move what a mosaic shows."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import erfc

from geomosaic.camera.exterior import Poses
from geomosaic.geodesy.local import LocalFrame
from geomosaic.mosaic.ownership import Ownership
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.warp import ground_window

Floats = NDArray[np.float64]
SHARE: Final = 0.99
"""Of the land, as people judge a map: a corner of it may be worse, a strip along a side may not."""
_MOST_PLACES: Final = 100_000
_WITHIN_PX: Final = 1e6


def leaning_99_px(ownership: Ownership, poses: Poses, work_frame: LocalFrame, ground: GroundSurface) -> float:
    """Displacement that 99 % of the mosaic's land keeps below, since the ground may be higher or lower.

    A place moves by its height's error times the tangent of the angle at which its frame looks at it. NaN
    where the ground's deviations aren't known, or no frame gives anything.
    """
    if ground.sd_m is None:
        return float("nan")
    sd_px = leaning_sd_px(ownership, poses, work_frame, ground)
    sd_px = sd_px[sd_px > 0.0]
    if not sd_px.size:
        return float("nan")

    def too_many(within_px: float) -> float:
        return float(erfc(within_px / sd_px / np.sqrt(2.0)).mean()) - (1.0 - SHARE)

    return float(brentq(too_many, 0.0, _WITHIN_PX)) if too_many(_WITHIN_PX) < 0.0 else _WITHIN_PX


def leaning_sd_px(
    ownership: Ownership, poses: Poses, work_frame: LocalFrame, ground: GroundSurface
) -> Floats:
    """That displacement's deviation in pixels of the mosaic, at cells all over what frames give, (k,)."""
    grid, owner = ownership.grid, ownership.owner
    step = int(np.ceil(np.sqrt(owner.size / _MOST_PLACES)))
    owner = owner[::step, ::step]
    side_m = step * ownership.cell_px * grid.gsd_m
    window = ground_window(
        grid.crs, work_frame, ground, grid.west_m, grid.north_m, side_m, owner.shape[1], owner.shape[0]
    )
    given = owner > 0
    at_m = window.points_m()[given]
    sight = at_m - poses.positions_m[owner[given] - 1]
    tangent = np.linalg.norm(sight[:, :2], axis=1) / np.maximum(-sight[:, 2], 1e-6)
    return np.asarray(tangent * ground.sd_at(at_m[:, 0], at_m[:, 1]) / grid.gsd_m)
