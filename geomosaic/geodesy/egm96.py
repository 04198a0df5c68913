"""The geoid EGM96 at 15 minutes of arc, which comes with the package."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from geomosaic.arrays import Floats

FILE: Final = Path(__file__).with_name("egm96_15.npz")


@cache
def _undulation_m() -> Floats:
    """(721, 1441) from 90 degrees north, 180 west to 90 south, 180 east."""
    with np.load(FILE) as stored:
        nodes = stored["differences_cm"].astype(np.int64).cumsum(axis=0).cumsum(axis=1)
    return np.asarray(np.concatenate([nodes, nodes[:, :1]], axis=1) / 100.0)


def undulation_m(lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Height of EGM96 above WGS 84's ellipsoid in m, bilinear as PROJ does.

    Within 5 mm of PROJ's grid `us_nga_egm96_15.tif`, whose nodes are rounded to centimetres here. The model
    itself is 0.5 to 1 m off (Lemoine et al. 1998, NASA/TP-1998-206861).

    Args: degrees, of any common shape.
    """
    grid = _undulation_m()
    step_deg = 180.0 / (len(grid) - 1)
    across = (np.asarray(lon_deg) + 180.0) % 360.0 / step_deg
    down = np.clip((90.0 - np.asarray(lat_deg)) / step_deg, 0.0, grid.shape[0] - 1.0)
    col = np.minimum(across.astype(np.intp), grid.shape[1] - 2)
    row = np.minimum(down.astype(np.intp), grid.shape[0] - 2)
    east, south = across - col, down - row
    north_m = (1.0 - east) * grid[row, col] + east * grid[row, col + 1]
    south_m = (1.0 - east) * grid[row + 1, col] + east * grid[row + 1, col + 1]
    return np.asarray((1.0 - south) * north_m + south * south_m)
