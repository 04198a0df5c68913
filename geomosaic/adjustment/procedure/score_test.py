"""A model of lens and shutter, some steps from another model's solution: what its unknowns would gain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.problem.bundle_model import (
    READOUT,
    Begun,
    Factors,
    Priors,
    State,
    stepped,
    with_interior,
)
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.bundle_equations import cost_of, known, normals_of
from geomosaic.adjustment.solver.clearance import clearances_m
from geomosaic.adjustment.solver.normal_equations import reduce_normals
from geomosaic.adjustment.solver.prior_reweighting import trust_in_tags
from geomosaic.adjustment.solver.variance_component_newton import ahead
from geomosaic.adjustment.solver.variance_components import variance_components
from geomosaic.adjustment.terms.collinearity import interior_of
from geomosaic.adjustment.terms.rolling_shutter_rotation import with_drift, with_swing
from geomosaic.constants import tuned

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_STEPS = tuned(
    3, "steps", "of a model that is tested: with one, turns of the frames gain half of what they may"
)
_SHARES = tuned(
    (1.0, 0.5, 0.25), "of a step", "tried until the cost falls: with fewer, far models do not move"
)


def few_steps(tracks: Tracks, camera_of: Ints, priors: Priors, begun: Begun) -> Begun:
    """The solution some Gauss-Newton steps from another model's, robust weights as it left them.

    The first step is that of a score test (Rao 1948). Variance components are estimated once, after it, if
    the model has others than the solution it begins from.
    Raises: NotSolvableError where the equations have no solution.
    """
    state, factors = _begin(priors, begun)
    clearance_m = clearances_m(tracks, state.positions, state.points)
    priors = replace(priors, held=begun.held, clearance_m=clearance_m)
    priors = replace(priors, trust=trust_in_tags(priors, state, factors))
    of_cameras, of_platform = np.split(~known(priors), [state.interior.size])
    of_cameras = of_cameras.reshape(state.interior.shape)
    cost = cost_of(tracks, camera_of, priors, state, factors)
    for k in range(_STEPS):
        reduced = reduce_normals(normals_of(tracks, camera_of, priors, state, factors))
        pose, interior, points, level, mounting = reduced.solve()
        step = pose, interior * of_cameras, points, level, mounting * of_platform[: mounting.size]
        trials = (stepped(state, share, *step) for share in _SHARES)
        costs = ((cost_of(tracks, camera_of, priors, trial, factors), trial) for trial in trials)
        found = next((pair for pair in costs if pair[0] < cost), None)
        if found is None:
            break
        cost, state = found
        if k == 0 and len(factors.while_read) != len(begun.factors.while_read):
            after, followed = variance_components(
                tracks, camera_of, priors, state, factors, reduced, image_only=False
            )
            factors, _ = ahead(factors, after, followed, priors)
            cost = cost_of(tracks, camera_of, priors, state, factors)
    return _end(camera_of, priors, state, factors, begun)


def _begin(priors: Priors, begun: Begun) -> tuple[State, Factors]:
    """Where a model begins: functions of the row that the other did not have at nothing."""
    state = State(
        begun.poses.positions_m.copy(),
        begun.poses.rotations.copy(),
        np.stack([interior_of(c) for c in begun.cameras]),
        begun.points_m,
        begun.mounting,
        level=begun.level_m,
    )
    if priors.swing_sd_rad is None:
        return state, replace(begun.factors, while_read=())
    swing, terms = np.zeros(priors.swing_sd_rad.shape), priors.swing_sd_rad.shape[1]
    state.swing, state.drift_m = swing, np.zeros((len(swing), 3))
    if begun.swing is not None and begun.drift_m is not None:
        same = min(begun.swing.shape[1], terms)
        swing[:, :same], state.drift_m = begun.swing[:, :same], begun.drift_m
    if len(begun.factors.while_read) == terms + 2:
        return state, begun.factors
    return state, replace(begun.factors, while_read=(1.0,) * (terms + 2))


def _end(camera_of: Ints, priors: Priors, state: State, factors: Factors, begun: Begun) -> Begun:
    """The state as a solution."""
    poses = replace(priors.poses, positions_m=state.positions, rotations=state.rotations)
    if state.swing is not None and state.drift_m is not None:
        poses = with_swing(poses, state.swing, state.interior[camera_of, READOUT])
        poses = with_drift(poses, state.drift_m, state.interior[camera_of, READOUT])
    return replace(
        begun,
        poses=poses,
        cameras=tuple(with_interior(c, row) for c, row in zip(priors.cameras, state.interior, strict=True)),
        points_m=state.points,
        mounting=state.mounting,
        factors=factors,
        swing=state.swing,
        drift_m=state.drift_m,
        level_m=state.level,
    )
