"""One surface of what was matched and what was known before, and how sure it is."""

from __future__ import annotations

from typing import Annotated, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.refinement import SURE, UNSEEN
from geomosaic.surface.tile import Heights

Floats32 = NDArray[np.float32]
_ALIKE: Final = (0.2, 0.4, 0.6, 0.8, 1.0)
"""Correlations for which the two tables below hold; straight between."""
_SD_CELLS: Annotated[
    tuple[float, ...],
    Because(
        "cells",
        "deviation of heights on open ground and on roofs, by correlation: 68 % and more are within",
        "computed of three simulated towns, 60 m to 120 m wide, cells of 0.4 m",
    ),
] = (1.0, 0.3, 0.15, 0.1, 0.05)
_WRONG: Annotated[
    tuple[float, ...],
    Because(
        "share",
        "of cells beside a step that have the other side's height, by correlation",
        "computed of the same towns: off by more than 1 m",
    ),
] = (0.5, 0.35, 0.22, 0.12, 0.02)
_ASIDE_CELLS: Annotated[
    float,
    Because(
        "cells",
        "by which crowns and walls may lie aside: what leans is as unsure as it is steep",
        "computed of the same towns: crowns that lean by 3 are 0.6 to 1.3 cells of height off",
    ),
] = 0.3
_AROUND_CELLS: Annotated[
    int,
    Because(
        "cells",
        "side of the window in which steps are looked for, and cells that were matched surely",
        "as far as `sharpening` looks",
    ),
] = 13
_DISTINCT_BITS: Annotated[
    float,
    Because(
        "bits",
        "by which heights in and around a cell cost less than others, from which on they are kept even if no "
        "two frames look alike in small: crowns that wind moves",
        "computed: of the waves of six simulated lakes 95 in 100 cells stay below 4.25, all below 4.6; a "
        "real forest has 5.2 to 5.7, of which no frames correlate by more than 0.3",
    ),
] = 4.5
_WITNESSES: Annotated[
    int,
    Because(
        "frames",
        "that see a cell, from which on it may be kept by its costs alone: between two some height costs "
        "little by chance, so that they have to look alike there, and around",
        "computed of a simulated town (seed 11): meadows at its rim, seen by two, rose by 14 to 24 m, by 5.6 "
        "bits less than other heights",
    ),
] = 3
_LEAST_VIEWS: Annotated[int, Because("frames", "that a match takes", "a pair")] = 2
_SUPPORT: Annotated[
    float,
    Because(
        "share",
        "of the cells around that were matched surely, below which a cell is held: water and blank roofs, "
        "where some match by chance; with more, crowns are given up, whose heights are better than what lies "
        "around",
        "computed: two simulated lakes reach 0.05; groves at a town's rim (seed 11), seen aslant by three "
        "and four, are off by more than 1 m 45 % with 0.25, 39 % with 0.12; 82 % within a deviation, not 70",
    ),
] = 0.12
_SUPPORT_OF_TWO: Annotated[
    float,
    Because(
        "share",
        "of the same where two frames alone see a cell: with less, cells that match by chance stand as "
        "masts along the border of what was matched; with more, roofs there are given up",
        CHOSEN,
    ),
] = 0.5
_EVENED_CELLS: Annotated[
    int,
    Because(
        "cells",
        "side of the window in which noise is evened out: a larger one takes longer and rounds off ridges",
        CHOSEN,
    ),
] = 9
_NOISE_CELLS: Annotated[
    float,
    Because(
        "cells",
        "of height that may be noise, two to three deviations; with more, kerbs and low walls go",
        "_SD_CELLS, see there",
    ),
] = 0.4
_KEPT: Annotated[
    float,
    Because(
        "share",
        "of the height over the base that is kept with every doubling of the distance to a sure cell: with 1 "
        "a roof's height would run out to sea, with less holes in a roof become pits",
        CHOSEN,
    ),
] = 0.6


