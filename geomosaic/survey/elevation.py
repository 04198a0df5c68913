"""A DEM as a survey's elevation model: its vertical datum resolved, its cover of the frames checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError

from geomosaic.arrays import Floats
from geomosaic.doors.raster import DEM, open_raster
from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.geodesy.heights import ellipsoidal_offset_m, vertical_crs
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.dem import check_grid, read_heights
from geomosaic.survey.model import ElevationModel, Warn


def read_elevation(
    path: Path,
    offset_m: float | None,
    frame_names: Sequence[str],
    lonlat: Floats,
    datum: CRS | None = None,
) -> tuple[ElevationModel, Floats, list[Warn]]:
    """The elevation model of a DEM, its ellipsoidal heights under the frames, and what was assumed.

    What must be added to the DEM's values is offset_m if given. Otherwise it is the geoid's undulation at the
    survey's middle, by PROJ, if the DEM's CRS has a vertical part or a datum is given. The undulation changes
    by centimetres within a few kilometres. In all other cases 0 is added, with a warning: the values are
    taken to share the datum of the POS heights.

    Args: lonlat (n, 2) degrees of the frames' nadir points; datum: of heights whose CRS has no vertical part.
    Raises: `FileError` for what is no raster, `InputError` without a CRS, without the geoid's
    grid, or not covering the frames, saying by how much.
    """
    path = path.absolute()
    crs, bounds = check_dem(path)
    model, warnings = _with_datum(path, offset_m, vertical_crs(crs) or datum, np.median(lonlat, axis=0))
    xy = _covered(path, MapProjection(crs.to_wkt()), bounds, frame_names, lonlat)
    heights = read_heights(model, (*xy.min(axis=0), *xy.max(axis=0))).at(*xy.T)
    gaps = [name for name, h in zip(frame_names, heights, strict=True) if not np.isfinite(h)]
    if len(gaps) == len(frame_names):
        fix = "give a DEM with heights there, or correct its nodata value"
        raise InputError("the DEM has no heights under the frames", file=path, fix=fix)
    if gaps:
        text = (
            f"{path.name}: no heights under {len(gaps)} frames, where the nearest are used "
            f"({', '.join(gaps[:3])}): relief displaces the map there; give a --dem that covers them"
        )
        warnings.append(Warn("dem-gaps", "", text))
    return model, heights, warnings


def check_dem(path: Path) -> tuple[CRS, Any]:
    """The CRS of a DEM and its bounds in it, from its header.

    Raises: `FileError` for what is no raster, not north-up or has no heights, `InputError` without a CRS that
    has a place on the Earth.
    """
    with open_raster(path, DEM) as dem:
        if dem.crs is None:
            fix = "assign its coordinate reference system (gdal_edit.py -a_srs EPSG:n)"
            raise InputError("the DEM has no coordinate reference system", file=path, fix=fix)
        check_grid(dem, path)
        try:
            crs = CRS.from_wkt(dem.crs.to_wkt())
        except CRSError as error:
            problem = "the DEM's coordinate reference system can't be understood"
            raise InputError(problem, file=path, fix="assign one (gdal_edit.py -a_srs EPSG:n)") from error
        level = crs.sub_crs_list[0] if crs.is_compound else crs
        if not level.is_geographic and not level.is_projected:
            problem = f"the DEM's coordinate reference system '{level.name}' is a {level.type_name}"
            raise InputError(problem, file=path, fix="give the DEM in a map projection or in degrees")
        try:
            MapProjection(crs.to_wkt()).map_from_geodetic(0.0, 0.0)
        except InputError as error:
            raise InputError(error.problem, file=path, fix=error.fix) from error
        return crs, dem.bounds


def _with_datum(
    path: Path, offset_m: float | None, vertical: CRS | None, middle: Floats
) -> tuple[ElevationModel, list[Warn]]:
    model = ElevationModel(str(path), 0.0, "")
    if offset_m is not None:
        return replace(model, offset_m=offset_m, vertical=f"offset {offset_m:+g} m as given"), []
    if vertical is not None:
        try:
            offset = ellipsoidal_offset_m(vertical, *middle)
        except InputError as error:
            fix = f"give ellipsoidal minus stated height with --dem-offset METRES, or {error.fix}"
            raise InputError(error.problem, file=path, fix=fix) from error
        return replace(model, offset_m=offset, vertical=f"{vertical.name}, offset {offset:+.2f} m"), []
    text = (
        f"{path.name}: no vertical datum, so its heights are taken in the datum of the frames' heights: the "
        "map may lie too high or low; else give --dem-offset METRES"
    )
    vertical_text = "assumed to share the datum of the frames' heights"
    return replace(model, vertical=vertical_text), [Warn("dem-datum-assumed", "", text)]


def _covered(
    path: Path, projection: MapProjection, bounds: Any, names: Sequence[str], lonlat: Floats
) -> Floats:
    """Places of frames (n, 2) in the CRS of a DEM. Raises: `InputError` where the DEM does not cover all."""
    xy = projection.map_from_geodetic(*lonlat.T)
    nearest = np.clip(xy, [bounds.left, bounds.bottom], [bounds.right, bounds.top])
    outside = ~np.isfinite(xy).all(axis=1) | (nearest != xy).any(axis=1)
    if not outside.any():
        return xy
    edge = projection.geodetic_from_map(*np.nan_to_num(nearest, posinf=0.0).T)
    away = np.linalg.norm(mid_latitude_offset_m(*edge.T, *lonlat.T), axis=1)
    away[~outside] = 0.0
    i = int(np.argmax(away))
    far = f"{away[i] / 1000.0:,.1f} km" if away[i] >= 2000.0 else f"{away[i]:.0f} m"
    raise InputError(
        f"the DEM does not cover {outside.sum()} of {len(names)} frames: {names[i]} lies {far} outside",
        file=path,
        fix="give a DEM of the whole survey",
    )
