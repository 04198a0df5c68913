"""Causes of a heading that does not fit: the heading tag is wrong, the image was turned, or both.

Three directions of a frame are compared: its heading tag y, the heading h of its image, and the expected
heading e of its flight. h is that in which the image lies relative to its neighbours' images. An image that
was turned by q quarters after the flight lies at h = y - 90 q, and y fits e. With a wrong tag h fits e, and y
fits neither.

    p(y, h | tag right, q) = N(y - h - 90 q; s) f(y)
    p(y, h | tag wrong, q) = g(y) f(h + 90 q)
    f(x) = (1 - a - b) N(x - e - u; w) + a N(x - e - u - 180; w) + b / 360

g is uniform, and if the image was not turned half the heading kept from the line before, which was flown the
other way. The usual angle u, its scatter w and the rates a and b of frames that look elsewhere are estimated
from the frames whose tags and images agree. The rates of wrong tags and turned images are estimated from all
frames. The method is expectation maximisation with weak priors of the rates (Laplace's rule of succession).
Expected headings e are the course, one heading for all frames, or none; they are averaged by their
likelihoods.

References: Dempster, Laird and Rubin 1977 (mixtures); Kass and Raftery 1995 (averages over models, with
Schwarz's penalty for the estimated parameters).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools, Floats
from geomosaic.constants import MEDIAN_ONE, MOST_ROUNDS, sourced, tuned
from geomosaic.estimation.robust import THREE_SIGMA

WRONG = sourced(4, "place", "of a wrong tag on an image that was not turned", "order of `explained`")
"""Number of "wrong tag, image not turned" among a frame's eight explanations, in `explained`'s order."""
MOST_RAD = tuned(np.radians(30.0), "rad", "of headings that agree: more takes wrong ones along")
_FIRST_RAD = tuned(np.radians(12.0), "rad", "scatter at first: less misses the peak; more merges two")
_FEW = tuned(3.0, "frames", "that the first scatter counts for: less trusts a scatter of three frames")
_STRAYS = tuned(
    (0.1, 0.5), "frames", "counted as seen the other way, and anyhow: less is surer of the course"
)
_PRIORS = tuned((0.9, 0.05, 0.05), "share", "of flights along the course, under one heading, under any")
_SAME_RAD = sourced(1e-4, "rad", "that equal tags differ by", "half of 0.01 degree; meridians of 1 km: 1e-4")
_FALSE_PAIR = tuned(0.02, "share", "of tied pairs that tie wrongly: less is surer of frames on one pair")


@dataclass(frozen=True)
class HeadingEvidence:
    """Directions of n frames in the order in which they were taken, in rad, clockwise from north; NaN where
    unknown.

    given_rad (n,): heading tags. image_rad (n,): as the images lie. course_rad (n,): courses over ground.
    sd_rad (n,): standard deviations of the tags. possible (n, 4): quarter turns that an image can have had.
    """

    given_rad: Floats
    image_rad: Floats
    course_rad: Floats
    sd_rad: Floats
    possible: Bools


def explained(evidence: HeadingEvidence) -> Floats:
    """Probabilities (n, 2, 4) of the explanations: [tag right or wrong, quarter turns of the image].

    A frame without a heading tag or image heading counts as right and not turned.
    """
    given, image = evidence.given_rad, evidence.image_rad
    out = np.zeros((len(given), 2, 4))
    known = np.isfinite(given) & np.isfinite(image)
    out[~known, 0, 0] = 1.0
    if not known.any():
        return out
    given, image, course = given[known], image[known], evidence.course_rad[known]
    quarters = np.arange(4) * np.pi / 2.0
    apart = wrapped(given[:, None] - image[:, None] - quarters)
    near = np.abs(apart[:, 0])[np.abs(apart[:, 0]) < MOST_RAD]
    scatter = float(np.median(near)) / MEDIAN_ONE if len(near) else 0.0
    sd = np.maximum(evidence.sd_rad[known], scatter)[:, None]
    agree = np.abs(apart[:, 0]) < THREE_SIGMA * sd[:, 0]
    wrong = np.full(apart.shape, 1.0 / math.tau)
    wrong[:, 0] = (wrong[:, 0] + _kept(given, image, agree, sd[:, 0])) / 2.0
    tags = np.stack([normal(apart, sd), wrong], axis=1)
    ways = evidence.possible[known] / np.maximum(evidence.possible[known, 1:].sum(axis=1, keepdims=True), 1)
    ways[:, 0] = 1.0
    expected = (course, np.zeros(len(given)), np.full(len(given), np.nan))
    found, logs = np.empty((len(expected), *tags.shape)), np.log(_PRIORS)
    for k, e in enumerate(expected):
        way, penalty = _flown(given[agree] - e[agree])
        camera = image[:, None] + quarters - e[:, None]
        fits = np.stack([np.repeat(way.density(given - e)[:, None], 4, axis=1), way.density(camera)], axis=1)
        found[k], log = _shares(tags * fits, ways)
        logs[k] += log - penalty
    weight = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    out[known] = np.tensordot(weight, found, axes=1)
    return out


def _kept(given: Floats, image: Floats, agree: Bools, sd: Floats) -> Floats:
    """Densities (n,) of tags that were kept from the line before: the last earlier frame whose tag fits its
    image, which lies the other way. Half of them are kept to the last digit."""
    n, ways = len(given), np.radians(np.arange(0.0, 360.0, 10.0))
    aside = np.abs(wrapped(image[:, None] - ways))
    latest = np.full((n + 1, len(ways)), -1)
    latest[np.flatnonzero(agree) + 1, aside[agree].argmin(axis=1)] = np.flatnonzero(agree)
    latest = np.maximum.accumulate(latest, axis=0)[:-1]
    before = np.where(aside > np.pi / 2.0, latest, -1).max(axis=1)
    off = np.abs(wrapped(given - given[before]))
    apart = np.diff(np.unique(given), append=np.inf)
    digit = apart[apart > _SAME_RAD].min()
    to_the_digit = np.where(off < digit / 2.0, 1.0 / digit, 0.0)
    return np.where(before < 0, 1.0 / math.tau, (normal(off, sd) + to_the_digit) / 2.0)


def _shares(like: Floats, ways: Floats) -> tuple[Floats, float]:
    """Probabilities (n, 2, 4) by likelihoods (n, 2, 4) and the rates of wrong tags and turned images; and the
    logarithm of the likelihood of all.

    Args: ways (n, 4): share of each quarter turn among turned images; 1 if not turned.
    """
    n = len(like)
    wrong = turned = 1.0 / (n + 2.0)
    for _ in range(MOST_ROUNDS):
        by_turn = ways * [1.0 - turned, turned, turned, turned]
        share = like * np.stack([(1.0 - wrong) * by_turn, wrong * by_turn], axis=1)
        whole = share.sum(axis=(1, 2), keepdims=True)
        share /= whole
        wrong, turned = ((float(share[at].sum()) + 1.0) / (n + 2.0) for at in (np.s_[:, 1], np.s_[:, :, 1:]))
    return share, float(np.log(whole).sum())


@dataclass(frozen=True)
class _Flown:
    """Headings of the camera less expected ones: usual angle and scatter (rad), rates of the opposite and of
    any heading."""

    usual: float
    width: float
    opposite: float
    stray: float

    def parts(self, off: Floats) -> Floats:
        """Densities (3, ...) of the camera's headings less expected ones: usual, opposite, any."""
        near, back = (normal(wrapped(off - self.usual - turn), self.width) for turn in (0.0, np.pi))
        usual = 1.0 - self.opposite - self.stray
        return np.stack([usual * near, self.opposite * back, np.full(off.shape, self.stray / math.tau)])

    def density(self, off: Floats) -> Floats:
        """Their sum; an unknown difference may be any."""
        return np.where(np.isfinite(off), self.parts(off).sum(axis=0), 1.0 / math.tau)