def fused(found: Heights, cells: Cells, base: GroundSurface) -> DenseSurface:
    """What was matched; where nothing around was matched surely the base, raised by what lies around."""
    east, north = cells.axes_m()
    base_m = base.up_at(east, north[:, None]).astype(np.float32)
    base_sd_m = np.nan_to_num(base.sd_at(east, north[:, None])).astype(np.float32)
    window = (_AROUND_CELLS, _AROUND_CELLS)
    sure = (found.alike >= SURE).astype(np.float32)
    support = cv2.blur(sure, window, borderType=cv2.BORDER_CONSTANT)
    witnessed = found.seeing >= _WITNESSES
    distinct = witnessed & (found.distinct >= _DISTINCT_BITS)
    supported = np.where(witnessed, support >= _SUPPORT, (found.alike >= SURE) & (support >= _SUPPORT_OF_TWO))
    kept = (supported | distinct) & (found.alike > UNSEEN)
    views = np.maximum(found.views, np.where(distinct, _LEAST_VIEWS, 0).astype(np.uint8))
    weight = kept.astype(np.float32)
    over_m = _even(np.where(kept, found.up_m - base_m, np.float32(0.0)), cells.cell_m)
    filled_m = _filled(over_m * weight, weight)
    varying = _filled(over_m**2 * weight, weight) - filled_m**2
    held_sd_m = np.hypot(base_sd_m, np.sqrt(np.maximum(varying, 0.0)))
    return DenseSurface(
        cells,
        base_m + filled_m,
        np.where(kept, _sd_m(found, cells.cell_m, window), held_sd_m).astype(np.float32),
        np.where(kept, views, np.uint8(0)),
    )


def _sd_m(found: Heights, cell_m: float, window: tuple[int, int]) -> Floats32:
    """Of matched heights: by how alike frames are, by the lean of the surface, by steps nearby."""
    own = cell_m * np.interp(found.alike, _ALIKE, _SD_CELLS)
    lean = np.hypot(*np.gradient(found.up_m))
    element = np.ones(window, dtype=np.uint8)
    apart = cv2.dilate(found.up_m, element) - cv2.erode(found.up_m, element)
    step = np.where(apart > _AROUND_CELLS * cell_m / 4.0, apart, np.float32(0.0))
    wrong = np.sqrt(np.interp(found.alike, _ALIKE, _WRONG)) * step
    return np.asarray(np.sqrt(own**2 + (_ASIDE_CELLS * lean) ** 2 + wrong**2), dtype=np.float32)


def unmatched(cells: Cells, base: GroundSurface) -> DenseSurface:
    """The base, where nothing is matched."""
    east, north = cells.axes_m()
    up, sd = base.up_at(east, north[:, None]), base.sd_at(east, north[:, None])
    return DenseSurface(
        cells, up.astype(np.float32), sd.astype(np.float32), np.zeros(up.shape, dtype=np.uint8)
    )


def _even(over_m: Floats32, cell_m: float) -> Floats32:
    """Without the noise of single cells; edges stay."""
    return np.asarray(
        cv2.bilateralFilter(over_m, _EVENED_CELLS, _NOISE_CELLS * cell_m, _EVENED_CELLS / 4.0), np.float32
    )


def _filled(values: Floats32, weight: Floats32) -> Floats32:
    """Values (rows, cols) where weight is 1; where it is less, those of coarser and coarser cells around."""
    if min(values.shape) < 2 or weight.min() >= 1.0:
        return values
    size = tuple(-(-n // 2) for n in values.shape[::-1])
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(values * weight, size, interpolation=cv2.INTER_AREA)
    mean = np.where(share > 0.0, mean / np.maximum(share, np.float32(1e-6)), np.float32(0.0))
    coarse = _filled(np.asarray(mean, np.float32), np.asarray(np.minimum(share * 2.0, 1.0), np.float32))
    around = cv2.resize(coarse, values.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(weight * values + (1.0 - weight) * np.float32(_KEPT) * around, dtype=np.float32)
