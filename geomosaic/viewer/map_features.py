"""A run's vector layers in pixels of a map: seamlines, footprints, frames, control and check points."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from pyproj import CRS, Transformer

from geomosaic.arrays import Floats
from geomosaic.doors.gdal_failures import close, gdal_failures
from geomosaic.doors.vector import open_vector
from geomosaic.geodesy.mapcrs import same_map
from geomosaic.viewer.grid_raster import ViewGrid

_LAYERS: Final = (
    ("seamlines", "Seamlines", "#ffe100", ""),
    ("footprints", "Footprints", "#00c8e6", ""),
    ("ccd_strips", "CCD strips", "#00c8e6", "ccd"),
    ("frames", "Frames", "#3ddc5f", "frame"),
    ("control", "Control and check points", "#ff4d5a", "name"),
)
"""Of layers.gpkg: title, colour, and the field that labels points."""
_MOST_FEATURES: Final = 20_000  # of a layer: more make the page slow; less hides layers
_STRAIGHT_PX: Final = 0.5  # that a line is off: less sends more vertices; more moves lines from seams
_DECIMALS: Final = 1


def map_features(package: Path, grid: ViewGrid) -> list[dict[str, Any]]:
    """Layers that hold anything: title, colour, lines as lists of places, and points with labels.

    Raises: `FileError` where the file cannot be read.
    """
    found = []
    with gdal_failures(package):
        source = open_vector(package)
        for name, title, colour, label in _LAYERS:
            layer = source.GetLayerByName(name)
            if layer is not None and 0 < layer.GetFeatureCount() <= _MOST_FEATURES:
                px_from_layer = _px_from_layer(layer, grid)
                if px_from_layer is not None:
                    found.append({"title": title, "colour": colour, **_drawn(layer, label, px_from_layer)})
        close(source)
    return found


def _px_from_layer(layer: Any, grid: ViewGrid) -> Callable[[Floats], Floats] | None:
    """Places of a layer to columns and rows; None where the map is not on the Earth and the layer is."""
    reference = layer.GetSpatialRef()
    own = None if reference is None else CRS.from_wkt(reference.ExportToWkt(["FORMAT=WKT2_2019"]))
    of_map = CRS.from_wkt(grid.crs) if grid.crs else None
    if own is None or (of_map is not None and same_map(own, of_map)):
        return grid.px_from_map
    if of_map is None:
        return None
    way = Transformer.from_crs(own, of_map, always_xy=True)
    return lambda at: grid.px_from_map(np.column_stack(way.transform(at[:, 0], at[:, 1])))


def _drawn(layer: Any, label: str, px_from_layer: Callable[[Floats], Floats]) -> dict[str, list[Any]]:
    lines: list[Any] = []
    points: list[Any] = []
    for feature in layer:
        geometry = feature.GetGeometryRef()
        if geometry is None:
            continue
        geometry.FlattenTo2D()
        shape = shapely.transform(shapely.from_wkb(bytes(geometry.ExportToWkb())), px_from_layer)
        if shape.is_empty or not np.isfinite(shapely.get_coordinates(shape)).all():
            continue  # such as a frame whose place nobody knows
        if shape.geom_type == "Point":
            name = str(feature.GetField(label)) if label and feature.GetFieldIndex(label) >= 0 else ""
            points.append([*_rounded(shape)[0], name])
        else:
            lines += _rings(shape)
    return {"lines": lines, "points": points}


def _rings(shape: Any) -> list[list[list[float]]]:
    """The lines, or the edges of the areas, of a shape."""
    plain = shapely.simplify(shape, _STRAIGHT_PX)
    edges = plain.boundary if plain.geom_type.endswith("Polygon") else plain
    return [_rounded(part) for part in shapely.get_parts(edges) if not part.is_empty]


def _rounded(shape: Any) -> list[list[float]]:
    at: list[list[float]] = np.round(shapely.get_coordinates(shape), _DECIMALS).tolist()
    return at
