"""Map coordinate systems: only for reading DEMs and control and for writing."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS, Geod, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import TransformerGroup

from geomosaic.arrays import Floats
from geomosaic.constants import tuned
from geomosaic.doors.unwarned import unwarned
from geomosaic.errors import InputError
from geomosaic.geodesy.crs_names import crs_of, required_crs
from geomosaic.geodesy.ellipsoid import longitudes_near, middle_of

LOCAL_CRS = (
    'ENGCRS["local frame in units of its own",EDATUM["nowhere on Earth"],CS[Cartesian,2],'
    'AXIS["(E)",east,ORDER[1]],AXIS["(N)",north,ORDER[2]],LENGTHUNIT["unit of its own",1]]'
)
"""Of a mosaic that nothing puts on the Earth. Programs that need a unit read it as metres."""
_GIVE_CODE = "give the EPSG code of a map projection with --crs, such as EPSG:n"
_SAME_M = tuned(0.01, "m", "by which versions of one system may differ; more would take a datum for another")
_AROUND_DEG = tuned(0.2, "deg", "about the frames: less leaves tears in their views; more writes WKT in vain")
_MERIDIAN_DEG = tuned(1e-4, "deg", "11 m to either side: shorter loses digits; longer curves")
_LOCAL_PLANE = "+proj=aeqd +lat_0=0 +lon_0=0 +ellps=WGS84 +units=m"
"""Geometry goes on as if the local frame lay at longitude and latitude 0."""


def utm_crs(lon_deg: float, lat_deg: float) -> str:
    """`EPSG:326zz` or `EPSG:327zz` of a point, with the grid's exceptions for Norway and Svalbard."""
    zone = int((lon_deg + 180.0) // 6.0) % 60 + 1
    if 56.0 <= lat_deg < 64.0 and 3.0 <= lon_deg < 12.0:
        zone = 32
    if 72.0 <= lat_deg < 84.0 and 0.0 <= lon_deg < 42.0:
        zone = 31 + 2 * int((lon_deg + 3.0) // 12.0)
    return f"EPSG:{326 if lat_deg >= 0.0 else 327}{zone:02d}"


def is_local(crs: str) -> bool:
    """Whether a map CRS is that of a local frame, somewhere unknown."""
    return crs == LOCAL_CRS


def in_local_frame(crs: str) -> bool:
    """The same of any CRS that a file states, since files write that of a local frame in different ways."""
    return is_local(crs) or CRS.from_user_input(crs).type_name == "Engineering CRS"


def same_map(one: CRS, other: CRS) -> bool:
    """Whether two map CRSs are one. Those of local frames are, since files write them in different ways."""
    return one == other or one.type_name == other.type_name == "Engineering CRS"


def check_on_earth(crs: str, what: str) -> None:
    """`InputError` where a map CRS is a local frame's, of which there can't be a `what`."""
    if in_local_frame(crs):
        raise InputError(
            f"a mosaic in a local frame has no place on the Earth: no {what} can be made of it",
            fix="give the frames positions with --pos, or control points with --gcp",
        )


def map_crs(text: str, lonlat: tuple[float, float] | None = None) -> CRS:
    """A projected CRS in metres from an EPSG code, WKT, PROJ string or name.

    Of several systems of one name those count in whose area of use lonlat lies, the survey's middle.

    Raises: `InputError` for what is none, or has heights too, which a map does not have; `AmbiguousCrsError`
    where several are left that differ.
    """
    stated = required_crs(text, _GIVE_CODE)
    if stated.vertical is not None or any(crs_of(code).is_compound for code in stated.groups[0]):
        fix = "give the part of the plan alone; what the positions' heights count from is --height-datum"
        raise InputError(f"'{text}' has heights too, and the map's are ellipsoidal", fix=fix)
    for group in stated.groups:
        metric = [crs for crs in stated.meant(group) if _is_metric(crs)]
        fitting = [crs for crs in metric if not _is_reversed(crs)]
        if metric and not fitting:
            raise InputError(
                f"'{text}' counts from north to south or from east to west, so that its map would be turned "
                "or a mirror image",
                fix="give the system of the same land that counts east and north, such as EPSG:5514 for "
                "Krovak or ESRI:102562 for South Africa",
            )
        if lonlat is not None and len(fitting) > 1:
            fitting = [crs for crs in fitting if outside_area_m(crs, *lonlat) == 0.0] or fitting
        if fitting:
            if not _alike(fitting, lonlat):
                raise stated.ambiguous(fitting, _GIVE_CODE)
            return fitting[0]
    raise InputError(f"'{text}' is no map projection in metres", fix=_GIVE_CODE)


def _is_metric(crs: CRS) -> bool:
    return crs.is_projected and all(a.unit_conversion_factor == 1.0 for a in crs.axis_info[:2])


def _is_reversed(crs: CRS) -> bool:
    """Whether coordinates rise to the south or the west."""
    directions = {axis.direction.lower() for axis in crs.axis_info[:2]}
    return bool(directions & {"south", "west"}) and directions != {"south"}


def _alike(group: list[CRS], lonlat: tuple[float, float] | None) -> bool:
    """Whether systems put one place at the same coordinates, to the centimetre."""
    area = group[0].area_of_use
    if lonlat is None and area is not None:
        lonlat = (area.west + area.east) / 2.0, (area.south + area.north) / 2.0
    if len(group) == 1 or lonlat is None:
        return len(group) == 1
    at = np.array([MapProjection(crs.to_2d().to_wkt()).map_from_geodetic(*lonlat) for crs in group])
    return bool((np.ptp(at, axis=0) < _SAME_M).all())


def outside_area_m(crs: CRS, lon_deg: float, lat_deg: float) -> float:
    """How far a point lies outside a CRS's area of use in metres; 0 inside, or where the area is unknown."""
    area = crs.area_of_use
    if area is None:
        return 0.0
    width = (area.east - area.west) % 360.0 or 360.0
    east_of_west = (lon_deg - area.west) % 360.0
    outside = 0.0 if east_of_west <= width else min(east_of_west - width, 360.0 - east_of_west)
    lat = min(max(lat_deg, area.south), area.north)
    if outside == 0.0 and lat == lat_deg:
        return 0.0
    lon = lon_deg - outside if east_of_west - width <= 360.0 - east_of_west else lon_deg + outside
    return float(Geod(ellps="WGS84").inv(lon_deg, lat_deg, lon, lat)[2])


def one_operation(crs: str, lonlat: Floats) -> str:
    """A CRS by its name, as WKT where PROJ would move places about some by more than one operation.

    PROJ chooses by the place, which would leave a tear of metres in the map. The WKT's remark is the
    operation at the middle, in PROJ's words: `MapProjection` takes that one everywhere.

    Args: lonlat: (n, 2) degrees.
    """
    projection, (lon_deg, lat_deg) = MapProjection(crs), middle_of(lonlat)
    lon, lat = longitudes_near(lonlat[:, 0], lon_deg), lonlat[:, 1]
    corners = [
        ((x + 180.0) % 360.0 - 180.0, min(max(y, -90.0), 90.0))
        for x in (lon.min() - _AROUND_DEG, lon.max() + _AROUND_DEG)
        for y in (lat.min() - _AROUND_DEG, lat.max() + _AROUND_DEG)
    ]
    operation = projection.operation_at(lon_deg, lat_deg).definition
    if all(projection.operation_at(*corner).definition == operation for corner in corners):
        return crs
    stated = CRS.from_user_input(crs).to_2d().to_json_dict()
    return CRS.from_json_dict({**stated, "remarks": operation}).to_wkt()


@lru_cache(maxsize=32)
def _map_from_geodetic(crs: str) -> Transformer:
    system = CRS.from_user_input(_LOCAL_PLANE if is_local(crs) else crs)
    try:
        if system.remarks is not None and system.remarks.startswith("proj=pipeline"):
            with unwarned(UserWarning):  # of grids that are missing, `datum_shift` warns
                known = TransformerGroup("EPSG:4979", system.to_2d(), always_xy=True).transformers
            for operation in known:  # a stranger's remark counts only where PROJ knows the operation itself
                if operation.definition == system.remarks:
                    return operation
        return Transformer.from_crs("EPSG:4979", system.to_2d(), always_xy=True)
    except ProjError as error:
        problem = f"PROJ knows no way into the coordinate reference system ({error})"
        raise InputError(problem, fix="give one with an EPSG code") from error


@dataclass(frozen=True)
class MapProjection:
    """A map CRS by its name (`EPSG:32615` or WKT), moving points between it and WGS 84."""

    crs: str

    def operation_at(self, lon_deg: float, lat_deg: float) -> Transformer:
        """What PROJ moves a place by, with its name, accuracy and definition."""
        way = _map_from_geodetic(self.crs)
        way.transform(lon_deg, lat_deg)
        try:
            return way.get_last_used_operation()
        except ProjError:  # there is nothing to choose from
            return way

    def map_from_geodetic(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> Floats:
        """Easting and northing in metres, shape (..., 2)."""
        lon, lat = np.broadcast_arrays(
            np.asarray(lon_deg, dtype=np.float64), np.asarray(lat_deg, dtype=np.float64)
        )
        en = _map_from_geodetic(self.crs).transform(lon.ravel(), lat.ravel())
        return np.stack(en, axis=-1).reshape((*lon.shape, 2))

    def unwrapped(self, x: Floats, about: float) -> Floats:
        """Longitudes of a CRS in degrees within half a turn of one, so that they don't jump at 180 degrees;
        eastings stay."""
        if not CRS.from_user_input(_LOCAL_PLANE if is_local(self.crs) else self.crs).is_geographic:
            return x
        return longitudes_near(x, about)

    def geodetic_from_map(self, easting_m: ArrayLike, northing_m: ArrayLike) -> Floats:
        """Longitude and latitude in degrees, shape (..., 2)."""
        east, north = np.broadcast_arrays(
            np.asarray(easting_m, dtype=np.float64), np.asarray(northing_m, dtype=np.float64)
        )
        lonlat = _map_from_geodetic(self.crs).transform(east.ravel(), north.ravel(), direction="INVERSE")
        return np.stack(lonlat, axis=-1).reshape((*east.shape, 2))

    def scale_at(self, lon_deg: float, lat_deg: float) -> float:
        """Length on the map by length on the ellipsoid at a place, to where it differs most from 1."""
        ends = Geod(ellps="WGS84").fwd([lon_deg] * 2, [lat_deg] * 2, [0.0, 90.0], [1.0] * 2)[:2]
        metre_m = self.map_from_geodetic(*ends) - self.map_from_geodetic(lon_deg, lat_deg)
        scales = np.linalg.svd(metre_m, compute_uv=False)
        return float(scales[np.argmax(np.abs(scales - 1.0))])

    def grid_convergence_rad(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> Floats:
        """Angle from grid north to true north, positive where true north lies west of grid north.

        True azimuth = grid azimuth + convergence; east of a northern UTM zone's central meridian
        the convergence is positive. It is that of WGS 84's meridian, whatever meridian the CRS counts from.
        """
        lat = np.asarray(lat_deg, dtype=np.float64)
        ends = [np.clip(lat + way, -90.0, 90.0) for way in (-_MERIDIAN_DEG, _MERIDIAN_DEG)]
        south, north = (self.map_from_geodetic(lon_deg, end) for end in ends)
        with np.errstate(invalid="ignore"):  # a frame without a place
            east, up = np.moveaxis(north - south, -1, 0)
        return np.asarray(-np.arctan2(east, up))
