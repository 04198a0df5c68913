"""`geomosaic measure`: known lines, squares and heaps, and their deviations against chance."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely
from osgeo import gdal, osr
from pyproj import CRS
from small_surveys import geomosaic, summary

from geomosaic.doors.vector import LINE, POLYGON, read_shapes
from geomosaic.export.accuracy import BANDS
from geomosaic.quality.measured import area_of, length_of, volume_of
from geomosaic.quality.run_measures import RunRasters, measure_polygons

UTM = CRS.from_user_input("EPSG:32632")


def geojson(path: Path, kind: str, *shapes: list[Any], crs: str = "EPSG:32632") -> Path:
    """Coordinates of shapes in a map CRS."""
    features = [
        {"type": "Feature", "properties": {}, "geometry": {"type": kind, "coordinates": s}} for s in shapes
    ]
    name = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{crs.partition(':')[2]}"}}
    path.write_text(
        json.dumps({"type": "FeatureCollection", "crs": {"type": "name", **name}, "features": features})
    )
    return path


def shaken(shape: Any, sd_m: np.ndarray, times: int = 20_000) -> np.ndarray:
    """Lines or polygons (times,) whose vertices are off by chance, alike where rings close."""
    at = shapely.get_coordinates(shape)
    off = np.random.default_rng(2).normal(size=(times, *at.shape)) * sd_m[:, None]
    if shape.geom_type == "LineString":
        return shapely.linestrings(at + off)
    off[:, -1] = off[:, 0]
    return shapely.polygons(at + off)


def test_a_length_is_off_as_its_vertices_are() -> None:
    line = shapely.LineString([[0, 0], [30, 0], [30, 40], [10, 70]])
    sd_m = np.array([0.1, 0.2, 0.1, 0.3])
    found = length_of(line, sd_m, 0.0, None)
    assert found.value == pytest.approx(30.0 + 40.0 + np.hypot(20.0, 30.0))
    assert found.sd == pytest.approx(shapely.length(shaken(line, sd_m)).std(), rel=0.02)
    assert length_of(line, sd_m, 0.01, None).sd == pytest.approx(np.hypot(found.sd, 0.01 * found.value))


def test_vertices_on_a_straight_line_add_nothing() -> None:
    ends = shapely.LineString([[0, 0], [100, 0]])
    many = shapely.segmentize(ends, 1.0)
    assert length_of(ends, np.full(2, 0.1), 0.0, None).sd == pytest.approx(0.1 * np.sqrt(2.0))
    assert length_of(many, np.full(101, 0.1), 0.0, None).sd == pytest.approx(0.1 * np.sqrt(2.0))


def test_an_area_is_off_as_its_vertices_are() -> None:
    corner = shapely.Polygon([[0, 0], [40, 0], [45, 30], [0, 50]])
    sd_m = np.array([0.1, 0.2, 0.1, 0.3, 0.1])
    found = area_of(corner, sd_m, 0.0, None)
    assert found.sd == pytest.approx(shapely.area(shaken(corner, sd_m)).std(), rel=0.02)
    hole = shapely.box(10.0, 10.0, 20.0, 20.0)
    holed = shapely.Polygon(corner.exterior.coords, [hole.exterior.coords])
    both = area_of(holed, np.concatenate([sd_m, np.full(5, 0.1)]), 0.0, None)
    assert both.value == pytest.approx(corner.area - 100.0)
    assert both.sd == pytest.approx(np.hypot(found.sd, area_of(hole, np.full(5, 0.1), 0.0, None).sd))


def test_the_ellipsoid_counts_where_the_map_is_out_of_scale() -> None:
    """On UTM's central meridian 1 m is 0.9996 m of map; 180 km off it the map is true."""
    line = shapely.LineString([[500_000.0, 5_300_000.0], [500_000.0, 5_301_000.0]])
    found = length_of(line, np.zeros(2), 0.0, UTM)
    assert found.ellipsoidal == pytest.approx(1000.0 / 0.9996, rel=1e-6)
    square = shapely.box(500_000.0, 5_300_000.0, 500_100.0, 5_300_100.0)
    assert area_of(square, np.zeros(5), 0.0, UTM).ellipsoidal == pytest.approx(1e4 / 0.9996**2, rel=1e-6)
    shifted = shapely.transform(line, lambda at: at + [180_000.0, 0.0])
    assert length_of(shifted, np.zeros(2), 0.0, UTM).ellipsoidal is None


