"""Robust similarities of the plane and of space: one scale, one rotation, one shift."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from geomosaic.arrays import Complexes, Floats
from geomosaic.constants import ROUNDS, tuned
from geomosaic.estimation.linear import singular_values

_COLLINEAR = tuned(0.05, "second by first singular value", "below it points lie on a line and a turn is free")
SAMPLES = tuned(500, "pairs or triples", "tried; a quarter is good with half or a third of blunders")


def cauchy_about_median(length: Floats, medians: float = 2.0) -> Floats:
    """Cauchy's weights (k,), a half at so many median residuals."""
    return np.asarray(1.0 / (1.0 + (length / max(medians * float(np.median(length)), 1e-9)) ** 2))


def fit_similarity(source: Floats, target: Floats, rounds: int = 5) -> tuple[complex, complex]:
    """Robust similarity of the plane as complex numbers, target = turn * source + shift. Args: source, target
    (k, 2), k >= 2."""
    z, w = source @ [1, 1j], target @ [1, 1j]
    weight = np.ones(len(z))
    turn, shift = 1.0 + 0j, 0j
    for _ in range(rounds):
        z_0, w_0 = np.average(z, weights=weight), np.average(w, weights=weight)
        spread = float((weight * np.abs(z - z_0) ** 2).sum())
        if spread > 0.0:
            turn = complex((weight * (w - w_0) * np.conj(z - z_0)).sum() / spread)
        shift = complex(w_0 - turn * z_0)
        weight = cauchy_about_median(np.abs(w - turn * z - shift))
    return turn, shift


def similarity_design(z: Complexes) -> Floats:
    """Derivatives (2, k, 4) of turn * z + shift, east and north, by both parts of the turn and the shift."""
    one, zero = np.ones(len(z)), np.zeros(len(z))
    rows = [[z.real, -z.imag, one, zero], [z.imag, z.real, zero, one]]
    return np.stack([np.stack(row, axis=-1) for row in rows])


@dataclass(frozen=True)
class Similarity3D:
    """`to = scale rotation from + shift`; rotation (3, 3), shift (3,)."""

    scale: float
    rotation: Floats
    shift: Floats

    def of(self, points: Floats) -> Floats:
        """Transformed points (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)

    @classmethod
    def through(cls, points: Floats, to: Floats) -> Similarity3D | None:
        """The robust similarity from points (n, 3) to others (n, 3); None for fewer than 3 or on a line. It
        starts from the triple with the least median residual (Rousseeuw 1984); Cauchy's weights about the
        median residual follow. Each fit is Umeyama's (1991, section 4)."""
        n = len(points)
        triples = (list(t) for t in combinations(range(n), 3))
        if math.comb(n, 3) > SAMPLES:  # spread over all points: any one may be a blunder
            rng = np.random.default_rng(0)
            triples = (rng.choice(n, 3, replace=False).tolist() for _ in range(SAMPLES))
        tried = [
            cls._weighted(points[t], to[t], np.ones(3))
            for t in triples
            if not (_collinear(points[t]) or _collinear(to[t]))
        ]
        if not tried:
            return None
        best = min(tried, key=lambda t: float(np.median(t._residual(points, to))))
        for _ in range(ROUNDS):
            best = cls._weighted(points, to, cauchy_about_median(best._residual(points, to), 3.0))
        return best

    def _residual(self, points: Floats, to: Floats) -> Floats:
        return np.asarray(np.linalg.norm(self.of(points) - to, axis=1))

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


def _collinear(points: Floats) -> bool:
    sizes = singular_values(points - points.mean(axis=0))[1]
    return bool(sizes[1] <= _COLLINEAR * sizes[0])
