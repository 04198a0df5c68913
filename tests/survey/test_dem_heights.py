"""DEMs as people have them: undeclared fills, scales, damage, maps that lie nowhere, and far too fine ones."""

from __future__ import annotations

import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio import Affine
from rasterio.errors import NotGeoreferencedWarning
from small_surveys import mosaic, small_survey, summary

from geomosaic.errors import FileError, InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.relief import relief
from geomosaic.survey.dem import HeightRaster, read_heights
from geomosaic.survey.dem_outliers import outliers
from geomosaic.survey.elevation import check_dem
from geomosaic.survey.model import ElevationModel
from geomosaic.survey.strip_heights import read_dem_heights
from geomosaic_simulate.survey import SimulatedSurvey

UTM = "EPSG:32632"
EAST, NORTH = 500_000.0, 5_400_000.0


def hills(rows: int = 120, cols: int = 160) -> np.ndarray:
    """Heights between 480 and 560 m, slopes up to 40 %, on pixels of 10 m."""
    row, col = np.mgrid[:rows, :cols]
    rough = np.random.default_rng(3).normal(0.0, 0.3, (rows, cols))
    return (520.0 + 25.0 * np.sin(row / 9.0) + 15.0 * np.cos(col / 13.0) + rough).astype(np.float32)


def write(path: Path, values: np.ndarray, pixel_m: float = 10.0, **profile: object) -> Path:
    """A north-up GeoTIFF whose north-west corner is (EAST, NORTH)."""
    band = {key: profile.pop(key) for key in ("scales", "offsets", "units") if key in profile}
    given: dict[str, object] = {"driver": "GTiff", "count": 1, "crs": UTM, "dtype": values.dtype}
    given |= {"transform": Affine(pixel_m, 0.0, EAST, 0.0, -pixel_m, NORTH)}
    given |= {"height": values.shape[0], "width": values.shape[1]} | profile
    with rasterio.open(path, "w", **given) as file:
        file.write(values, 1)
        for key, value in band.items():
            setattr(file, key, (value,))
    return path


def read(path: Path, finest: float = 0.0) -> HeightRaster:
    """All of a DEM."""
    with rasterio.open(path) as file:
        bounds = tuple(file.bounds)
    return read_heights(ElevationModel(str(path), 0.0, ""), bounds, finest)


@pytest.mark.parametrize("fill", [-9999.0, -32768.0, 1e38, -3.4e38, 9999.0, 65535.0, 0.0, -99.0])
@pytest.mark.parametrize("finest", [0.0, 35.0])
def test_undeclared_fills_are_unknown(tmp_path: Path, fill: float, finest: float) -> None:
    values = hills()
    values[20:60, 30:90] = fill
    values[100, 10:14] = fill
    found = read(write(tmp_path / "dem.tif", values), finest)
    low, high = np.nanmin(found.height_ellipsoidal_m), np.nanmax(found.height_ellipsoidal_m)
    assert low > 475.0 and high < 565.0
    assert found.outliers and found.outliers[0][0] == pytest.approx(fill)
    share = np.isnan(found.height_ellipsoidal_m).mean()
    assert 0.12 < share < (0.13 if finest == 0.0 else 0.2)
    if finest == 0.0:
        assert found.outliers[0][1] == 40 * 60 + 4


def test_lone_pixels_far_off_are_unknown() -> None:
    values = hills().astype(float)
    values[5, 5], values[50, 60], values[51, 60] = 700.0, 300.0, 250.0
    assert np.argwhere(outliers(values)).tolist() == [[5, 5], [50, 60], [51, 60]]


def test_what_is_ground_stays() -> None:
    """Hills, a lake, the sea next to a cliff, terraces, a flat roof, a plain, and one height alone."""
    lake = np.maximum(hills(), np.float32(510.0)).astype(float)
    coast = np.tile(np.repeat([0.0, 14.0, 30.0, 33.0], 30), (90, 1))
    coast[:, 60:] += np.random.default_rng(1).normal(0.0, 0.2, (90, 60))
    roof = np.full((90, 120), 100.0)
    roof[40:60, 40:70] = 180.0
    quarry = np.full((90, 120), 100.0)
    quarry[40:60, 40:70] = 85.0
    mountain = 1000.0 + 45.0 * np.abs(np.arange(100) - 50.0)[:, None] + np.zeros((100, 80))
    for ground in (hills().astype(float), lake, coast, roof, quarry, mountain, np.zeros((50, 50))):
        assert not outliers(ground).any()
        holes = ground.copy()
        holes[10:14, 10:14] = np.nan
        assert not outliers(holes).any()


