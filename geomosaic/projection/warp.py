"""The warp: for every pixel of a map window, where a frame saw it.

Between the map and the ground lies nothing but the map projection and the Earth's bend. They are smooth
enough for a polynomial over a window, so pyproj is asked at 25 nodes only. From there on every pixel goes
through the relief and the collinearity equations itself, so neither tilt, distortion nor a rough DEM costs
accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Floats, Floats32
from geomosaic.camera.exterior import Pose, row_moved_px
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import turned_by
from geomosaic.constants import HEIGHT_ROUNDS, MOST_ROUNDS, TOGETHER, tuned
from geomosaic.estimation.linear import pseudo_inverse
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import FLAT, GroundSurface
from geomosaic.projection.map_grid import MapGrid

Axes = tuple[Floats32, Floats32, Floats32]
"""x, y and z in the camera of ground points, in m."""
_NODES = tuned(5, "nodes a side", "of the projection's polynomial, odd: 3 are 1.0 mm off over 10 km, 5 0.8")
_CONVERGED_PX = tuned(0.004, "px", "row step that ends it: more shows at breaks; less is lost in rounding")


@dataclass(frozen=True)
class GroundWindow:
    """The ground points, in the work frame, under the pixel centres of a north-up map window.

    `polynomial` (6, 3) gives east, north, up in metres from 1, u, v, u², uv, v². Here u and v run from -1 to
    1 over the window's cols and rows. On it stands `relief_m` (rows, cols), the height over the polynomial
    along `vertical` (3,), or None where the polynomial is the ground.
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
        u, v = middles(self.width_px), middles(self.height_px)[:, None]
        return [_surface(self.polynomial[:, k], u, v) for k in range(3)]

    def relief_on(self, ground: GroundSurface, gsd_m: float, u: Floats, v: Floats) -> Floats32:
        """The ground over the polynomial along `vertical` at u and v, which broadcast; gsd_m: a pixel.

        Flat ground is the polynomial: its pixels stay the same to the bit where no object is raised.
        """
        east, north, up = (_surface(self.polynomial[:, k], u, v) for k in range(3))
        lean = self.vertical[:2] / self.vertical[2]
        rise = np.zeros_like(up) if ground.kind == FLAT else ground.up_at(east, north) - up
        if float(np.abs(rise).max(initial=0.0)) * float(np.hypot(*lean)) > 1e-2 * gsd_m:
            rise = ground.up_at(east + rise * lean[0], north + rise * lean[1]) - up
        if ground.raised:
            east, north, up, rise = np.broadcast_arrays(east, north, up, rise)
            height = np.full(rise.shape, np.nan)
            ground.raise_objects(east, north, height)
            rise = np.where(np.isnan(height), rise, height - up)
        return np.asarray(rise / self.vertical[2], dtype=np.float32)


def ground_window(grid: MapGrid, work_frame: LocalFrame, ground: GroundSurface) -> GroundWindow:
    """Ground points of a map window.

    A map pixel is the ground point that has its map coordinates. Its height is found by fixed point: the
    vertical there is all but parallel to the work frame's up, so a round gains three to four digits. The
    polynomial leaves out (window / Earth radius)² of the window: 1e-6 m at 300 m, 3 cm at 10 km.
    """
    bare = bare_window(grid, work_frame, ground)
    if not ground.has_relief:
        return bare
    relief_m = bare.relief_on(ground, grid.gsd_m, middles(grid.width_px), middles(grid.height_px)[:, None])
    return replace(bare, relief_m=relief_m)


