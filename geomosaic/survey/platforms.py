"""Aircraft that fly at once, separated by the continuity of their paths where no tag names them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomosaic.arrays import Floats, Ints
from geomosaic.constants import SLIGHT, tuned
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.survey.model import Frame

_FAST = tuned(40.0, "m/s", "that no survey drone flies: less parts fast wings; more joins near drones")
_FASTER = tuned(3.0, "ratio", "to the usual speed: less parts gusty flights; more joins near drones")
_AHEAD = tuned(4, "frames", "among which a frame's own next is: fewer drones fly at once")
LEAST_FRAMES = tuned(3, "frames", "of a path: fewer are positions far off, not an aircraft")
_CLOCK_S = tuned(0.1, "s", "resolution of fine clocks: less makes bursts fast; more hides near drones")


def with_platforms(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """The frames, in order of capture; those of several aircraft without serial numbers with a platform each.

    Frames alternate between aircraft where the way from one to the next needs a speed that no drone flies,
    and paths with usual speeds pass through all of them. Else the frames are as they were.
    """
    at = [i for i, f in enumerate(frames) if not f.platform and f.time_s is not None and f.position.known]
    at.sort(key=lambda i: frames[i].time_s or 0.0)  # frames may be in the order of their names
    if len(at) < 2 * LEAST_FRAMES:
        return tuple(frames)
    positions = [frames[i].position for i in at]
    lonlat = np.array([(p.lon_deg, p.lat_deg) for p in positions])
    plan_m = mid_latitude_offset_m(*lonlat[0], *lonlat.T)
    times_s = np.array([frames[i].time_s for i in at], dtype=np.float64)
    sd_m = float(np.median([max(p.sd_east_m, p.sd_north_m) for p in positions]))
    paths = paths_of(plan_m, times_s, sd_m)
    out = list(frames)
    if paths.max() > 0:
        for i, path in zip(at, paths, strict=True):
            out[i] = replace(frames[i], platform=f"path {path + 1}")
    return tuple(out)


def paths_of(plan_m: Floats, times_s: Floats, sd_m: float) -> Ints:
    """Which path each frame (n,) belongs to, counted from 0; all 0 where one aircraft can have flown them.

    Args: plan_m (n, 2): east and north; times_s (n,), rising; sd_m: of a position.
    """
    clock_s = _CLOCK_S if (np.abs(times_s - np.round(times_s)) > SLIGHT).mean() > 0.5 else 1.0

    def speed(i: int, j: int) -> float:
        """The least from frame i to j that deviations and the clock allow."""
        apart_m = float(np.linalg.norm(plan_m[j] - plan_m[i]))
        return max(apart_m - sd_m, 0.0) / (float(times_s[j] - times_s[i]) + clock_s)

    n = len(times_s)
    nearest = [min(speed(i, j) for j in range(i + 1, min(i + _AHEAD, n - 1) + 1)) for i in range(n - 1)]
    limit = max(_FAST, _FASTER * float(np.median(nearest)))
    alone = np.zeros(n, dtype=np.intp)
    if max(speed(i, i + 1) for i in range(n - 1)) <= limit:
        return alone
    paths, flown, velocity = alone.copy(), [[0]], [np.zeros(2)]
    for j in range(1, n):
        steps = [(plan_m[j] - plan_m[its[-1]]) / (times_s[j] - times_s[its[-1]] + clock_s) for its in flown]
        near = [k for k, its in enumerate(flown) if min(speed(i, j) for i in its[-2:]) <= limit]
        if near:
            path = min(near, key=lambda k: float(np.linalg.norm(steps[k] - velocity[k])))
            velocity[path] = steps[path]
            flown[path].append(j)
        else:
            path = len(flown)
            velocity.append(np.zeros(2))
            flown.append([j])
        paths[j] = path
    if sum(len(its) >= LEAST_FRAMES for its in flown) < 2:
        return alone
    for j in range(1, n):
        if len(flown[paths[j]]) < LEAST_FRAMES:  # a position far off, not an aircraft
            paths[j] = paths[j - 1]
    return paths
