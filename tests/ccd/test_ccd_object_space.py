"""Object space of the strips: heights out of a DEM, the ideal line's layout, RPC and outlines of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import shapely
from osgeo import gdal

from geomosaic.camera.rpc import parse_rpc
from geomosaic.ccd.layout import SceneLayout, image_space_layout
from geomosaic.ccd.model import CcdSettings, StripOffsets
from geomosaic.ccd.object_space import ObjectSpace, level_ground, read_object_space
from geomosaic.ccd.outlines import outlines
from geomosaic.ccd.scene_rpc import scene_rpc
from geomosaic.ccd.virtual_layout import ideal_camera, virtual_layout
from geomosaic.ccd.virtual_line import virtual_line
from geomosaic.composition.strip_compose import PlacedStrips, compose_strips
from geomosaic.doors.raster import OWN, open_raster
from geomosaic.errors import InputError
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.survey import strip_heights
from geomosaic.survey.dem import read_heights
from geomosaic.survey.model import ElevationModel
from geomosaic.survey.strip_heights import read_dem_heights
from geomosaic.survey.strips import StripGeometry, read_geometry
from geomosaic_simulate.strip_overlaps import strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import StripWorld
from geomosaic_simulate.strips import SimulatedStrips, simulate_strips

STILL: dict[str, Any] = {
    "jitter_1hz_px": 0.0, "jitter_5hz_px": 0.0, "jitter_22hz_px": 0.0, "drift_px_per_s": 0.0,
    "drift_angle_deg": 0.0, "mounting_px": 0.0, "thermal_px": 0.0, "course_deg": 180.0,
}  # fmt: skip
PLAN = StripPlan(
    ccds=3, width_px=256, lines=3000, seed=11, relief_m=600.0, relief_wavelength_m=4000.0, targets=24,
    jitter_1hz_px=0.3, jitter_22hz_px=0.2, snr=0.0, gain_sd=0.0, offset_sd=0.0, column_sd=0.0,
)  # fmt: skip


@dataclass(frozen=True)
class Made:
    files: SimulatedStrips
    geometry: StripGeometry
    space: ObjectSpace
    scene: StripWorld
    targets: Any


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    files = simulate_strips(tmp_path_factory.mktemp("strips"), PLAN)
    geometry = read_geometry(files.geometry)
    space = read_object_space(geometry)
    assert space is not None
    assert files.targets is not None
    return Made(
        files, geometry, space, StripWorld(PLAN), np.genfromtxt(files.targets, delimiter=",", names=True)
    )


def ground_of(targets: Any) -> Any:
    return np.stack([targets[k] for k in ("lon_deg", "lat_deg", "height_ellipsoidal_m")], axis=-1)


def strip_place(layout: SceneLayout, ccd: int, x: float, y: float) -> Any:
    """Strip col and line at raster col x and row y, straight between the rows' middles."""
    row = int(np.floor(y - 0.5))
    places = layout.places(ccd, row, row + 2)
    at = np.array([[np.interp(x, places.knots_px, v[r]) for r in (0, 1)] for v in places.image_px])
    return at[:, 0] + (y - 0.5 - row) * (at[:, 1] - at[:, 0])


# Heights


