"""How far frames differ along the seams of a mosaic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geomosaic.arrays import Bools, Floats32, Ints
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.seam_parts import SeamPart, to_8_bits


@dataclass(frozen=True)
class SeamFigures:
    """Figures along seams.

    length_m: their length. difference_mean, difference_90: mean and nine tenths of how far both frames differ
    there, in grey levels of 8 bits. on_objects: their share on what stands on the ground, None if that is
    unknown.
    """

    length_m: float
    difference_mean: float
    difference_90: float
    on_objects: float | None


def seam_figures(of: Ownership, parts: Sequence[SeamPart]) -> SeamFigures:
    """Both cells of every step from one frame's to another's, as both frames show them."""
    scale, number = to_8_bits(parts), {p.frame + 1: k for k, p in enumerate(parts)}
    steps = []
    for axis in (0, 1):
        one, other = (np.moveaxis(of.owner, axis, 0)[s] for s in (slice(None, -1), slice(1, None)))
        at = np.nonzero((one != other) & (one > 0) & (other > 0))
        here = np.stack(at if axis == 0 else at[::-1], axis=1)
        there = here + np.array([axis == 0, axis == 1])
        steps.append(np.column_stack([one[at], other[at], here, there]))
    every = np.concatenate(steps)
    every = every[np.lexsort(every[:, :2].T)]
    ends = np.flatnonzero((np.diff(every[:, :2], axis=0) != 0).any(axis=1)) + 1
    differences, high = [np.zeros(0)], [np.zeros(0, dtype=bool)]
    for along in np.split(every, ends) if len(every) else []:
        two = [parts[number[p]] for p in along[0, :2].tolist() if p in number]
        row, col = along[:, 2:].reshape(-1, 2).T
        if len(two) == 2:
            left, right = (_at(part, row, col) * scale for part in two)
            differences.append(np.abs(left - right).mean(axis=-1))
        if two and two[0].standing is not None:
            at_part, within = _within(two[0], row, col)
            high.append(two[0].standing[at_part][within])
    known, on_objects = np.concatenate(differences), np.concatenate(high)
    known = known[np.isfinite(known)]
    length_m = len(every) * of.cell_px * of.grid.gsd_m
    share = float(on_objects.mean()) if len(on_objects) else None
    if not len(known):
        return SeamFigures(length_m, float("nan"), float("nan"), share)
    return SeamFigures(length_m, float(known.mean()), float(np.quantile(known, 0.9)), share)


def _within(part: SeamPart, row: Ints, col: Ints) -> tuple[tuple[Ints, Ints], Bools]:
    """Where cells of the mosaic lie in a part, and which of them do; the others are its first cell."""
    height, width = part.may.shape
    row, col = row - part.row, col - part.col
    there = (row >= 0) & (row < height) & (col >= 0) & (col < width)
    return (np.where(there, row, 0), np.where(there, col, 0)), there


def _at(part: SeamPart, row: Ints, col: Ints) -> Floats32:
    """Values (n, b) at cells of the mosaic, NaN beyond what the frame may give."""
    at, there = _within(part, row, col)
    there &= part.may[at]
    return np.where(there[:, None], part.values[at].astype(np.float32), np.float32(np.nan))
