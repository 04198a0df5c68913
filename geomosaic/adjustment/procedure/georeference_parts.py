"""A part of a block laid onto the positions of its frames: one scale, one turn, one place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import MEDIAN_LENGTH, tuned
from geomosaic.estimation.linear import least_squares
from geomosaic.estimation.robust import lie_weight

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_DRAWS = tuned(
    300,
    "pairs of frames",
    "that are tried: of positions of which half are wrong, a quarter of the pairs are right",
)
_ALIKE_RAD = tuned(
    0.2,
    "rad",
    "by which headings and positions may turn a part differently: compasses are off by 10 degrees",
)
_LEAST_SHARE = tuned(
    0.2,
    "share of what is stated",
    "a position's noise is not below it, as far as laying goes: else a few that agree by chance would"
    " outvote the rest",
)


@dataclass(frozen=True)
class Fixes:
    """What is known on the ground of a part's frames: their nadir points where positions were observed, and
    control points seen in them.

    frame (k,): which. offset (k,): from its nadir point as the frame was believed to stand, 0 for a position.
    at, sd_m (k,): where that is, east + i north, and its deviation.
    """

    frame: NDArray[np.intp]
    offset: Complexes
    at: Complexes
    sd_m: Floats

    def of(self, frames: NDArray[np.intp]) -> Fixes:
        """Of some frames (sorted), counted among these."""
        mine = np.isin(self.frame, frames)
        number = np.searchsorted(frames, self.frame[mine])
        return Fixes(number, self.offset[mine], self.at[mine], self.sd_m[mine])


@dataclass(frozen=True)
class Beliefs:
    """What POS says of frames: nadir points (n,), east + i north, and deviations (n,): of these in m, of
    headings in rad, of the scale that heights and focal length give, as a share."""

    nadir: Complexes
    position_sd_m: Floats
    yaw_sd_rad: Floats
    scale_sd: Floats

    def of(self, frames: NDArray[np.intp]) -> Beliefs:
        """Of some frames."""
        return Beliefs(
            self.nadir[frames], self.position_sd_m[frames], self.yaw_sd_rad[frames], self.scale_sd[frames]
        )


def laid(
    shape: Complexes, place: Complexes, beliefs: Beliefs, fixes: Fixes
) -> tuple[complex, complex, Floats]:
    """The similarity, at = whole * place + shift, that lays frames onto what is known of where they are; and
    how far each fix is trusted, (k,).

    Begun from pairs of frames far apart (the least median of squares, Rousseeuw 1984) and from what headings
    and heights say, each improved by re-weighted least squares; the one with the lower cost is taken.
    Headings and heights have their say with the deviation of one frame: what they are off by they mostly have
    in common. A position beyond six deviations has none.

    Args: shape (n,): turn and scale of each frame against what was given of it. place (n,): nadir points.
    """
    given = _given(shape, beliefs)
    if not len(fixes.at):
        return given, complex(np.mean(beliefs.nadir - given * place)), np.zeros(0)
    known = place[fixes.frame] + shape[fixes.frame] * fixes.offset
    sd = float(np.median(beliefs.scale_sd[fixes.frame])), float(min(np.median(beliefs.yaw_sd_rad), np.pi))
    tried = [_improved(whole, known, given, sd, fixes) for whole in (given, *_drawn(known, fixes))]
    return min(tried, key=lambda t: t[0])[1:]


def _given(shape: Complexes, beliefs: Beliefs) -> complex:
    """What headings and heights say of the whole: that most frames are turned and scaled as given."""
    turns = np.conj(shape) / np.abs(shape)
    apart = np.abs(np.angle(turns[:, None] * np.conj(turns)))
    best = turns[np.minimum(apart, _ALIKE_RAD).sum(axis=1).argmin()]
    near = np.abs(np.angle(turns * np.conj(best))) < np.maximum(3.0 * beliefs.yaw_sd_rad, 0.1)
    turn = complex(turns[near].mean()) if near.any() else complex(best)
    return complex(turn / abs(turn) * np.exp(-np.median(np.log(np.abs(shape)))))


def _drawn(place: Complexes, fixes: Fixes) -> list[complex]:
    """Of many pairs of fixes the similarity with the least median miss."""
    n = len(place)
    i, j = np.triu_indices(n, 1)
    if len(i) > _DRAWS:
        some = np.random.default_rng(0).choice(len(i), 8 * _DRAWS, replace=len(i) < 8 * _DRAWS)
        i, j = i[some], j[some]
        far = np.argsort(-np.abs(place[i] - place[j]), kind="stable")[: len(i) // 2]
        far = far[:: max(1, len(far) // _DRAWS)]
        i, j = i[far], j[far]
    base, given = place[i] - place[j], fixes.at[i] - fixes.at[j]
    apart = (np.abs(base) > 0.0) & (np.abs(given) > 0.0)
    if n < 4 or not apart.any():
        return []
    whole = given[apart] / base[apart]
    left = fixes.at[None] - whole[:, None] * place[None]
    shift = np.median(left.real, axis=1) + 1j * np.median(left.imag, axis=1)
    return [complex(whole[np.median(np.abs(left - shift[:, None]), axis=1).argmin()])]


def _improved(
    whole: complex, place: Complexes, given: complex, sd: tuple[float, float], fixes: Fixes
) -> tuple[float, complex, complex, Floats]:
    """Cost, similarity and trust after re-weighting from `whole` on."""
    left = fixes.at - whole * place
    shift = complex(np.median(left.real), np.median(left.imag))
    n, one, zero = len(place), np.ones(len(place)), np.zeros(len(place))
    e, u = place.real, place.imag
    design = np.concatenate([np.stack([e, -u, one, zero], 1), np.stack([u, e, zero, one], 1)])
    weight = np.ones(n)
    for _ in range(20):
        standard = np.abs(fixes.at - whole * place - shift) / fixes.sd_m
        noise = max(float(np.median(standard)) / MEDIAN_LENGTH, _LEAST_SHARE)
        weight = lie_weight(standard / noise)
        root = np.sqrt(weight) / (noise * fixes.sd_m)
        axis, off = whole / abs(whole), float(np.angle(whole / given))
        held = np.array([[axis.real, axis.imag, 0, 0], [-axis.imag, axis.real, 0, 0]])
        held[0] /= sd[0] * abs(given)
        heard = np.sqrt(float(lie_weight(np.array(abs(off) / sd[1])))) / sd[1]
        held[1] *= heard / abs(whole)
        rows = np.concatenate([design * np.tile(root, 2)[:, None], held])
        sides = np.concatenate([fixes.at.real * root, fixes.at.imag * root, [1.0 / sd[0], -off * heard]])
        size = np.linalg.norm(rows, axis=0) + 1e-12
        x = least_squares(rows / size, sides, rcond=1e-12) / size
        whole, shift = complex(x[0], x[1]), complex(x[2], x[3])
    standard = np.abs(fixes.at - whole * place - shift) / fixes.sd_m
    scale, turn = np.log(abs(whole / given)) / sd[0], np.angle(whole / given) / sd[1]
    cost = float(np.log1p(standard**2).sum() + np.log1p(scale**2) + np.log1p(turn**2))
    return cost, whole, shift, weight
