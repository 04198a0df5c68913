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
    with_interior,
)
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.bundle_equations import lengths_px
from geomosaic.adjustment.solver.bundle_steps import _ROUGH, _converge
from geomosaic.adjustment.solver.clearance import clearances_m
from geomosaic.adjustment.solver.prior_reweighting import median_px, trust_in_tags
from geomosaic.adjustment.solver.variance_component_newton import ahead
from geomosaic.adjustment.solver.variance_components import variance_components
from geomosaic.adjustment.terms.collinearity import interior_of
from geomosaic.adjustment.terms.rolling_shutter_rotation import with_drift, with_swing
from geomosaic.constants import tuned

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_STEPS = tuned(
    4, "steps", "each, with the first variance components and the next: less loses models that are far"
)


def few_steps(tracks: Tracks, camera_of: Ints, priors: Priors, begun: Begun) -> Begun:
    """The solution some steps from another model's, the first of them that of a score test (Rao 1948).

    Residuals weigh by their present median, priors as stated; then variance components are estimated once.
    Raises: NotSolvableError where the equations have no solution.
    """
    state = _begin(priors, begun)
    clearance_m = clearances_m(tracks, state.positions, state.points)
    priors = replace(priors, held=begun.held, clearance_m=clearance_m)
    miss_px = median_px(lengths_px(tracks, camera_of, priors, state))
    components = 0 if state.swing is None else state.swing.shape[1] + 2
    factors = Factors(max(miss_px, Factors.image_px), while_read=(1.0,) * components)
    priors = replace(priors, trust=trust_in_tags(priors, state, factors))
    state, _, reduced = _converge(tracks, camera_of, priors, state, factors, _STEPS, _ROUGH)
    found = variance_components(tracks, camera_of, priors, state, factors, reduced, image_only=False)
    factors, _ = ahead(factors, *found, priors)
    state, _, _ = _converge(tracks, camera_of, priors, state, factors, _STEPS, _ROUGH)
    return _end(camera_of, priors, state, factors, begun)


def _begin(priors: Priors, begun: Begun) -> State:
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
        return state
    swing = np.zeros(priors.swing_sd_rad.shape)
    state.swing, state.drift_m = swing, np.zeros((len(swing), 3))
    if begun.swing is not None and begun.drift_m is not None:
        same = min(begun.swing.shape[1], swing.shape[1])
        swing[:, :same], state.drift_m = begun.swing[:, :same], begun.drift_m
    return state


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