def test_the_ellipsoid_of_a_system_in_grads_is_as_large_as_any() -> None:
    """On the parallel of contact of Lambert's zone II, 52 grads, 1 m is 0.99987742 m of map."""
    lambert = CRS("EPSG:27572")
    line = shapely.LineString([[600_000.0, 2_199_500.0], [600_000.0, 2_200_500.0]])
    found = length_of(line, np.zeros(2), 0.0, lambert)
    assert found.ellipsoidal == pytest.approx(1000.0 / 0.99987742, rel=1e-6)
    square = shapely.box(599_950.0, 2_199_950.0, 600_050.0, 2_200_050.0)
    found = area_of(square, np.zeros(5), 0.0, lambert)
    assert found.ellipsoidal == pytest.approx(1e4 / 0.99987742**2, rel=1e-6)


def test_a_heap_on_tilted_ground_has_its_own_volume() -> None:
    """A heap of 5 x 5 m and 2 m, a pit half as large, on a slope."""
    at = np.stack(np.meshgrid(np.arange(0.25, 30.0, 0.5), np.arange(0.25, 20.0, 0.5)), axis=-1).reshape(-1, 2)
    up = 400.0 + 0.2 * at[:, 0] - 0.1 * at[:, 1]
    up += 2.0 * (np.abs(at - [8.0, 8.0]) < 2.5).all(axis=1) - 1.0 * (np.abs(at - [20.0, 10.0]) < 2.5).all(
        axis=1
    )
    rim = shapely.get_coordinates(shapely.segmentize(shapely.box(0.0, 0.0, 30.0, 20.0).exterior, 0.5))[:-1]
    on_rim = np.column_stack([rim, 400.0 + 0.2 * rim[:, 0] - 0.1 * rim[:, 1]])
    found = volume_of(
        np.column_stack([at, up]), on_rim, np.full(len(at), 0.03), np.full(len(rim), 0.04), 0.25
    )
    assert (found.above, found.below) == (pytest.approx(50.0), pytest.approx(25.0))
    assert found.sd == pytest.approx(600.0 * 0.05)


def raster(path: Path, bands: list[np.ndarray], nodata: float = -9999.0, epsg: int = 32632) -> Path:
    """Pixels of 1 m from (600000, 5300100)."""
    rows, cols = bands[0].shape
    made = gdal.GetDriverByName("GTiff").Create(str(path), cols, rows, len(bands), gdal.GDT_Float32)
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(epsg)
    made.SetSpatialRef(reference)
    made.SetGeoTransform((600_000.0, 1.0, 0.0, 5_300_100.0, 0.0, -1.0))
    for number, values in enumerate(bands, start=1):
        made.GetRasterBand(number).SetNoDataValue(nodata)
        made.GetRasterBand(number).WriteArray(values.astype(np.float32))
    made.GetRasterBand(1).SetMetadataItem("STATISTICS_MINIMUM", "0.4")
    made.FlushCache()
    return path


