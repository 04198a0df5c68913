"""Nouns of the strips' offsets: the overlap of a pair, its offsets line by line, what a method may be given.

Convention: a ground point at (col, line) of the left strip lies in the right strip at
`col - (width - overlap) + dcol` and `line + side * row_separation + dline`. The side is +1 when the left
strip is in the leading row and the right one in the trailing row, and -1 the other way round.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Bytes, Floats
from geomosaic.constants import sourced, tuned

Progress = Callable[[int, int], None]
"""Called with how many of how many are done; may raise to stop the work."""

LABELS: Final = ("measured", "bridged", "unreliable")
"""Own evidence in the images; from neighbouring lines and pairs; hardly known, or seen by one CCD. Recordings
fix their order."""
MEASURED, BRIDGED, UNRELIABLE = range(len(LABELS))
RELIABLE_SD_PX = sourced(0.6, "px", "more admits misplaced lines; less loses usable ones", "1 px / 1.645")
SURE_SD_PX = tuned(0.25, "px", "for a measured line, to learn from: more admits what hangs on neighbours")
LOCKING_SD_PX = tuned(0.02, "px", "of places between pixels: less lets a few decide; more weighs all alike")
UNKNOWN_SD_PX = tuned(10.0, "px", "of unseen lines, as far as TH-1 is off nominal: less claims too much")


@dataclass(frozen=True)
class Overlap:
    """What two neighbours see of the same ground, lines set against each other by the nominal geometry.

    left, right: (n, read_px), the left strip's last columns and the right strip's first. Row i is the left
    strip's line first_line + i and the right strip's line first_line + i + round(side * row_separation).
    valid: (n, read_px) where both hold an image; rows that only one strip has are False throughout.
    """

    pair: int
    left: NDArray[Any]
    right: NDArray[Any]
    side: int
    valid: Bools
    first_line: int = 0


@dataclass(frozen=True)
class PairOffsets:
    """Offsets of the right strip against the nominal geometry, for every line of the left strip.

    dcol_px, dline_px, sd_col_px, sd_line_px: (n,), at the lines' middles. label: (n,) uint8, of LABELS.
    """

    pair: int
    dcol_px: Floats
    dline_px: Floats
    sd_col_px: Floats
    sd_line_px: Floats
    label: Bytes

    @classmethod
    def unknown(cls, pair: int, lines: int) -> PairOffsets:
        """Those of a pair of which nothing is known."""
        zero, far = np.zeros(lines), np.full(lines, UNKNOWN_SD_PX)
        return cls(pair, zero, zero, far, far, np.full(lines, UNRELIABLE, dtype=np.uint8))


@dataclass(frozen=True)
class StripOffsets:
    """What a method found: offsets of the pairs whose two strips are there, in their order."""

    method: str
    pairs: tuple[PairOffsets, ...]


@dataclass(frozen=True)
class CcdSettings:
    """What the methods may be given.

    search_cols_px, search_lines_px: how far the offsets may lie from the nominal geometry. knot_lines: the
    distance of the knots between which `joint` draws its curves, 0: by the line rate. segment_lines: the
    length of a segment of `piecewise_linear`. enhance: stretch each segment's grey range before matching.
    ratio: the most by which SIFT's nearest may be as far as the second.
    """

    search_cols_px: int = 16
    search_lines_px: int = 24
    knot_lines: int = 0
    segment_lines: int = 512
    enhance: bool = True
    ratio: float = 0.75