def test_scale_offset_and_unit_of_the_band_count(tmp_path: Path) -> None:
    stored = np.rint((hills() - 400.0) / 0.01).astype(np.int16)
    path = write(tmp_path / "dem.tif", stored, nodata=-32768, scales=0.01, offsets=400.0)
    np.testing.assert_allclose(read(path).height_ellipsoidal_m, hills(), atol=0.006)
    for scale in (0.0, float("nan")):
        path = write(tmp_path / "bad.tif", stored, scales=scale)
        with pytest.raises(FileError, match=r"bad\.tif: the DEM's scale is (0|nan)"):
            check_dem(path)
    with pytest.raises(InputError, match=r"old\.tif: the DEM's heights are in fathom; convert them"):
        check_dem(write(tmp_path / "old.tif", hills(), units="fathom"))
    us_m = 1200.0 / 3937.0
    feet = [(name, 0.3048) for name in ("ft", "Foot", "foot (International)")]
    feet += [(name, us_m) for name in ("US survey foot", "us-ft", "Foot_US", "feet (US)", "U.S. survey feet")]
    for unit, metres in (*feet, ("metre", 1.0)):
        path = write(tmp_path / "unit.tif", hills() / metres, units=unit)
        np.testing.assert_allclose(read(path).height_ellipsoidal_m, hills(), atol=1e-3)
    with pytest.raises(InputError, match=r"wave\.tif: the DEM's values are complex64"):
        check_dem(write(tmp_path / "wave.tif", hills().astype(np.complex64)))


@pytest.mark.parametrize(("vertical", "metres"), [(6360, 1200.0 / 3937.0), (8228, 0.3048), (5703, 1.0)])
def test_the_unit_of_the_vertical_system_counts(tmp_path: Path, vertical: int, metres: float) -> None:
    """NAVD88 in US survey feet, in international feet and in metres; the band states no unit."""
    path = write(tmp_path / "dem.tif", hills() / metres)
    (tmp_path / "dem.vrt").write_text(
        f'<VRTDataset rasterXSize="160" rasterYSize="120"><SRS>{UTM}+{vertical}</SRS>'
        f"<GeoTransform>{EAST}, 10, 0, {NORTH}, 0, -10</GeoTransform>"
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="1">dem.tif'
        "</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    for file in (
        path.with_suffix(".vrt"),
        write(tmp_path / "own.tif", hills() / metres, crs=f"{UTM}+{vertical}"),
    ):
        np.testing.assert_allclose(read(file).height_ellipsoidal_m, hills(), atol=1e-3)


@pytest.mark.parametrize(
    ("crs", "words"),
    [
        (
            'LOCAL_CS["site grid",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]',
            "'site grid' is a Engineering",
        ),
        ("EPSG:4978", "is a Geocentric CRS"),
    ],
)
def test_maps_that_lie_nowhere(tmp_path: Path, crs: str, words: str) -> None:
    path = write(tmp_path / "dem.tif", hills(), crs=crs)
    with pytest.raises(InputError, match=words):
        check_dem(path)


def test_a_place_that_is_no_number(tmp_path: Path) -> None:
    path = tmp_path / "dem.vrt"
    write(tmp_path / "dem.tif", hills())
    for bad in ("nan, 10, 0, 5e6, 0, -10", "1e308, 1e308, 0, 5e6, 0, -1e308"):
        path.write_text(
            f'<VRTDataset rasterXSize="160" rasterYSize="120"><SRS>{UTM}</SRS><GeoTransform>{bad}</GeoTransform>'
            '<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="1">dem.tif'
            "</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
        )
        with pytest.raises(FileError, match=r"is no number|has no coordinate"):
            check_dem(path)
    model = ElevationModel(str(tmp_path / "dem.tif"), 0.0, "")
    for bounds in ((np.inf, 0.0, np.inf, 1.0), (np.nan,) * 4, (1e300, 1e300, 2e300, 2e300)):
        with pytest.raises(FileError, match="does not cover"):
            read_heights(model, bounds)  # type: ignore[arg-type]


