"""How high the land lies with what stands on it, and what that is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.arrays import Bytes, Floats, Floats32
from geomosaic_simulate.buildings import Building
from geomosaic_simulate.relief import RasterRelief, Relief

GROUND, ROOF, CROWN = 0, 1, 2
"""What is seen from above."""


def heights_on_grid(
    relief: Relief | RasterRelief,
    buildings: Sequence[Building],
    trees: Floats | None,
    west_m: float,
    north_m: float,
    spacing_m: float,
    shape: tuple[int, int],
) -> tuple[Floats32, Bytes]:
    """Ellipsoidal heights (rows, cols) of pixels' middles, rows from the north down, and what is there.

    Args: trees as `World.trees`; west_m, north_m: the outer corner, in the map CRS.
    """
    east = west_m + (np.arange(shape[1]) + 0.5) * spacing_m
    north = north_m - (np.arange(shape[0]) + 0.5) * spacing_m
    height = np.array(relief.height_at(east, north[:, None]), dtype=np.float32)
    kind = np.full(shape, GROUND, dtype=np.uint8)

    def around(x: float, y: float, reach_m: float) -> tuple[slice, slice]:
        cols = np.searchsorted(east, [x - reach_m, x + reach_m])
        rows = np.searchsorted(-north, [-y - reach_m, -y + reach_m])
        return slice(*rows.tolist()), slice(*cols.tolist())

    for b in buildings:
        at = around(b.easting_m, b.northing_m, float(np.hypot(b.half_length_m, b.half_width_m)))
        off = np.stack(np.meshgrid(east[at[1]] - b.easting_m, north[at[0]] - b.northing_m), axis=-1)
        uv = off @ b.axes.T
        within = (np.abs(uv) <= [b.half_length_m, b.half_width_m]).all(axis=-1)
        height[at][within] = relief.height_at(b.easting_m, b.northing_m) + b.roof_m(uv[within])
        kind[at][within] = ROOF
    for x, y, radius, tall in () if trees is None else trees:
        at = around(x, y, radius)
        away_sq = (east[at[1]] - x) ** 2 + ((north[at[0]] - y) ** 2)[:, None]
        crown = relief.height_at(x, y) + tall * (1.0 - away_sq / radius**2)
        higher = crown > height[at]
        height[at][higher] = crown[higher]
        kind[at][higher] = CROWN
    return height, kind
