"""What all positions of a block may be off by in common, which no number of frames averages out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geomosaic.adjustment.model import Block
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL, VERTICAL
from geomosaic.adjustment.terms.term import Components
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.constants import NORMAL_PER_MAD, sourced, tuned
from geomosaic.estimation.robust import THREE_SIGMA
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.accuracy import POSITION

_LAND_M = sourced(800.0, "m", "of the land above the sea, which such heights leave out", "ETOPO1: mean 797 m")
_MAY_BE_CHANCE = tuned(0.5, "share of the stated variance", "less scatter: the rest may be a common shift")
_COMMON_SD_M = sourced(2.1, "m per axis", "common shift of a flight's positions", "u-blox NEO-M8: 2.5 m CEP")


def common_error(
    block: Block, poses: Poses, ground: GroundSurface, components: Components | None = None
) -> Floats:
    """Variances (3,), east, north and up in m², of an error that all reported positions may have in common,
    which their residuals do not show. Positions of one receiver on one flight scatter less than stated.
    The error takes the rest of the stated variance, as far as a receiver's errors last for a flight.

    Args: poses, ground: as found. components: of methods that estimate them; without them the deviations
    contain all but the datum.
    """
    if components is None:
        return np.array([0.0, 0.0, _in_height(block, poses, ground, 0.0)])
    scatter = np.array([components[HORIZONTAL]] * 2 + [components[VERTICAL]])
    hidden = flights_error_sd_m(block.poses) ** 2 * np.maximum(1.0 - scatter**2 / _MAY_BE_CHANCE, 0.0)
    hidden[2] = _in_height(block, poses, ground, hidden[2])
    return np.asarray(np.clip(hidden, 0.0, POSITION["none"].sd_horizontal_m ** 2))


def flights_error_sd_m(given: Poses) -> Floats:
    """Deviations (3,), east, north and up, of what reported positions of one flight are off by in common. It
    is as stated, but at most a receiver's; in height by as much more as is stated."""
    stated_m = stated_sd_m(given)
    in_plan_m = float(stated_m[:2].max())
    return stated_m * min(1.0, _COMMON_SD_M / in_plan_m) if in_plan_m else stated_m


def stated_sd_m(given: Poses) -> Floats:
    """Medians (3,) of the deviations that are stated, zeros where no position is known."""
    known = ~position_assumed(given)
    return np.asarray(np.median(given.positions_sd_m[known], axis=0)) if known.any() else np.zeros(3)


def _in_height(block: Block, poses: Poses, ground: GroundSurface, hidden_m2: float) -> float:
    """Variance of a common shift in height, by the datum and the drift of the heights. A datum that is not
    stated adds the receiver's deviation, which frames share, and that of the zero height. Zero is the
    ellipsoid, the sea or, where the ground comes out about height 0, the take-off. hidden_m2: what residuals
    do not show of a stated one."""
    reference = block.heights
    if reference is None:
        return 0.0
    tied = np.isin(np.arange(len(block.names)), [i for pair in block.ties.frames for i in pair])
    known = np.isfinite(reference.height_m) & (tied if tied.any() else True)
    if not known.any():
        return POSITION["none"].sd_vertical_m ** 2
    stated_m = float(np.median(reference.sd_m[known]))
    at_m, datum_m = poses.positions_m[known], 0.0
    found_m = reference.work_frame.geodetic_from_enu(at_m)[:, 2]
    if reference.datum_sd_m is not None:
        above_m = float(np.median(at_m[:, 2] - ground.up_at(at_m[:, 0], at_m[:, 1])))
        take_off = abs(float(np.median(found_m)) - above_m) < above_m / 2.0
        datum_m = float(np.hypot(stated_m, _LAND_M if take_off else reference.datum_sd_m))
    off = reference.height_m[known] - found_m
    spread_m = NORMAL_PER_MAD * float(np.median(np.abs(off - np.median(off))))
    drift_m = spread_m if spread_m > THREE_SIGMA * stated_m or datum_m else 0.0
    return (datum_m**2 if datum_m else hidden_m2) + drift_m**2


def with_common_error(poses: Poses, variance_m2: Floats) -> Poses:
    """The poses' deviations with `common_error` counted in full in every frame."""
    return replace(poses, positions_sd_m=np.sqrt(poses.positions_sd_m**2 + variance_m2))
