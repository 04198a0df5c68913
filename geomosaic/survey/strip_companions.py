"""Whether the DEM, the RPC and the model of CCD strips are of their scene."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from geomosaic.camera.pushbroom import Pushbroom
from geomosaic.camera.rpc import Rpc, parse_rpc
from geomosaic.doors.files import SHORT_BYTES, check_regular, decoded, read_bytes
from geomosaic.doors.raster import Purpose, open_raster
from geomosaic.errors import FileError, InputError
from geomosaic.geodesy.ellipsoid import mid_latitude_offset_m
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.strip_model import read_model

_FIX: Final = "give the RPC of the stitched scene, or leave 'rpc' out"
_RPC: Final = Purpose(("GTiff",), "is no RPC and no raster that holds one", _FIX)
_DEM_FIX: Final = "give a DEM of the whole scene, or leave 'dem' out"
_PAST: Final = "looks past the Earth"
_PAST_FIX: Final = "check the attitude's and the looks' signs"


def read_rpc(path: Path) -> Rpc:
    """The RPC of a text (GeoEye's _RPC.TXT) or of a raster that holds one.

    Raises: `FileError` or `InputError` naming the file.
    """
    check_regular(path, _FIX)
    try:
        if path.stat().st_size <= SHORT_BYTES:
            content = read_bytes(path, SHORT_BYTES, "an RPC", _FIX)
            if b"LINE_OFF" in content and b"\0" not in content:
                return parse_rpc(decoded(content, path, _FIX))
        with open_raster(path, _RPC) as raster:
            return Rpc.from_metadata(raster.tags(ns="RPC"))
    except FileError:
        raise
    except InputError as error:
        raise InputError(error.problem, file=path, fix=_FIX) from error
    except (OSError, ValueError) as error:
        raise FileError(_RPC.problem, file=path, fix=_FIX) from error


def checked_model(path: Path, ccds: int, line_rate_hz: float) -> Pushbroom:
    """The model of so many CCDs at this line rate; `InputError` if it is of others."""
    model = read_model(path)
    if len(model.right_tan) != ccds:
        problem = f"has looks for {len(model.right_tan)} CCDs, the geometry has {ccds}"
        raise InputError(problem, file=path, fix="give one for each, dead ones too")
    if abs(model.line_rate_hz / line_rate_hz - 1.0) > 1e-3:
        problem = f"has {model.line_rate_hz:g} lines a second, the geometry {line_rate_hz:g}"
        raise InputError(problem, file=path, fix="correct line_rate_hz")
    return model


def check_pixel(model: Pushbroom, size_px: tuple[int, int], pixel_m: float, file: Path, path: Path) -> None:
    """`InputError`, naming the geometry's file, where pixels of the model at path differ by over 2 times.

    size_px: a strip's columns and lines; the pixel's width is that between its two middle columns.
    """
    col, line = size_px[0] / 2.0, size_px[1] / 2.0
    left, right = model.ground_from_image(len(model.right_tan) // 2, [col - 0.5, col + 0.5], line, 0.0)
    own_m = float(np.hypot(*mid_latitude_offset_m(left[0], left[1], right[0], right[1])))
    if not np.isfinite(own_m):
        raise InputError(_PAST, file=path, fix=_PAST_FIX)
    if not 0.5 <= own_m / pixel_m <= 2.0:
        problem = f"ground_pixel_m is {pixel_m:g}, but pixels of {path.name} measure {own_m:.3g} m"
        raise InputError(problem, file=file, fix="correct ground_pixel_m, or give the model of these strips")


def check_cover(dem: Path, model: Pushbroom, size_px: tuple[int, int], height_m: float) -> None:
    """`InputError` for a DEM that covers nothing of where the model looks at a height (m).

    size_px: a strip's columns and lines.
    """
    crs, bounds = check_dem(dem)
    cols, lines = np.linspace(0.0, size_px[0], 3), np.linspace(0.0, size_px[1], 9)[:, None]
    looked = [model.ground_from_image(k, cols, lines, height_m) for k in range(len(model.right_tan))]
    lon, lat = np.concatenate(looked)[..., :2].reshape(-1, 2).T
    x, y = MapProjection(crs.to_wkt()).map_from_geodetic(lon, lat).T
    inside = (bounds.left <= x) & (x <= bounds.right) & (bounds.bottom <= y) & (y <= bounds.top)
    if not inside.any():
        at = f"{np.median(lon):.3f}, {np.median(lat):.3f} deg"
        raise InputError(
            f"the DEM does not cover the strips: the model looks at {at}", file=dem, fix=_DEM_FIX
        )


def check_rpc(
    path: Path, size_px: tuple[int, int], pixel_m: float, model: Pushbroom | None, dem: Path | None
) -> Rpc:
    """The RPC of a scene of size_px (columns, lines); `InputError` if it is another scene's.

    Its own image must have about that size. Its middle must lie within a scene's size of where the model
    looks, or, without a model, on the DEM. Another scene of the same size is known only by these.
    """
    rpc = read_rpc(path)
    wanted = np.array(size_px[::-1], dtype=np.float64)
    middle, half = rpc.offset[:2] + 0.5, rpc.scale[:2]
    if (np.abs(middle - wanted / 2.0) > half).any() or (half > wanted).any() or (half < wanted / 4.0).any():
        own, ours = (f"{w:.0f} x {n:.0f}" for n, w in (2.0 * half, wanted))
        why = f"an image of some {own} px, where the strips make {ours}"
        raise InputError(f"is of another scene: {why}", file=path, fix=_FIX)
    lat, lon, height = (float(v) for v in rpc.offset[2:])
    if model is not None:
        at = model.ground_from_image(len(model.right_tan) // 2, 0.0, size_px[1] / 2.0, height)
        away_m = float(np.hypot(*mid_latitude_offset_m(at[0], at[1], lon, lat)))
        if not away_m < float(np.hypot(*wanted)) * pixel_m:
            why = f"its middle is {away_m / 1000.0:,.0f} km from where the model looks"
            raise InputError(f"is of another scene: {why}", file=path, fix=_FIX)
    elif dem is not None:
        crs, bounds = check_dem(dem)
        x, y = MapProjection(crs.to_wkt()).map_from_geodetic(lon, lat)
        if not (bounds.left <= x <= bounds.right and bounds.bottom <= y <= bounds.top):
            why = f"its middle ({lon:.3f}, {lat:.3f} deg) is not on {dem.name}"
            fix = "correct 'rpc' or 'dem'"
            raise InputError(f"it or {dem.name} is of another scene: {why}", file=path, fix=fix)
    return rpc
