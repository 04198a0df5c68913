"""Standard deviations of a mosaic's pixels on the ground, propagated from poses and heights.

A pixel shows what its frame's ray meets. Let r be the ray from the projection centre to the place, and n the
normal (-slope east, -slope north, 1) of the ground. A shift dC, a turn t and a height error dh move that
place by

    dX = (I - r n' / n'r) (dC + t x r) + r dh / n'r

Ground that the block itself has estimated rises, tilts and grows with its frames. A place there moves as the
ground does, by the joint covariance of places (`block_errors.py`), which holds the block's scale and lens.
Poses alone do not: an error of the scale moves the rim of a frame farther than its middle. dh counts from the
moved ground, and n'dX is an error of the height.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from itertools import product
from typing import Final

import numpy as np

from geomosaic.adjustment.ground.ground_choice import DEM_SD_M
from geomosaic.adjustment.model import Adjusted
from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.block_errors import BlockErrors

DEM: Final = "dem"
_ACROSS = tuned(5, "samples", "of a span; fewer miss a wall of a default cell, more take time")


class HeightSource(IntEnum):
    """Band 3 of accuracy.tif: where the height of a place comes from."""

    TIE_SURFACE = 1
    MATCHED = 2
    FILLED = 3
    EXTRAPOLATED = 4


@dataclass(frozen=True)
class GroundDeviations:
    """Standard deviations (n,) of places in m.

    horizontal_m: root of the mean of the variances east and north. vertical_m: of the height, NaN where the
    ground is assumed level or its deviation is unknown.
    """

    horizontal_m: Floats
    vertical_m: Floats


def pose_covariances(adjusted: Adjusted) -> Floats:
    """Covariances (f, 6, 6) of east, north, up (m) and the turns about them (rad): of the adjustment, else of
    the deviations as if they were independent. NaN where nothing is known."""
    if adjusted.pose_covariance is not None:
        return adjusted.pose_covariance
    poses = adjusted.poses
    sd = np.column_stack([poses.positions_sd_m, poses.rotations_sd_rad])
    sd[~np.isfinite(sd)] = np.nan
    return np.asarray(np.where(np.eye(6, dtype=bool), sd[:, :, None] ** 2, 0.0))


def moves_with_ground(adjusted: Adjusted, ground: GroundSurface) -> Bools:
    """Frames (f,) whose errors the ground shares, since it was estimated from them."""
    estimated = adjusted.pose_covariance is not None and ground.kind != DEM
    return np.array([estimated and status == "tied" for status in adjusted.status], dtype=bool)


def sight_jacobians(sight_m: Floats) -> Floats:
    """Derivatives (n, 3, 6) of the ends of sights (n, 3) by shift and turn of their frames: [I, -[r]x]."""
    east, north, up = sight_m.T
    out = np.zeros((len(sight_m), 3, 6))
    out[:, [0, 1, 2], [0, 1, 2]] = 1.0
    out[:, 0, 4], out[:, 0, 5] = up, -north
    out[:, 1, 3], out[:, 1, 5] = -up, east
    out[:, 2, 3], out[:, 2, 4] = north, -east
    return out


def height_jacobians(sight_m: Floats, slope: Floats) -> Floats:
    """Derivatives (n, 3) of where sights (n, 3) meet the ground by the ground's height.

    slope (n, 2): rise per m east and north. NaN where the ground faces away from the frame.
    """
    towards = np.einsum("ni,ni->n", sight_m, _normals(slope))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(towards[:, None] < 0.0, sight_m / towards[:, None], np.nan))


def ground_jacobians(sight_m: Floats, slope: Floats) -> Floats:
    """Derivatives (n, 3, 6) of where sights (n, 3) meet ground that stays, by shift and turn of frames."""
    ends = sight_jacobians(sight_m)
    along = np.einsum("ni,nij->nj", _normals(slope), ends)
    return np.asarray(ends - height_jacobians(sight_m, slope)[:, :, None] * along[:, None, :])


def height_deviations(ground: GroundSurface, known: GroundSurface, east: Floats, north: Floats) -> Floats:
    """Deviations (n,) in m of the ground's heights, those known before where it states none, else NaN.

    Beyond the ground's grid its edge goes on level: there by as much more as it rises over the same distance
    within.
    """
    own = _stated(ground, east, north)
    sd_m = np.where(np.isnan(own), _stated(known, east, north), own)
    at_m = np.stack([east, north], axis=-1)
    low_m = np.array([ground.east_0_m, ground.north_0_m])
    edge_m = at_m.clip(low_m, low_m + ground.spacing_m * (np.array(ground.up_m.shape[::-1]) - 1))
    rise_m = ground.up_at(*edge_m.T) - ground.up_at(*(2.0 * edge_m - at_m).T)
    return np.asarray(np.hypot(sd_m, rise_m))


def slopes_of(ground: GroundSurface, east: Floats, north: Floats, span_m: float) -> Floats:
    """Rise (n, 2) per m east and north over span_m; level on ground that shows walls, which stand between
    level places."""
    if ground.has_walls:
        return np.zeros((len(east), 2))
    half = span_m / 2.0
    rise_east = ground.up_at(east + half, north) - ground.up_at(east - half, north)
    rise_north = ground.up_at(east, north + half) - ground.up_at(east, north - half)
    return np.stack([rise_east, rise_north], axis=-1) / span_m


@dataclass(frozen=True)
class GroundPropagation:
    """Propagates the poses of an adjusted block to its ground. ground: what the mosaic lies on; span_m: over
    which its slope is taken."""

    adjusted: Adjusted
    ground: GroundSurface
    span_m: float

    @cached_property
    def block(self) -> BlockErrors | None:
        """Errors of ground that moves with the frames; None where the places' covariance is unknown."""
        places = self.adjusted.places
        return BlockErrors(places) if places is not None and self._moves.any() else None

    @cached_property
    def own_m2(self) -> Floats:
        """Variances (f,), mean of east and north, that frames have beyond the block around them: of places
        straight below, where scale and lens do not count."""
        if self.block is None:
            return np.zeros(len(self._moves))
        below_m = self.adjusted.poses.positions_m.copy()
        below_m[:, 2] = self.ground.up_at(below_m[:, 0], below_m[:, 1])
        ends = sight_jacobians(below_m - self.adjusted.poses.positions_m)[:, :2]
        by_pose = _variances(ends, pose_covariances(self.adjusted)).sum(axis=1)
        by_block = self.block.covariances_at(below_m)
        own_m2 = (by_pose - by_block[:, 0, 0] - by_block[:, 1, 1]) / 2.0
        return np.where(self._moves, np.maximum(own_m2, 0.0), 0.0)

    def at(self, places_m: Floats, frame: Ints, standing_sd_m: Floats | float = 0.0) -> GroundDeviations:
        """Deviations at places (n, 3) of the work frame that the frames (n,) show.

        standing_sd_m (n,): by what may stand there unseen.
        """
        east, north, _ = places_m.T
        sight_m = places_m - self.adjusted.poses.positions_m[frame]
        slope, moves = slopes_of(self.ground, east, north, self.span_m), self._moves[frame]
        height_sd_m = np.hypot(self._height_sd_m(east, north), standing_sd_m)
        by_height = np.square(height_jacobians(sight_m, slope)[:, :2]).sum(axis=1)
        horizontal, risen = np.nan_to_num(height_sd_m) ** 2 * by_height / 2.0, np.zeros(len(frame))
        for of, variances in ((~moves, self._above_still_ground), (moves, self._with_ground)):
            if of.any():
                plan_m2, up_m2 = variances(places_m[of], slope[of], frame[of])
                horizontal[of] += plan_m2
                risen[of] = up_m2
        return GroundDeviations(np.sqrt(horizontal), np.sqrt(risen + height_sd_m**2))

    def _height_sd_m(self, east: Floats, north: Floats) -> Floats:
        """Deviations (n,) of heights, in m. On ground that shows walls they are root mean squares over a
        span, since a few cells there are off by a wall's height."""
        if not self.ground.has_walls:
            return height_deviations(self.ground, self.adjusted.ground, east, north)
        total = np.zeros(len(east))
        aside_m = (np.arange(_ACROSS) - (_ACROSS - 1) / 2.0) * self.span_m / _ACROSS
        for right_m, up_m in product(aside_m.tolist(), repeat=2):
            at = east + right_m, north + up_m
            total += height_deviations(self.ground, self.adjusted.ground, *at) ** 2
        return np.sqrt(total / _ACROSS**2)

    @cached_property
    def _moves(self) -> Bools:
        return moves_with_ground(self.adjusted, self.ground)

    def _above_still_ground(self, places_m: Floats, slope: Floats, frame: Ints) -> tuple[Floats, Floats]:
        """Variances (n,) in plan and of heights by the frames' poses."""
        jacobian = ground_jacobians(places_m - self.adjusted.poses.positions_m[frame], slope)[:, :2]
        plan_m2 = _variances(jacobian, pose_covariances(self.adjusted)[frame]).sum(axis=1) / 2.0
        return plan_m2, np.zeros(len(frame))

    def _with_ground(self, places_m: Floats, slope: Floats, frame: Ints) -> tuple[Floats, Floats]:
        """The same on ground that moves with the frames: by the block's, else by the poses alone."""
        if self.block is not None:
            moved = self.block.covariances_at(places_m)
        else:
            ends = sight_jacobians(places_m - self.adjusted.poses.positions_m[frame])
            moved = ends @ pose_covariances(self.adjusted)[frame] @ np.swapaxes(ends, 1, 2)
        normal = _normals(slope)
        up_m2 = np.einsum("ni,nij,nj->n", normal, moved, normal)
        plan_m2 = (moved[:, 0, 0] + moved[:, 1, 1]) / 2.0 + self.own_m2[frame]
        return plan_m2, np.maximum(up_m2, 0.0)


def _stated(ground: GroundSurface, east: Floats, north: Floats) -> Floats:
    sd_m = ground.sd_at(east, north)
    return np.where(np.isnan(sd_m), DEM_SD_M, sd_m) if ground.kind == DEM else sd_m


def _normals(slope: Floats) -> Floats:
    return np.concatenate([-slope, np.ones((len(slope), 1))], axis=1)


def _variances(jacobian: Floats, covariance: Floats) -> Floats:
    """Diagonals (n, k) of J C J', J (n, k, 6), C (n, 6, 6); rounding must not make them negative."""
    found = np.einsum("nki,nki->nk", jacobian @ covariance, jacobian)
    return np.asarray(np.maximum(found, 0.0))
