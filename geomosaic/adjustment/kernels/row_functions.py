"""How a frame rotates and moves while its rows are read: smooth functions of the row."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.polynomial import legendre

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.camera.exterior import LEAST_RECORDED, Poses, Turns
from geomosaic.camera.rotation import exp_turn, log_turn
from geomosaic.constants import sourced, tuned

TERMS = tuned(4, "functions of the row", "Legendre's of degree 1 to 4: a whole period is met to a tenth")
VIBRATION_TERMS = tuned(12, "functions of the row", "the same for three periods, where frames vibrate")
_TABLED = sourced(8, "times a function", "of tabled turns; fewer: crests are cut", "(2 pi / 32)^2 / 8")
_MOST_RECORDED = tuned(0.49, "share of the height from the middle row on", "beyond: nothing is left to guess")


def with_drift(poses: Poses, drift_m: Floats, readouts_s: Floats) -> Poses:
    """Poses whose velocities hold the drifts (f, 3) along the cameras' axes over their readouts (f,) too."""
    way_m = np.einsum("fij,fj->if", poses.rotations, drift_m)
    off = np.divide(way_m, readouts_s, out=np.zeros(way_m.shape), where=readouts_s != 0.0)
    given = np.zeros((len(poses), 3)) if poses.velocities_m_per_s is None else poses.velocities_m_per_s
    return replace(poses, velocities_m_per_s=given + off.T)


def recorded_share(turns: Turns | None, frame: Ints, readouts_s: Floats) -> Floats:
    """Up to which share of the image's height turns are recorded, (m,), from the middle row on in the order
    of reading. NaN where next to none of it is. Args: frame, readouts_s (m,)."""
    if turns is None:
        return np.full(readouts_s.shape, np.nan)
    until_s = np.broadcast_to(turns.recorded_until_s, len(turns.rad))[frame]
    share = until_s / np.where(readouts_s, np.abs(readouts_s), np.nan)
    return np.where(share > LEAST_RECORDED, np.minimum(share, _MOST_RECORDED), np.nan)


def terms_at(share: Floats, terms: int, recorded: Floats, backwards: Bools) -> tuple[Floats, Floats]:
    """The functions (..., terms) at rows, and their slopes over a whole height: Legendre's polynomials. Where
    rotations are recorded, the first function is for the record's zero. The others are powers from two on of
    the rows after the record's end, along which rates were guessed. Args: share: of the image's height, from
    the middle row on. recorded: share up to which rotations are recorded, in the order of reading, NaN where
    they are not. backwards: where rows are read upwards."""
    whole = legendre.legvander(2.0 * share, terms)
    slopes = 2.0 * whole[..., :terms] @ legendre.legder(np.eye(terms + 1))[:, 1:]
    whole = (whole - legendre.legvander(np.zeros(1), terms))[..., 1:]
    known = np.broadcast_to(np.isfinite(recorded), share.shape)
    if terms == 1 or not known.any():
        return whole, slopes
    way = np.where(backwards, -1.0, 1.0)
    length = np.where(known, 0.5 - recorded, 1.0)[..., None]
    powers = np.arange(2, terms + 1)
    since = np.maximum((way * share - np.where(known, recorded, 0.0))[..., None] / length, 0.0)
    middle = np.maximum(-np.where(known, recorded, 0.0)[..., None] / length, 0.0)
    known = known[..., None]
    whole[..., 1:] = np.where(known, since**powers - middle**powers, whole[..., 1:])
    steep = np.asarray(way)[..., None] * powers * since ** (powers - 1) / length
    slopes[..., 1:] = np.where(known, steep, slopes[..., 1:])
    return whole, slopes


def with_rotation_terms(poses: Poses, rotation_terms_rad: Floats, readouts_s: Floats) -> Poses:
    """Poses whose turns include the rotation terms (f, terms, 3) about the cameras' axes, `R(row) = R
    exp(rotation_terms(row)) exp(turn(row))`. Args: readouts_s (f,): of each frame's camera, over which its
    terms are defined."""
    turns, terms = poses.turns, rotation_terms_rad.shape[1]
    times = 2 if terms == 1 else _TABLED * terms + 1
    if turns is None:
        span_s = float(np.abs(readouts_s).max()) or 1.0
        turns = Turns(span_s, np.zeros((len(poses), times, 3)))
    elif turns.rad.shape[1] < times:
        tabled = [turns[i].tabled(turns.span_s, times).rad for i in range(len(poses))]
        turns = replace(turns, rad=np.stack(tabled))
    n, k = turns.rad.shape[:2]
    after_s = np.linspace(-0.5, 0.5, k) * turns.span_s
    share = after_s / np.where(readouts_s, readouts_s, np.inf)[:, None]
    recorded = recorded_share(turns, np.arange(n), readouts_s)[:, None]
    by_row = np.einsum(
        "nkt,ntj->nkj", terms_at(share, terms, recorded, readouts_s[:, None] < 0.0)[0], rotation_terms_rad
    )
    rad = log_turn(exp_turn(by_row.reshape(-1, 3)) @ exp_turn(turns.rad.reshape(-1, 3)))
    return replace(poses, turns=replace(turns, rad=rad.reshape(n, k, 3)))
