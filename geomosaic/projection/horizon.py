"""What stands before what: how far places lie below the lines of sight over all that rises before them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats, Floats32
from geomosaic.constants import TOGETHER, tuned
from geomosaic.projection.ground import GroundSurface

_MOST_SAMPLES = tuned(8_000_000, "samples", "around a camera, 32 MB: fewer thin horizon views; more are slow")
_STEPS_PER_NODE = tuned(2, "steps", "along a line: fewer show strips next to walls; more take time")
_POLE_M = tuned(1.0, "m", "widest object that hides nothing: more sees through walls and chimneys")
_NEAR_NODES = tuned(2, "nodes", "around all rays: fewer miss the line and the next node at the edge")


def hidden_m(ground: GroundSurface, camera_m: ArrayLike, places_m: Floats) -> Floats32:
    """How far places (rows, cols, 3) lie below what a camera at camera_m (3,) sees over the ground before
    them, in m: not above 0 where it sees them.

    Along each line from below the camera outwards, what has been seen under the least angle from level is
    what hides. Lines are as dense as nodes at the farthest place. Heights are lowered by a deviation, and
    nothing narrower than a metre counts.
    """
    camera = np.asarray(camera_m, dtype=np.float64)
    off = (places_m[..., :2] - camera[:2]).astype(np.float32)
    away = np.hypot(off[..., 0], off[..., 1])
    bearing, first_rad, width_rad, zero_rad = _bearings(off)
    between = np.concatenate([places_m[..., :2].reshape(-1, 2), camera[None, :2]])
    ground = ground.about(between, _hiding_nodes(ground) + _NEAR_NODES)
    heights = _hiding(ground)
    low, high = float(heights.min()), float(heights.max())
    last_m = float(away.max(initial=0.0))
    # A line of sight passes above all that is nearer to the camera than the share of its way below `high`.
    nearest = float(away.min(initial=last_m)) * max(1.0 - (high - low) / max(camera[2] - low, 1e-3), 0.0)
    apart_m = ground.spacing_m
    while True:
        step_m = apart_m / _STEPS_PER_NODE
        lines, steps = (
            int(np.ceil(m / by)) + 3 for m, by in ((last_m * width_rad, apart_m), (last_m - nearest, step_m))
        )
        if lines * steps <= _MOST_SAMPLES:
            break
        apart_m *= 1.25
    line = zero_rad + first_rad + width_rad * (np.arange(lines)[:, None] - 1.0) / (lines - 3)
    out = np.maximum(nearest + step_m * np.arange(steps), step_m / 2.0).astype(np.float32)
    corner = ground.east_0_m, ground.north_0_m
    seen = np.full((lines, steps), low - 1e4, dtype=np.float32)
    for first in range(0, lines, TOGETHER):
        part = line[first : first + TOGETHER]
        at = [
            np.float32((camera[k] - corner[k]) / ground.spacing_m)
            + out * (of(part) / ground.spacing_m).astype(np.float32)
            for k, of in enumerate((np.cos, np.sin))
        ]
        up = cv2.remap(heights, at[0], at[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        below = np.subtract(np.float32(camera[2]), up, out=up)
        below /= out
        np.minimum.accumulate(below, axis=1, out=below)
        seen[first : first + len(part), 1:] = np.float32(camera[2]) - out[1:] * below[:, :-1]
    to_line = (bearing - np.float32(first_rad)) * np.float32((lines - 3) / width_rad) + np.float32(1.0)
    to_step = (away - np.float32(nearest)) / np.float32(step_m)
    lowest = cv2.remap(seen, to_step, to_line, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(lowest - places_m[..., 2].astype(np.float32))


def _bearings(off: Floats32) -> tuple[Floats32, float, float, float]:
    """Of places off the camera: their bearings (rad) from that from which they are counted, the first of them
    and their span, and the bearing from which they are counted."""
    middle = float(np.arctan2(*off.reshape(-1, 2).mean(axis=0, dtype=np.float64)[::-1]))
    zero = middle - np.pi
    bearing = np.arctan2(off[..., 1], off[..., 0])
    bearing = np.remainder(bearing - np.float32(zero), np.float32(2.0 * np.pi))
    first, last = float(bearing.min(initial=7.0)), float(bearing.max(initial=0.0))
    return bearing, first, max(last - first, 1e-6), zero


def _hiding_nodes(ground: GroundSurface) -> int:
    """Nodes a side of what is too narrow to hide: an odd number."""
    return 2 * round(_POLE_M / ground.spacing_m / 2.0) + 1


def _hiding(ground: GroundSurface) -> Floats32:
    """Heights of what may hide, (rows, cols). The edge of what stands is seldom sure: it is as sure as what
    stands about it."""
    side = _hiding_nodes(ground)
    square = np.ones((side, side), np.uint8)
    heights = cv2.morphologyEx(ground.up_m.astype(np.float32), cv2.MORPH_OPEN, square)
    if ground.sd_m is not None:
        lowered = ground.up_m - np.nan_to_num(ground.sd_m)
        heights = np.minimum(heights, cv2.dilate(lowered.astype(np.float32), square))
    return np.asarray(heights, dtype=np.float32)
