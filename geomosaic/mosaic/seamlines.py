"""Seamlines as polygons: where each frame gives the mosaic, at reduced resolution."""

from __future__ import annotations

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.features import shapes

from geomosaic.mosaic.model import OutputGrid, Seamline
from geomosaic.mosaic.window import Composed

_MOST_LABELS = 4_000_000
_SIMPLIFY_LABELS = 1.0


class SeamLabels:
    """Collects, window by window, which frame gives every n-th pixel; n keeps it small."""

    def __init__(self, grid: OutputGrid, window_px: int) -> None:
        self._grid = grid
        self.step_px = 1
        while grid.width_px * grid.height_px > _MOST_LABELS * self.step_px**2 and self.step_px < window_px:
            self.step_px *= 2
        self._labels: NDArray[np.int32] = np.zeros(
            (-(-grid.height_px // self.step_px), -(-grid.width_px // self.step_px)), dtype=np.int32
        )

    def add(self, composed: Composed) -> None:
        """Takes over a window's sources, from the middle of each cell of n x n pixels."""
        n = self.step_px
        height, width = composed.source.shape
        rows = np.minimum(np.arange(0, height, n) + n // 2, height - 1)
        cols = np.minimum(np.arange(0, width, n) + n // 2, width - 1)
        row, col = composed.window.row // n, composed.window.col // n
        self._labels[row : row + rows.size, col : col + cols.size] = composed.source[np.ix_(rows, cols)]

    def seamlines(self) -> tuple[Seamline, ...]:
        """One for each frame that gives pixels, in the frames' order.

        Lines between frames are simplified once for both sides, so that neighbours share them.
        """
        cell_m = self.step_px * self._grid.gsd_m
        transform = rasterio.Affine(cell_m, 0.0, self._grid.west_m, 0.0, -cell_m, self._grid.north_m)
        rough = [
            shapely.geometry.shape(geometry)
            for geometry, _ in shapes(self._labels, mask=self._labels > 0, transform=transform)
        ]
        if not rough:
            return ()
        lines = shapely.line_merge(shapely.unary_union(shapely.boundary(rough)))
        smooth = shapely.simplify(shapely.get_parts(lines), _SIMPLIFY_LABELS * cell_m)
        faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.unary_union(smooth))))
        by_frame: dict[int, list[shapely.Polygon]] = {}
        for face in faces:
            label = self._label_at(shapely.point_on_surface(face))
            if label and face.area > cell_m**2:
                by_frame.setdefault(label - 1, []).append(face)
        return tuple(
            Seamline(frame, tuple(_rings(p) for p in sorted(by_frame[frame], key=lambda p: p.bounds)))
            for frame in sorted(by_frame)
        )

    def _label_at(self, point: shapely.Point) -> int:
        cell_m = self.step_px * self._grid.gsd_m
        row = min(int((self._grid.north_m - point.y) / cell_m), self._labels.shape[0] - 1)
        col = min(int((point.x - self._grid.west_m) / cell_m), self._labels.shape[1] - 1)
        return int(self._labels[row, col])


def _rings(polygon: shapely.Polygon) -> tuple[NDArray[np.float64], ...]:
    return tuple(np.asarray(r.coords, dtype=np.float64) for r in (polygon.exterior, *polygon.interiors))
