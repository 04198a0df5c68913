"""Objects: what stands on the ground, each a part of the surface without a step in it."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geomosaic.arrays import Bools, Floats32, Ints32
from geomosaic.composition.seam_parts import HIGH_M
from geomosaic.constants import sourced, tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.edge_refinement import STEP_CELLS

_AROUND = sourced(np.ones((3, 3), np.uint8), "nodes", "a node and its neighbours", "definition")
_SMOOTH = tuned(5, "nodes", "of the median that takes single nodes off outlines: fewer leave them frayed")


def objects_between(surface: GroundSurface, terrain: GroundSurface) -> Ints32:
    """The objects of a surface that stand on a terrain with the same nodes: by node (rows, cols) the number
    of its object from 1 on, 0 elsewhere.

    What stands is higher over the terrain than a node's distance, and than half of the highest neighbour:
    the foot of a wall is ground. It is divided where its heights leap; parts below `HIGH_M` are left out.
    """
    over_m = np.asarray(surface.up_m - terrain.up_m, dtype=np.float32)
    stands = (over_m > surface.spacing_m) & (over_m > cv2.dilate(over_m, _AROUND) / 2.0)
    stands = cv2.medianBlur(stands.view(np.uint8), _SMOOTH) > 0
    range_m = cv2.dilate(over_m, _AROUND) - cv2.erode(over_m, _AROUND)
    limit_m = STEP_CELLS * surface.spacing_m
    even = cv2.morphologyEx((stands & (range_m <= limit_m)).view(np.uint8), cv2.MORPH_OPEN, _AROUND) > 0
    parts = _nearest_part(stands, even)
    return _high(_numbered(_without_steps(parts, over_m, limit_m)), over_m)


def _nearest_part(stands: Bools, even: Bools) -> Ints32:
    """Connected even nodes, the others of a clump with the nearest of them; all of a clump without any."""
    clumps, _ = ndimage.label(stands, _AROUND)
    seeds, seeded = ndimage.label(even)
    if not seeded:
        return np.asarray(clumps, dtype=np.int32)
    nearest = ndimage.distance_transform_edt(~even, return_distances=False, return_indices=True)
    parts = seeds[tuple(nearest)]
    own = clumps[tuple(nearest)] == clumps
    return np.where(stands, np.where(own, parts, seeded + clumps), 0).astype(np.int32)


def _without_steps(parts: Ints32, over_m: Floats32, limit_m: float) -> Ints32:
    """Adjacent parts as one, if their heights do not leap along most of what they share."""
    number = int(parts.max(initial=0)) + 1
    pairs, leaps = [], []
    for a, h in ((parts, over_m), (parts.T, over_m.T)):
        one, other = a[:, 1:-2], a[:, 2:-1]
        meet = (one != other) & (one > 0) & (other > 0)
        pairs.append(np.sort(np.stack([one[meet], other[meet]]), axis=0))
        leaps.append((np.abs(h[:, 3:] - h[:, :-3]) > limit_m)[meet])
    (first, second), leap = np.concatenate(pairs, axis=1), np.concatenate(leaps).astype(np.float64)
    shape = number, number
    lengths = coo_array((np.ones(len(leap)), (first, second)), shape).tocsr()
    steps = coo_array((leap, (first, second)), shape).tocsr()
    joined = (lengths - 2.0 * steps) > 0.0
    _, found = connected_components(joined, directed=False)
    return np.where(parts > 0, found[parts] + 1, 0).astype(np.int32)


def _high(labels: Ints32, over_m: Floats32) -> Ints32:
    """Those whose median height is that of an object that leans: cars are left on the ground."""
    numbers = np.arange(int(labels.max(initial=0)) + 1)
    height_m = np.asarray(ndimage.median(over_m, labels, numbers))
    return _numbered(np.where((height_m > HIGH_M)[labels], labels, 0).astype(np.int32))


def _numbered(labels: Ints32) -> Ints32:
    """From 1 on without gaps."""
    kept = np.flatnonzero(np.bincount(labels.ravel()))
    number = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.int32)
    number[kept[kept > 0]] = np.arange(1, np.count_nonzero(kept) + 1)
    return number[labels]
