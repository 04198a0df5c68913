"""A raster whose pixels a mosaic shares: its CRS, ground pixel and corner."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import CRS

from geomosaic.constants import tuned
from geomosaic.doors.raster import REFERENCE, Raster, open_raster
from geomosaic.errors import FileError, InputError
from geomosaic.geodesy.mapcrs import MapProjection, map_crs, utm_crs

_OFF_PX = tuned(0.01, "px", "rows against columns, end to end: less refuses rounded pixels; more misaligns")


@dataclass(frozen=True)
class Alignment:
    """The pixels of a north-up raster on the map.

    crs: `EPSG:n`, or WKT. origin_m: easting and northing of its upper left corner.
    """

    file: Path
    crs: str
    gsd_m: float
    origin_m: tuple[float, float]

    def check_crs(self, crs: str) -> None:
        """`InputError` unless another CRS that was asked for is the raster's."""
        if not CRS.from_user_input(self.crs).equals(map_crs(crs), ignore_axis_order=True):
            ours, theirs = (_name(CRS.from_user_input(c)) for c in (self.crs, crs))
            raise InputError(
                f"is in {ours}, but the mosaic in {theirs}",
                file=self.file,
                fix=f"leave out --crs, or give --align-to a raster in {theirs}",
            )

    def check_gsd(self, gsd_m: float) -> None:
        """`InputError` unless another ground pixel that was asked for is the raster's."""
        if abs(gsd_m / self.gsd_m - 1.0) > 1e-6:
            problem = f"has pixels of {self.gsd_m:.10g} m, but --gsd asks for {gsd_m:g} m"
            raise InputError(problem, file=self.file, fix="leave out --gsd or --align-to")


def read_alignment(path: Path) -> Alignment:
    """The pixels of a raster, as its header says.

    Raises: `FileError` for what is no local raster, or lies nowhere, in degrees, feet, turned, or has pixels
    that are no squares.
    """
    with open_raster(path, REFERENCE) as raster:
        t = raster.transform
        if raster.crs is None or t.is_identity or not np.isfinite(t).all():
            fix = "say where it lies (gdal_edit.py -a_srs EPSG:n -a_ullr WEST NORTH EAST SOUTH FILE)"
            raise FileError("has no place on the map", file=path, fix=fix)
        crs = CRS.from_wkt(raster.crs.to_wkt())
        crs = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d()
        if not crs.is_projected or any(a.unit_conversion_factor != 1.0 for a in crs.axis_info[:2]):
            fix = f"warp it to one first (gdalwarp -t_srs {_metric(raster, crs)} FILE OUT)"
            raise FileError(f"is in {_name(crs)}, no map projection in metres", file=path, fix=fix)
        if t.b != 0.0 or t.d != 0.0 or t.a <= 0.0 or t.e >= 0.0:
            problem = "is turned or upside down: its rows don't run from west to east, the first in the north"
            raise FileError(problem, file=path, fix=f"warp it first (gdalwarp -t_srs {_name(crs)} FILE OUT)")
        if abs(t.a + t.e) * max(raster.width, raster.height) > _OFF_PX * t.a:
            problem = f"has pixels of {t.a:.10g} x {-t.e:.10g} m, no squares"
            raise FileError(problem, file=path, fix=f"warp it first (gdalwarp -tr {t.a:g} {t.a:g} FILE OUT)")
        return Alignment(path, crs.to_string(), float(t.a), (float(t.c), float(t.f)))


def _name(crs: CRS) -> str:
    authority = crs.to_authority(min_confidence=100)
    return ":".join(authority) if authority else str(crs.name)


def _metric(raster: Raster, crs: CRS) -> str:
    """The UTM zone of a raster's middle, or what to put there."""
    x, y = raster.xy(raster.height // 2, raster.width // 2)
    if crs.is_projected:
        x, y = MapProjection(crs.to_wkt()).geodetic_from_map(x, y).tolist()
    return utm_crs(x, y) if abs(x) <= 360.0 and abs(y) <= 84.0 else "EPSG:n"