def test_the_surface_of_a_run_gives_volumes_and_none_past_its_end(tmp_path: Path) -> None:
    """100 km off UTM's meridian 1 m is 0.99972299 m of map: a heap of 100 m² by 3 m has 300.17 m³."""
    up, sd = np.full((100, 100), 350.0), np.full((100, 100), 0.1)
    up[40:50, 40:50] += 3.0
    up[:, 90:] = -9999.0
    rasters = RunRasters(
        raster(tmp_path / "accuracy.tif", [np.full((100, 100), 0.5)], float("nan")),
        {"mosaic": {"gsd_m": 0.1}, "metrics": {"seams": {"median_px": 2.0}}},
        raster(tmp_path / "surface.tif", [up]),
        raster(tmp_path / "surface_confidence.tif", [sd, 0.0 * sd]),
    )
    square = [
        [600_020.0, 5_300_080.0],
        [600_080.0, 5_300_080.0],
        [600_080.0, 5_300_020.0],
        [600_020.0, 5_300_020.0],
    ]
    beyond = [[x + 30.0, y] for x, y in square]
    file = geojson(tmp_path / "heap.geojson", "Polygon", [[*square, square[0]]], [[*beyond, beyond[0]]])
    _, (heap, past) = measure_polygons(rasters, read_shapes(file, POLYGON), file)
    assert heap.volume is not None
    assert (heap.volume.above, heap.volume.below) == (pytest.approx(300.1663, abs=1e-4), 0.0)
    assert heap.volume.sd == pytest.approx(3600.0 / 0.99972299**2 * 0.1 * np.sqrt(2.0), rel=1e-5)
    assert past.volume is None and np.isnan(past.area.sd)
    own_m = np.sqrt(0.5**2 - 0.4**2 + (0.1 * np.hypot(2.0 / 2.0 / np.sqrt(np.log(2.0)), 12**-0.5)) ** 2)
    assert heap.area.sd == pytest.approx(own_m * np.sqrt(4 * (60.0**2 + 60.0**2) / 4.0), rel=1e-3)


def test_a_volume_on_a_map_out_of_scale_is_that_on_the_ground(tmp_path: Path) -> None:
    """Mercator at 43 degrees north, where its parallels are 1.36347 and its meridians 1.36839 times as long."""
    up, one = np.full((100, 100), 350.0), np.ones((100, 100))
    up[40:50, 40:50] += 3.0
    paths = [tmp_path / f"{name}.tif" for name in ("accuracy", "surface", "confidence")]
    of = zip(paths, (one, up, one), strict=True)
    accuracy, surface, confidence = (raster(path, [values], epsg=3857) for path, values in of)
    square = [[600_020.0, 5_300_080.0], [600_080.0, 5_300_080.0], [600_080.0, 5_300_020.0]]
    ring = [*square, [600_020.0, 5_300_020.0], square[0]]
    file = geojson(tmp_path / "heap.geojson", "Polygon", [ring], crs="EPSG:3857")
    _, (heap,) = measure_polygons(
        RunRasters(accuracy, {}, surface, confidence), read_shapes(file, POLYGON), file
    )
    assert heap.volume is not None and heap.area.ellipsoidal is not None
    assert heap.volume.above == pytest.approx(160.7927, abs=1e-4)
    assert heap.volume.above / 300.0 == pytest.approx(heap.area.ellipsoidal / heap.area.value)


