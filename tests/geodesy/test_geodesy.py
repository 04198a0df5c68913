"""Radii, the mid-latitude formula, the work frame and map coordinates, against pyproj and published numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from geomosaic.errors import InputError
from geomosaic.geodesy.ellipsoid import meridian_radius_m, mid_latitude_offset_m, prime_vertical_radius_m
from geomosaic.geodesy.local import LocalFrame, ecef_from_geodetic
from geomosaic.geodesy.mapcrs import MapProjection, map_crs, utm_crs

GEOD = Geod(ellps="WGS84")


def test_radii_at_equator_and_pole() -> None:
    """a(1-e²) = 6335439.327 m, a = 6378137 m; at the pole both are a²/b = 6399593.626 m."""
    assert meridian_radius_m(0.0) == pytest.approx(6335439.327, abs=1e-3)
    assert prime_vertical_radius_m(0.0) == pytest.approx(6378137.0, abs=1e-6)
    assert meridian_radius_m(np.pi / 2) == pytest.approx(6399593.626, abs=1e-3)
    assert prime_vertical_radius_m(np.pi / 2) == pytest.approx(6399593.626, abs=1e-3)


def test_mid_latitude_of_the_papers_first_two_frames() -> None:
    """Table 2 of Yue et al. 2021: about 512 m apart, east by south."""
    east, north = mid_latitude_offset_m(87.3897, 42.0944, 87.3958, 42.0936)
    azimuth, _, distance = GEOD.inv(87.3897, 42.0944, 87.3958, 42.0936)
    assert distance == pytest.approx(512.5, abs=0.5)
    assert float(np.hypot(east, north)) == pytest.approx(distance, abs=1e-4)
    assert east > 0 > north
    assert float(np.degrees(np.arctan2(east, north))) == pytest.approx(azimuth, abs=0.01)


# Worst errors in metres over 16 azimuths against the geodesic, (vector, length), as docs/methods/paper_methods.md
# states them: the vector against east and north at the start point, so with half the convergence.
MID_LATITUDE_ERRORS_M = {
    (10.0, 42.0): (7.1e-6, 1e-8), (10.0, 60.0): (1.4e-5, 1e-8), (10.0, 80.0): (4.4e-5, 1e-8),
    (1e3, 0.0): (2.3e-6, 2.6e-7), (1e3, 42.0): (0.071, 1.1e-6), (1e3, 60.0): (0.135, 3.5e-6),
    (1e4, 0.0): (0.0023, 2.6e-4), (1e4, 42.0): (7.1, 0.0011), (1e4, 60.0): (13.5, 0.0035),
    (1e5, 0.0): (2.3, 0.26), (1e5, 42.0): (705.0, 1.1), (1e5, 60.0): (1350.0, 3.5), (1e5, 80.0): (4420.0, 37.0),
}  # fmt: skip


def mid_latitude_errors_m(distance_m: float, lat_deg: float) -> tuple[float, float]:
    """Worst error of the offset's vector and of its length, over 16 azimuths from the start point."""
    azimuth = np.arange(0.0, 360.0, 22.5)
    lon, lat, _ = GEOD.fwd(np.full(16, 11.3), np.full(16, lat_deg), azimuth, np.full(16, distance_m))
    offset = mid_latitude_offset_m(11.3, lat_deg, lon, lat)
    truth = distance_m * np.column_stack([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
    length = np.linalg.norm(offset, axis=1) - distance_m
    return float(np.linalg.norm(offset - truth, axis=1).max()), float(np.abs(length).max())


@pytest.mark.parametrize(("distance_m", "lat_deg"), list(MID_LATITUDE_ERRORS_M))
def test_mid_latitude_against_the_geodesic(distance_m: float, lat_deg: float) -> None:
    found = mid_latitude_errors_m(distance_m, lat_deg)
    assert found == pytest.approx(MID_LATITUDE_ERRORS_M[distance_m, lat_deg], rel=0.05, abs=1e-8)


def test_mid_latitude_across_the_date_line() -> None:
    east, _ = mid_latitude_offset_m(179.99, 10.0, -179.99, 10.0)
    assert float(east) == pytest.approx(GEOD.inv(179.99, 10.0, -179.99, 10.0)[2], abs=1e-3)


def test_ecef_of_a_published_point() -> None:
    """EPSG Guidance Note 7-2, 2.2.1: 53°48'33.820"N 2°07'46.380"E, 73.0 m."""
    xyz = ecef_from_geodetic(2 + 7 / 60 + 46.38 / 3600, 53 + 48 / 60 + 33.82 / 3600, 73.0)
    assert xyz == pytest.approx([3771793.968, 140253.342, 5124304.349], abs=1e-3)


def test_enu_of_a_published_point() -> None:
    """EPSG Guidance Note 7-2, 4.1.2: topocentric origin 55°N 5°E 200 m, the same point."""
    enu = LocalFrame(5.0, 55.0, 200.0).enu_from_geodetic(
        2 + 7 / 60 + 46.38 / 3600, 53 + 48 / 60 + 33.82 / 3600, 73.0
    )
    assert enu == pytest.approx([-189013.869, -128642.040, -4220.171], abs=2e-3)


@given(
    st.floats(-179, 179),
    st.floats(-80, 80),
    st.floats(-0.1, 0.1),
    st.floats(-0.1, 0.1),
    st.floats(-100, 5000),
)
def test_enu_there_and_back(lon: float, lat: float, d_lon: float, d_lat: float, height: float) -> None:
    frame = LocalFrame(lon, lat, 120.0)
    back = frame.geodetic_from_enu(frame.enu_from_geodetic(lon + d_lon, lat + d_lat, height))
    assert back == pytest.approx([lon + d_lon, lat + d_lat, height], abs=1e-6)


def test_local_axes_turn_with_the_meridians() -> None:
    """1 km east at 60°N north turns by tan(60°)/R = 1.55 arcmin per km, to the west seen from the origin."""
    frame = LocalFrame(10.0, 60.0, 0.0)
    lon, lat, _ = GEOD.fwd(10.0, 60.0, 90.0, 1000.0)
    north = frame.enu_from_local_rotation(lon, lat)[:, 1]
    assert float(np.arctan2(north[0], north[1])) == pytest.approx(
        -1000.0 * np.tan(np.radians(60)) / 6394000, rel=2e-3
    )


@pytest.mark.parametrize(
    ("lon", "lat", "crs"),
    [(-91.99, 46.84, "EPSG:32615"), (87.4, 42.09, "EPSG:32645"), (5.3, 60.4, "EPSG:32632"), (15.0, 78.0, "EPSG:32633"), (18.4, -33.9, "EPSG:32734"), (180.0, 0.0, "EPSG:32601")],
)  # fmt: skip
def test_utm_zones(lon: float, lat: float, crs: str) -> None:
    assert utm_crs(lon, lat) == crs


def test_utm_of_a_published_point() -> None:
    """The CN Tower, 43°38'33.24"N 79°23'13.7"W, is 17T 630084 4833438 (Wikipedia, UTM)."""
    en = MapProjection("EPSG:32617").map_from_geodetic(
        -(79 + 23 / 60 + 13.7 / 3600), 43 + 38 / 60 + 33.24 / 3600
    )
    assert en == pytest.approx([630084.0, 4833438.0], abs=1.0)


def test_grid_convergence_sign() -> None:
    """East of the central meridian of a northern zone true north lies west of grid north."""
    projection = MapProjection("EPSG:32632")
    a, b = projection.map_from_geodetic([11.0, 11.0], [48.0, 48.001])
    grid_azimuth_of_north = np.arctan2(*(b - a))
    gamma = float(projection.grid_convergence_rad(11.0, 48.0))
    assert gamma == pytest.approx(np.radians(1.4866), abs=1e-5)
    assert gamma == pytest.approx(-grid_azimuth_of_north, abs=1e-6)


@pytest.mark.parametrize(
    ("crs", "lon_deg", "lat_deg", "convergence_deg"),
    [
        ("EPSG:27572", 5.5, 46.8, 2.3060),  # 3.1628 deg east of Paris, times the sine of 52 grads
        ("EPSG:27391", 7.0, 60.0, 0.8173),  # 4 deg 40 min west of Oslo is 6.05625 deg east of Greenwich
        ("EPSG:31253", 15.987222, 47.5, -0.2552),  # 34 deg east of Ferro is 16.33333 deg east of Greenwich
        ("EPSG:32632", 9.0, 0.0, 0.0),
        ("EPSG:3031", 30.0, -75.0, -30.0),
        ("EPSG:3031", 30.0, -90.0, -30.0),
    ],
)
def test_grid_convergence_of_any_prime_meridian(
    crs: str, lon_deg: float, lat_deg: float, convergence_deg: float
) -> None:
    """Difference of longitude from the central meridian times the sine of the latitude, to 11 arc seconds
    by which national meridians are turned against that of WGS 84."""
    found = MapProjection(crs).grid_convergence_rad(np.array([lon_deg]), lat_deg)
    assert np.degrees(found) == pytest.approx([convergence_deg], abs=0.003)


def test_grid_convergence_of_a_frame_without_a_place_is_unknown() -> None:
    assert np.isnan(MapProjection("EPSG:32632").grid_convergence_rad([np.nan], [np.nan])).all()


def test_a_map_that_proj_has_no_way_into_is_named() -> None:
    with pytest.raises(InputError, match="PROJ knows no way"):
        MapProjection("EPSG:22700").grid_convergence_rad(38.0, 35.0)


@pytest.mark.parametrize("text", ["EPSG:4326", "EPSG:99999", "EPSG:2263", "north"])
def test_a_crs_that_is_no_metric_map_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="such as EPSG:n"):
        map_crs(text)


@pytest.mark.parametrize("name", ["EPSG:5513", "EPSG:2065", "EPSG:2048"])
def test_maps_that_count_south_or_west_are_refused(name: str) -> None:
    """Their mosaics would be mirror images, or upside down."""
    with pytest.raises(InputError, match="mirror image") as refused:
        map_crs(name)
    assert "EPSG:5514" in str(refused.value)


@pytest.mark.parametrize("name", ["EPSG:5514", "EPSG:2193", "EPSG:3031", "EPSG:3413", "EPSG:5041"])
def test_maps_with_any_order_of_axes_and_about_the_poles_are_taken(name: str) -> None:
    assert map_crs(name).to_epsg() == int(name.removeprefix("EPSG:"))
