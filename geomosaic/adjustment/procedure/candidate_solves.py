"""Solutions of candidate models of lens and shutter, begun from another model's."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Block, Settings
from geomosaic.adjustment.problem.bundle_model import (
    READOUT,
    Begun,
    Factors,
    Priors,
    State,
    stepped,
    with_interior,
)
from geomosaic.adjustment.problem.priors import priors_of
from geomosaic.adjustment.problem.tracks import Tracks
from geomosaic.adjustment.solver.bundle import solve_bundle
from geomosaic.adjustment.solver.bundle_equations import cost_of, known, lengths_px, normals_of
from geomosaic.adjustment.solver.normal_equations import Reduced, reduce_normals
from geomosaic.adjustment.solver.prior_reweighting import median_px, trust_in_tags
from geomosaic.adjustment.solver.single_points import settled_points, wandering
from geomosaic.adjustment.solver.variance_component_newton import ahead
from geomosaic.adjustment.solver.variance_components import undetermined, variance_components
from geomosaic.adjustment.terms.collinearity import INTERIOR, interior_of
from geomosaic.adjustment.terms.mounting import MOUNTING
from geomosaic.adjustment.terms.rolling_shutter_rotation import with_drift, with_swing
from geomosaic.camera.interior import Camera
from geomosaic.constants import tuned
from geomosaic.estimation.linear import least_squares

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
_STEPS = tuned(4, "steps", "before and after variance components: fewer lose models that are far")
_SHARES = tuned((1.0, 0.5, 0.25, 0.1), "of a step", "tried until the cost falls: fewer leave far models")
_LITTLE = tuned(1e-3, "share of the cost", "a gain that ends the steps: less decides nothing")
_OF_ALL_LENSES = INTERIOR.index("k1")
_ANGLES = tuned(100, "angles", "at which one lens is fitted to another: smooth functions need no more")


@dataclass(frozen=True)
class Model:
    """A model of lens and shutter, and the solution that its own begins from."""

    block: Block
    settings: Settings
    before: Begun


def solved(tracks: Tracks, model: Model) -> Begun:
    """The model's solution. Raises: NotSolvableError where there is none."""
    block, begun = model.block, _begun(model)
    priors = priors_of(block, model.settings, block.lenses, begun.points_m)
    found = solve_bundle(
        *(tracks, block.lens_of, priors, begun.poses),
        again=begun, rough=True, lens_held=not model.settings.self_calibration,
    )  # fmt: skip
    return found.of_points(found.points_m)


def few_steps(tracks: Tracks, model: Model) -> Begun:
    """The model some steps from the solution before, the first of them that of a score test (Rao 1948).

    Residuals weigh by their present median, priors as stated; then variance components are estimated once.
    Raises: NotSolvableError where the equations have no solution.
    """
    block, begun, camera_of = model.block, _begun(model), model.block.lens_of
    priors = priors_of(block, model.settings, block.lenses, begun.points_m)
    state = _begin(priors, begun)
    miss_px = median_px(lengths_px(tracks, camera_of, priors, state))
    components = 0 if state.swing is None else state.swing.shape[1] + 2
    factors = Factors(max(miss_px, Factors.image_px), while_read=(1.0,) * components)
    as_before = replace(factors, image_px=begun.factors.image_px)
    held = begun.held & undetermined(tracks, camera_of, priors, state, as_before)
    priors = replace(priors, held=held, trust=trust_in_tags(priors, state, factors))
    state, reduced = _followed(tracks, camera_of, priors, state, factors)
    found = variance_components(tracks, camera_of, priors, state, factors, reduced, image_only=False)
    factors, _ = ahead(factors, *found, priors)
    state, _ = _followed(tracks, camera_of, priors, state, factors)
    return _end(camera_of, priors, state, factors, begun)


def _followed(
    tracks: Tracks, camera_of: Ints, priors: Priors, state: State, factors: Factors
) -> tuple[State, Reduced]:
    """The state after some steps, until they gain next to nothing, and the last step's equations."""
    cost = cost_of(tracks, camera_of, priors, state, factors)
    of_cameras, of_platform = np.split(~known(priors), [state.interior.size])
    for _ in range(_STEPS):
        reduced = reduce_normals(normals_of(tracks, camera_of, priors, state, factors))
        pose, interior, points, level, mounting = reduced.solve()
        interior = interior * of_cameras.reshape(interior.shape)
        step = pose, interior, points, level, mounting * of_platform[: mounting.size]
        alone, before = wandering(reduced), cost
        for share in _SHARES:
            trial = settled_points(*(tracks, camera_of, priors, stepped(state, share, *step), factors, alone))
            trial_cost = cost_of(tracks, camera_of, priors, trial, factors)
            if trial_cost < cost:
                state, cost = trial, trial_cost
                break
        if before - cost < _LITTLE * cost:
            break
    return state, reduced


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
    swing: Floats = np.zeros(priors.swing_sd_rad.shape)
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


def _begun(model: Model) -> Begun:
    """What the model's solve begins from: lenses of its kind, whose terms are determined anew."""
    before, given = model.before, model.block.lenses
    lenses = tuple(_begun_lens(*both) for both in zip(given, before.cameras, strict=True))
    held, same = before.held.copy(), [a.kind == b.kind for a, b in zip(given, before.cameras, strict=True)]
    of_lenses = held[: held.size - len(MOUNTING)].reshape(len(lenses), -1)
    if model.settings.self_calibration:
        of_lenses[~np.array(same), _OF_ALL_LENSES:READOUT] = False
    return replace(before.of_points(before.points_m, lenses), held=held)


def _begun_lens(given: Camera, found: Camera) -> Camera:
    """A lens as found with another model; one of another kind gets terms that bend rays alike."""
    numbers, before = interior_of(given), interior_of(found)
    same = READOUT if given.kind == found.kind else _OF_ALL_LENSES
    numbers[:same] = before[:same]
    if given.kind != found.kind:
        numbers[_OF_ALL_LENSES : _OF_ALL_LENSES + 3] = _odd_terms(found)
    numbers[READOUT] = before[READOUT] or numbers[READOUT]
    return with_interior(given, numbers)


def _odd_terms(lens: Camera) -> Floats:
    """k1 to k3 of the fisheye of the same focal length that bends rays as a lens does."""
    widest = np.linalg.norm(lens.ray_from_image(lens.corners_px)[:, :2], axis=1).max()
    angle = np.linspace(0.0, float(np.arctan(widest)), _ANGLES)
    design = angle[:, None] ** [3, 5, 7]
    return least_squares(design, lens.lens.radial(lens.terms, np.tan(angle)) - angle)