def test_a_truncated_dem_is_one_clear_line(tmp_path: Path) -> None:
    path = write(tmp_path / "dem.tif", hills(), compress="deflate")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(FileError, match=r"dem\.tif: .*; (copy it again|give a DEM)"):
        read_heights(ElevationModel(str(path), 0.0, ""), (EAST, NORTH - 1200.0, EAST + 1600.0, NORTH))
    grid = tmp_path / "grid.asc"
    grid.write_text("ncols 40\nnrows 40\nxllcorner 5e5\nyllcorner 5399600\ncellsize 10\n" + "500 " * 700)
    (tmp_path / "grid.prj").write_text(rasterio.CRS.from_string(UTM).to_wkt())
    with pytest.raises(FileError, match=r"grid\.asc: can't be read whole; copy it again"):
        read_heights(ElevationModel(str(grid), 0.0, ""), (EAST, NORTH - 400.0, EAST + 400.0, NORTH))


def test_strips_hear_of_outliers_too(tmp_path: Path) -> None:
    values = hills()
    values[20:60, 30:90] = -9999.0
    path = write(tmp_path / "dem.tif", values)
    lonlat = MapProjection(UTM).geodetic_from_map(EAST + np.arange(50.0, 1500.0, 50.0), NORTH - 600.0)
    heights = read_dem_heights(path, lonlat)
    assert 475.0 < heights.span_m[0] < heights.span_m[1] < 565.0
    (warning,) = [w for w in heights.warnings if w.code == "dem-outliers"]
    assert warning.text.startswith("dem.tif: 2,400 heights") and "-9999 m (2,400 times)" in warning.text


def test_a_very_fine_dem_is_read_no_finer_than_asked(tmp_path: Path) -> None:
    """16 million pixels of 0.05 m, 200 m x 200 m, for nodes of 0.4 m."""
    row, col = np.mgrid[:4000, :4000].astype(np.float32)
    values = 500.0 + row / 400.0 + 3.0 * np.sin(col / 900.0)
    path = write(tmp_path / "dsm.tif", values, 0.05, tiled=True, compress="deflate", predictor=3)
    del row, col, values
    tracemalloc.start()
    found = read(path, 0.4)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.height_ellipsoidal_m.shape == (500, 500) and found.pixel_x == pytest.approx(0.4)
    assert peak < 40e6
    assert found.height_ellipsoidal_m[250, 0] == pytest.approx(500.0 + 2003.5 / 400.0 + 3.5 / 300.0, abs=1e-3)


def test_the_surface_of_a_dem_is_exact_between_its_knots() -> None:
    """A level DEM 4 km wide in UTM, off the central meridian: its ellipsoidal height everywhere, bent with the Earth."""
    frame = LocalFrame(11.3, 48.1, 500.0)
    middle = MapProjection(UTM).map_from_geodetic(11.3, 48.1)
    west, north = middle + [-2600.0, 2600.0]
    slope = np.arange(520.0)[None, :] * 0.5
    raster = HeightRaster(500.0 + slope + np.zeros((520, 1)), UTM, float(west), float(north), 10.0, 10.0)
    began = time.perf_counter()
    ground = relief(frame, raster, np.array([-2000.0, -2000.0]), np.array([2000.0, 2000.0]), 4.0)
    assert time.perf_counter() - began < 20.0
    rows, cols = (np.linspace(0, n - 1, 23).astype(int) for n in ground.up_m.shape)
    enu = np.array(
        [
            (
                ground.east_0_m + c * ground.spacing_m,
                ground.north_0_m + r * ground.spacing_m,
                ground.up_m[r, c],
            )
            for r in rows
            for c in cols
        ]
    )
    lon, lat, height = frame.geodetic_from_enu(enu).T
    xy = MapProjection(UTM).map_from_geodetic(lon, lat)
    np.testing.assert_allclose(height, raster.at(*xy.T), atol=1e-5)


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> SimulatedSurvey:
    """One line of three frames with a DEM."""
    size = {"width_px": 320, "height_px": 240}
    return small_survey(tmp_path_factory.mktemp("dem"), lines=1, frames_per_line=3, seed=31, **size)


