"""Lines that a strip has lost or twice: from one line to the next, the offset changes by a whole number.

The curves bend steeply where that happens, but so they may elsewhere; what decides are the lines themselves.
Up to one line the offset before explains them, from it on the offset after, and each fails on the other side.
Both together explain them better than the curve without a step, which follows a steep motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from geomosaic.arrays import Floats, Floats32, Ints
from geomosaic.ccd.columns import BOX_PX
from geomosaic.ccd.expected import NOISE_SHARE, Expected
from geomosaic.ccd.paths import WINDOW_BLOCKS
from geomosaic.ccd.rows import RowPair
from geomosaic.ccd.volumes import BLOCK_LINES
from geomosaic.constants import tuned

_STEEP_KNOTS = tuned(8, "knots", "of a rise, of lines fitted beyond: fewer follow noise; more see relief")
_SHARP_LINES = tuned(48, "lines", "on which one offset must win: fewer are noise; more merge near steps")
_LEAST_SEEN = tuned(0.6, "share", "valid pixels at a step: less decides next to clouds; more misses some")


@dataclass(frozen=True)
class LineStep:
    """From `line` of a pair's (`index`) window on, dline is larger by `count`."""

    index: int
    line: int
    count: int


def steps(pairs: Sequence[RowPair], offset_px: Floats, likely: Expected) -> list[LineStep]:
    """Where pairs' dline changes by whole lines.

    Args: offset_px (pairs, knots, 2) as found without the steps.
    A place shows one step, of the CCD that one or two pairs share: the largest.
    """
    found: list[LineStep] = []
    knot_lines, alone = likely.knot_lines, len(pairs) <= 2
    least_px = likely.steep_px(_STEEP_KNOTS * knot_lines, alone)
    curves = [_pair_curve(offset_px, index, knot_lines) for index in range(len(pairs))]
    for knot in _steep(offset_px[..., 1], least_px):
        places = [_step(pair, curve, knot) for pair, curve in zip(pairs, curves, strict=True)]
        here = [LineStep(index, *place) for index, place in enumerate(places) if place is not None]
        most = max((abs(step.count) for step in here), default=0)
        found += [step for step in here if abs(step.count) == most]
    return found


def lasting(found: Sequence[LineStep]) -> list[LineStep]:
    """The steps less those that go and come back in one pair alone: a cloud's edges, not lines lost for good.

    Lines that a CCD lost are seen by both pairs that share it; such steps are kept.
    """

    def alone(step: LineStep) -> bool:
        return not any(
            other.index != step.index
            and abs(other.count) == abs(step.count)
            and abs(other.line - step.line) <= _SHARP_LINES
            for other in found
        )

    def comes_back(step: LineStep) -> bool:
        return any(o.index == step.index and o.count == -step.count and alone(o) for o in found)

    return [step for step in found if not (alone(step) and comes_back(step))]


