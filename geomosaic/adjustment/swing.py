"""How each frame swings while its rows are read: a few smooth functions of the row, and what is believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from geomosaic.camera.exterior import Poses, Turns
from geomosaic.camera.rotation import exp_turn, log_turn

Floats = NDArray[np.float64]

TERMS = 4
"""Functions of the row about each axis: Legendre's of degree 1 to 4, less what they are at the middle row. A
swing of a whole period while a frame is read is met to a tenth, one of half a period to a hundredth."""
RATE_SD_RAD_PER_S = 0.3
"""To begin with, of what each function gives a frame's rates: 28 frames of a fixed wing of 0.7 kg have 0.26
rad/s that they keep over a readout and 0.15 that come and go, by its gyroscope (root mean square of three
axes). What the frames of a block really do is estimated, see `variance_components`."""
GUST_M_PER_S = 0.5
"""Of a velocity while a frame is read about that by positions: over the flying height it is a rate of
turning, as far as level ground can tell. Taken as exact, chance differences of velocities would tell readout
and scale."""
_TABLED = 33  # times of a table of turns; linear between them: a period is met to 1 in 200


def terms_at(share: Floats, terms: int) -> tuple[Floats, Floats]:
    """The functions (..., terms) at rows by their share of the picture's height, from the middle row on, and
    their slopes over a whole height."""
    whole = legendre.legvander(2.0 * share, terms)
    slopes = 2.0 * whole[..., :terms] @ legendre.legder(np.eye(terms + 1))[:, 1:]
    return (whole - legendre.legvander(np.zeros(1), terms))[..., 1:], slopes


def with_swing(poses: Poses, swing_rad: Floats, readouts_s: Floats) -> Poses:
    """Poses whose turns hold the swing (f, terms, 3) about the work frame's axes too:
    `R(row) = exp(swing(row)) R exp(turn(row))`.

    Args: readouts_s (f,): of each frame's camera, over which its swing is meant.
    """
    turns, times = poses.turns, 2 if swing_rad.shape[1] == 1 else _TABLED
    if turns is None:
        span_s = float(np.abs(readouts_s).max()) or 1.0
        turns = Turns(span_s, np.zeros((len(poses), times, 3)))
    elif turns.rad.shape[1] < times:
        tabled = [turns[i].tabled(turns.span_s, times).rad for i in range(len(poses))]
        turns = Turns(turns.span_s, np.stack(tabled))
    n, k = turns.rad.shape[:2]
    after_s = np.linspace(-0.5, 0.5, k) * turns.span_s
    share = after_s / np.where(readouts_s, readouts_s, np.inf)[:, None]
    by_row = np.einsum("nkt,ntj->nkj", terms_at(share, swing_rad.shape[1])[0], swing_rad)
    in_camera = np.einsum("nji,nkj->nki", poses.rotations, by_row)
    rad = log_turn(exp_turn(in_camera.reshape(-1, 3)) @ exp_turn(turns.rad.reshape(-1, 3)))
    return replace(poses, turns=Turns(turns.span_s, rad.reshape(n, k, 3)))
