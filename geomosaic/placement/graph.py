"""Flight lines and the overlap graph."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.constants import TOGETHER, tuned

HOVER = tuned(0.1, "share", "of a wide step: shorter ones are hovers; more loses slow flights")
_TRIED = tuned(8, "times the neighbours", "whose outlines are intersected: fewer lose turned frames")


def flight_lines(positions_m: Floats, turn_deg: float = 40.0, gap: float = 4.0) -> tuple[int, ...]:
    """Number of the flight line of each frame, in order of capture.

    A new line begins where the course turns by more than turn_deg, or where a step is more than
    `gap` times the median step.

    Args: positions_m (n, 2 or 3), in order of capture.
    """
    steps = np.diff(positions_m[:, :2], axis=0)
    length = np.linalg.norm(steps, axis=1)
    typical = usual_step_m(length) or 1.0
    lines, line, course = [0], 0, None
    for step, size in zip(steps, length, strict=True):
        if size < 0.05 * typical:
            lines.append(line)
            continue
        direction = step / size
        if size > gap * typical or (
            course is not None and float(course @ direction) < np.cos(np.radians(turn_deg))
        ):
            line, course = line + 1, None
        else:
            course = direction
        lines.append(line)
    return tuple(lines)


def usual_step_m(lengths_m: Floats) -> float:
    """The median of steps between frames (k,) while the aircraft flew: hovers and the frames of one capture
    count nothing. 0 without any."""
    if not lengths_m.size:
        return 0.0
    flown = lengths_m[lengths_m > HOVER * float(np.quantile(lengths_m, 0.9))]
    return float(np.median(flown)) if flown.size else 0.0


def overlapping_pairs(
    footprints_m: Sequence[Floats], reach_m: float, most: int = 12, least: float = 0.02
) -> tuple[tuple[int, int], ...]:
    """Pairs of frames that may see the same ground, left < right, by falling overlap.

    Each outline grows by reach_m (how far a frame may be misplaced, plus how a turned frame may stick out). A
    pair stands if the true outlines share anything, or the grown ones more than `least` of the smaller true
    one.

    Args: footprints_m: per frame (k, 2 or 3) outline on the ground. most: how many neighbours a frame
        asks for; a pair stays if either of its frames asks for it.
    """
    outlines = [
        shapely.make_valid(shapely.Polygon(f[:, :2])) if len(f) >= 3 else shapely.Point()
        for f in footprints_m
    ]
    grown = [o.buffer(reach_m) for o in outlines]
    left, right = shapely.STRtree(grown).query(grown, predicate="intersects")
    keep = left < right
    left, right = left[keep], right[keep]
    if not left.size:
        return ()
    kept = _likely(np.array([o.bounds for o in outlines]), left, right, _TRIED * most)
    left, right = left[kept], right[kept]
    outlines_a, grown_a = np.array(outlines, dtype=object), np.array(grown, dtype=object)
    smaller = np.minimum(shapely.area(outlines_a)[left], shapely.area(outlines_a)[right])
    shared, near = (_shared_areas(of, left, right) / smaller for of in (outlines_a, grown_a))
    score = shared + 0.01 * near
    asked = _asked(left, right, score, most)
    wanted = np.flatnonzero(asked & ((shared > 0.0) | (near > least)))
    wanted = wanted[np.argsort(-score[wanted], kind="stable")]
    return tuple((int(left[k]), int(right[k])) for k in wanted)


def _asked(left: Ints, right: Ints, score: Floats, most: int) -> Bools:
    """Which pairs (k,) are among the best of either frame."""
    frame, pair = np.concatenate([left, right]), np.tile(np.arange(left.size), 2)
    order = np.lexsort((pair, -score[pair], frame))
    nth = np.arange(order.size) - np.searchsorted(frame[order], frame[order], side="left")
    out = np.zeros(left.size, dtype=bool)
    out[pair[order[nth < most]]] = True
    return out


def _likely(bounds: Floats, left: Ints, right: Ints, most: int) -> Bools:
    """Pairs (k,) whose outlines are worth intersecting, by how far their bounds (n, 4) overlap: of frames on
    the spot each meets all others."""
    low = np.fmax(bounds[left, :2], bounds[right, :2])
    high = np.fmin(bounds[left, 2:], bounds[right, 2:])
    apart_m = np.nan_to_num(np.linalg.norm(np.maximum(low - high, 0.0), axis=1), nan=np.inf)
    return _asked(left, right, np.nan_to_num((high - low).clip(0.0).prod(axis=1)) - apart_m, most)


def _shared_areas(outlines: NDArray[np.object_], left: Ints, right: Ints) -> Floats:
    """Of pairs of outlines, some at once: the shapes that they share take memory."""
    parts = [slice(k, k + TOGETHER) for k in range(0, len(left), TOGETHER)]
    shared = (shapely.intersection(outlines[left[some]], outlines[right[some]]) for some in parts)
    return np.concatenate([shapely.area(of) for of in shared])


def adjacent_frames(
    frames: Collection[int], sequence: Sequence[int], tried: Collection[tuple[int, int]], steps: int = 2
) -> list[tuple[int, int]]:
    """Pairs (left < right) of some frames with those up to `steps` before and after them in order of flight,
    but for those tried already. They serve frames whose position is so far off that by it they overlap none
    of their neighbours."""
    at = {frame: k for k, frame in enumerate(sequence)}
    adjacent = {
        (min(i, j), max(i, j))
        for i in frames
        for j in sequence[max(at[i] - steps, 0) : at[i] + steps + 1]
        if i != j
    }
    return sorted(adjacent - set(tried))


def connected_parts(n: int, pairs: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Groups of frames that pairs connect, largest first; frames without any are parts of one."""
    part = list(range(n))

    def find(i: int) -> int:
        while part[i] != i:
            part[i] = part[part[i]]
            i = part[i]
        return i

    for a, b in pairs:
        part[find(a)] = find(b)
    groups: dict[int, list[int]] = {}
    for i in range(n):
        groups.setdefault(find(i), []).append(i)
    return sorted(groups.values(), key=lambda g: (-len(g), g[0]))
