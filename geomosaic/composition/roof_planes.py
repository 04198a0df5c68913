"""Roofs of planes: what tells a building from a tree, and carries heights out to its edges."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from geomosaic.arrays import Bools, Floats, Floats32, Ints, Ints32
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares, pseudo_inverse

_MOST = tuned(6, "planes", "of a roof: two hipped roofs that meet have no more that matter")
_OFF_NODES = tuned(0.5, "node spacings", "off a plane: less loses roofs to noise; more makes crowns roofs")
_OFF_M = tuned(0.1, "m", "the same, at least: tiles and gravel are as rough")
_STEEPEST = tuned(1.5, "m per m", "slope of a roof: steeper is a wall; less loses steep roofs")
_LEAST_NODES = tuned(12, "nodes", "of a plane: fewer fit anything; more lose dormers")
_LEAST_SHARE = tuned(0.04, "share", "of a roof that a plane has: less is noise; more loses hips")
_TRIALS = tuned(60, "samples", "a plane: half the roof is found by 6 nodes in 1 of 64; more take time")
_SAMPLE = tuned(6, "nodes", "a plane is tried by: fewer tilt by noise; more are hardly of one plane")
_NEAR = tuned((6.0, 0.15), "nodes, of the roof's side", "about the first of a sample: wider mixes hips")


@dataclass(frozen=True)
class RoofPlanes:
    """The planes of a roof over the ground: labels (rows, cols), by node the plane from 1 on, 0 where none
    fits; terms (n, 3): rise by col, by row, and height at the first node, in m; share: of the nodes off the
    edge that one of them fits."""

    labels: Ints32
    terms: Floats
    share: float

    def heights_m(self, finer: int) -> Floats32:
        """(rows, cols) times finer: each place lies on the plane of the nearest node that has one."""
        nearest = ndimage.distance_transform_edt(
            self.labels == 0, return_distances=False, return_indices=True
        )
        labels = self.labels[tuple(nearest)]
        height, width = labels.shape[0] * finer, labels.shape[1] * finer
        best, which = np.full((height, width), -1.0, np.float32), np.zeros((height, width), np.intp)
        for number in range(len(self.terms)):
            share = cv2.blur((labels == number + 1).astype(np.float32), (3, 3))
            share = cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR)
            which[share > best] = number
            np.maximum(best, share, out=best)
        col, row = ((np.arange(n) + 0.5) / finer - 0.5 for n in (width, height))
        terms = self.terms[which]
        return (terms[..., 0] * col + terms[..., 1] * row[:, None] + terms[..., 2]).astype(np.float32)


def roof_planes(over_m: Floats32, own: Bools, spacing_m: float) -> RoofPlanes:
    """Planes through heights over_m (rows, cols) of an object's own nodes, each through what the ones before
    left. Each is the one with most support of samples (Fischler and Bolles 1981)."""
    row, col = np.nonzero(_off_edges(own))
    left, height = np.ones(len(row), dtype=bool), over_m[row, col].astype(np.float64)
    at = np.column_stack([col, row, np.ones(len(row))]).astype(np.float64)
    off_m = max(_OFF_NODES * spacing_m, _OFF_M)
    labels, terms = np.zeros(own.shape, dtype=np.int32), list[Floats]()
    least = max(_LEAST_NODES, int(_LEAST_SHARE * len(row)))
    rng = np.random.default_rng(0)
    while left.sum() >= least and len(terms) < _MOST:
        some = np.flatnonzero(left)
        plane = _plane(at[some], height[some], spacing_m, off_m, rng)
        if plane is None:
            break
        fits = some[np.abs(at[some] @ plane - height[some]) < off_m]
        left[fits] = False
        whole = _wide_parts(row[fits], col[fits], own.shape, least)
        if whole.any():
            terms.append(plane)
            labels[row[fits][whole], col[fits][whole]] = len(terms)
        elif len(fits) < least:
            break
    share = float((labels[row, col] > 0).mean()) if len(row) else 0.0
    return RoofPlanes(labels, np.array(terms).reshape(-1, 3), share)


def _off_edges(own: Bools) -> Bools:
    """Nodes two from the edge, or one where the object is narrow, or all."""
    for nodes in (2, 1):
        inner = cv2.erode(own.view(np.uint8), np.ones((2 * nodes + 1, 2 * nodes + 1), np.uint8)) > 0
        if np.count_nonzero(inner) >= _LEAST_NODES:
            return inner
    return own


def _plane(
    at: Floats, height: Floats, spacing_m: float, off_m: float, rng: np.random.Generator
) -> Floats | None:
    """The plane (3,) that fits most of places at (n, 3); None where no sample gives one."""
    reach = _NEAR[0] + _NEAR[1] * np.sqrt(len(at))
    col, row, samples = *at[:, :2].T.copy(), list[Ints]()
    for _ in range(_TRIALS):
        first = rng.integers(len(at))
        near = np.flatnonzero((col - col[first]) ** 2 + (row - row[first]) ** 2 < reach**2)
        if len(near) >= _SAMPLE:
            samples.append(rng.choice(near, _SAMPLE, replace=False))
    if not samples:
        return None
    some = np.array(samples)
    planes = (pseudo_inverse(at[some]) @ height[some][..., None])[..., 0]
    fits = np.array([np.count_nonzero(np.abs(at @ plane - height) < off_m) for plane in planes])
    fits[np.hypot(planes[:, 0], planes[:, 1]) > _STEEPEST * spacing_m] = 0
    best: Floats = planes[np.argmax(fits)]
    if fits.max() <= _SAMPLE:
        return None
    for _ in range(3):
        best = _through(at, height, np.flatnonzero(np.abs(at @ best - height) < off_m))
    return best


def _through(at: Floats, height: Floats, some: Ints) -> Floats:
    return np.asarray(least_squares(at[some], height[some]))


def _wide_parts(row: Ints, col: Ints, shape: tuple[int, ...], least: int) -> Bools:
    """Which of some nodes lie in a connected part of so many."""
    flags = np.zeros(shape, np.uint8)
    flags[row, col] = 1
    _, parts, stats, _ = cv2.connectedComponentsWithStats(flags, connectivity=8)
    return np.asarray(stats[parts[row, col], cv2.CC_STAT_AREA] >= least)
