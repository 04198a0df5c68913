"""A pair as its leading and its trailing strip: the view in which all pairs see one and the same motion.

With the pointing error a(t), in lines and columns at time t, the ground that the leading row sees at line u
comes to the trailing row at u + S + a(u + S) - a(u): every pair sees b(u) = a(u + S) - a(u), whatever its side.
In the words of the left strip the same is +b(t) for side +1 and about -b(t - S) for side -1, hence the
alternating sign and the lag of S = row_separation lines. Relief and clouds too move all pairs alike here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from geomosaic.ccd.model import Flags, Floats, Images, Overlap
from geomosaic.survey.strips import StripGeometry


@dataclass(frozen=True)
class RowPair:
    """Columns of the leading and of the trailing strip; row u of both belongs to the leading strip's line u.

    A ground point at (c, u) of lead lies in trail at (c + nominal_col + dcol, u + dline), offsets in the
    sense "trailing minus leading". first: the row of the overlap that is u = 0. relief_px: (n,) known part of
    dline, or None.
    """

    pair: int
    side: int
    lead: Images
    trail: Images
    valid: Flags
    nominal_col: int
    first: int
    relief_px: Floats | None

    def __len__(self) -> int:
        return len(self.lead)


def row_pair(overlap: Overlap, geometry: StripGeometry) -> RowPair:
    """An overlap seen from its leading strip, from that strip's first line on."""
    lead, trail = (overlap.left, overlap.right)[:: overlap.side]
    lag = round(geometry.row_separation_lines)
    first = 0 if overlap.side > 0 else min(lag, len(lead))
    relief = overlap.relief_px
    return RowPair(
        overlap.pair,
        overlap.side,
        lead[first:].astype(np.float32),
        trail[first:].astype(np.float32),
        overlap.valid[first:],
        -overlap.side * (geometry.read_px - geometry.overlap_px),
        first,
        None if relief is None else overlap.side * relief[first:],
    )


def left_lines(pair: RowPair, dline_px: Floats, lines: int) -> Floats:
    """Lines u, with fractions, at which the leading strip sees what the left strip's lines see.

    Args: dline_px (n,) trailing minus leading at u = 0, 1, ... lines: of the left strip.
    """
    t = np.arange(lines, dtype=np.float64) - pair.first
    if pair.side > 0:
        return t
    u = np.arange(len(dline_px), dtype=np.float64)
    return (
        np.interp(t, np.maximum.accumulate(u + dline_px), u)
        + np.minimum(t - (u[0] + dline_px[0]), 0.0)
        + (np.maximum(t - (u[-1] + dline_px[-1]), 0.0))
    )


def of_left(pair: RowPair, geometry: StripGeometry, at: Floats, values: Floats) -> Floats:
    """Offsets (dcol, dline) (2, n) at u = 0, 1, ... as the left strip's lines, seen at `at`, have them."""
    u = np.arange(values.shape[1], dtype=np.float64)
    out = pair.side * np.stack([np.interp(at, u, row) for row in values])
    whole = pair.side * geometry.row_separation_lines
    out[1] += round(whole) - whole
    return out


def shared_length(pairs: Sequence[RowPair]) -> int:
    """Lines over which any pair has something to compare."""
    ends: list[int] = []
    for pair in pairs:
        rows: NDArray[np.intp] = np.flatnonzero(pair.valid.any(axis=1))
        ends.append(int(rows[-1]) + 1 if rows.size else 0)
    return max(ends, default=0)
