"""All pairs at once: one motion for all, an own slow part for each, clouds set aside (method `joint`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from geomosaic.arrays import Bools, Floats, Ints
from geomosaic.ccd.expected import Expected, expected
from geomosaic.ccd.joint_window import (
    LEAST_KNOTS,
    KnotOffsets,
    WindowStart,
    first_offsets,
    solved_window,
)
from geomosaic.ccd.lost_lines import LineStep, lasting, steps
from geomosaic.ccd.model import (
    BRIDGED,
    MEASURED,
    RELIABLE_SD_PX,
    SURE_SD_PX,
    UNKNOWN_SD_PX,
    UNRELIABLE,
    CcdSettings,
    PairOffsets,
    Progress,
)
from geomosaic.ccd.overlaps import Strips
from geomosaic.ccd.parallel import each
from geomosaic.ccd.prepared_pairs import curve_of
from geomosaic.ccd.rows import left_offsets, relief_of, row_pair, shared_lines
from geomosaic.ccd.volumes import within_overlap
from geomosaic.constants import tuned
from geomosaic.survey.strips import StripGeometry

_WINDOW_LINES = tuned(20000, "lines", "solved at once: more take memory; fewer teach less about the motion")
_MOST_ROUNDS = tuned(2, "rounds", "searches for lost lines: one misses hidden steps; each takes a solution")
_DOUBTFUL_LINES = tuned(3.0, "lines", "doubtful at lost lines: less trusts the wrong side; more loses some")


def joint(
    strips: Strips, settings: CcdSettings, progress: Progress, window_lines: int = _WINDOW_LINES
) -> tuple[PairOffsets, ...]:
    """Offsets of every line of every pair, with standard deviations.

    The strips are gone through in windows of about `window_lines` lines, which overlap and fade into each
    other; all pairs are solved together in each (`joint_window`). What a DEM shows of dline is taken out
    before and added after. Lines whose ground only one strip has keep the nearest offset, `unreliable`.
    """
    likely = expected(strips.geometry, settings.knot_lines)
    settings = within_overlap(settings, strips.geometry.overlap_px)
    step = likely.knot_lines
    lines = max((shared_lines(strips, pair) for pair in strips.pairs), default=0)
    if lines < LEAST_KNOTS * step:
        return tuple(PairOffsets.unknown(pair, strips.lines(pair)) for pair in strips.pairs)
    knots = lines // step + 2  # a few lines beyond: offsets move what is shared
    known = [relief_of(strips, pair, knots * step) for pair in strips.pairs]
    windows = list(_windows(knots, window_lines // step))
    whole = KnotOffsets.nothing(len(strips.pairs), knots)
    for count, window in enumerate(windows):
        progress(count, len(windows))
        whole.add(_solved(strips, settings, likely, window, known), window.first, window.weight)
    progress(len(windows), len(windows))
    return tuple(_of_pair(strips, k, whole, step, known[k]) for k in range(len(strips.pairs)))


@dataclass(frozen=True)
class _Window:
    """Knots first to last, and what each counts in the whole: 1 inside, fading into the next window."""

    first: int
    last: int
    weight: Floats


def _windows(knots: int, longest: int) -> Iterator[_Window]:
    """Windows that overlap by a tenth on either side."""
    margin = longest // 10
    count = max(round(knots / longest), 1) if knots <= 1.2 * longest else -(-knots // longest)
    ends = np.linspace(0, knots, count + 1).astype(int)
    at = np.arange(knots) + 0.5
    fade = max(margin // 2, 1)
    for first, last in pairwise(ends):
        weight = np.ones(knots)
        if first > 0:
            weight *= np.clip(0.5 + (at - first) / (2 * fade), 0.0, 1.0)
        if last < knots:
            weight *= np.clip(0.5 + (last - at) / (2 * fade), 0.0, 1.0)
        reach = max(first - margin, 0), min(last + margin, knots)
        yield _Window(int(reach[0]), int(reach[1]), weight[slice(*reach)])


def _solved(
    strips: Strips, settings: CcdSettings, likely: Expected, window: _Window, known_px: list[Floats]
) -> KnotOffsets:
    """A window's curves; lines found lost or repeated are added to what is known, from there to the end."""
    step = likely.knot_lines
    first, last = window.first * step, window.last * step
    before = [px[first:].copy() for px in known_px]
    pairs = each(
        lambda k: row_pair(strips, strips.pairs[k], first, last, known_px[k][first:last]),
        range(len(known_px)),
    )

    def begun(lost: list[LineStep]) -> WindowStart:
        for px, mine in zip(known_px, before, strict=True):
            px[first:] = mine
        for at in lost:
            known_px[at.index][first + at.line :] += at.count
        return first_offsets(pairs, settings, likely)

    lost: list[LineStep] = []
    found, clear = solved_window(pairs, begun(lost), likely)
    for _ in range(_MOST_ROUNDS):
        more = lasting([*lost, *steps(clear, found.offset_px, likely)])
        if more == lost:
            break
        lost = more
        found, clear = solved_window(pairs, begun(lost), likely)
    level = np.hypot(*np.median(found.offset_px, axis=(0, 1)))
    return found if level <= likely.far_px else found.widened(float(level))


