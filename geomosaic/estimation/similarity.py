"""Similarities of space: one scale, one rotation, one shift."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import tuned
from geomosaic.estimation.linear import singular_values

Floats = NDArray[np.float64]
_ROUNDS = tuned(20, "rounds", "of re-weighting; ten settle it")
_COLLINEAR = tuned(
    0.05,
    "of the largest singular value",
    "for the second one, below which points lie on a line and are free to turn about it",
)
_MOST_TRIPLES = tuned(
    500,
    "triples",
    "of points to begin from; one of four is good where a third are blunders",
)


@dataclass(frozen=True)
class Similarity3D:
    """`to = scale rotation from + shift`; rotation (3, 3), shift (3,)."""

    scale: float
    rotation: Floats
    shift: Floats

    def of(self, points: Floats) -> Floats:
        """Points (n, 3) moved."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)

    @classmethod
    def through(cls, points: Floats, to: Floats) -> Similarity3D | None:
        """The robust similarity that takes points (n, 3) nearest to others (n, 3), n >= 3.

        None where the points are fewer or lie on a line. Begun from the three points with the least median
        miss (Rousseeuw 1984), then re-weighted with Cauchy's function about the median miss; each fit after
        Umeyama 1991, section 4.
        """
        if len(points) < 3 or _on_a_line(points) or _on_a_line(to):
            return None
        best, least = cls._weighted(points, to, np.ones(len(points))), np.inf
        for triple in list(combinations(range(len(points)), 3))[:_MOST_TRIPLES]:
            some = list(triple)
            if _on_a_line(points[some]):
                continue
            tried = cls._weighted(points[some], to[some], np.ones(3))
            miss = float(np.median(np.linalg.norm(tried.of(points) - to, axis=1)))
            if len(points) > 3 and miss < least:
                best, least = tried, miss
        for _ in range(_ROUNDS):
            miss = np.linalg.norm(best.of(points) - to, axis=1)
            typical = max(float(np.median(miss)), 1e-9)
            best = cls._weighted(points, to, 1.0 / (1.0 + (miss / (3.0 * typical)) ** 2))
        return best

    @classmethod
    def _weighted(cls, points: Floats, to: Floats, weight: Floats) -> Similarity3D:
        share = (weight / weight.sum())[:, None]
        middle, there = (share * points).sum(axis=0), (share * to).sum(axis=0)
        a, b = points - middle, to - there
        u, sizes, vt = singular_values((share * b).T @ a)
        mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
        rotation = u @ mirror @ vt
        spread = float((share * a**2).sum())
        scale = float((sizes * np.diag(mirror)).sum()) / max(spread, 1e-300)
        return cls(scale, rotation, there - scale * rotation @ middle)


def _on_a_line(points: Floats) -> bool:
    sizes = singular_values(points - points.mean(axis=0))[1]
    return bool(sizes[1] <= _COLLINEAR * sizes[0])
