"""Priors of gains: about what exposures report, by a deviation that is found; about nothing without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix, diags, eye, hstack

from geomosaic.arrays import Floats, Ints
from geomosaic.camera.interior import Camera
from geomosaic.constants import sourced, tuned
from geomosaic.estimation.nested_dissection import Bordered
from geomosaic.survey.model import Frame

GAIN_SD = tuned(0.2, "log brightness", "prior, half a stop: less forbids exposure; more follows noise")
_PROBES = sourced(
    16,
    "vectors",
    "of a trace: a tenth of it for 16 unknowns",
    "Hutchinson 1990, A stochastic estimator of the trace",
)


@dataclass(frozen=True)
class Exposures:
    """What frames were taken with. camera (n,): its number, from 0. log_exposure (n,): natural logarithm of
    `Frame.exposure`, NaN where unknown."""

    camera: Ints
    log_exposure: Floats

    @classmethod
    def of(cls, frames: Sequence[Frame], cameras: Sequence[Camera]) -> Exposures:
        """Of frames and the camera of each."""
        number = {name: k for k, name in enumerate(dict.fromkeys(c.name for c in cameras))}
        exposures = np.array([f.exposure for f in frames], dtype=np.float64)
        return cls(np.array([number[c.name] for c in cameras], dtype=np.intp), np.log(exposures))

    @property
    def unknown(self) -> Exposures:
        """Of the same cameras, without exposures."""
        return replace(self, log_exposure=np.full(len(self.camera), np.nan))

    @property
    def about_mean(self) -> Floats:
        """The logarithms (n,) less their mean; 0 where unknown, or where all are alike."""
        known = np.isfinite(self.log_exposure)
        mean = float(self.log_exposure[known].mean()) if known.any() else 0.0
        return np.where(known, self.log_exposure - mean, 0.0)

    def gain_errors(self) -> csr_matrix:
        """Of gains (n), each camera's contrast and offset: what gains differ by from those that exposures
        report, or from nothing where they don't, (n, n + 2 cameras)."""
        n = len(self.camera)
        at = csr_matrix((np.isfinite(self.log_exposure).astype(np.float64), (np.arange(n), self.camera)))
        return hstack([eye(n), -diags(self.about_mean) @ at, -at], "csr")


@dataclass(frozen=True)
class Scatter:
    """Combinations (k, u) of unknowns that scatter about what is expected of them, (k,), by a deviation; a
    variance component, or fixed."""

    combination: csr_matrix
    expected: Floats
    deviation: float
    fixed: bool = False

    @cached_property
    def normal(self) -> csr_matrix:
        """What they add to normal equations, (u, u)."""
        return self.combination.T @ self.combination / self.deviation**2

    @cached_property
    def side(self) -> Floats:
        """What they add to the right-hand side, (u,)."""
        return np.asarray(self.combination.T @ self.expected / self.deviation**2)

    def estimated(self, found: Floats, normal: Bordered) -> Scatter:
        """With the deviation that the unknowns found (u,) and their covariance make more likely (Dempster,
        Laird and Rubin 1977, Maximum likelihood from incomplete data, section 4.4)."""
        k = self.combination.shape[0]
        if self.fixed or not k:
            return self
        probes = np.eye(k) if k <= _PROBES else _signs(k)
        across = np.asarray(self.combination.T @ probes)
        trace = float((across * normal.solve(across)).sum()) * k / float((probes**2).sum())
        square = float(((self.combination @ found - self.expected) ** 2).sum()) + trace
        return replace(self, deviation=float(np.sqrt(square / k)))


def _signs(k: int) -> Floats:
    """The same random signs in each round, so that rounds converge."""
    return np.asarray(np.random.default_rng(k).choice((-1.0, 1.0), (k, _PROBES)))