def far_from_nominal(geometry: StripGeometry, offsets: Sequence[PairOffsets]) -> tuple[float, float] | None:
    """What all pairs have in common, (dcol, dline) trailing minus leading, if it is more than the ground's.

    Then either clouds are all that is seen, or the row separation is stated wrongly; no line is measured.
    """
    levels = [
        geometry.side(pair.pair) * np.median(np.stack([pair.dcol_px, pair.dline_px]), axis=1)
        for pair in offsets
        if len(pair.label)
    ]
    shared = np.median(levels, axis=0) if levels else np.zeros(2)
    return (float(shared[0]), float(shared[1])) if np.hypot(*shared) > expected(geometry).far_px else None


def _of_pair(strips: Strips, k: int, whole: KnotOffsets, step: int, known_px: Floats) -> PairOffsets:
    """The k-th pair's curves as offsets of its left strip's lines."""
    pair, knots = strips.pairs[k], whole.offset_px.shape[1]
    centres = np.asarray(np.arange(knots) * float(step) + (step - 1) / 2)
    dcol, dline = curve_of(centres, whole.offset_px[k], np.arange(knots * step, dtype=np.float64))
    (col, line), at = left_offsets(strips, pair, dcol, dline + known_px)
    lost = np.abs(np.diff(known_px - relief_of(strips, pair, len(known_px))))
    broken = np.flatnonzero(lost > 0.5)
    unsure = _near(at, broken, lost[broken] + _DOUBTFUL_LINES)
    outside = (at < -step) | (at > shared_lines(strips, pair) + step)
    sd_col, sd_line = (np.interp(at, centres, whole.sd_px[k, :, axis]) for axis in (0, 1))
    nearest = np.clip(np.rint((at - centres[0]) / step).astype(int), 0, knots - 1)
    beyond = np.maximum(centres[0] - at, at - centres[-1]).clip(0.0) / step
    growth = np.hypot(1.0 + beyond, beyond)  # of a line through two knots, carried on past them
    sd_col, sd_line = sd_col * growth, sd_line * growth
    label = _labels(whole.own[k][nearest] >= 0.5, outside | unsure, np.maximum(sd_col, sd_line))
    sd_col[outside], sd_line[outside | unsure] = UNKNOWN_SD_PX, UNKNOWN_SD_PX
    return PairOffsets(pair, col, line, sd_col, sd_line, label)


def _near(at: Floats, places: Ints, reach: Floats) -> Bools:
    """Which of `at` lie within reach (m,) of places (m,)."""
    found = np.zeros(at.shape, dtype=np.bool_)
    for place, most in zip(places, reach, strict=True):
        found |= np.abs(at - place) <= most
    return found


def _labels(own: Bools, outside: Bools, sd_px: Floats) -> np.ndarray:
    label = np.where(own & (sd_px <= SURE_SD_PX), MEASURED, BRIDGED)
    label[(sd_px > RELIABLE_SD_PX) | outside] = UNRELIABLE
    return label.astype(np.uint8)
