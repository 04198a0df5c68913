"""What the heights of a written surface count from: the ellipsoid, or a geoid that PROJ has a grid of."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
from osgeo import osr
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS

from geomosaic.arrays import Floats
from geomosaic.composition.model import OutputGrid
from geomosaic.errors import InputError
from geomosaic.geodesy.heights import ellipsoidal_offsets_m, height_datum_in_metres
from geomosaic.geodesy.mapcrs import MapProjection, is_local

_GEOID_NODES: Final = 33
"""Along each side of a grid: in 30 km one a kilometre, where geoids bend by millimetres."""
_SAME_M: Final = 0.01
"""Heights over two ellipsoids that differ by less count as the same."""


@dataclass(frozen=True)
class HeightSystem:
    """crs: what a GeoTIFF's tags can say, the map's alone for ellipsoidal heights; crs_in_space: the map's
    with them, empty where tags say all there is to say, or no CRS can. text says it in words. undulation_m:
    (33, 33) over the grid from its upper left corner, what heights lie below the ellipsoidal ones."""

    crs: str
    crs_in_space: str
    text: str
    undulation_m: Floats

    @property
    def whole_crs(self) -> str:
        """All that can be said."""
        return self.crs_in_space or self.crs

    def undulation_at(self, grid: OutputGrid, row: int, col: int, rows: int, cols: int) -> Floats:
        """At the pixels of part of a grid, bilinear between nodes."""
        nodes = np.linspace(0.0, 1.0, _GEOID_NODES)
        right = (col + np.arange(cols) + 0.5) / grid.width_px
        down = (row + np.arange(rows) + 0.5) / grid.height_px * (_GEOID_NODES - 1)
        at_nodes = np.stack([np.interp(right, nodes, line) for line in self.undulation_m])
        above = np.minimum(down.astype(np.intp), _GEOID_NODES - 2)
        share = (down - above)[:, None]
        return np.asarray((1.0 - share) * at_nodes[above] + share * at_nodes[above + 1])


def height_system(grid: OutputGrid, heights: str) -> HeightSystem:
    """What heights on a grid count from.

    Raises: `InputError` where the geoid's grid isn't installed, or the grid lies nowhere on the Earth.
    """
    vertical, none = height_datum_in_metres(heights), np.zeros((_GEOID_NODES, _GEOID_NODES))
    if is_local(grid.crs):
        if vertical.is_vertical:
            fix = "leave out --height-datum and --set export.surface.heights"
            raise InputError("a mosaic in a local frame has no heights above a geoid", fix=fix)
        return HeightSystem(grid.crs, "", "above the local frame's origin, in its unit", none)
    share = np.linspace(0.0, 1.0, _GEOID_NODES)
    pixel = np.stack(np.meshgrid(share * grid.width_px, share * grid.height_px), axis=-1)
    lonlat = MapProjection(grid.crs).geodetic_from_map(*np.moveaxis(grid.map_from_pixel(pixel), -1, 0))
    if not vertical.is_vertical:
        return HeightSystem(grid.crs, _in_space(grid.crs, lonlat[0, 0]), "ellipsoidal, WGS 84, metres", none)
    try:
        undulation_m = ellipsoidal_offsets_m(vertical, lonlat[..., 0], lonlat[..., 1])
    except InputError as error:
        fix = f"write ellipsoidal heights with --set export.surface.heights=ellipsoidal, or {error.fix}"
        raise InputError(error.problem, fix=fix) from error
    plane = CRS.from_user_input(grid.crs).to_2d()
    both = CompoundCRS(name=f"{plane.name} + {vertical.name}", components=[plane, vertical])
    return HeightSystem(both.to_wkt(), "", f"{vertical.name}, metres", undulation_m)


def reference_of(crs: str) -> Any:
    """OSR's, east before north."""
    reference = osr.SpatialReference()
    reference.SetFromUserInput(crs)
    reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    return reference


def describe_bands(dataset: Any, bands: Iterable[tuple[str, str]], nodata: float) -> None:
    """Writes what stands in each band of a GDAL dataset, and its unit, with the nodata value."""
    for number, (name, unit) in enumerate(bands, start=1):
        band = dataset.GetRasterBand(number)
        band.SetNoDataValue(nodata)
        band.SetDescription(name)
        band.SetUnitType(unit)


def write_sidecar(path: Path, heights: HeightSystem) -> None:
    """What GDAL believes before a raster's tags: those of a GeoTIFF can't hold a projected CRS with
    ellipsoidal heights."""
    reference = reference_of(heights.whole_crs)
    order = ",".join(map(str, reference.GetDataAxisToSRSAxisMapping()))
    dataset = ElementTree.Element("PAMDataset")
    element = ElementTree.SubElement(dataset, "SRS", dataAxisToSRSAxisMapping=order)
    element.text = reference.ExportToWkt(["FORMAT=WKT2_2019"])
    path.write_bytes(ElementTree.tostring(dataset, "utf-8") + b"\n")


def _in_space(crs: str, lonlat: Floats) -> str:
    """A map CRS with ellipsoidal heights, if they are those over WGS 84's ellipsoid; else nothing."""
    space = CRS.from_user_input(crs).to_2d().to_3d()
    height = Transformer.from_crs("EPSG:4979", space, always_xy=True).transform(lonlat[0], lonlat[1], 0.0)[2]
    return str(space.to_wkt()) if abs(height) < _SAME_M else ""