def test_a_run_has_an_accuracy_raster_on_its_mosaics_grid(few_run: Path) -> None:
    metrics = summary(few_run)["metrics"]["accuracy"]
    with rasterio.open(few_run / "accuracy.tif") as tiff, rasterio.open(few_run / "mosaic.tif") as of:
        assert tiff.crs == of.crs and tiff.descriptions == tuple(name for name, _ in BANDS)
        assert (tiff.transform.c, tiff.transform.f) == (of.transform.c, of.transform.f)
        assert tiff.transform.a == pytest.approx(16 * of.transform.a)
        assert (tiff.width, tiff.height) == (-(-of.width // 16), -(-of.height // 16))
        shown = of.dataset_mask()[8::16, 8::16] > 0
        horizontal, vertical, source = tiff.read()[:, : shown.shape[0], : shown.shape[1]]
        assert np.isfinite(horizontal[shown]).mean() > 0.99
        assert np.isnan(vertical).all() and metrics["vertical_median_m"] is None
        assert set(source[shown]) == {1.0, 4.0}
    assert metrics["horizontal_median_m"] == pytest.approx(np.nanmedian(horizontal), rel=0.05)
    assert 0.1 < metrics["horizontal_median_m"] < metrics["horizontal_95_m"] < 1.0
    assert metrics["share"]["tie_surface"] > 0.5


def test_the_project_of_a_run_shows_its_accuracy(few_run: Path) -> None:
    with zipfile.ZipFile(few_run / "project.qgz") as archive:
        text = archive.read("project.qgs").decode()
    assert text.count("<datasource>./accuracy.tif</datasource>") == 2
    assert "Accuracy in plan" in text and "Where heights come from" in text


def test_the_report_of_a_run_shows_its_accuracy(few_run: Path) -> None:
    assert "Accuracy in plan" in (few_run / "report.html").read_text(encoding="utf-8")


def middle_of(run: Path) -> tuple[float, float]:
    with rasterio.open(run / "mosaic.tif") as tiff:
        west, south, east, north = tiff.bounds
    return (west + east) / 2.0, (south + north) / 2.0


def test_a_line_and_a_square_of_a_run(
    few_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """True lengths are stated within the stated deviations' reach; what all of the map is off by cancels."""
    east, north = middle_of(few_run)
    line = geojson(tmp_path / "line.geojson", "LineString", [[east - 15, north], [east + 15, north]])
    ring = [
        [east - 10, north - 10],
        [east + 10, north - 10],
        [east + 10, north + 10],
        [east - 10, north + 10],
    ]
    square = geojson(tmp_path / "square.geojson", "Polygon", [[*ring, ring[0]]])
    assert geomosaic("measure", few_run, "--line", line, "--polygon", square, "--json") == 0
    output = json.loads(capsys.readouterr().out)
    (length,), (area,) = output["lines"], output["polygons"]
    assert length["length_m"] == pytest.approx(30.0, abs=1e-6) and area["area_m2"] == pytest.approx(
        400.0, abs=1e-6
    )
    assert "length_ellipsoidal_m" not in length  # 171 km from the meridian a map in UTM is true to 4e-5
    run_summary = summary(few_run)
    by_scale_m = 30.0 * 1e-3 * run_summary["accuracy"]["relative"]["scale_permille"]
    absolute = run_summary["metrics"]["accuracy"]["horizontal_median_m"]
    assert by_scale_m < length["length_sd_m"] < np.hypot(by_scale_m, absolute)
    by_scale_m2 = 2.0 * 400.0 * by_scale_m / 30.0
    assert by_scale_m2 < area["area_sd_m2"] < np.hypot(by_scale_m2, 20.0 * np.sqrt(2.0) * absolute)
    assert area["volume_above_m3"] is None and "cancel" in output["assumed"]
    assert geomosaic("measure", few_run, "--line", line) == 0
    out = capsys.readouterr().out
    assert "length_sd_m" in out and "30.000" in out and "cancel" in out


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda folder, run: [], "give --line FILE or --polygon FILE"),
        (lambda folder, run: ["--line", folder / "none.geojson"], "none.geojson"),
        (lambda folder, run: ["--line", geojson(folder / "p.geojson", "Point", [0.0, 0.0])], "has no line"),
        (
            lambda folder, run: ["--polygon", geojson(folder / "x.geojson", "Polygon",
                                                      [[[0, 0], [9, 9], [9, 0], [0, 9], [0, 0]]])],
            "crosses itself",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_measured_is_one_line(
    make: Any, says: str, few_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert geomosaic("measure", few_run, *make(tmp_path, few_run)) == 2
    said = capsys.readouterr()
    assert said.out == "" and len(said.err.strip().splitlines()) == 1 and says in said.err


def test_a_run_without_the_raster_says_which_stage_makes_it(
    few_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = geojson(tmp_path / "line.geojson", "LineString", [[0.0, 0.0], [1.0, 0.0]])
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "run.json").write_bytes((few_run / "run.json").read_bytes())
    assert geomosaic("measure", bare, "--line", line) == 2
    assert "accuracy.tif" in capsys.readouterr().err
    assert geomosaic("measure", tmp_path, "--line", line) == 2
    assert "is no finished run" in capsys.readouterr().err


def test_lines_are_read_out_of_multilines(tmp_path: Path) -> None:
    file = geojson(
        tmp_path / "two.geojson", "MultiLineString", [[[0.0, 0.0], [1.0, 0.0]], [[2.0, 0.0], [2.0, 3.0]]]
    )
    assert [shapely.length(line) for line in read_shapes(file, LINE).geometries] == [1.0, 3.0]