def _steep(dline_px: Floats, least_px: float) -> list[int]:
    """Knots, some apart, about which any pair's curve rises or falls more than motion and relief let it."""
    apart = dline_px - np.median(dline_px, axis=0) if len(dline_px) > 2 else dline_px
    rise = np.abs(apart[:, _STEEP_KNOTS:] - apart[:, :-_STEEP_KNOTS]).max(axis=0)
    found = []
    while rise.size and rise.max() > least_px:
        highest = np.flatnonzero(rise >= rise.max() - 1e-6)
        at = int(np.median(highest[highest <= highest[0] + _STEEP_KNOTS]))
        found.append(at + _STEEP_KNOTS // 2)
        rise[max(at - 12, 0) : at + 13] = 0.0
    return sorted(found)


@dataclass(frozen=True)
class _PairCurve:
    """A pair's curve in two parts (knots, 2): its own, and the motion that the other pairs show."""

    own: Floats
    motion: Floats
    knot_lines: int


def _pair_curve(offset_px: Floats, index: int, knot_lines: int) -> _PairCurve:
    others = np.delete(offset_px, index, axis=0)
    motion = np.median(others, axis=0) if len(others) > 2 else np.zeros(offset_px.shape[1:])
    return _PairCurve(offset_px[index] - motion, motion, knot_lines)


def _step(pair: RowPair, curve: _PairCurve, knot: int) -> tuple[int, int] | None:
    """The line from which on dline is larger, and by how much; None where there is no step."""
    near, far = _STEEP_KNOTS, 2 * _STEEP_KNOTS
    own, motion, knot_lines = curve.own, curve.motion, curve.knot_lines
    if knot < far or knot + far >= len(own):
        return None
    first = max((knot * knot_lines) - WINDOW_BLOCKS * BLOCK_LINES, 0)
    u = np.arange(first, min(first + 2 * WINDOW_BLOCKS * BLOCK_LINES, len(pair)), dtype=np.intp)
    at = (u - (knot_lines - 1) / 2) / knot_lines
    left, right = np.arange(knot - far, knot - near), np.arange(knot + near, knot + far)
    moved = np.stack([np.interp(at, np.arange(len(motion)), axis) for axis in motion.T])
    before, after = (_line(fitted, own[fitted], at) + moved for fitted in (left, right))
    smooth = np.stack([np.interp(at, np.arange(len(own)), axis) for axis in (own + motion).T])
    middle = len(u) // 2
    jump = float(after[1, middle] - before[1, middle])
    tried = []
    for count in range(round(jump) - 1, round(jump) + 2):
        half = np.array([[0.0], [(count - jump) / 2]])
        if (
            count
            and (found := _split(pair, u, np.stack([before - half, after + half, smooth]), knot_lines))
            is not None
        ):
            tried.append((*found, count))
    if not tried:
        return None
    _, line, count = min(tried)
    return line, count


def _split(pair: RowPair, u: Ints, curves_px: Floats, knot_lines: int) -> tuple[float, int] | None:
    """What misfit is left if a pair lies on one curve up to a line and then on another, and that line.

    Args: curves_px (3, 2, n): the one, the other, and the one that it lies on if there is no step. Within
    knot_lines of a step that curve cannot follow it.
    """
    misfit = np.stack([_misfit(pair, u, curve) for curve in curves_px])
    seen = pair.valid[u].mean(axis=1)
    if not np.isfinite(misfit).all():
        return None
    sums = np.concatenate([np.zeros((2, 1)), np.cumsum(misfit[:2], axis=1)], axis=1)
    where = int(np.argmin(sums[0] - sums[1]))
    if not _SHARP_LINES <= where <= len(u) - _SHARP_LINES:
        return None
    ahead, behind = misfit[:, where - _SHARP_LINES : where], misfit[:, where : where + _SHARP_LINES]
    if (
        min(seen[where - _SHARP_LINES : where].mean(), seen[where : where + _SHARP_LINES].mean())
        < _LEAST_SEEN
    ):
        return None
    (here, there, _), (back, then, _) = ahead.sum(axis=1), behind.sum(axis=1)
    sharp = here < NOISE_SHARE * there and then < NOISE_SHARE * back
    one, _, smooth = ahead[:, -knot_lines:].sum(axis=1)
    _, other, still = behind[:, :knot_lines].sum(axis=1)
    sharp &= one + other < smooth + still
    return (float(here + then), int(u[where])) if sharp else None


def _line(knots: Ints, offset_px: Floats, at: Floats) -> Floats:
    """Straight lines through (dcol, dline) at knots, at others: (2, n)."""
    slope, level = np.polyfit(knots, offset_px, 1)
    return np.asarray(slope[:, None] * at + level[:, None])


def _misfit(pair: RowPair, u: Ints, curve_px: Floats) -> Floats:
    """Mean squares (n,) of lead's lines u less trail's at (dcol, dline) curve_px (2, n); NaN where unseen."""
    width = pair.lead.shape[1]
    shift = curve_px[0] + pair.nominal_col
    first, last = int(max(0, np.ceil(2 - shift.min()))), int(min(width, np.floor(width - 2 - shift.max())))
    lines = u + pair.known_px[u] + curve_px[1]
    low, high = int(np.floor(lines.min())) - 3, int(np.ceil(lines.max())) + 4
    if last - first < 16 or low < 0 or high > len(pair):
        return np.full(len(u), np.nan)
    top = max(min(low, int(u[0])) - 2 * BOX_PX, 0)
    lead, trail = pair.detail(slice(top, max(high, int(u[-1]) + 1) + 2 * BOX_PX))
    cols = (np.arange(first, last) + shift[:, None]).astype(np.float32)
    rows = np.broadcast_to((lines - top)[:, None], cols.shape).astype(np.float32)
    moved: Floats32 = np.asarray(cv2.remap(trail, cols, rows, cv2.INTER_LINEAR), dtype=np.float32)
    apart = lead[u - top, first:last] - moved
    seen = pair.valid[u, first:last]
    return np.asarray((apart**2 * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1), dtype=np.float64)
