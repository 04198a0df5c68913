"""A pair as its leading and its trailing strip: the view in which all pairs see one and the same motion.

Let a(t) be the pointing error, in lines and columns at time t. Ground that the leading row sees at line u
comes to the trailing row at u + S + a(u) - a(u + S). So every pair sees b(u) = a(u) - a(u + S), whatever its
side. In the words of the left strip the same is +b(t) for side +1 and about -b(t - S) for side -1. Hence the
alternating sign and the lag of S = row_separation lines. Relief and clouds too move all pairs alike here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32
from geomosaic.ccd.brightness import grey_cells
from geomosaic.ccd.columns import even_columns, fine_detail
from geomosaic.ccd.overlaps import Strips


@dataclass(frozen=True)
class RowPair:
    """Columns of the leading and of the trailing strip; row i of both is the leading strip's line first + i.

    A ground point at (c, u) of lead lies in trail at (c + nominal_col + dcol, u + dline), offsets in the
    sense "trailing minus leading". lead, trail: (n, read_px), without the columns' own response, trail with
    lead's contrast of fine detail. valid: of both. grey: (2, h, w) mean greys of lead's and of trail's cells.
    known_px: (n,) part of dline that is known beforehand.
    """

    lead: Floats32
    trail: Floats32
    valid: Bools
    grey: Floats
    nominal_col: int
    known_px: Floats

    def __len__(self) -> int:
        return len(self.lead)

    @property
    def to_left_right(self) -> slice:
        """What orders leading and trailing as left and right, and back."""
        return slice(None, None, 1 if self.nominal_col <= 0 else -1)

    def detail(self, lines: slice = slice(None)) -> tuple[Floats32, Floats32]:
        """Fine detail of lead and trail at some lines, 0 where not valid."""
        seen = self.valid[lines].astype(np.float32)
        lead, trail = (fine_detail(image[lines], seen) * seen for image in (self.lead, self.trail))
        return lead, trail


def row_pair(strips: Strips, pair: int, first: int, last: int, known_px: Floats) -> RowPair:
    """A pair's overlap at its leading strip's lines first to last; known_px (last - first,).

    Saturated pixels count as not seen.
    """
    g = strips.geometry
    start = _left_of_leading(strips, pair)
    overlap = strips.overlap(pair, first + start, last + start)
    lead, trail = (overlap.left, overlap.right)[:: overlap.side]
    lead, trail = (image.astype(np.float32) for image in (lead, trail))
    grey = np.stack([grey_cells(image, overlap.valid) for image in (lead, trail)])
    full = 2.0**g.bit_depth - 1.0
    valid = overlap.valid & (lead < full) & (trail < full)
    lead, trail = (even_columns(image, valid) for image in (lead, trail))
    trail *= _gain(lead, trail, valid)
    return RowPair(lead, trail, valid, grey, -overlap.side * (g.read_px - g.overlap_px), known_px)


def _gain(lead: Floats32, trail: Floats32, valid: Bools) -> np.float32:
    """The ratio of the sides' median fine detail, which no dark level changes; 1 where a side has none."""
    sizes = (np.abs(fine_detail(x, valid.astype(np.float32))[valid]) for x in (lead, trail))
    one, other = (float(np.median(size)) if size.size else 0.0 for size in sizes)
    return np.float32(one / other if min(one, other) > 0.0 else 1.0)


def shared_lines(strips: Strips, pair: int) -> int:
    """Lines of the leading strip, from its first on, whose ground the trailing strip has by the geometry."""
    lead, trail = strips.geometry.lines[pair : pair + 2][:: strips.geometry.side(pair)]
    return max(min(lead, trail - round(strips.geometry.row_separation_lines)), 0)


def relief_of(strips: Strips, pair: int, lines: int) -> Floats:
    """The DEM's part of dline, trailing minus leading, at the leading strip's lines (0 without a DEM)."""
    relief = strips.relief_px.get(pair)
    if relief is None:
        return np.zeros(lines)
    at = np.arange(lines) + _left_of_leading(strips, pair)
    return strips.geometry.side(pair) * relief[np.clip(at, 0, len(relief) - 1)]


def left_offsets(strips: Strips, pair: int, dcol_px: Floats, dline_px: Floats) -> tuple[Floats, Floats]:
    """A pair's offsets in the words of its left strip.

    Args: dcol_px, dline_px (n,) trailing minus leading at the leading strip's lines u = 0, 1, ...
    Returns: (2, lines) dcol and dline of the left strip's lines, and (lines,) the u, with fractions, which
    see the same ground. Beyond the ends the offsets stay what they are there.
    """
    g = strips.geometry
    side = g.side(pair)
    at = np.arange(strips.lines(pair), dtype=np.float64) - _left_of_leading(strips, pair)
    u = np.arange(len(dline_px), dtype=np.float64)
    if side < 0:
        seen_at = np.maximum.accumulate(u + dline_px)
        beyond = np.minimum(at - seen_at[0], 0.0) + np.maximum(at - seen_at[-1], 0.0)
        at = np.interp(at, seen_at, u) + beyond
    out = side * np.stack([np.interp(at, u, dcol_px), np.interp(at, u, dline_px)])
    whole = side * g.row_separation_lines
    out[1] += round(whole) - whole
    return out, at


def _left_of_leading(strips: Strips, pair: int) -> int:
    """The left strip's line that nominally sees what the leading strip's line 0 sees."""
    return 0 if strips.geometry.side(pair) > 0 else round(strips.geometry.row_separation_lines)