def test_heights_are_the_dems_tile_by_tile(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    west, south, east, north = made.scene.bounds_m
    e, n = rng.uniform(west + 30.0, east - 30.0, (40, 20)), rng.uniform(south + 30.0, north - 30.0, (40, 20))
    lonlat = made.scene.projection.geodetic_from_map(e, n)
    true = made.scene.relief.height_at(e, n)
    assert np.ptp(true) > 500.0
    np.testing.assert_allclose(made.space.height_at(lonlat[..., 0], lonlat[..., 1]), true, atol=0.15)
    # The same from small tiles, few of which are kept, as from the whole raster
    monkeypatch.setattr(strip_heights, "_TILE_PX", 16)
    monkeypatch.setattr(strip_heights, "_MOST_TILES", 3)
    heights = read_dem_heights(made.files.dem, lonlat.reshape(-1, 2))
    whole = read_heights(ElevationModel(str(made.files.dem), 0.0, ""), (west, south, east, north)).at(e, n)
    np.testing.assert_allclose(heights(lonlat[..., 0], lonlat[..., 1]), whole, atol=1e-4)
    assert len(heights._tiles) <= 3
    assert [w.code for w in heights.warnings] == ["dem-datum-assumed"]


def test_gaps_take_the_nearest_height_and_the_edge_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "dem.tif"
    height = np.full((40, 50), 100.0, np.float32) + 2.0 * np.arange(50, dtype=np.float32)
    height[10:20, 20:30] = -9999.0
    profile = {
        "driver": "GTiff",
        "width": 50,
        "height": 40,
        "count": 1,
        "dtype": "float32",
        "nodata": -9999.0,
    }
    transform = rasterio.Affine(10.0, 0.0, 500000.0, 0.0, -10.0, 4000400.0)
    with rasterio.open(path, "w", crs="EPSG:32648", transform=transform, **profile) as dem:
        dem.write(height, 1)
    utm = MapProjection("EPSG:32648")
    x = np.array([500005.0, 500030.0, 500215.0, 500600.0])
    y = np.array([4000395.0, 4000100.0, 4000255.0, 4000200.0])
    lonlat = utm.geodetic_from_map(x, y)
    heights = read_dem_heights(path, lonlat)
    np.testing.assert_allclose(heights(*lonlat.T), [100.0, 105.0, 138.0, 198.0], atol=0.01)
    assert heights.span_m == pytest.approx((100.0, 138.0), abs=0.01)
    # One place of four is in a void, another beyond the DEM.
    text = "dem.tif: no heights for 50 % of the scene, where the nearest are used: "
    assert (heights.warnings[-1].code, heights.warnings[-1].text[: len(text)]) == ("dem-gaps", text)
    assert [w.code for w in read_dem_heights(path, lonlat[:2]).warnings] == ["dem-datum-assumed"]
    with pytest.raises(InputError, match=r"dem.tif: the DEM does not cover the strips; give a DEM of"):
        read_dem_heights(path, lonlat[3:])


def test_object_space_without_model_without_dem_and_with_tables_too_short(made: Made) -> None:
    assert read_object_space(replace(made.geometry, model=None)) is None
    flat = read_object_space(replace(made.geometry, dem=None))
    assert flat is not None
    level = float(parse_rpc(made.files.rpc.read_text()).offset[4])
    assert flat.height_at(np.array([100.0, 101.0]), np.array([38.0, 38.0])).tolist() == [level, level]
    assert 850.0 < level < 1000.0
    bare = read_object_space(replace(made.geometry, dem=None, rpc=None))
    assert bare is not None
    assert bare.mean_m == 0.0
    longer = replace(made.geometry, lines=(3000, 12000, 3000))
    with pytest.raises(
        InputError, match=r"model.yaml: has orbit of -1.500 to 2.500 s, but strips of 3.667 s"
    ):
        read_object_space(longer)


# Layout


def test_layout_of_a_perfect_camera_is_the_nominal_one() -> None:
    """Level at 900 m; then 466 m higher, which the leading row sees a line later, the trailing one earlier."""
    plan = StripPlan(ccds=3, width_px=256, lines=2600, relief_m=0.0, first_row=2, **STILL)
    g, model = plan.geometry(), StripWorld(plan).cameras.true
    layout = virtual_layout(g, level_ground(model, 900.0))
    assert (layout.first_line, layout.height_px, layout.width_px) == (-1057.0, 4714, 576)
    assert [layout.cols(k) for k in range(3)] == [(0, 256), (160, 416), (320, 576)]
    assert layout.seams_px == pytest.approx((208.0, 368.0), abs=0.01)
    for ccd, line in ((0, 2300.25 + 1057.0), (1, 2300.25 - 1057.0)):
        at = strip_place(layout, ccd, ccd * 160 + 100.5, 2300.25 - layout.first_line)
        np.testing.assert_allclose(at, [100.5, line], atol=0.01)
    high = virtual_layout(g, level_ground(model, 1366.0))
    for ccd, moved in ((0, -1.0), (1, 1.0)):
        at = strip_place(high, ccd, ccd * 160 + 100.5, 2300.25 - high.first_line)
        assert at[1] - 2300.25 - (-1057.0 if ccd == 1 else 1057.0) == pytest.approx(moved, abs=0.01)
    common = virtual_layout(g, level_ground(model, 900.0), "common")
    assert (common.first_line, common.height_px) == (1057.0, 486)
    with pytest.raises(InputError, match="no lines in common"):
        virtual_layout(replace(g, lines=(300, 2600, 2600)), level_ground(model, 900.0), "common")


def test_ideal_camera_has_neither_jitter_nor_drift() -> None:
    """A drift of 5 px/s stays as a slope of the attitude; waves go."""
    scene = StripWorld(StripPlan(ccds=4, lines=4000, seed=4))
    camera = ideal_camera(scene.plan.geometry(), scene.cameras.true)
    line = np.linspace(0.0, 4000.0, 41)
    attitude = camera.attitude_rad(line)
    assert np.abs(np.diff(attitude, n=2, axis=0)).max() < 1e-15
    waves = (attitude - scene.cameras.true.attitude_rad(line)) / scene.plan.pixel_rad
    assert 0.5 < np.abs(waves[:, 1]).max() < 3.0
    assert np.abs(waves[:, :2].mean(axis=0)).max() < 0.1


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.proof)])
def test_places_between_knots_are_the_models_own(seed: int) -> None:
    """Jitter of 22 Hz and half a pixel over 900 m of relief, at random places of every CCD at full width."""
    plan = StripPlan(ccds=4, width_px=4096, lines=4000, seed=seed, relief_m=900.0, jitter_22hz_px=0.5)
    scene = StripWorld(plan)

    def height_at(lon: Any, lat: Any) -> Any:
        xy = scene.projection.map_from_geodetic(lon, lat)
        return scene.relief.height_at(xy[..., 0], xy[..., 1])

    space = ObjectSpace(scene.cameras.true, height_at, scene.relief.base_m)
    layout = virtual_layout(plan.geometry(), space)
    rng = np.random.default_rng(seed)
    for ccd in range(4):
        top = 500 + ccd if plan.row(ccd) == 2 else 2500 + ccd
        rows = rng.integers(0, 203, 60)
        first, last = layout.cols(ccd)
        x = rng.uniform(first, last, 60)
        places = layout.places(ccd, top, top + 203)
        assert places.image_px.shape == (2, 203, len(places.knots_px))
        assert places.knots_px[0] <= first < last <= places.knots_px[-1]
        found = [
            [np.interp(a, places.knots_px, v[r]) for a, r in zip(x, rows, strict=True)]
            for v in places.image_px
        ]
        height = np.full(60, 900.0)
        for _ in range(8):
            ground = layout.camera.ground_from_image(0, x, layout.first_line + top + rows + 0.5, height)
            height = height_at(ground[:, 0], ground[:, 1])
        true = scene.cameras.true.image_from_ground(ccd, ground, found[1], found[0])
        assert true[:, 1].min() > 0.0
        np.testing.assert_allclose(found, true.T, atol=0.003)


