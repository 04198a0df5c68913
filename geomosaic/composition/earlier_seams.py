"""Seams of an earlier mosaic, which stay where the frames on both sides are the same.

Where frames differ little, the least moves their seams by some cells, and no mosaic looks better for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from geomosaic.arrays import Ints32, Ints64
from geomosaic.composition.grid import SAME_CELL
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.seam_parts import SeamPart


def with_earlier_seams(
    cut: Ownership, parts: Sequence[SeamPart], was: Ownership, numbers: Ints64
) -> Ownership:
    """The ownership in which a cell stays with its earlier owner, if that still may give it and the present
    owner gave cells of the earlier mosaic as well.

    Args: numbers (n,): of each frame the number that it had, -1 where it is new or another.
    """
    side_m = cut.cell_px * cut.grid.gsd_m
    off = np.array([was.grid.west_m - cut.grid.west_m, cut.grid.north_m - was.grid.north_m]) / side_m
    col, row = np.rint(off).astype(int).tolist()
    alike = (was.cell_px, was.grid.gsd_m) == (cut.cell_px, cut.grid.gsd_m)
    if not alike or np.abs(off - (col, row)).max() > SAME_CELL:
        return cut
    both = np.flatnonzero(numbers >= 0)
    if not len(both):
        return cut
    owner = np.zeros(max(int(was.owner.max(initial=0)), int(numbers.max(initial=-1)) + 1) + 1, dtype=np.int32)
    owner[numbers[both] + 1] = both + 1
    earlier = _placed(owner[was.owner], cut.owner.shape, row, col)
    may = np.zeros(cut.owner.shape, dtype=bool)
    for part in parts:
        may[part.of_all] |= part.may & (earlier[part.of_all] == part.frame + 1)
    return replace(cut, owner=np.where(may & np.isin(cut.owner, both + 1), earlier, cut.owner))


def _placed(cells: Ints32, shape: tuple[int, ...], row: int, col: int) -> Ints32:
    """Cells in an array of another shape, from a row and col on that may lie outside; 0 elsewhere."""
    out = np.zeros(shape, dtype=np.int32)
    rows, cols = (
        slice(min(max(first, 0), whole), max(min(first + size, whole), 0))
        for first, size, whole in zip((row, col), cells.shape, shape, strict=True)
    )
    out[rows, cols] = cells[rows.start - row : rows.stop - row, cols.start - col : cols.stop - col]
    return out
