"""Objects: what stands on the ground, each a part of the surface without a step in it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geomosaic.composition.seam_parts import HIGH_M
from geomosaic.constants import sourced
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.edge_refinement import STEP_CELLS

Bools = NDArray[np.bool_]
Floats32 = NDArray[np.float32]
Labels = NDArray[np.int32]
_SLOPE = sourced(1.0, "m per m", "of what is drawn: steeper is a side, which frames see aslant", "45 degrees")
_AROUND = np.ones((3, 3), np.uint8)
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
_NONE = np.float32(-1e6)
_FINER = 4
"""Pixels a node, on which outlines are drawn."""
_OUTLINE = 5
"""Nodes of the median that straightens outlines, as in `surface.void_fill`."""


@dataclass(frozen=True)
class Objects:
    """On the nodes of a surface, (rows, cols): labels, the number of an object from 1 on, 0 elsewhere; cover,
    the share of a node's cell within the object's outline; even, where an object has no step."""

    labels: Labels
    cover: Floats32
    even: Bools

    @cached_property
    def boxes(self) -> NDArray[np.intp]:
        """(n, 4) of each object: first row and col, and those beyond the last."""
        found = [(a.start, b.start, a.stop, b.stop) for a, b in ndimage.find_objects(self.labels)]
        return np.array(found, dtype=np.intp).reshape(-1, 4)

    def where(self, chosen: Bools) -> Bools:
        """The nodes (rows, cols) of the objects that are chosen (n,)."""
        return np.asarray(np.concatenate([[False], chosen])[self.labels])


def objects_between(surface: GroundSurface, terrain: GroundSurface) -> Objects:
    """The objects of a surface that stand on a terrain with the same nodes.

    What stands is higher over the terrain than a node's distance, and than half of what is highest beside it:
    the foot of a wall is ground. It is divided where its heights leap; parts below `HIGH_M` are left out.
    Outlines are made of straight lines, a node's distance off at most.
    """
    over_m = np.asarray(surface.up_m - terrain.up_m, dtype=np.float32)
    stands = (over_m > surface.spacing_m) & (over_m > cv2.dilate(over_m, _AROUND) / 2.0)
    stands = cv2.medianBlur(stands.view(np.uint8), _OUTLINE) > 0
    range_m = cv2.dilate(over_m, _AROUND) - cv2.erode(over_m, _AROUND)
    limit_m = STEP_CELLS * surface.spacing_m
    even = cv2.morphologyEx((stands & (range_m <= limit_m)).view(np.uint8), cv2.MORPH_OPEN, _AROUND) > 0
    parts = _nearest_part(stands, even)
    whole = _high(_numbered(_without_steps(parts, over_m, limit_m)), over_m)
    inner = cv2.erode(stands.view(np.uint8), _AROUND) > 0
    return _outlined(whole, inner & (range_m <= limit_m))


def _nearest_part(stands: Bools, even: Bools) -> Labels:
    """Connected even nodes, the others of a clump with the nearest of them; all of a clump without any."""
    clumps, _ = ndimage.label(stands, _AROUND)
    seeds, seeded = ndimage.label(even)
    if not seeded:
        return np.asarray(clumps, dtype=np.int32)
    nearest = ndimage.distance_transform_edt(~even, return_distances=False, return_indices=True)
    parts = seeds[tuple(nearest)]
    own = clumps[tuple(nearest)] == clumps
    return np.where(stands, np.where(own, parts, seeded + clumps), 0).astype(np.int32)


def _without_steps(parts: Labels, over_m: Floats32, limit_m: float) -> Labels:
    """Parts beside each other as one, if their heights do not leap along most of what they share."""
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


def _high(labels: Labels, over_m: Floats32) -> Labels:
    """Those whose median height is that of an object that leans: cars are left on the ground."""
    numbers = np.arange(int(labels.max(initial=0)) + 1)
    height_m = np.asarray(ndimage.median(over_m, labels, numbers))
    return _numbered(np.where((height_m > HIGH_M)[labels], labels, 0).astype(np.int32))


def _numbered(labels: Labels) -> Labels:
    """From 1 on without gaps."""
    kept = np.flatnonzero(np.bincount(labels.ravel()))
    number = np.zeros(int(labels.max(initial=0)) + 1, dtype=np.int32)
    number[kept[kept > 0]] = np.arange(1, np.count_nonzero(kept) + 1)
    return number[labels]


def _outlined(labels: Labels, even: Bools) -> Objects:
    """Objects with polygons for outlines where they meet the ground, and the nodes that these reach."""
    found, cover = labels.copy(), np.zeros(labels.shape, dtype=np.float32)
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        rows, cols = (slice(max(s.start - _OUTLINE, 0), s.stop + _OUTLINE) for s in box)
        at = rows, cols
        own = labels[at] == number
        of_own = _polygons_cover(own)
        meets_another = cv2.dilate(((labels[at] > 0) & ~own).view(np.uint8), _AROUND) > 0
        of_own[own & meets_another] = 1.0
        taken = (of_own > cover[at]) & (own | (labels[at] == 0))
        cover[at][taken], found[at][taken] = of_own[taken], number
        found[at][own & ~taken] = 0
    return Objects(_numbered(found), cover, even)


def _polygons_cover(own: Bools) -> Floats32:
    """The share of each cell within polygons about some."""
    size = own.shape[1] * _FINER, own.shape[0] * _FINER
    fine = cv2.resize(own.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)
    fine = cv2.GaussianBlur(fine, (0, 0), float(_FINER))
    lines, _ = cv2.findContours((fine > 0.5).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    straight = [cv2.approxPolyDP(line, float(_FINER), closed=True) for line in lines]
    filled = np.zeros(fine.shape, np.uint8)
    cv2.fillPoly(filled, straight, (1,))
    return np.asarray(
        cv2.resize(filled.astype(np.float32), own.shape[::-1], interpolation=cv2.INTER_AREA), np.float32
    )


def with_objects(surface: GroundSurface, terrain: GroundSurface, objects: Objects) -> GroundSurface:
    """The terrain with all objects on it, each up to its outline, which is halfway up between nodes.

    An object is as the surface shows it where it has no step, with slopes of 45 degrees at most: midway
    between the lowest such surface over these heights and the highest below, the nearest one (McShane 1934).
    Deviations within an object are their median.
    """
    up_m, sd_m = terrain.up_m.astype(np.float32), None
    for number, box in enumerate(objects.boxes.tolist(), start=1):
        row, col, last_row, last_col = box
        at = slice(row, last_row), slice(col, last_col)
        own = objects.labels[at] == number
        over_m = np.asarray(surface.up_m[at] - terrain.up_m[at], dtype=np.float32)
        even_m = _evened(over_m, own, objects.even[at], _SLOPE * surface.spacing_m)
        up_m[at][own] += (objects.cover[at] * even_m)[own]
    if surface.sd_m is not None and terrain.sd_m is not None and len(objects.boxes):
        numbers = np.arange(1, len(objects.boxes) + 1)
        of_each = ndimage.median(np.nan_to_num(surface.sd_m), objects.labels, numbers)
        of_all = np.concatenate([[0.0], of_each]).astype(np.float32)[objects.labels]
        sd_m = np.where(objects.labels > 0, of_all, terrain.sd_m)
    return replace(surface, up_m=up_m, sd_m=sd_m if len(objects.boxes) else terrain.sd_m)


def _evened(over_m: Floats32, own: Bools, even: Bools, step_m: float) -> Floats32:
    """Heights of an object by those of its even nodes, or of all where none is."""
    known = own & even if (own & even).any() else own
    bounds = []
    for sign in (np.float32(1.0), np.float32(-1.0)):
        values = np.where(known, sign * over_m, _NONE)
        for _ in range(sum(own.shape)):
            before = values
            values = np.maximum(values, cv2.dilate(values, _CROSS) - np.float32(step_m))
            values = np.maximum(values, cv2.dilate(before, _AROUND) - np.float32(np.sqrt(2.0) * step_m))
            if (values == before).all():
                break
        bounds.append(sign * values)
    return np.asarray((bounds[0] + bounds[1]) / 2.0, dtype=np.float32)


def standing_on(terrain: GroundSurface, raised: GroundSurface, stands: Bools) -> GroundSurface:
    """The terrain with what stands on it (rows, cols) as in `with_objects`."""
    sd_m = None
    if raised.sd_m is not None and terrain.sd_m is not None:
        sd_m = np.where(stands, raised.sd_m, terrain.sd_m)
    return replace(raised, up_m=np.where(stands, raised.up_m, terrain.up_m), sd_m=sd_m)
