"""How each frame swings while its rows are read: a few smooth functions of the row, and what is believed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from geomosaic.adjustment.problem.estimate import Estimate
from geomosaic.adjustment.terms.term import LEAST_REDUNDANCY, Component, Components, FrameTerm
from geomosaic.camera.exterior import LEAST_RECORDED, Poses, Turns
from geomosaic.camera.rotation import exp_turn, log_turn
from geomosaic.constants import sourced, tuned

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]

TERMS = sourced(
    4,
    "functions of the row",
    "about each axis, Legendre's of degree 1 to 4, less what they are at the middle row: a swing of a "
    "whole period while a frame is read is met to a tenth (root mean square), one of half a period to a "
    "hundredth. Fewer can't follow motors, more are three unknowns a frame each",
    "least squares of a sine by Legendre's polynomials; that 1 is too few: docs/design.md, swings (28 "
    "frames of a Sequoia: 5.5 px with a constant rate, 0.91 px with four)",
)
RATE_SD_RAD_PER_S = sourced(
    0.3,
    "rad/s",
    "deviation, to begin with, of what each function gives a frame's rates; then it is estimated (see "
    "`variance_components`). With much less, lens and poses take up turns first; with much more, turns "
    "take up what poses do",
    "gyroscope of 28 frames of a Sequoia on a fixed wing of 0.7 kg: 0.26 rad/s kept over a readout, "
    "0.15 that come and go (root mean square of three axes)",
)
GUST_M_PER_S = sourced(
    0.5,
    "m/s",
    "deviation of a velocity while a frame is read about that by positions: over the flying height it "
    "is a rate of turning, as far as level ground can show. Taken as exact (0), chance differences of "
    "velocities set readout and scale: blocks came out 12 and 21 % too large",
    "commit 1b27d03: velocities by positions are off by 0.3 to 1 m/s; docs/results.md, velocities taken "
    "as exact, seeds 37 and 48",
)
MOST_SWING = tuned(
    10.0,
    "times the deviation to begin with",
    "of how frames swing at most: nothing reports by how much; ten times as fast is a crash",
)
MOST_GUSTS = sourced(
    3.0,
    "times GUST_M_PER_S",
    "that velocities may be off by: nothing flies a survey in gusts of 1.5 m/s. A rate of turning beyond "
    "is no velocity's, and as far as it stands for one it takes up what else is amiss: halves of a "
    "flight lay 2.4 px apart with five times, 1.5 with three and with one and a half",
    "docs/results.md, split halves",
)
MOST_DRIFT = sourced(
    1.0,
    "times GUST_M_PER_S",
    "that velocities may be off by as such, along the ground or up, root mean square; what is more along "
    "the ground stays a rate of turning: in metres, as velocities are, it drew a block whose frames turn "
    "smaller, to a quarter, where fewer metres are the same turn. A frame that climbs while it is read "
    "looks like one that is tilted and lies a little further on, so that only the block as a whole shows "
    "which: with three times as much, a flight's climbs went to 6 m/s and its block to 11 degrees",
    "docs/results.md, garfield's halves; docs/design.md, climbs",
)
UPWARDS: Floats = sourced(
    np.array([1e-3, 1e-3, 1.0]),
    "of a drift's deviation, east, north and up",
    "where frames turn; next to nothing along the ground, since equations want more than none",
    "docs/design.md, climbs: a flight's halves lay 3 degrees apart with as much along the ground",
)
LEVEL_AXES: Floats = sourced(
    np.array([1.0, 1.0, 1e-3]),
    "of a rate's deviation, about east, north and up",
    "a velocity that is off looks like a rate about a level axis; next to nothing about the other, since "
    "equations want more than none. A rate about the line of sight that all frames have, a lens's "
    "decentring and a tilt cancel: with as much about all axes a flight's halves lay 5.7 px apart, its "
    "principal points 50 to 74 px off",
    "docs/results.md, split halves",
)
VIBRATION_TERMS = sourced(
    12,
    "functions of the row",
    "about each axis where frames vibrate while they are read: as TERMS, for three periods",
    "least squares of a sine by Legendre's polynomials; 42 frames of an action camera under an aeroplane "
    "left 1.03 px with 4, 0.80 with 8 and 0.78 with 12",
)
_TABLED = sourced(
    8,
    "times for each function",
    "of a table of turns over a readout, linear between them: a period of four functions is met to 1 in "
    "200; with fewer its crests are cut",
    "linear interpolation: (2 pi / 32)² / 8",
)
_MOST_RECORDED = tuned(
    0.49,
    "share of the height from the middle row on",
    "beyond which nothing is left to guess: the last hundredth, where a function may still stand",
)


def with_drift(poses: Poses, drift_m: Floats, readouts_s: Floats) -> Poses:
    """Poses whose velocities hold the drifts (f, 3) over their readouts (f,) too."""
    off = np.divide(drift_m.T, readouts_s, out=np.zeros(drift_m.T.shape), where=readouts_s != 0.0)
    given = np.zeros((len(poses), 3)) if poses.velocities_m_per_s is None else poses.velocities_m_per_s
    return replace(poses, velocities_m_per_s=given + off.T)


def recorded_share(turns: Turns | None, frame: Ints, readouts_s: Floats) -> Floats:
    """Up to which share of the image's height, from the middle row on in the order of reading, turns are
    recorded, (m,), of frames (m,) with readouts_s (m,); NaN where next to none of it is."""
    if turns is None:
        return np.full(readouts_s.shape, np.nan)
    until_s = np.broadcast_to(turns.recorded_until_s, len(turns.rad))[frame]
    share = until_s / np.where(readouts_s, np.abs(readouts_s), np.nan)
    return np.where(share > LEAST_RECORDED, np.minimum(share, _MOST_RECORDED), np.nan)


def terms_at(share: Floats, terms: int, recorded: Floats, backwards: Bools) -> tuple[Floats, Floats]:
    """The functions (..., terms) at rows by their share of the image's height, from the middle row on, and
    their slopes over a whole height.

    Legendre's polynomials; where turns are recorded up to a share of the height (`recorded`, NaN where not;
    in the order of reading, which is upwards where `backwards`), the first is for the record's zero, and the
    others are powers from two on of the rows since, along which rates were guessed.
    """
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


def with_swing(poses: Poses, swing_rad: Floats, readouts_s: Floats) -> Poses:
    """Poses whose turns hold the swing (f, terms, 3) about the work frame's axes too:
    `R(row) = exp(swing(row)) R exp(turn(row))`.

    Args: readouts_s (f,): of each frame's camera, over which its swing is meant.
    """
    turns, terms = poses.turns, swing_rad.shape[1]
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
        "nkt,ntj->nkj", terms_at(share, terms, recorded, readouts_s[:, None] < 0.0)[0], swing_rad
    )
    in_camera = np.einsum("nji,nkj->nki", poses.rotations, by_row)
    rad = log_turn(exp_turn(in_camera.reshape(-1, 3)) @ exp_turn(turns.rad.reshape(-1, 3)))
    return replace(poses, turns=replace(turns, rad=rad.reshape(n, k, 3)))


LEAST_SWING = tuned(0.02, "times the first deviation", "less: swings that shrank could not grow again")
_STIFF = tuned(0.03, "of the largest axis's deviation", "below it an axis is held, see LEVEL_AXES")
DRIFTS = "drift along the ground", "drift upwards"


@dataclass(frozen=True)
class RollingShutterRotation(FrameTerm):
    """Rotation (swing) and drift of f frames while their rows are read are near zero.

    swing_sd_rad (f, t, 3), drift_sd_m (f, 3): first deviations; each function of the row, drifts along the
    ground and drifts upwards have variance components. common: a part of the swing may be common to all
    frames, so that it does not shrink. most_swing: limit of its components.
    """

    swing_sd_rad: Floats
    drift_sd_m: Floats
    common: bool
    most_swing: float

    name: ClassVar[str] = "rolling shutter rotation"

    @property
    def weight(self) -> Floats:  # type: ignore[override]
        return np.ones((len(self.drift_sd_m), 1))

    @property
    def terms(self) -> int:
        return int(self.swing_sd_rad.shape[1])

    def component_names(self) -> tuple[str, ...]:
        return (*(f"swing {k + 1}" for k in range(self.terms)), *DRIFTS)

    def columns(self, at: Estimate) -> slice:
        return slice(6, 6 + 3 * self.terms + 3)

    def miss(self, at: Estimate) -> Floats:
        return -at.while_read

    def sd(self, components: Components) -> Floats:
        *of_swing, along, up = (components[name] for name in self.component_names())
        swing_sd = self.swing_sd_rad * np.reshape(of_swing, (-1, 1))
        return np.column_stack([swing_sd.reshape(len(swing_sd), -1), self.drift_sd_m * [along, along, up]])

    def derivatives(self, at: Estimate) -> tuple[None, list[tuple[str, Floats]]]:
        return None, []

    def components(self, at: Estimate, components: Components, variances: Floats) -> Iterator[Component]:
        """By the residuals of all frames, less what all have in common in the camera's axes: that belongs to
        the readout or the lens."""
        own = np.concatenate([at.swing_rad, at.drift_m[:, None]], axis=1)
        own = np.einsum("fji,ftj->fti", at.rotations, own)
        own = np.einsum("fij,ftj->fti", at.rotations, own - np.median(own, axis=0)).reshape(len(own), -1)
        sd, terms = self.sd(components), self.terms
        of = np.append(np.repeat(np.arange(terms), 3), terms + np.array([0, 0, 1]))
        redundancy = 1.0 - variances[:, self.columns(at)] / sd**2
        least = [1.0 if self.common else LEAST_SWING] * terms + [LEAST_SWING] * 2
        most = [self.most_swing] * terms + [MOST_DRIFT] * 2
        for k, name in enumerate(self.component_names()):
            factor, its = components[name], sd * (of == k)
            of_term = (its > _STIFF * its.max(axis=1, keepdims=True)).astype(float)
            told = np.pad(of_term, ((0, 0), (6, 0))), np.pad(-own, ((0, 0), (6, 0)))
            r = float((of_term * redundancy).sum()) - (its.max(axis=0) > 0.0).sum()
            if r <= LEAST_REDUNDANCY:
                found = float(np.clip(factor, least[k], most[k]))
                yield Component(name, found, *told, least=least[k], most=most[k])
                continue
            squares = float((of_term * (own / sd) ** 2).sum())
            scatter = factor * float(np.sqrt(squares / r))
            follows, found = float(least[k] < scatter < most[k]), float(np.clip(scatter, least[k], most[k]))
            yield Component(name, found, *told, squares, r, follows, least[k], most[k])
