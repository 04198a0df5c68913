"""How two images of a pair lie to each other as a whole: by a plane, predicted or estimated."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import shapely

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.estimation.linear import inverse_each

Size = tuple[int, int]
Pair = tuple[int, int]
_GRAIN_PX = tuned(16.0, "px", "rounding of predictions: less lets a new frame change other pairs")
_BY_NEIGHBOUR = tuned(0.05, "share", "of the side, search by a neighbour: less misses relief; more is slow")
LEAST_POINTS = tuned(8, "points", "on one plane; four define it: fewer are chance; more miss overlaps")


@dataclass(frozen=True)
class Guess:
    """Where the right image is predicted to show what the left one shows, to within a radius.

    size_px: width and height of the left image. corners_px: where its corners (top left, top right, bottom
    right, bottom left) lie in the right one, col and row each; not used where the radius is infinite.
    """

    size_px: Size
    corners_px: tuple[tuple[float, float], ...]
    radius_px: float

    @property
    def plane(self) -> Floats:
        """The right image's places from the left one's, a homography (3, 3)."""
        there = np.array(self.corners_px, np.float32)
        return np.asarray(cv2.getPerspectiveTransform(_corners(self.size_px).astype(np.float32), there))


def unconstrained_guess(size_px: Size) -> Guess:
    """A guess that holds for any pair."""
    return Guess(size_px, ((0.0, 0.0),) * 4, float("inf"))


def guessed(size_px: Size, plane: Floats | None, radius_px: float) -> Guess:
    """A guess by a plane, rounded; nothing where there is none, or where corners lie beyond the horizon."""
    if plane is None or not np.isfinite(plane).all():
        return unconstrained_guess(size_px)
    corners = _corners(size_px)
    depth = corners @ plane[2, :2] + plane[2, 2]
    if (depth * depth[0] <= 0.0).any():
        return unconstrained_guess(size_px)
    there = np.round(through(plane, corners) / _GRAIN_PX) * _GRAIN_PX
    radius_px = float(np.ceil(radius_px / _GRAIN_PX) * _GRAIN_PX)
    return Guess(size_px, tuple((float(c), float(r)) for c, r in there), radius_px)


def plane_through(left_px: Floats, right_px: Floats) -> Floats | None:
    """The homography with the least squared misses; None where too few points, or no finite ones, say it."""
    good = np.isfinite(left_px).all(axis=1) & np.isfinite(right_px).all(axis=1)
    if good.sum() < LEAST_POINTS:
        return None
    plane, _ = cv2.findHomography(left_px[good], right_px[good], 0)
    return None if plane is None else np.asarray(plane, np.float64)


def through(plane: Floats, px: Floats) -> Floats:
    """Where a plane takes places (n, 2)."""
    if not len(px):
        return np.zeros((0, 2))
    return np.asarray(cv2.perspectiveTransform(px[:, None].astype(np.float64), plane)[:, 0], np.float64)


def stretched(plane: Floats, px: Floats) -> Floats:
    """How a plane turns and stretches about places (n, 2): derivatives (n, 2, 2), [right axis, left axis]."""
    depth = px @ plane[2, :2] + plane[2, 2]
    there = (px @ plane[:2, :2].T + plane[:2, 2]) / depth[:, None]
    return np.asarray((plane[None, :2, :2] - there[:, :, None] * plane[2, None, :2]) / depth[:, None, None])


class SeenPlanes:
    """The planes of tied pairs, and through one common neighbour those of others, each estimated when asked
    for. Args: places: the tie points of a pair (k, 2), in the left and the right image."""

    def __init__(self, places: Callable[[int, int], tuple[Floats, Floats]]) -> None:
        self._places = places
        self._counts: dict[Pair, int] = {}
        self._planes: dict[Pair, Floats | None] = {}
        self._ties: dict[int, dict[int, int]] = defaultdict(dict)

    def add(self, a: int, b: int, count: int) -> None:
        """A tied pair's frames, left and right, and how many tie points it has now."""
        self._counts[a, b] = self._ties[a][b] = self._ties[b][a] = count
        self._planes.pop((a, b), None)

    def between(self, a: int, b: int) -> Floats | None:
        """The plane that takes places of frame a to frame b; None if neither ties nor a neighbour say it."""
        plane = self._of_pair(a, b)
        if plane is not None:
            return plane
        common = self._ties[a].keys() & self._ties[b].keys()
        for c in sorted(common, key=lambda c: (-min(self._ties[a][c], self._ties[b][c]), c)):
            first, second = self._of_pair(a, c), self._of_pair(c, b)
            if first is not None and second is not None:
                return np.asarray(second @ first)
        return None

    def _of_pair(self, a: int, b: int) -> Floats | None:
        """The plane of a tied pair; None of another, and of one whose tie points lie on none."""
        left, right = pair = (a, b) if (a, b) in self._counts else (b, a)
        if pair not in self._counts:
            return None
        if pair not in self._planes:
            plane = plane_through(*self._places(left, right))
            back = None if plane is None else inverse_each(plane)
            whole = back is not None and np.isfinite(back).all()
            self._planes[left, right], self._planes[right, left] = (plane, back) if whole else (None, None)
        return self._planes[a, b]

    def guess(self, a: int, b: int, sizes_px: Sequence[Size]) -> Guess | None:
        """What a neighbour lets expect of a pair; None where none does, or they show no ground in common."""
        radius_px = _BY_NEIGHBOUR * max(sizes_px[b])
        guess = guessed(sizes_px[a], self.between(a, b), radius_px)
        if np.isinf(guess.radius_px):
            return None
        there = shapely.Polygon(guess.corners_px).buffer(radius_px)
        return guess if there.intersects(shapely.box(0.0, 0.0, *sizes_px[b])) else None


def _corners(size_px: Size) -> Floats:
    width, height = size_px
    return np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