def test_a_dem_with_a_hole_of_9999_gives_the_pixel_it_gave_without(
    survey: SimulatedSurvey, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with rasterio.open(survey.dem) as file:
        values, profile = file.read(1), {**file.profile, "nodata": None}
    rows, cols = values.shape
    values[: rows // 3, : cols // 3] = -9999.0
    dem = tmp_path / "dem.tif"
    with rasterio.open(dem, "w", **profile) as file:
        file.write(values, 1)
    run = tmp_path / "run"
    given = ["--pos", survey.pos, "--camera", survey.camera, "--adjust", "least_squares", "--dem-offset", 0]
    assert mosaic(survey.frames, run, *given, "--dem", dem) == 0
    run_summary = summary(run)
    assert run_summary["mosaic"]["gsd_m"] == pytest.approx(0.1, rel=0.1)
    (text,) = [w["text"] for w in run_summary["warnings"] if w["code"] == "dem-outliers"]
    assert "-9999 m" in text and "dem.tif" in text
    bare = tmp_path / "bare.vrt"
    bare.write_text(
        f'<VRTDataset rasterXSize="9" rasterYSize="9"><SRS>{UTM}</SRS><GeoTransform>5e5,9,0,5e6,0,-9</GeoTransform>'
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename>/gone.tif</SourceFilename>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    assert mosaic(survey.frames, tmp_path / "other", *given, "--dem", bare) == 2
    assert "bare.vrt: its source '/gone.tif' is not there; copy it too" in capfd.readouterr().err


@pytest.mark.proof
def test_a_dem_whose_heights_are_in_feet_is_named(survey: SimulatedSurvey, tmp_path: Path) -> None:
    """Its unit is not stated: the frames' altitudes show that it lies 1,200 m too high."""
    dem, run = tmp_path / "dem.tif", tmp_path / "run"
    with rasterio.open(survey.dem) as file:
        values, profile = file.read(1) / 0.3048, file.profile
    with rasterio.open(dem, "w", **profile) as file:
        file.write(values.astype(profile["dtype"]), 1)
    given = ["--camera", survey.camera, "--adjust", "least_squares", "--dem-offset", 0]
    assert mosaic(survey.frames, run, *given, "--dem", survey.dem) == 0
    assert "dem-heights-off" not in {w["code"] for w in summary(run)["warnings"]}
    assert mosaic(survey.frames, run, *given, "--dem", dem) == 0
    (text,) = [w["text"] for w in summary(run)["warnings"] if w["code"] == "dem-heights-off"]
    assert "m above the ground by the frames' altitudes: its heights may be in feet" in text
    assert summary(run)["verdict"]["grade"] == "doubtful"


def test_a_raster_without_a_place_is_named(tmp_path: Path) -> None:
    path = tmp_path / "dem.tif"
    with pytest.warns(NotGeoreferencedWarning):
        write(path, hills(), crs=None, transform=Affine.identity())
    with pytest.raises(InputError, match="no coordinate reference system"):
        check_dem(path)


def test_a_dem_in_degrees_crosses_the_180th_meridian() -> None:
    """A plane that rises 2000 m a degree to the east, read as GDAL gives it: from 179.9 to 180.1 degrees."""
    frame = LocalFrame(179.998, -16.8, 0.0)
    pixel = 2e-4
    slope = 2000.0 * pixel * (np.arange(1000.0) + 0.5)
    raster = HeightRaster(np.tile(slope, (1000, 1)), "EPSG:4326", 179.9, -16.7, pixel, pixel)
    ground = relief(frame, raster, np.full(2, -600.0), np.full(2, 600.0), 20.0)
    east_m = np.array([-500.0, 0.0, 150.0, 300.0, 500.0])
    up_m = ground.up_at(east_m, np.zeros(5))
    lon = frame.geodetic_from_enu(np.column_stack([east_m, np.zeros(5), up_m]))[:, 0]
    assert lon[0] > 179.0 and lon[-1] < -179.0
    assert up_m == pytest.approx(2000.0 * ((lon - 179.9) % 360.0), abs=0.1)
