"""Slopes of noisy courses by natural cubic smoothing splines, their stiffness by likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.estimation.linear import cholesky_of_band, solve_band

_STIFFNESS = tuned(10.0 ** np.linspace(-4.0, 6.0, 41), "steps^3", "from interpolation to a straight line")


@dataclass(frozen=True)
class _Course:
    """Values (n, a) at rising times (n,), n > 2, and their departures from straight lines. bends (n - 2, a):
    second divided differences. curved, noisy (3, n - 2): the bands of R and of Q'Q (Green and Silverman 1994,
    2.1.2)."""

    times: Floats
    values: Floats
    bends: Floats
    curved: Floats
    noisy: Floats

    @classmethod
    def of(cls, times: Floats, values: Floats) -> _Course:
        h = np.diff(times)
        bends = np.diff(np.diff(values, axis=0) / h[:, None], axis=0)
        curved, noisy = np.zeros((3, len(bends))), np.zeros((3, len(bends)))
        before, middle, behind = 1.0 / h[:-1], -(1.0 / h[:-1] + 1.0 / h[1:]), 1.0 / h[1:]
        curved[2], curved[1, 1:] = (h[:-1] + h[1:]) / 3.0, h[1:-1] / 6.0
        noisy[2] = before**2 + middle**2 + behind**2
        noisy[1, 1:] = middle[:-1] * before[1:] + behind[:-1] * middle[1:]
        noisy[0, 2:] = behind[:-2] * before[2:]
        return cls(times, values, bends, curved, noisy)

    def likelihood(self, stiffness: float) -> tuple[float, float]:
        """Parts of minus twice the logarithm of the restricted likelihood: the sum of squares in units of the
        curve's variance, and the determinant's logarithm, times the axes."""
        factor = cholesky_of_band(self.curved + stiffness * self.noisy, lower=False)
        squares = float((self.bends * solve_band(factor, self.bends, lower=False)).sum())
        return squares, 2.0 * float(np.log(factor[2]).sum()) * self.values.shape[1]

    def slopes(self, stiffness: float) -> Floats:
        """(n, a) at the times, by section 2.4.1."""
        h = np.diff(self.times)[:, None]
        factor = cholesky_of_band(self.curved + stiffness * self.noisy, lower=False)
        bent = np.pad(solve_band(factor, self.bends, lower=False), ((1, 1), (0, 0)))
        fitted = self.values - stiffness * np.diff(np.diff(bent, axis=0) / h, axis=0, prepend=0.0, append=0.0)
        rise = np.diff(fitted, axis=0) / h
        first = rise - h / 6.0 * (2.0 * bent[:-1] + bent[1:])
        return np.concatenate([first, rise[-1:] + h[-1:] / 6.0 * bent[-2:-1]])


def slopes(times: Sequence[Floats], values: Sequence[Floats]) -> list[Floats]:
    """Slopes (n, a) of courses by their values (n, a) at rising times (n,), n > 1, all as stiff as makes
    their bends likeliest together. What they share with their neighbours is curve, what they don't is noise.

    Restricted likelihood of the integrated Wiener process with white noise, its variance profiled out (Wahba
    1985, A comparison of GCV and GML, section 2). Two values have their straight line's.
    """
    courses = {k: _Course.of(t, v) for k, (t, v) in enumerate(zip(times, values, strict=True)) if len(t) > 2}
    unit = float(np.median(np.concatenate([np.diff(t) for t in times]))) ** 3 if times else 1.0
    count = sum(c.bends.size for c in courses.values())
    least, best = np.inf, float(_STIFFNESS[-1])
    for stiffness in _STIFFNESS[::-1] if count else ():
        parts = np.array([c.likelihood(stiffness * unit) for c in courses.values()]).sum(axis=0)
        cost = count * np.log(max(parts[0], np.finfo(np.float64).tiny)) + parts[1]
        if cost < least:
            least, best = cost, float(stiffness)
    return [
        courses[k].slopes(best * unit) if k in courses else (v[[1, 1]] - v[[0, 0]]) / (t[1] - t[0])
        for k, (t, v) in enumerate(zip(times, values, strict=True))
    ]
