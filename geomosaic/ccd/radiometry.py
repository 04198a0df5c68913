"""Gain and offset of every CCD from what neighbours see of the same ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.ccd.columns import column_gains
from geomosaic.ccd.model import (
    MEASURED,
    UNRELIABLE,
    CcdSettings,
    Overlap,
    PairOffsets,
    Progress,
    StripOffsets,
)
from geomosaic.ccd.overlaps import Strips
from geomosaic.ccd.parallel import each
from geomosaic.constants import tuned
from geomosaic.matching.displacement import LEAST_CORRELATION

_MOST_PIECES = tuned(64, "pieces", "of a strip, nearly a whole TH-1 scene: more take time and change nothing")
_BLOCK_PX = tuned((16, 8), "lines, columns", "of a mean grey: smaller is noisy; larger has less contrast")
_LEAST_BLOCKS = tuned(24, "blocks", "for a gain and an offset: fewer are chance; more fail in narrow overlap")
_OFFSET_SD = tuned(0.01, "full scale", "prior of an offset: less makes it a gain; more makes it noise")
_ODD_COLUMN = tuned(0.1, "share", "off its neighbours: less drops good columns; more keeps dead ones")
_LIKE_VARIANCE = tuned(4.0, "ratio", "of variances that needs no correlation: less parts level ground")


_PIECE_LINES: Final = CcdSettings.segment_lines
_SPARE_LINES: Final = CcdSettings.search_lines_px
"""Margin of a piece: as far as offsets go."""


@dataclass(frozen=True)
class Radiometry:
    """`gain[k] * counts + offset[k]` of CCD k is on the scale all share; (ccds,) both."""

    gain: Floats
    offset: Floats


@dataclass(frozen=True)
class Blocks:
    """Means (b, c) of blocks of the left strip and of the same ground in the right one.

    Rows are stretches of lines, columns stretches of columns: a column's own response stays in its column.
    use: (b, c) where all pixels are valid, none is at an end of the scale, and no line's offsets are
    unreliable. sure: (b,) where the offsets of all lines are measured.
    """

    left: Floats
    right: Floats
    use: Bools
    sure: Bools


def radiometry(strips: Strips, offsets: StripOffsets, progress: Progress) -> Radiometry:
    """Gains and offsets of all CCDs; in each unbroken run the gains' mean is 1 and the offsets' mean is 0.

    A run ends where a CCD is dead or a pair has too little to compare (`straight_line`), as next to a CCD
    that is stuck at one grey. Of long strips 64 pieces of 512 lines, evenly spread, are seen.
    """
    g = strips.geometry
    lag = round(g.row_separation_lines)
    curves = {pair.pair: pair for pair in offsets.pairs}
    longest = max(g.lines)
    tops = np.arange(0, longest, _PIECE_LINES)
    tops = tops[np.unique(np.linspace(0, len(tops) - 1, min(len(tops), _MOST_PIECES)).astype(np.intp))]

    def of_pair(pair: int, top: int) -> list[Blocks]:
        first = top + (0 if g.side(pair) > 0 else lag)
        stop = min(first + _PIECE_LINES, strips.lines(pair))
        if stop <= first:
            return []
        overlap = strips.overlap(pair, first - _SPARE_LINES, stop + _SPARE_LINES)
        return [blocks(overlap, strips, curves[pair])]

    found: dict[int, list[Blocks]] = {pair: [] for pair in strips.pairs}
    for done, top in enumerate(tops.tolist()):
        for pair, part in zip(strips.pairs, each(partial(of_pair, top=top), strips.pairs), strict=True):
            found[pair] += part
        progress(done + 1, len(tops))
    lines = {pair: straight_line(parts, 2.0**g.bit_depth - 1) for pair, parts in found.items()}
    ccds = len(g.ccds)
    gain, offset = np.ones(ccds), np.zeros(ccds)
    begin = 0
    for k in range(ccds):
        line = lines.get(k)
        if line is not None:
            gain[k + 1] = gain[k] / line[0]
            offset[k + 1] = offset[k] - gain[k + 1] * line[1]
            continue
        run = slice(begin, k + 1)
        offset[run] = (offset[run] - offset[run].mean()) / gain[run].mean()
        gain[run] /= gain[run].mean()
        begin = k + 1
    return Radiometry(gain, offset)


def blocks(overlap: Overlap, strips: Strips, offsets: PairOffsets) -> Blocks:
    """The blocks of a piece of an overlap that has `_SPARE_LINES` more at either end.

    The right strip is moved by the offsets. Columns whose response is a tenth off are left out.
    """
    g = strips.geometry
    high, wide = _BLOCK_PX
    count = (len(overlap.left) - 2 * _SPARE_LINES) // high
    rows = _SPARE_LINES + np.arange(count * high)
    margin = g.read_px - g.overlap_px
    cols = np.arange(margin, g.read_px - g.overlap_px % wide)
    shape = count, high, len(cols) // wide, wide
    if not (len(rows) and len(cols)):
        none = np.empty(shape[::2])
        return Blocks(none, none, np.zeros(none.shape, dtype=bool), np.zeros(count, dtype=bool))
    at = np.clip(rows + overlap.first_line, 0, strips.lines(overlap.pair) - 1)
    apart = overlap.side * g.row_separation_lines
    dcol, dline = offsets.dcol_px[at], offsets.dline_px[at] + apart - round(apart)
    sure, known = offsets.label[at] == MEASURED, offsets.label[at] != UNRELIABLE
    map_x = (cols[None, :] - margin + dcol[:, None]).astype(np.float32)
    map_y = np.broadcast_to((rows + dline)[:, None], map_x.shape).astype(np.float32)
    left, use_left = (a[rows[:, None], cols] for a in _counts(overlap.left, overlap.valid, g.bit_depth))
    right, use_right = (
        cv2.remap(a, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
        for a in _counts(overlap.right, overlap.valid, g.bit_depth)
    )
    use = (use_left > 0.999) & (use_right > 0.999) & known[:, None]
    return Blocks(
        left.reshape(shape).mean(axis=(1, 3), dtype=np.float64),
        right.reshape(shape).mean(axis=(1, 3), dtype=np.float64),
        np.asarray(use.reshape(shape).all(axis=(1, 3))),
        np.asarray(sure.reshape(count, high).all(axis=1)),
    )


def _counts(side: NDArray[Any], valid: Bools, bit_depth: int) -> tuple[Floats32, Floats32]:
    """Counts of one side of an overlap, and 1 where they may be used, else 0."""
    image = side.astype(np.float32)
    even = np.abs(column_gains(image, valid) - 1.0) <= _ODD_COLUMN
    return image, (valid & (image > 0.0) & (image < 2.0**bit_depth - 1) & even).astype(np.float32)


def straight_line(parts: Sequence[Blocks], full: float) -> tuple[float, float] | None:
    """(g, o) with right = g * left + o. None where there is too little to compare, or where one side varies
    and the other does not follow. The other is then of one grey to the last digit, or of noise alone.

    The slope is of total least squares, both sides being equally noisy, over the blocks' differences from
    their own column's mean: column patterns don't enter. Robust: Cauchy weights at three times a deviation
    that half of the blocks may spoil. As far as the blocks' greys don't determine the slope, o is drawn to 0
    (deviation 1 % of the full scale).
    """
    if not parts:
        return None
    x, y, use = (np.concatenate([getattr(p, name) for p in parts]) for name in ("left", "right", "use"))
    sure = use & np.concatenate([p.sure for p in parts])[:, None]
    use = sure if sure.sum() >= _LEAST_BLOCKS else use
    use = use & (use.sum(axis=0) >= 3)
    if use.sum() < _LEAST_BLOCKS:
        return None
    cols = use.any(axis=0)
    x, y, use = x[:, cols], y[:, cols], use[:, cols]
    g = float(np.median(y[use]) / max(np.median(x[use]), 1.0))
    rest = np.where(use, y - g * x, np.nan)
    rest -= np.nanmedian(rest, axis=0)
    mean_x = mean_y = np.zeros(x.shape[1])
    for _ in range(20):
        scale = max(float(np.quantile(np.abs(rest[use]), 0.25)) / 0.3186, 1e-3)
        weight = np.where(use, 1.0 / (1.0 + (np.nan_to_num(rest) / (3.0 * scale)) ** 2), 0.0)
        total = weight.sum(axis=0)
        mean_x, mean_y = (weight * x).sum(axis=0) / total, (weight * y).sum(axis=0) / total
        dx, dy = x - mean_x, y - mean_y
        xx, yy, xy = (float((weight * a * b).sum()) for a, b in ((dx, dx), (dy, dy), (dx, dy)))
        if _stuck(*(v / float(total.sum()) for v in (xx, yy, xy))):
            return None
        slope = (yy - xx + np.hypot(yy - xx, 2.0 * xy)) / (2.0 * xy) if xy > 0.0 else 1.0
        level_x, level_y = max(float(mean_x.mean()), 1.0), float(mean_y.mean())
        sure_of_slope = max(xy, 0.0) / scale**2
        sure_of_ratio = (level_x / (_OFFSET_SD * full)) ** 2
        g = float(
            (slope * sure_of_slope + level_y / level_x * sure_of_ratio) / (sure_of_slope + sure_of_ratio)
        )
        rest = dy - g * dx
    return g, float((mean_y - g * mean_x).mean())


def _stuck(xx: float, yy: float, xy: float) -> bool:
    """Whether one side doesn't vary at all, or far less than the other one and not with it.

    Args: xx, yy the sides' variances, xy their covariance, counts².
    """
    low, high = sorted((xx, yy))
    return low <= float(np.finfo(np.float32).eps) * max(high, 1.0) or (
        high > _LIKE_VARIANCE * low and xy < LEAST_CORRELATION * float(np.sqrt(low * high))
    )
