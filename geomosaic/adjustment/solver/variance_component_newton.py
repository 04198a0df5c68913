"""Where variance components are on their way to, and whether they stand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.bundle_model import GROUPS, Factors, Priors
from geomosaic.adjustment.solver.variance_components import PRIOR_FACTORS, limits_while_read
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares

Floats = NDArray[np.float64]
_TIMES: tuple[float, float] = tuned(
    (0.5, 4.0),
    "times its own change",
    "that a component is sent ahead: not back, which is chance where unknowns are still on their way, "
    "and not where nine tenths of what is found follow what was believed",
)


def image_change(before: Factors, after: Factors) -> float:
    """The largest relative change of the components of images and of control."""
    names = "image_px", "control_px", "control_plan", "control_height"
    pairs = [(getattr(before, name), getattr(after, name)) for name in names]
    return max(abs(float(np.log(a / b))) for a, b in pairs)


def ahead(before: Factors, after: Factors, followed: Floats, priors: Priors) -> tuple[Factors, float]:
    """Where the priors' components will stand, from those they were found with and are found now; and the
    largest relative change on the way there.

    Frames swing less the less they are believed to: found anew round after round, such a component goes
    a fifth of its way each time. How much of what is found follows what was believed is known
    (`variance_components`), so it goes the whole way at once (Newton's step).
    """
    change = _logs(after) - _logs(before)
    if not change.any():
        return after, 0.0
    whole = least_squares(np.eye(len(change)) - followed, change)
    times = np.divide(whole, change, out=np.ones_like(change), where=change != 0.0)
    logs = _logs(before) + change * np.clip(times, *_TIMES)
    groups = {
        g: float(np.exp(np.clip(log, *np.log(PRIOR_FACTORS)))) for g, log in zip(GROUPS, logs, strict=False)
    }
    while_read = np.exp(logs[len(GROUPS) :])
    if while_read.size:
        while_read = np.clip(while_read, *limits_while_read(priors))
    sent = replace(after, **groups, while_read=tuple(while_read.tolist()))
    return sent, float(np.abs(_logs(sent) - _logs(before)).max())


def _logs(factors: Factors) -> Floats:
    return np.log([*(factors.of(g) for g in GROUPS), *factors.while_read])