def test_a_target_in_two_ccds_has_one_place(made: Made) -> None:
    layout = virtual_layout(made.geometry, made.space)
    camera = layout.camera
    found = 0
    for target in made.targets:
        place = camera.image_from_ground(0, ground_of(target), 1500.0, 300.0) - [0.0, layout.first_line]
        at = strip_place(layout, int(target["ccd"]) - 1, *place)
        np.testing.assert_allclose(at, [target["col_px"], target["line_px"]], atol=0.005)
        found += 1
    assert found > 20
    both = [t for t in np.unique(made.targets["target"]) if (made.targets["target"] == t).sum() == 2]
    assert len(both) >= 5


def test_the_composed_scene_is_the_true_one(made: Made, tmp_path: Path) -> None:
    """Against the image of the simulation's own ideal line: no shift of 0.01 px is left."""
    layout = virtual_layout(made.geometry, made.space, "common")
    compose_strips(PlacedStrips(made.geometry, layout), tmp_path / "scene.tif")
    with open_raster(tmp_path / "scene.tif", OWN) as raster:
        composed = raster.read(1).astype(np.float64)
        valid = raster.dataset_mask() > 0
    assert made.files.true_scene is not None
    with open_raster(made.files.true_scene, OWN) as raster:
        true = raster.read(1).astype(np.float32)
    cols, rows = np.arange(16, layout.width_px - 16, 8), np.arange(4, layout.height_px - 4, 8)
    x, t = np.meshgrid(cols + 0.5, layout.first_line + rows + 0.5)
    ground = layout.camera.ground_from_image(0, x, t, 900.0)
    seen = made.scene.cameras.ideal.image_from_ground(0, ground, t, x)
    assert 1.0 < np.abs(seen - np.stack([x, t], axis=-1)).max() < 60.0
    # Where the true image has each raster pixel: smooth, so straight between every 8th
    wide = cv2.resize(
        (seen - np.stack([x, t], axis=-1)).astype(np.float32), (8 * len(cols), 8 * len(rows)),
        interpolation=cv2.INTER_LINEAR,
    )  # fmt: skip
    r, c = np.mgrid[rows[0] - 3 : rows[-1] + 5, cols[0] - 3 : cols[-1] + 5]
    at_x = (c + wide[..., 0]).astype(np.float32)
    at_y = (r + layout.first_line + wide[..., 1]).astype(np.float32)
    # Lanczos on both sides: OpenCV's cubic, Keys' with a = -0.75, itself shifts by up to 0.048 px
    wanted = cv2.GaussianBlur(cv2.remap(true, at_x, at_y, cv2.INTER_LANCZOS4), (0, 0), 1.5)[8:-8, 8:-8]
    got = cv2.GaussianBlur(composed[r, c].astype(np.float32), (0, 0), 1.5)[8:-8, 8:-8]
    good = valid[r, c][8:-8, 8:-8]
    assert good.mean() > 0.99
    slope_y, slope_x = np.gradient(wanted)
    rest = (got - wanted)[good]
    design = np.stack([slope_x[good], slope_y[good]], axis=1)
    shift = np.linalg.lstsq(design, rest, rcond=None)[0]
    assert np.abs(shift).max() < 0.01
    assert rest.std() < 0.03 * wanted.std()


