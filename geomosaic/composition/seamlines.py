"""Seamlines as polygons: where each frame gives the mosaic, at reduced resolution."""

from __future__ import annotations

import cv2
import numpy as np
import rasterio
import shapely
from rasterio.features import shapes

from geomosaic.arrays import Bools, Floats, Ints32
from geomosaic.composition.model import Hole, Holes, OutputGrid, Seamline
from geomosaic.composition.window import Window
from geomosaic.constants import tuned

_MOST_LABELS = tuned(4_000_000, "cells", "of the outlined raster, 16 MB: fewer are coarse; more take time")
_MOST_LISTED = tuned(20, "holes", "largest ones listed: more are not looked at")


class SeamLabels:
    """Collects, window by window, which frame gives every n-th pixel; n keeps it small.

    cut: whether the mosaic is cut to an area that was asked for.
    """

    def __init__(self, grid: OutputGrid, window_px: int, *, cut: bool = False) -> None:
        self._grid, self._cut = grid, cut
        self.step_px = 1
        while grid.width_px * grid.height_px > _MOST_LABELS * self.step_px**2 and self.step_px < window_px:
            self.step_px *= 2
        self._labels: Ints32 = np.zeros(
            (-(-grid.height_px // self.step_px), -(-grid.width_px // self.step_px)), dtype=np.int32
        )
        self._wanted = np.full(self._labels.shape, not cut)

    def add(self, window: Window, labels: Ints32, wanted: Bools | None) -> None:
        """Takes over a window's cells, see `Composed.cells`."""
        row, col = window.row // self.step_px, window.col // self.step_px
        at = slice(row, row + labels.shape[0]), slice(col, col + labels.shape[1])
        self._labels[at] = labels
        self._wanted[at] = True if wanted is None or not self._cut else wanted

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
        smooth = shapely.simplify(shapely.get_parts(lines), cell_m)
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

    def holes(self) -> Holes:
        """Parts without a frame that don't reach the mosaic's outside; of an area all of them, at its edge
        too."""
        empty = ((self._labels == 0) & self._wanted).view(np.uint8)
        empty = np.pad(empty, 1, constant_values=0 if self._cut else 1)
        _, of, stats, _ = cv2.connectedComponentsWithStats(empty, connectivity=4)
        inside = [k for k in range(1, len(stats)) if self._cut or k != of[0, 0]]
        inside.sort(key=lambda k: (-int(stats[k, cv2.CC_STAT_AREA]), k))
        cell_m = self.step_px * self._grid.gsd_m
        found = []
        for k in inside[:_MOST_LISTED]:
            left, top, width, height, cells = (int(v) for v in stats[k])
            part = (of[top : top + height, left : left + width] == k).view(np.uint8)
            depth = cv2.distanceTransform(np.pad(part, 1), cv2.DIST_L2, cv2.DIST_MASK_3)
            row, col = np.unravel_index(int(depth.argmax()), depth.shape)
            # Two rims: one about all labels, one about the part.
            place = np.array([left + int(col) - 1.5, top + int(row) - 1.5]) * self.step_px
            east_m, north_m = self._grid.map_from_pixel(place)
            found.append(Hole(cells * cell_m**2, float(east_m), float(north_m)))
        area = sum(int(stats[k, cv2.CC_STAT_AREA]) for k in inside)
        return Holes(len(inside), area * cell_m**2, tuple(found))

    def _label_at(self, point: shapely.Point) -> int:
        cell_m = self.step_px * self._grid.gsd_m
        row = min(int((self._grid.north_m - point.y) / cell_m), self._labels.shape[0] - 1)
        col = min(int((point.x - self._grid.west_m) / cell_m), self._labels.shape[1] - 1)
        return int(self._labels[row, col])


def _rings(polygon: shapely.Polygon) -> tuple[Floats, ...]:
    return tuple(np.asarray(r.coords, dtype=np.float64) for r in (polygon.exterior, *polygon.interiors))
