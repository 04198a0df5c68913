"""Lines of a pair of strips whose offsets weren't measured, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools
from geomosaic.ccd.model import BRIDGED, MEASURED, RELIABLE_SD_PX, UNRELIABLE, PairOffsets


@dataclass(frozen=True)
class Gap:
    """Lines first to last of the left strip, BRIDGED or UNRELIABLE; the largest deviation; why."""

    first_line: int
    last_line: int
    label: int
    largest_sd_px: float
    why: str


def gaps(offsets: PairOffsets, common: Bools) -> list[Gap]:
    """Every run of lines that were not measured, in order. common: (n,) whose ground both strips have."""
    ends = np.flatnonzero(np.diff(2 * offsets.label.astype(int) + common, prepend=-1, append=-1))
    out = []
    for first, after in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        label = int(offsets.label[first])
        if label == MEASURED:
            continue
        run = slice(first, after)
        sd_px = float(max(offsets.sd_col_px[run].max(), offsets.sd_line_px[run].max()))
        why = _why(offsets, first, after, sd_px) if common[first] else "only one strip has this ground"
        out.append(Gap(first, after - 1, label, sd_px, why))
    return out


def _why(offsets: PairOffsets, first: int, after: int, sd_px: float) -> str:
    measured = np.flatnonzero(offsets.label == MEASURED)
    if not measured.size:
        return "nothing was measured on any line"
    at_end = after <= measured[0] or first > measured[-1]
    source = "from the one side that was measured" if at_end else "between what was measured before and after"
    if offsets.label[first] == UNRELIABLE:
        return f"nothing seen alike in both strips for too long: may be off by {sd_px:.2g} px"
    assert offsets.label[first] == BRIDGED
    if sd_px <= RELIABLE_SD_PX:
        return f"too little seen alike in both strips (cloud, water, no texture): carried over {source}"
    return f"carried over {source}, its deviation grows to {sd_px:.2g} px"