# RPC and outlines


def written(path: Path, layout: SceneLayout, rpc: Any) -> None:
    gdal.UseExceptions()
    raster = gdal.GetDriverByName("GTiff").Create(str(path), layout.width_px, layout.height_px, 1)
    raster.SetMetadata(rpc.metadata(), "RPC")
    raster = None


def by_gdal(path: Path, ground: Any) -> Any:
    """Raster cols and rows where GDAL's RPC transformer has ground points."""
    found = []
    for lon, lat, height in ground:
        options = ["METHOD=RPC", f"RPC_HEIGHT={height:.6f}"]
        transformer = gdal.Transformer(gdal.Open(str(path)), None, options)
        ok, point = transformer.TransformPoint(1, lon, lat, 0.0)
        assert ok
        found.append(point[:2])
    return np.array(found)


@pytest.mark.parametrize(("kind", "within_px"), [("virtual", 0.02), ("image", 1.0)])
def test_gdal_lands_on_the_targets_by_the_scenes_rpc(
    made: Made, tmp_path: Path, kind: str, within_px: float
) -> None:
    """In image space the raster keeps the jitter that all CCDs share, and no RPC can follow it."""
    if kind == "virtual":
        layout: SceneLayout = virtual_layout(made.geometry, made.space)
    else:
        strips = strips_in_memory(made.geometry, [])
        strips.object_space = made.space
        pairs = virtual_line(strips, CcdSettings(), lambda _done, _total: None)
        layout = image_space_layout(made.geometry, StripOffsets("virtual_line", pairs))
    found = scene_rpc(made.geometry, layout, made.space)
    assert found is not None
    assert found.rms_px is not None
    assert found.rms_px < within_px / 2.0
    path = tmp_path / "scene.tif"
    written(path, layout, found.rpc)
    places = by_gdal(path, ground_of(made.targets))
    for target, place in zip(made.targets, places, strict=True):
        if 1.0 < place[1] < layout.height_px - 1.0:
            at = strip_place(layout, int(target["ccd"]) - 1, *place)
            np.testing.assert_allclose(at, [target["col_px"], target["line_px"]], atol=within_px)


