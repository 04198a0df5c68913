"""Where a point cloud shows bare ground: nothing stands up within reach."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_opening, minimum_filter

Floats = NDArray[np.float64]
CELL_M = 0.5
_WINDOW_M = 4.5
_STANDS_UP_M = 0.35


def read_cloud(path: Path) -> Floats | None:
    """Points (n, 3) easting, northing, height of a LAZ file; None without the packages to read it."""
    try:
        import laspy
        import lazrs  # noqa: F401  (laspy's decoder)
    except ImportError:
        return None
    cloud = laspy.read(path)
    return np.column_stack([cloud.x, cloud.y, cloud.z])


def write_bare_ground(cloud: Floats, reach_m: float, crs: str, path: Path) -> None:
    """A LAZ file of the points on bare ground."""
    import laspy
    from pyproj import CRS

    points = cloud[bare_ground(cloud, cloud[:, :2], reach_m)]
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.full(3, 0.001)
    header.add_crs(CRS(crs))
    bare = laspy.LasData(header)
    bare.x, bare.y, bare.z = points.T
    bare.write(path)


def bare_ground(cloud: Floats, places: Floats, reach_m: float) -> NDArray[np.bool_]:
    """Which places (n, 2) lie on bare ground: for `reach_m` around, points everywhere, none standing up.

    The ground is the opening of the lowest points of 0.5 m cells over a window of 4.5 m: what is narrower
    and higher than its surroundings goes. A cell whose highest point is 0.35 m above it is not bare, nor one
    without points (forest, water, the shade below trees).
    """
    west_south = cloud[:, :2].min(axis=0)
    cols, rows = (np.floor((cloud[:, :2].max(axis=0) - west_south) / CELL_M).astype(int) + 1).tolist()
    cell = np.floor((cloud[:, :2] - west_south) / CELL_M).astype(np.intp)
    index = cell[:, 1] * cols + cell[:, 0]
    low, high = np.full(rows * cols, np.inf), np.full(rows * cols, -np.inf)
    np.minimum.at(low, index, cloud[:, 2])
    np.maximum.at(high, index, cloud[:, 2])
    low, high = low.reshape(rows, cols), high.reshape(rows, cols)
    known = np.isfinite(low)
    size = round(_WINDOW_M / CELL_M)
    ground = grey_opening(np.where(known, low, low[known].max()), size=(size, size))
    bare = known & (high - ground < _STANDS_UP_M)
    bare = (
        minimum_filter(bare.astype(np.uint8), size=2 * int(np.ceil(reach_m / CELL_M)) + 1, mode="constant")
        > 0
    )
    col, row = np.floor((places - west_south) / CELL_M).astype(np.intp).T
    inside = (col >= 0) & (row >= 0) & (col < cols) & (row < rows)
    out = np.zeros(len(places), dtype=bool)
    out[inside] = bare[row[inside], col[inside]]
    return out
