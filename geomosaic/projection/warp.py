"""The warp: for every pixel of a map window, where a frame saw it.

Between the map and the ground lies nothing but the map projection and the Earth's bend, smooth enough for a
polynomial over a window; pyproj is asked at 25 nodes only. From there on every pixel goes through the relief
and the collinearity equations itself, so neither tilt, distortion nor a rough DEM costs accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import turned_by
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import GroundSurface

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
_NODES = 5
_HEIGHT_ROUNDS = 3
_ROWS_AT_ONCE = 64
_MOVING_ROUNDS, _TURNING_ROUNDS = 2, 5
_TIMES_A_ROW = (
    4  # turns are looked up, not interpolated: vibration turns a camera by some tenths of a pixel a row
)


@dataclass(frozen=True)
class GroundWindow:
    """The ground points, in the work frame, under the pixel centres of a north-up map window.

    `polynomial` (6, 3) gives east, north, up in metres from 1, u, v, u², uv, v², where u and v run from
    -1 to 1 over the window's cols and rows. On it stands `relief_m` (rows, cols), the height over the
    polynomial along `vertical` (3,), or None where the polynomial is the ground.
    """

    width_px: int
    height_px: int
    polynomial: Floats
    vertical: Floats
    relief_m: Floats32 | None

    def points_m(self) -> Floats:
        """East, north, up of all pixel centres, shape (rows, cols, 3)."""
        points = np.stack(self._base_m(), axis=-1)
        if self.relief_m is not None:
            points += self.relief_m[..., None] * self.vertical
        return np.asarray(points)

    def _base_m(self) -> list[Floats]:
        u, v = _axis(self.width_px), _axis(self.height_px)
        return [_surface(self.polynomial[:, k], u, v) for k in range(3)]


def ground_window(
    crs: str,
    work_frame: LocalFrame,
    ground: GroundSurface,
    west_m: float,
    north_m: float,
    gsd_m: float,
    width_px: int,
    height_px: int,
) -> GroundWindow:
    """Ground points of a map window whose upper left corner is (west_m, north_m) in `crs`.

    A map pixel is the ground point that has its map coordinates. Its height is found by fixed point: the
    vertical there is all but parallel to the work frame's up, so a round gains three to four digits. The
    polynomial leaves out (window / Earth radius)² of the window: 1e-6 m at 300 m, 3 cm at 10 km.
    """
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, _NODES), np.linspace(-1.0, 1.0, _NODES))
    easting = west_m + (u + 1.0) / 2.0 * width_px * gsd_m
    northing = north_m - (v + 1.0) / 2.0 * height_px * gsd_m
    lonlat = MapProjection(crs).geodetic_from_map(easting, northing)
    lon, lat = lonlat[..., 0], lonlat[..., 1]
    height = np.full(lon.shape, work_frame.height_ellipsoidal_m + float(ground.up_m.mean()))
    for _ in range(_HEIGHT_ROUNDS):
        enu = work_frame.enu_from_geodetic(lon, lat, height)
        height += ground.up_at(enu[..., 0], enu[..., 1]) - enu[..., 2]
    smooth = ground.kind == "flat"
    if not smooth:
        height[:] = height.mean()
    nodes = work_frame.enu_from_geodetic(lon, lat, height)
    fit = np.linalg.lstsq(_terms(u, v).reshape(-1, 6), nodes.reshape(-1, 3), rcond=None)
    polynomial = np.asarray(fit[0], dtype=np.float64)
    middle = _NODES // 2
    above = work_frame.enu_from_geodetic(
        lon[middle, middle], lat[middle, middle], height[middle, middle] + 1e3
    )
    vertical = (above - nodes[middle, middle]) / 1e3
    bare = GroundWindow(width_px, height_px, polynomial, vertical, None)
    if smooth:
        return bare
    return GroundWindow(width_px, height_px, polynomial, vertical, _relief_m(bare, ground, gsd_m))


def _relief_m(window: GroundWindow, ground: GroundSurface, gsd_m: float) -> Floats32:
    east, north, up = window._base_m()
    lean = window.vertical[:2] / window.vertical[2]
    rise = ground.up_at(east, north) - up
    if float(np.abs(rise).max()) * float(np.hypot(*lean)) > 1e-2 * gsd_m:
        rise = ground.up_at(east + rise * lean[0], north + rise * lean[1]) - up
    return np.asarray(rise / window.vertical[2], dtype=np.float32)


def frame_from_map(
    window: GroundWindow, pose: Pose, camera: Camera, rows: slice = slice(None), cols: slice = slice(None)
) -> tuple[Floats32, Floats32]:
    """Col and row in a frame of the window's pixel centres: two float32 arrays, NaN where not seen.

    The equations of `Pose.image_from_ground` in single precision and in place, a band of rows at a time so
    that it stays in the processor's cache. Coordinates are taken from the projection centre, which keeps
    the rounding near 0.001 px.

    Args: rows, cols: contiguous part of the window, in its pixels.
    """
    u, v = _axis(window.width_px)[cols], _axis(window.height_px)[rows]
    shifted = window.polynomial.copy()
    shifted[0] -= pose.position_m
    coefficients = shifted @ pose.rotation.matrix
    vertical = window.vertical @ pose.rotation.matrix
    relief = None if window.relief_m is None else window.relief_m[rows, cols]
    limit = camera.radius_limit**2
    velocity = np.zeros(3) if pose.velocity_m_per_s is None else pose.velocity_m_per_s @ pose.rotation.matrix
    turns = _turns_by_row(pose, camera)
    rolling = turns is not None or (camera.readout_s != 0.0 and bool(velocity.any()))
    col = np.empty((v.size, u.size), dtype=np.float32)
    row = np.empty_like(col)
    for top in range(0, v.size, _ROWS_AT_ONCE):
        band = slice(top, top + _ROWS_AT_ONCE)
        x, y, z = (_surface(coefficients[:, k], u, v[band], np.float32) for k in range(3))
        if relief is not None:
            for axis, share in zip((x, y, z), vertical, strict=True):
                axis += relief[band] * np.float32(share)
        into = col[band], row[band]
        if not rolling:
            _image_from_camera(camera, limit, x, y, z, *into)
            continue
        _image_from_camera(camera, limit, x.copy(), y.copy(), z.copy(), *into)
        for _ in range(_MOVING_ROUNDS if turns is None else _TURNING_ROUNDS):
            after_s = camera.read_after_s(into[1])
            mx, my, mz = (axis - after_s * np.float32(v) for axis, v in zip((x, y, z), velocity, strict=True))
            if turns is not None:
                at = np.clip(np.nan_to_num(into[1] * _TIMES_A_ROW + 0.5), 0, turns.shape[1] - 1).astype(
                    np.intp
                )
                mx, my, mz = turned_by([turn[at] for turn in turns], (mx, my, mz))
            _image_from_camera(camera, limit, mx, my, mz, *into)
    return col, row


def _turns_by_row(pose: Pose, camera: Camera) -> Floats32 | None:
    """The turns (3, times) from present to middle camera axes, backwards, for each quarter of a row."""
    if pose.turns is None or not camera.readout_s:
        return None
    row_px = np.arange(_TIMES_A_ROW * camera.height_px + 1) / _TIMES_A_ROW
    return np.asarray(-pose.turns.at(camera.read_after_s(row_px))[0].T, dtype=np.float32)


def _image_from_camera(
    camera: Camera, limit_sq: float, x: Floats32, y: Floats32, z: Floats32, col: Floats32, row: Floats32
) -> None:
    """`Camera.image_from_camera` of camera axes into col and row; x, y and z are used up."""
    with np.errstate(all="ignore"):
        z[z >= 0.0] = np.nan
        np.divide(x, -z, out=x)
        np.divide(y, z, out=y)
        _image_from_ideal(camera, limit_sq, x, y, col, row)


def _image_from_ideal(
    camera: Camera, limit_sq: float, x: Floats32, y: Floats32, col: Floats32, row: Floats32
) -> None:
    """The same of x right and y down over depth; x and y are used up."""
    f = np.float32(camera.focal_length_px)
    r_sq = x * x + y * y
    x[r_sq > limit_sq] = np.nan
    bent = camera.lens.bent(camera.terms.astype(np.float32), x, y, r_sq)
    centres = camera.principal_col_px, camera.principal_row_px
    for axis, out, centre in zip(bent, (col, row), centres, strict=True):
        np.multiply(axis, f, out=out)
        out += np.float32(centre)
    row[np.isnan(col)] = np.nan


def _axis(n: int) -> Floats:
    return np.asarray((np.arange(n) + 0.5) * (2.0 / n) - 1.0, dtype=np.float64)


def _terms(u: Floats, v: Floats) -> Floats:
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _surface(c: Floats, u: Floats, v: Floats, dtype: type[Any] = np.float64) -> NDArray[Any]:
    along_u = (c[0] + u * (c[1] + u * c[3])).astype(dtype)
    along_v = (v * (c[2] + v * c[5])).astype(dtype)
    out = np.outer((v * c[4]).astype(dtype), u.astype(dtype))
    out += along_u
    out += along_v[:, None]
    return np.asarray(out)
