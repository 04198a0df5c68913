"""Lines of a pair of strips whose offsets weren't measured, and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geomosaic.ccd.model import BRIDGED, MEASURED, RELIABLE_SD_PX, UNRELIABLE, PairOffsets


@dataclass(frozen=True)
class Gap:
    """Lines first to last of the left strip, BRIDGED or UNRELIABLE; the largest deviation; why."""

    first_line: int
    last_line: int
    label: int
    largest_sd_px: float
    why: str


def gaps(offsets: PairOffsets) -> list[Gap]:
    """Every run of lines that were not measured, in order."""
    ends = np.flatnonzero(np.diff(offsets.label.astype(int), prepend=-1, append=-1))
    out = []
    for first, after in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        label = int(offsets.label[first])
        if label == MEASURED:
            continue
        run = slice(first, after)
        sd_px = float(max(offsets.sd_col_px[run].max(), offsets.sd_line_px[run].max()))
        out.append(Gap(first, after - 1, label, sd_px, _why(offsets, first, after, sd_px)))
    return out


def _why(offsets: PairOffsets, first: int, after: int, sd_px: float) -> str:
    lines = len(offsets.label)
    if first == 0 and after == lines:
        return "nothing was measured on any line"
    at_end = first == 0 or after == lines
    source = "from the one side that was measured" if at_end else "between what was measured before and after"
    if offsets.label[first] == UNRELIABLE:
        return f"nothing seen alike in both strips for too long: may be off by {sd_px:.2g} px"
    assert offsets.label[first] == BRIDGED
    if sd_px <= RELIABLE_SD_PX:
        return f"too little seen alike in both strips (cloud, water, no texture): carried over {source}"
    return f"carried over {source}, its deviation grows to {sd_px:.2g} px"
