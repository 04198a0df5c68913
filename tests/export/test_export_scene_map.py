"""A scene of strips on a map: each pixel shows what the RPC sees at its place on the ground."""

from __future__ import annotations

import json
import warnings
import zipfile

import cv2
import numpy as np
import pytest
import rasterio
from osgeo_utils.samples.validate_cloud_optimized_geotiff import validate
from pyproj import Transformer
from rasterio.errors import NotGeoreferencedWarning
from small_surveys import geomosaic
from stac_schema import check_schema

from geomosaic.camera.rpc import Rpc
from geomosaic.export.scene_map import SceneMapOptions, ground_under, scene_rpc_of, write_scene_map
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strips import simulate_strips

PLAN = StripPlan(seed=5, ccds=2, width_px=256, lines=1500, row_separation_lines=300, relief_m=150.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    scene = simulate_strips(folder / "scene", PLAN)
    assert geomosaic("strips", scene.geometry, "-o", folder / "run", "--map") == 0
    return folder / "run", scene.geometry.parent / "dem.tif"


def test_pixels_lie_where_rpc_and_dem_put_them(run):
    folder, dem_file = run
    assert validate(str(folder / "mosaic_map.tif"), full_check=True)[:2] == ([], [])
    with rasterio.open(dem_file) as dem:
        heights, to_dem, crs_dem = dem.read(1).astype(np.float32), ~dem.transform, dem.crs
    with rasterio.open(folder / "mosaic_map.tif") as tiff:
        on_map, valid, transform, crs = tiff.read(1), tiff.dataset_mask() > 0, tiff.transform, tiff.crs
        assert tiff.res == (PLAN.ground_pixel_m, PLAN.ground_pixel_m)
        assert transform.c % PLAN.ground_pixel_m == transform.f % PLAN.ground_pixel_m == 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(folder / "mosaic.tif") as tiff:
            scene, rpc = tiff.read(1).astype(np.float32), Rpc.from_metadata(tiff.tags(ns="RPC"))
    rows, cols = (of[::37] for of in np.nonzero(cv2.erode(valid.astype(np.uint8), np.ones((15, 15)))))
    east, north = transform.c + (cols + 0.5) * transform.a, transform.f + (rows + 0.5) * transform.e
    lon, lat = Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(east, north)
    x, y = Transformer.from_crs("EPSG:4326", crs_dem, always_xy=True).transform(lon, lat)
    col, row = to_dem.a * x + to_dem.c - 0.5, to_dem.e * y + to_dem.f - 0.5
    height = cv2.remap(heights, *(of[:, None].astype(np.float32) for of in (col, row)), cv2.INTER_LINEAR)[
        :, 0
    ]
    at = rpc.image_from_ground(np.column_stack([lon, lat, height])).astype(np.float32) - 0.5
    shifts = [(0.0, 0.0), (0.2, 0.0), (-0.2, 0.0), (0.0, 0.2), (0.0, -0.2)]
    off = [
        np.mean(
            (cv2.remap(scene, at[:, :1] + dx, at[:, 1:] + dy, cv2.INTER_CUBIC)[:, 0] - on_map[rows, cols])
            ** 2
        )
        for dx, dy in shifts
    ]
    assert len(rows) > 5000
    assert min(off[1:]) > 1.3 * off[0], "nowhere but where it is, to a tenth of a pixel"
    for one, other in ((1, 2), (3, 4)):  # a parabola through three
        assert abs(0.1 * (off[one] - off[other]) / (off[one] + off[other] - 2.0 * off[0])) < 0.02


@pytest.mark.parametrize(
    ("kind", "scale", "offset", "unit", "metres"),
    [
        ("float32", 1.0, 0.0, "ft", 0.3048),
        ("int16", 0.1, 500.0, "", 1.0),
        ("int16", 0.5, 900.0, "ft", 0.3048),
    ],
)
def test_a_dem_in_feet_or_with_a_scale_gives_the_same_map(run, tmp_path, kind, scale, offset, unit, metres):
    """Its lower third has nodata: there the RPC's middle height counts, whatever its values are."""
    folder, dem_file = run
    maps = []
    with rasterio.open(dem_file) as dem:
        profile, heights = dem.profile, dem.read(1).astype(np.float64)
    known = np.arange(len(heights)) < 2 * len(heights) // 3
    for number, (type_, by, to, name, m) in enumerate(
        (("float32", 1.0, 0.0, "", 1.0), (kind, scale, offset, unit, metres))
    ):
        path, values = tmp_path / f"dem{number}.tif", (heights / m - to) / by
        with rasterio.open(path, "w", **{**profile, "dtype": type_, "nodata": -32768}) as dem:
            dem.scales, dem.offsets, dem.units = [by], [to], [name]
            dem.write(
                np.where(known[:, None], np.round(values) if type_ == "int16" else values, -32768)[None]
            )
        out, rpc = tmp_path / f"map{number}.tif", scene_rpc_of(folder / "mosaic.tif")
        ground = ground_under(path, folder / "mosaic.tif", rpc)
        write_scene_map(folder / "mosaic.tif", out, SceneMapOptions(PLAN.ground_pixel_m), ground.elevation)
        with rasterio.open(out) as tiff:
            maps.append((tiff.read(1).astype(np.int32), tiff.dataset_mask() > 0, tiff.transform))
    (first, valid, place), (second, same_valid, same_place) = maps
    assert place == same_place and valid.shape == same_valid.shape
    assert (valid != same_valid).mean() < 0.001
    assert np.abs(first - second)[valid & same_valid].mean() < 0.002 * first[valid].std()


def test_the_catalogue_knows_the_scene_and_its_map(run):
    folder, _ = run
    assert geomosaic("export", "stac", folder) == 0
    item = json.loads((folder / "mosaic.stac.json").read_text())
    check_schema(item)
    scene, on_map = (item["assets"][name] for name in ("mosaic", "mosaic_map"))
    assert item["properties"]["proj:code"] is None and "proj:transform" not in scene
    with rasterio.open(folder / "mosaic_map.tif") as tiff:
        assert on_map["proj:code"] == tiff.crs.to_string()
        assert (on_map["proj:shape"], on_map["proj:transform"]) == ([*tiff.shape], [*tiff.transform[:6]])
        assert on_map["bands"][0]["data_type"] == tiff.dtypes[0]
    assert on_map["gsd"] == PLAN.ground_pixel_m


def test_the_scene_on_the_map_is_asked_for_in_one_step_or_later(run, tmp_path):
    """The same bytes, whether the run or the export writes it."""
    folder, _ = run
    (folder / "mosaic_map.tif").rename(tmp_path / "by_run.tif")
    assert geomosaic("export", "map", folder) == 0
    assert (folder / "mosaic_map.tif").read_bytes() == (tmp_path / "by_run.tif").read_bytes()


def test_project_and_tiles_take_the_scene_on_the_map(run):
    folder, _ = run
    with zipfile.ZipFile(folder / "project.qgz") as archive:
        assert b"./mosaic_map.tif" in archive.read("project.qgs")
    assert geomosaic("export", "tiles", folder) == 0
    index = json.loads((folder / "tiles" / "tiles.json").read_text())
    with rasterio.open(folder / "mosaic_map.tif") as tiff:
        box = rasterio.warp.transform_bounds(tiff.crs, "EPSG:4326", *tiff.bounds)
    assert index["bounds"] == pytest.approx(box, abs=1e-6)
