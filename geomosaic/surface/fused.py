"""One surface of what was matched and what was known before, and how sure it is."""

from __future__ import annotations

from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.cells import Cells
from geomosaic.surface.model import DenseSurface
from geomosaic.surface.refinement import SURE
from geomosaic.surface.tile import Heights

Floats32 = NDArray[np.float32]
_LEAST_SD: Annotated[
    float,
    Because(
        "cells",
        "deviation of heights where frames show the same",
        "computed of the same town: 68 % are within 0.14 cells where the correlation is above 0.9",
    ),
] = 0.12
_SD_UNLIKE: Annotated[
    float,
    Because(
        "cells",
        "by how much the deviation rises from a correlation of 1 to 0",
        "computed of the same town: 68 % are within 0.35 to 0.5 cells from 0.7 to 0.9",
    ),
] = 1.2
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
        "_LEAST_SD, see there",
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
] = 0.8


def with_coarse(fine: Heights, coarse: Heights) -> Heights:
    """What coarse cells are surer of than the fine ones in them: crowns that wind moves between frames, whose
    leaves no two frames show alike."""
    rows, cols = fine.up_m.shape
    size = 2 * coarse.up_m.shape[1], 2 * coarse.up_m.shape[0]
    up = cv2.resize(coarse.up_m, size, interpolation=cv2.INTER_LINEAR)[:rows, :cols]
    alike = cv2.resize(coarse.alike, size, interpolation=cv2.INTER_NEAREST)[:rows, :cols]
    taken = (fine.alike < SURE) & (alike >= SURE)
    views = cv2.resize(coarse.views, size, interpolation=cv2.INTER_NEAREST)[:rows, :cols]
    return Heights(
        np.where(taken, up, fine.up_m),
        np.where(taken, np.float32(SURE), fine.alike),
        np.where(taken, views, fine.views),
    )


def fused(found: Heights, cells: Cells, base: GroundSurface) -> DenseSurface:
    """What was matched surely; elsewhere the base, raised by what lies around, and as unsure as heights
    around vary."""
    east, north = cells.axes_m()
    base_m = base.up_at(east, north[:, None])
    base_sd_m = np.nan_to_num(base.sd_at(east, north[:, None]))
    sure = found.alike >= SURE
    over_m = (found.up_m - base_m).astype(np.float32)
    over_m = _even(over_m, cells.cell_m)
    weight = sure.astype(np.float32)
    filled_m = _filled(np.where(sure, over_m, np.float32(0.0)), weight)
    varying = _filled(np.where(sure, over_m**2, np.float32(0.0)), weight) - filled_m**2
    own_sd_m = cells.cell_m * (_LEAST_SD + _SD_UNLIKE * (1.0 - found.alike))
    other_sd_m = np.hypot(base_sd_m, np.sqrt(np.maximum(varying, 0.0)))
    return DenseSurface(
        cells,
        (base_m + filled_m).astype(np.float32),
        np.where(sure, own_sd_m, other_sd_m).astype(np.float32),
        np.where(sure, found.views, np.uint8(0)),
    )


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