def test_an_rpc_alone_is_moved_to_the_rasters_first_line(made: Made) -> None:
    geometry = replace(made.geometry, model=None)
    layout = image_space_layout(geometry, StripOffsets("none", ()))
    assert layout.first_line == -1057.0
    moved = scene_rpc(geometry, layout, None)
    assert moved is not None
    assert moved.rms_px is None
    given = parse_rpc(made.files.rpc.read_text())
    ground = ground_of(made.targets)
    apart = moved.rpc.image_from_ground(ground) - given.image_from_ground(ground)
    np.testing.assert_allclose(apart, np.broadcast_to([0.0, 1057.0], apart.shape), atol=1e-6)
    assert scene_rpc(replace(geometry, rpc=None), layout, None) is None


def test_outlines_hold_the_targets_that_each_ccd_sees(made: Made) -> None:
    layout = virtual_layout(made.geometry, made.space)
    rpc = scene_rpc(made.geometry, layout, made.space)
    by_model = outlines(made.geometry, layout, made.space, rpc)
    by_rpc = outlines(replace(made.geometry, model=None), layout, None, rpc)
    assert by_model is not None
    assert by_rpc is not None
    assert outlines(made.geometry, layout, None, None) is None
    for k, ring in by_model.ccds.items():
        assert (ring[0] == ring[-1]).all()
        polygon = shapely.Polygon(ring)
        assert polygon.is_valid
        seen = set(made.targets["target"][made.targets["ccd"] == k + 1])
        for target in made.targets:
            point = shapely.Point(target["lon_deg"], target["lat_deg"])
            assert polygon.contains(point) == (target["target"] in seen)
        np.testing.assert_allclose(by_rpc.ccds[k], ring, atol=20.0 / 1.1e5)
    first = layout.camera.ground_from_image(0, 0.0, layout.first_line, 900.0)
    np.testing.assert_allclose(by_model.scene[0], first[:2], atol=5.0 / 1.1e5)
    np.testing.assert_allclose(by_rpc.scene, by_model.scene, atol=5.0 / 1.1e5)
    assert shapely.Polygon(by_model.scene).contains(shapely.Polygon(by_model.ccds[1]).buffer(-1e-4))


# Attitudes with noise


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> tuple[StripGeometry, ObjectSpace]:
    """Attitudes at 400 Hz with noise of 20 microradians, so that lines look back and forth."""
    plan = replace(PLAN, lines=2600, relief_m=0.0, targets=0, attitude_noise_urad=20.0)
    geometry = read_geometry(simulate_strips(tmp_path_factory.mktemp("noisy"), plan, scene=False).geometry)
    space = read_object_space(geometry)
    assert space is not None
    return geometry, space


def test_noisy_attitudes_give_a_scene_whose_lines_are_read_once(
    noisy: tuple[StripGeometry, ObjectSpace], tmp_path: Path
) -> None:
    """Ground that no line sees, or many do, took every block to the strip's first line, or NaN to a traceback."""
    geometry, space = noisy
    layout = virtual_layout(geometry, space)
    assert abs(layout.height_px - 4714) < 30
    assert np.isfinite(layout.shift_lines).all()
    lost = layout.places(0, 2400, 3424).image_px[1] < -1e5
    assert 0.0 < lost.mean() < 0.1
    rpc = scene_rpc(geometry, layout, space)
    assert rpc is not None
    assert rpc.rms_px is not None
    assert rpc.rms_px < 1.0
    mosaic = compose_strips(PlacedStrips(geometry, layout), tmp_path / "scene.tif")
    assert max(mosaic.lines_read) < 1.05 * 2600


def test_attitudes_that_no_line_is_found_by_are_named(noisy: tuple[StripGeometry, ObjectSpace]) -> None:
    geometry, space = noisy
    wild = np.random.default_rng(1).normal(0.0, 1e-2, space.model.roll_pitch_yaw_rad.shape)
    model = replace(space.model, roll_pitch_yaw_rad=wild)
    with pytest.raises(
        InputError, match=r"attitudes are too noisy: .*; smooth the attitudes, or use --set mosaic"
    ):
        virtual_layout(geometry, replace(space, model=model))
