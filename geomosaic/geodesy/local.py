"""The work frame: local topocentric east-north-up metres at the survey's centre."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Transformer

from geomosaic.arrays import Floats


@lru_cache(maxsize=1)
def _ecef_from_geodetic() -> Transformer:
    return Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)


def ecef_from_geodetic(lon_deg: ArrayLike, lat_deg: ArrayLike, height_ellipsoidal_m: ArrayLike) -> Floats:
    """Earth-centred WGS 84 metres, shape (..., 3), of geodetic coordinates that broadcast."""
    lon, lat, height = np.broadcast_arrays(
        *(np.asarray(a, dtype=np.float64) for a in (lon_deg, lat_deg, height_ellipsoidal_m))
    )
    xyz = _ecef_from_geodetic().transform(lon.ravel(), lat.ravel(), height.ravel())
    return np.stack(xyz, axis=-1).reshape((*lon.shape, 3))


def geodetic_from_ecef(ecef_m: ArrayLike) -> Floats:
    """Longitude, latitude (degrees) and ellipsoidal height (m), shape (..., 3)."""
    ecef = np.asarray(ecef_m, dtype=np.float64)
    flat = ecef.reshape(-1, 3)
    llh = _ecef_from_geodetic().transform(flat[:, 0], flat[:, 1], flat[:, 2], direction="INVERSE")
    return np.stack(llh, axis=-1).reshape(ecef.shape)


def enu_from_ecef_rotation(lon_deg: ArrayLike, lat_deg: ArrayLike) -> Floats:
    """Rotation from ECEF axes to east-north-up axes at a point, shape (..., 3, 3)."""
    lon = np.radians(np.asarray(lon_deg, dtype=np.float64))
    lat = np.radians(np.asarray(lat_deg, dtype=np.float64))
    lon, lat = np.broadcast_arrays(lon, lat)
    zero = np.zeros_like(lon)
    east = np.stack([-np.sin(lon), np.cos(lon), zero], axis=-1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    return np.stack([east, north, up], axis=-2)


@dataclass(frozen=True)
class LocalFrame:
    """East-north-up at an origin: a rigorous Cartesian frame, so the Earth's curvature is kept.

    A surface of constant ellipsoidal height sinks below the frame's horizon by about d² / 2R:
    8 cm at 1 km, 7.8 m at 10 km.
    """

    lon_deg: float
    lat_deg: float
    height_ellipsoidal_m: float

    @cached_property
    def _origin_ecef_m(self) -> Floats:
        return ecef_from_geodetic(self.lon_deg, self.lat_deg, self.height_ellipsoidal_m)

    @cached_property
    def _enu_from_ecef(self) -> Floats:
        return enu_from_ecef_rotation(self.lon_deg, self.lat_deg)

    def enu_from_geodetic(
        self, lon_deg: ArrayLike, lat_deg: ArrayLike, height_ellipsoidal_m: ArrayLike
    ) -> Floats:
        """East, north, up in metres, shape (..., 3)."""
        d = ecef_from_geodetic(lon_deg, lat_deg, height_ellipsoidal_m) - self._origin_ecef_m
        return np.asarray(d @ self._enu_from_ecef.T)

    def geodetic_from_enu(self, enu_m: ArrayLike) -> Floats:
        """Longitude, latitude (degrees) and ellipsoidal height (m), shape (..., 3)."""
        enu = np.asarray(enu_m, dtype=np.float64)
        ecef = enu @ self._enu_from_ecef + self._origin_ecef_m
        return geodetic_from_ecef(ecef)

    def enu_from_local_rotation(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> Floats:
        """Rotation to this frame's axes from the east-north-up axes at another point, (..., 3, 3).

        Holds the convergence of the meridians and the change of the vertical: 1.6e-4 rad per km.
        """
        there = enu_from_ecef_rotation(lon_deg, lat_deg)
        return np.asarray(self._enu_from_ecef @ np.swapaxes(there, -1, -2))