def _flown(off: Floats) -> tuple[_Flown, float]:
    """By the differences of frames whose tags and images agree; NaN where no heading was expected. And
    Schwarz's penalty of its four numbers."""
    off = off[np.isfinite(off)]
    n = len(off)
    if not n:
        return _Flown(0.0, _FIRST_RAD, 0.0, 1.0), 0.0
    known = 1.0 + sum(_STRAYS) + n
    found = _Flown(usual_angle(off), _FIRST_RAD, _STRAYS[0] / known, _STRAYS[1] / known)
    for _ in range(MOST_ROUNDS):
        parts = found.parts(off)
        on, back, stray = parts / parts.sum(axis=0)
        apart = wrapped(off - found.usual)
        usual = found.usual + float((on * apart).sum() / max(float(on.sum()), 1e-9))
        spread = (float((on * apart**2).sum()) + _FEW * _FIRST_RAD**2) / (float(on.sum()) + _FEW)
        width = min(float(np.sqrt(spread)), MOST_RAD)
        rates = ((float(of.sum()) + prior) / known for of, prior in zip((back, stray), _STRAYS, strict=True))
        found = _Flown(usual, width, *rates)
    return found, 2.0 * float(np.log(n))


def usual_angle(angles_rad: Floats) -> float:
    """The angle (rad) that most of these are near, whatever the others are."""
    tried = np.radians(np.arange(0.0, 360.0, 2.0))
    peak = float(tried[normal(wrapped(angles_rad - tried[:, None]), _FIRST_RAD).sum(axis=1).argmax()])
    near = wrapped(angles_rad - peak)
    return peak + float(np.median(near[np.abs(near) < MOST_RAD]))


def wrong_positions(off_m: Floats, sd_m: Floats, reach_m: float) -> Floats:
    """Probabilities (n,) that positions are wrong: anywhere within reach, rather than normal about the place
    that the images give.

    Args: off_m (n,): distances in plan of given from adjusted positions, NaN where unknown; sd_m (n,): their
        standard deviations by coordinate; reach_m: radius of where a wrong position may lie.
    """
    out, known = np.zeros(len(off_m)), np.isfinite(off_m)
    n, rate = int(known.sum()), 1.0 / (known.sum() + 2.0)
    off, sd = off_m[known], np.maximum(sd_m[known], 1e-3)
    right = -0.5 * (off / sd) ** 2 - np.log(2.0 * np.pi * sd**2)
    wrong = -np.log(np.pi * max(reach_m, 1e-3) ** 2)
    for _ in range(MOST_ROUNDS):
        out[known] = 1.0 / (1.0 + np.exp(np.clip(right - wrong, -700.0, 700.0)) * (1.0 - rate) / rate)
        rate = (float(out.sum()) + 1.0) / (n + 2.0)
    return out


def placed_by_pairs(pairs: Floats) -> Floats:
    """Probabilities (n,) that so many tied pairs (n,) don't all place a frame wrongly."""
    return np.asarray(1.0 - _FALSE_PAIR ** np.asarray(pairs, dtype=np.float64))


def wrapped(angle_rad: Floats) -> Floats:
    """Angles from -pi to pi."""
    return np.asarray((angle_rad + np.pi) % math.tau - np.pi)


def normal(off: Floats, sd: Floats | float) -> Floats:
    """The normal density."""
    return np.asarray(np.exp(-0.5 * (off / sd) ** 2) / (np.sqrt(2.0 * np.pi) * sd))
