"""How far the ground's own deviations may move what a mosaic shows."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from geomosaic.camera.exterior import Poses
from geomosaic.constants import CHOSEN, Because
from geomosaic.geodesy.local import LocalFrame
from geomosaic.mosaic.ownership import Ownership
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.warp import ground_window

Floats = NDArray[np.float64]
SHARE: Annotated[
    float,
    Because(
        "share of the mosaic's land",
        "as people judge a map: a corner of it may be worse, a strip along a side may not; with less strips "
        "pass, with more a corner decides",
        CHOSEN,
    ),
] = 0.99
_MOST_PLACES: Annotated[
    int,
    Because(
        "places",
        "of the mosaic that are asked, evenly: a thousand of them are the share that may be worse; more "
        "only take time and memory",
        CHOSEN,
    ),
] = 100_000
_WITHIN_PX: Annotated[
    float,
    Because(
        "px",
        "where the search for the displacement ends, and what is said where even that isn't kept: far "
        "beyond any limit, so that it never hides a figure that matters",
        CHOSEN,
    ),
] = 1e6


def leaning_99_px(ownership: Ownership, poses: Poses, work_frame: LocalFrame, ground: GroundSurface) -> float:
    """Displacement that 99 % of the mosaic's land keeps below, since the ground may be higher or lower.

    A place moves by its height's error times the tangent of the angle at which its frame looks at it. NaN
    where the ground's deviations aren't known, or no frame gives anything.
    """
    from scipy.optimize import brentq

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