def bare_window(grid: MapGrid, work_frame: LocalFrame, ground: GroundSurface) -> GroundWindow:
    """The same without its relief: flat ground without its objects, else the ground's mean level there."""
    u, v, fit = _nodes()
    easting = grid.west_m + (u + 1.0) / 2.0 * grid.width_px * grid.gsd_m
    northing = grid.north_m - (v + 1.0) / 2.0 * grid.height_px * grid.gsd_m
    lonlat = MapProjection(grid.crs).geodetic_from_map(easting, northing)
    lon, lat = lonlat[..., 0], lonlat[..., 1]
    level_m = work_frame.height_ellipsoidal_m + float(ground.up_m.mean())
    base, above = work_frame.enu_from_geodetic(lon, lat, level_m + np.array([0.0, 1e3])[:, None, None])
    vertical, rise = (above - base) / 1e3, np.zeros(lon.shape)
    for _ in range(HEIGHT_ROUNDS):
        enu = base + rise[..., None] * vertical
        rise += ground.up_at(enu[..., 0], enu[..., 1]) - enu[..., 2]
    if ground.kind != FLAT:
        rise[:] = rise.mean()
    nodes = base + rise[..., None] * vertical
    polynomial = np.asarray(fit @ nodes.reshape(-1, 3))
    middle = _NODES // 2
    return GroundWindow(grid.width_px, grid.height_px, polynomial, vertical[middle, middle], None)


class ProjectionEquations:
    """A frame's equations in single precision: camera axes at its middle row, then col and row.

    The equations of `Pose.image_from_ground`. Coordinates are taken from the projection centre, which keeps
    the rounding near 0.001 px.
    """

    def __init__(self, pose: Pose, camera: Camera) -> None:
        self._pose, self._camera = pose, camera
        self._turn = self._by_step = None
        velocity = np.zeros(3) if pose.velocity_m_per_s is None else pose.velocity_m_per_s
        self._velocity = (velocity @ pose.rotation.matrix).astype(np.float32)
        self._still = camera.readout_s == 0.0 or not velocity.any()
        if pose.turns is not None and camera.readout_s:
            rad = pose.turns.rad.T.astype(np.float32)
            self._turn, self._by_step = rad[:, :-1].copy(), np.diff(rad)
            self._still = False

    def axes(self, window: GroundWindow, u: Floats, v: Floats, relief_m: Floats32 | None) -> Axes:
        """Camera axes in m, at the middle row, of a window's ground at u and v, which broadcast."""
        shifted = window.polynomial.copy()
        shifted[0] -= self._pose.position_m
        coefficients = shifted @ self._pose.rotation.matrix
        x, y, z = (_surface(coefficients[:, k], u, v, np.float32) for k in range(3))
        if relief_m is not None:
            vertical = window.vertical @ self._pose.rotation.matrix
            for axis, share in zip((x, y, z), vertical, strict=True):
                axis += relief_m * np.float32(share)
        return x, y, z

    def image(self, axes: Axes, col: Floats32, row: Floats32, *, started: bool = False) -> None:
        """Puts col and row where camera axes at the middle row are seen, NaN where they are not.

        Axes are used up. started: row holds all but what there will be. A place that has converged stays:
        it comes out the same whatever others are asked for with it.
        """
        if self._still:
            _image_from_camera(self._camera, axes, col, row)
            return
        x, y, z = axes
        if not started:
            _image_from_camera(self._camera, (x.copy(), y.copy(), z.copy()), col, row)
        open_yet, found_col, found_row = (
            np.ones(row.shape, dtype=bool),
            np.empty_like(col),
            np.empty_like(row),
        )
        for _ in range(MOST_ROUNDS):
            after_s = self._camera.read_after_s(row)
            u, v, w = (axis - after_s * v for axis, v in zip((x, y, z), self._velocity, strict=True))
            if self._turn is not None:
                u, v, w = turned_by(self._turns_at(row), (u, v, w))
            _image_from_camera(self._camera, (u, v, w), found_col, found_row)
            moved = row_moved_px(self._camera, row, found_row) > _CONVERGED_PX
            np.copyto(col, found_col, where=open_yet)
            np.copyto(row, found_row, where=open_yet)
            open_yet &= moved
            if not open_yet.any():
                break

    def _turns_at(self, row: Floats32) -> list[Floats32]:
        """From present to middle camera axes, backwards, at the image's rows."""
        assert self._pose.turns is not None
        assert self._turn is not None
        assert self._by_step is not None
        times, camera = self._turn.shape[1], self._camera
        a_row = np.float32(times * camera.readout_s / self._pose.turns.span_s / camera.height_px)
        step = np.fmin(np.fmax(row, np.float32(0.0)), np.float32(camera.height_px))  # NaN: any row
        step -= np.float32(camera.height_px / 2.0)
        step *= a_row
        step += np.float32(times / 2.0)
        low = np.clip(step, 0, times - 1).astype(np.intp)
        step -= low
        turns = np.take(self._by_step, low, axis=1)
        turns *= step
        turns += np.take(self._turn, low, axis=1)
        return list(np.negative(turns, out=turns))


