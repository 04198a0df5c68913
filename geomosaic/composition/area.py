"""The area that a mosaic is cut to: polygons of any CRS, brought to the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio import Affine
from rasterio.features import rasterize

from geomosaic.arrays import Bools, Floats
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.views import FrameView
from geomosaic.composition.window import Window
from geomosaic.constants import tuned
from geomosaic.doors.vector import read_shapes
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import is_local

_STEPS_ALONG = tuned(1000, "steps", "of edges along a survey: fewer show bends, 1000 are 0.01 mm off")


@dataclass(frozen=True)
class Area:
    """Ground on the map.

    polygons: each a tuple of closed rings (n, 2) of easting and northing, the outer one first; they don't
    overlap. A pixel is inside if its middle is. near: the share of the whole outline that it is; the rest
    lies far from the frames. asked: whether it was asked for; else it is what trimming left.
    """

    polygons: tuple[tuple[Floats, ...], ...]
    near: float = 1.0
    asked: bool = True

    @cached_property
    def geometry(self) -> Any:
        """As one geometry of shapely's."""
        return shapely.MultiPolygon([shapely.Polygon(rings[0], rings[1:]) for rings in self.polygons])

    def seen_by(self, views: Sequence[FrameView]) -> tuple[FrameView, ...]:
        """The views of the frames that see something of it, their bounds within its own."""
        bounds, found = np.array(self.geometry.bounds), []
        shapely.prepare(self.geometry)
        for view in views:
            low, high = np.maximum(view.bounds_m[:2], bounds[:2]), np.minimum(view.bounds_m[2:], bounds[2:])
            if (high > low).all() and shapely.intersects(self.geometry, shapely.box(*view.bounds_m)):
                found.append(replace(view, bounds_m=np.concatenate([low, high])))
        return tuple(found)

    def touched(self, grid: OutputGrid, windows: Sequence[Window]) -> list[Window]:
        """The windows in which something of it may lie, in their order."""
        boxes = shapely.box(*np.array([_bounds(grid, window) for window in windows]).T)
        shapely.prepare(self.geometry)
        return [w for w, may in zip(windows, shapely.intersects(self.geometry, boxes), strict=True) if may]

    def mask(self, grid: OutputGrid, window: Window) -> Bools:
        """Which pixels of a window are inside, (h, w)."""
        return self._burnt(grid, window, 1, touched=False)

    def cells(self, grid: OutputGrid, window: Window, cell_px: int) -> Bools:
        """Which cells of cell_px x cell_px pixels of a window it touches, (rows, cols)."""
        return self._burnt(grid, window, cell_px, touched=True)

    def seen(self, grid: OutputGrid, cells: Bools, cell_px: int) -> float:
        """The share of the whole outline that lies in these cells (rows, cols) of the grid."""
        inside = self._burnt(grid, Window(0, 0, grid.width_px, grid.height_px), cell_px, touched=False)
        seen_m2 = float((inside & cells).sum()) * (cell_px * grid.gsd_m) ** 2
        return self.near * seen_m2 / float(self.geometry.area)

    def _burnt(self, grid: OutputGrid, window: Window, step_px: int, touched: bool) -> Bools:
        shape = -(-window.height // step_px), -(-window.width // step_px)
        whole = Window(window.col, window.row, shape[1] * step_px, shape[0] * step_px)
        (west, south, east, north), side_m = _bounds(grid, whole), step_px * grid.gsd_m
        spare = west - side_m, south - side_m, east + side_m, north + side_m
        near = _polygonal(_clipped(self.geometry, spare))
        if near.is_empty:
            return np.zeros(shape, dtype=bool)
        burnt = rasterize(
            [near], shape, transform=Affine(side_m, 0.0, west, 0.0, -side_m, north), all_touched=touched
        )
        return np.asarray(burnt > 0)


def _clipped(geometry: Any, bounds_m: tuple[float, float, float, float]) -> Any:
    """What of a valid geometry lies within west, south, east and north.

    GEOS's quick clipping fails where a ring touches the rectangle at a corner alone; the exact one does not.
    """
    try:
        return shapely.clip_by_rect(geometry, *bounds_m)
    except shapely.errors.GEOSException:
        return shapely.intersection(geometry, shapely.box(*bounds_m))


@dataclass(frozen=True)
class Outline:
    """What a file says of an area: a valid geometry of shapely's, its CRS (WKT), whether it was corrected."""

    file: Path
    geometry: Any
    crs: str
    corrected: bool


def read_outline(path: Path) -> Outline:
    """The polygons of a file as one geometry; those that cross themselves are corrected.

    Raises: `FileError` as `doors.vector.read_shapes`; `InputError` where the polygons hold nothing.
    """
    found = read_shapes(path)
    corrected = not bool(shapely.is_valid(np.array(found.geometries, dtype=object)).all())
    try:
        whole = _polygonal(shapely.union_all([shapely.make_valid(g) for g in found.geometries]))
    except shapely.errors.GEOSException:
        whole = shapely.MultiPolygon()
    if not (whole.area > 0.0 and np.isfinite(shapely.bounds(whole)).all()):
        fix = "correct it in a GIS (QGIS: Fix geometries)"
        raise InputError(
            ("its polygons are empty, or have coordinates that are no numbers"), file=path, fix=fix
        )
    return Outline(path, whole, found.crs, corrected)


def area_seen(outline: Outline, crs: str, views: Sequence[FrameView]) -> tuple[Area, tuple[FrameView, ...]]:
    """The area on the map, cut to about what the frames see, and the frames that see something of it.

    Of these, bounds_m is what lies within the area's own bounds. Edges are straight in the outline's CRS.
    Raises: `InputError` where the area lies elsewhere than the frames, or the map is nowhere on Earth.
    """
    if is_local(crs):
        problem = "the area cannot be found, because no frame has a position"
        raise InputError(
            problem, file=outline.file, fix=("give positions with --pos, or control points with --gcp")
        )
    boxes = shapely.box(*np.array([v.bounds_m for v in views]).T)
    frames = shapely.union_all(boxes)
    geometry, near = _on_map(outline, crs, frames.bounds)
    shown = _polygonal(shapely.intersection(geometry, frames))
    if shown.is_empty:
        raise elsewhere(outline, crs, views)
    bounds = np.array(shown.bounds)
    shapely.prepare(geometry)
    seeing = []
    for view, sees in zip(views, shapely.intersects(geometry, boxes), strict=True):
        low, high = np.maximum(view.bounds_m[:2], bounds[:2]), np.minimum(view.bounds_m[2:], bounds[2:])
        if sees and (high > low).all():
            seeing.append(replace(view, bounds_m=np.concatenate([low, high])))
    return Area(rings_of(geometry), near), tuple(seeing)


def rings_of(geometry: Any) -> tuple[tuple[Floats, ...], ...]:
    """The closed rings (n, 2) of each polygon of a geometry of shapely's, the outer one first."""
    return tuple(
        tuple(np.asarray(r.coords, dtype=np.float64) for r in (p.exterior, *p.interiors))
        for p in shapely.get_parts(geometry)
        if p.geom_type == "Polygon"
    )


def _on_map(outline: Outline, crs: str, bounds_m: Sequence[float]) -> tuple[Any, float]:
    """What of an outline lies about bounds on the map, and the share of it that this is; edges are divided
    first, as they bend there."""
    west, south, east, north = bounds_m
    spare_m = 0.1 * max(east - west, north - south) + 1.0
    try:
        way = Transformer.from_crs(outline.crs, CRS.from_user_input(crs).to_2d(), always_xy=True)
        west, south, east, north = way.transform_bounds(
            west - spare_m, south - spare_m, east + spare_m, north + spare_m, direction="INVERSE"
        )
    except ProjError as error:
        problem = f"PROJ knows no way from its coordinate reference system to the map's ({error})"
        raise InputError(problem, file=outline.file, fix="write it in one with an EPSG code") from error
    if not np.isfinite([west, south, east, north]).all():
        return shapely.MultiPolygon(), 0.0
    boxes = [shapely.box(west, south, east, north)]
    if east < west:  # across longitude 180
        boxes = [shapely.box(west, south, 180.0, north), shapely.box(-180.0, south, east, north)]
    near = _polygonal(shapely.intersection(outline.geometry, shapely.union_all(boxes)))
    longest = max(max(b.bounds[2] - b.bounds[0], b.bounds[3] - b.bounds[1]) for b in boxes)
    share = near.area / outline.geometry.area
    near = shapely.segmentize(near, longest / _STEPS_ALONG)
    there = shapely.transform(near, lambda at: np.column_stack(way.transform(at[:, 0], at[:, 1])))
    return _polygonal(shapely.union_all(shapely.make_valid(shapely.get_parts(there)))), share


def _polygonal(geometry: Any) -> Any:
    """What of a geometry is polygons."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    return shapely.MultiPolygon([p for p in parts if p.geom_type == "Polygon" and not p.is_empty])


def _bounds(grid: OutputGrid, window: Window) -> tuple[float, float, float, float]:
    """West, south, east and north of a window."""
    west, north = grid.west_m + window.col * grid.gsd_m, grid.north_m - window.row * grid.gsd_m
    return west, north - window.height * grid.gsd_m, west + window.width * grid.gsd_m, north


def elsewhere(outline: Outline, crs: str, views: Sequence[FrameView]) -> InputError:
    """What is said of an area that no frame sees."""
    frames = shapely.union_all(shapely.box(*np.array([v.bounds_m for v in views]).T))
    area, survey = (_extent_text(g, c) for g, c in ((outline.geometry, outline.crs), (frames, crs)))
    name = CRS.from_user_input(outline.crs).name
    return InputError(
        f"the frames show no part of the area: it lies at {area}, they lie at {survey}",
        file=outline.file,
        fix=f"correct its coordinate reference system ({name}), or give another --aoi",
    )


def _extent_text(geometry: Any, crs: str) -> str:
    """Where the middle of a geometry lies."""
    west, south, east, north = geometry.bounds
    x, y = (west + east) / 2.0, (south + north) / 2.0
    way = Transformer.from_crs(CRS.from_user_input(crs).to_2d(), "EPSG:4326", always_xy=True)
    lon, lat = way.transform(x, y)
    if not np.isfinite([lon, lat]).all():
        return f"x {x:.10g}, y {y:.10g}"
    return f"longitude {lon:.5f}, latitude {lat:.5f}"
