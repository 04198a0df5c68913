"""The rigorous model of a focal plane of line sensors: orbit, attitude, look angles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from geomosaic.arrays import Floats
from geomosaic.camera.rotation import about_x, about_y, about_z
from geomosaic.constants import HEIGHT_ROUNDS, ROUNDS
from geomosaic.geodesy.ellipsoid import SEMI_MAJOR_M, SEMI_MINOR_M
from geomosaic.geodesy.local import ecef_from_geodetic, enu_from_ecef_rotation, geodetic_from_ecef


@dataclass(frozen=True, eq=False)
class Pushbroom:
    """Where each pixel of each CCD looks from and to, at the time of its line.

    Convention: line is a corner-origin coordinate, the same for all CCDs. Line l, first touched at l and left
    at l + 1, has its middle at l + 0.5, and time_s = line / line_rate_hz. Orbit axes: down along the
    ellipsoid's normal through the satellite, forward along the horizontal part of the velocity over the
    ground, right = down x forward. Body axes are orbit axes turned by Rz(yaw) Ry(pitch) Rx(roll): pitch > 0
    looks forward, roll > 0 looks left, yaw > 0 turns to the right. In body axes pixel (ccd, col) looks along
    (forward, right, 1), where

        forward = forward_tan[ccd] . (1, col, time_s),  right = right_tan[ccd] . (1, col, time_s).

    Orbit and attitude are cubic splines through their tables. Refraction and aberration are left out.

    orbit_time_s (n,), orbit_ecef_m (n, 3): WGS 84, fixed to the Earth. attitude_time_s (m,),
    roll_pitch_yaw_rad (m, 3). forward_tan, right_tan: (ccds, 3), per 1, px and s.
    """

    line_rate_hz: float
    orbit_time_s: Floats
    orbit_ecef_m: Floats
    attitude_time_s: Floats
    roll_pitch_yaw_rad: Floats
    forward_tan: Floats
    right_tan: Floats

    @cached_property
    def _orbit(self) -> CubicSpline:
        return CubicSpline(self.orbit_time_s, self.orbit_ecef_m)

    @cached_property
    def _attitude(self) -> CubicSpline:
        return CubicSpline(self.attitude_time_s, self.roll_pitch_yaw_rad)

    def attitude_rad(self, line: ArrayLike) -> Floats:
        """Roll, pitch, yaw (..., 3) at lines."""
        return np.asarray(self._attitude(np.asarray(line, dtype=np.float64) / self.line_rate_hz))

    def position_ecef_m(self, line: ArrayLike) -> Floats:
        """Where the satellite is at lines, (..., 3)."""
        return np.asarray(self._orbit(np.asarray(line, dtype=np.float64) / self.line_rate_hz))

    def ecef_from_body(self, line: ArrayLike, roll_pitch_yaw_rad: Floats | None = None) -> Floats:
        """Rotations (..., 3, 3) whose columns are the body's forward, right and down at lines.

        Args: roll_pitch_yaw_rad (..., 3): another attitude than the model's own.
        """
        time_s = np.asarray(line, dtype=np.float64) / self.line_rate_hz
        lonlath = geodetic_from_ecef(self._orbit(time_s))
        down = -enu_from_ecef_rotation(lonlath[..., 0], lonlath[..., 1])[..., 2, :]
        velocity = self._orbit(time_s, 1)
        forward = velocity - np.sum(velocity * down, axis=-1, keepdims=True) * down
        forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
        orbit = np.stack([forward, np.cross(down, forward), down], axis=-1)
        angles = self._attitude(time_s) if roll_pitch_yaw_rad is None else roll_pitch_yaw_rad
        body = about_z(angles[..., 2]) @ about_y(angles[..., 1]) @ about_x(angles[..., 0])
        return np.asarray(orbit @ body)

    def look(self, ccd: int, col: ArrayLike, line: ArrayLike) -> Floats:
        """Looking directions (..., 3) in body axes, down 1."""
        col_px, line_px = np.broadcast_arrays(np.asarray(col, float), np.asarray(line, float))
        terms = np.stack([np.ones_like(col_px), col_px, line_px / self.line_rate_hz], axis=-1)
        forward, right = terms @ self.forward_tan[ccd], terms @ self.right_tan[ccd]
        return np.stack([forward, right, np.ones_like(forward)], axis=-1)

    def ground_from_image(
        self,
        ccd: int,
        col: ArrayLike,
        line: ArrayLike,
        height_ellipsoidal_m: ArrayLike,
        roll_pitch_yaw_rad: Floats | None = None,
    ) -> Floats:
        """Longitude, latitude (degrees) and height (..., 3) where pixels look at a surface of given height.

        Args: cols, lines and heights that broadcast. NaN where the ray passes the Earth.
        """
        col_px, line_px, height = np.broadcast_arrays(
            *(np.asarray(a, dtype=np.float64) for a in (col, line, height_ellipsoidal_m))
        )
        origin = self.position_ecef_m(line_px)
        rotation = self.ecef_from_body(line_px, roll_pitch_yaw_rad)
        ray = np.einsum("...ij,...j->...i", rotation, self.look(ccd, col_px, line_px))
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        axes = np.array([SEMI_MAJOR_M, SEMI_MAJOR_M, SEMI_MINOR_M]) + height[..., None]
        o, r = origin / axes, ray / axes
        a, b, c = (np.sum(u * v, axis=-1) for u, v in ((r, r), (o, r), (o, o)))
        with np.errstate(invalid="ignore"):
            away = (-b - np.sqrt(b * b - a * (c - 1.0))) / a
        for _ in range(HEIGHT_ROUNDS):
            found = geodetic_from_ecef(origin + away[..., None] * ray)
            up = enu_from_ecef_rotation(found[..., 0], found[..., 1])[..., 2, :]
            away = away + (height - found[..., 2]) / np.sum(ray * up, axis=-1)
        found = geodetic_from_ecef(origin + away[..., None] * ray)
        return np.concatenate([found[..., :2], height[..., None]], axis=-1)

    def image_from_ground(
        self, ccd: int, ground: ArrayLike, near_line: ArrayLike, near_col: ArrayLike = 0.0
    ) -> Floats:
        """Col and line (..., 2) at which a CCD sees ground points (lon, lat in degrees, height; (..., 3)).

        Args: near_line, near_col: where to start; the nearer, the safer.
        """
        lonlath = np.asarray(ground, dtype=np.float64)
        point = ecef_from_geodetic(lonlath[..., 0], lonlath[..., 1], lonlath[..., 2])
        line, col, _ = np.broadcast_arrays(
            np.asarray(near_line, float), np.asarray(near_col, float), lonlath[..., 0]
        )
        for _ in range(ROUNDS):
            body = np.einsum(
                "...ji,...j->...i", self.ecef_from_body(line), point - self.position_ecef_m(line)
            )
            seen = body[..., :2] / body[..., 2:]
            away = seen - self.look(ccd, col, line)[..., :2]
            speed = self._orbit(line / self.line_rate_hz, 1)
            ground_share = np.linalg.norm(point, axis=-1) / np.linalg.norm(
                self.position_ecef_m(line), axis=-1
            )
            per_line = -np.linalg.norm(speed, axis=-1) * ground_share / self.line_rate_hz / body[..., 2]
            slope, step = self.forward_tan[ccd, 1], self.right_tan[ccd, 1]
            col_step = away[..., 1] / step
            line = line - (away[..., 0] - slope * col_step) / per_line
            col = col + col_step
        return np.stack([col, line], axis=-1)