def frame_from_map(
    window: GroundWindow, pose: Pose, camera: Camera, rows: slice = slice(None), cols: slice = slice(None)
) -> tuple[Floats32, Floats32]:
    """Col and row in a frame of the window's pixel centres: two float32 arrays, NaN where not seen.

    By `ProjectionEquations`, a band of rows at a time so that it stays in the processor's cache.

    Args: rows, cols: contiguous part of the window, in its pixels.
    """
    sight = ProjectionEquations(pose, camera)
    u, v = middles(window.width_px)[cols], middles(window.height_px)[rows, None]
    relief = None if window.relief_m is None else window.relief_m[rows, cols]
    col = np.empty((v.size, u.size), dtype=np.float32)
    row = np.empty_like(col)
    for top in range(0, v.size, TOGETHER):
        band = slice(top, top + TOGETHER)
        axes = sight.axes(window, u, v[band], None if relief is None else relief[band])
        sight.image(axes, col[band], row[band])
    return col, row


def _image_from_camera(camera: Camera, axes: Axes, col: Floats32, row: Floats32) -> None:
    """`Camera.image_from_camera` of camera axes, which are used up, into col and row."""
    x, y, z = axes
    with np.errstate(all="ignore"):
        z[z >= 0.0] = np.nan
        np.divide(x, -z, out=x)
        np.divide(y, z, out=y)
        _image_from_ideal(camera, x, y, col, row)


def _image_from_ideal(camera: Camera, x: Floats32, y: Floats32, col: Floats32, row: Floats32) -> None:
    """The same of x right and y down over depth; x and y are used up."""
    f = np.float32(camera.focal_length_px)
    r_sq = x * x + y * y
    x[r_sq > camera.radius_limit**2] = np.nan
    bent = camera.lens.bent(camera.terms.astype(np.float32), x, y, r_sq)
    centres = camera.principal_col_px, camera.principal_row_px
    for axis, out, centre in zip(bent, (col, row), centres, strict=True):
        np.multiply(axis, f, out=out)
        out += np.float32(centre)
    row[np.isnan(col)] = np.nan


def middles(n: int) -> Floats:
    """A window's n pixels across or down, where u or v of its polynomial has their middles."""
    return np.asarray((np.arange(n) + 0.5) * (2.0 / n) - 1.0, dtype=np.float64)


@cache
def _nodes() -> tuple[Floats, Floats, Floats]:
    """u and v of the nodes where pyproj is asked, and the polynomial's terms (6, nodes) of values there."""
    u, v = np.meshgrid(np.linspace(-1.0, 1.0, _NODES), np.linspace(-1.0, 1.0, _NODES))
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    return u, v, pseudo_inverse(terms.reshape(-1, 6))


def _surface(c: Floats, u: Floats, v: Floats, dtype: type[Any] = np.float64) -> NDArray[Any]:
    """The polynomial of coefficients c (6,) at u and v, which broadcast."""
    out = (v * c[4]).astype(dtype) * u.astype(dtype)
    out += (c[0] + u * (c[1] + u * c[3])).astype(dtype)
    out += (v * (c[2] + v * c[5])).astype(dtype)
    return np.asarray(out)
