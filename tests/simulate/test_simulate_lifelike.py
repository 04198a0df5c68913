"""What real surveys have besides noise: rolling shutters, real ground, water, smooth canopies, traffic."""

from __future__ import annotations

import csv
import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from small_surveys import simulated

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.errors import InputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic_simulate.changing import cars_at, changes_at, paint_changes
from geomosaic_simulate.flight import fly
from geomosaic_simulate.landscape import Landscape
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.rasters import square_mean
from geomosaic_simulate.readout import FrameReadout
from geomosaic_simulate.relief import Relief
from geomosaic_simulate.render import World, render, sight_of
from geomosaic_simulate.survey import simulate_frames, world_of

PLAN = SurveyPlan(
    seed=4, lines=1, frames_per_line=2, width_px=320, height_px=240, height_above_ground_m=60.0,
    pixel_noise=0.0, format="tiff8", pos_in="csv",
)  # fmt: skip
LON, LAT = 9.7, 46.5


def hill_m(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """A tilted plane with a ridge, of offsets from the middle."""
    return 1400.0 + 0.08 * east - 0.03 * north + 9.0 * np.cos(2.0 * np.pi * (east + 0.5 * north) / 260.0)


def write_dem(path: Path, half_m: float) -> tuple[float, float]:
    """A DEM of 2 m pixels in EPSG:32632 about LON, LAT; returns that middle's easting and northing."""
    east_0, north_0 = MapProjection("EPSG:32632").map_from_geodetic(LON, LAT)
    at = (np.arange(int(half_m)) + 0.5) * 2.0 - half_m
    heights = hill_m(at[None, :], -at[:, None]).astype(np.float32)
    to_map = Affine(2.0, 0.0, east_0 - half_m, 0.0, -2.0, north_0 + half_m)
    with rasterio.open(
        path, "w", driver="GTiff", width=at.size, height=at.size, count=1, dtype="float32",
        crs="EPSG:32632", transform=to_map,
    ) as out:  # fmt: skip
        out.write(heights, 1)
    return float(east_0), float(north_0)


def test_a_rolling_shutter_sees_each_row_from_where_the_camera_is_then() -> None:
    camera = Camera("c", 800, 600, 1000.0, 410.0, 295.0)
    world = World(LocalFrame(11.3, 48.1, 520.0), MapProjection("EPSG:32632"), Relief(1, 520.0))
    pose = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    sight = sight_of(camera, pose, world, FrameReadout(0.5, np.array([12.0, -4.0, 0.0])))
    for col, row, east_m, north_m in (
        (410.0, 300.0, 0.0, -0.5),  # the middle row: the pose itself, 5 rows below the principal point
        (410.0, 0.0, -3.0, 29.5 + 1.0),
        (610.0, 600.0, 20.0 + 3.0, -30.5 - 1.0),
        (310.0, 150.0, -10.0 - 1.5, 14.5 + 0.5),
    ):
        seen = [float(s.ev(row, col)) for s in (sight.easting, sight.northing)]
        true = world.map_from_enu(np.array([east_m, north_m, 0.0]))[:2]
        np.testing.assert_allclose(seen, true, atol=2e-3)


def test_truth_holds_the_course_that_the_shutter_needs(tmp_path: Path) -> None:
    plan = dataclasses.replace(
        PLAN, rolling_shutter_s=0.04, heading_deg=90.0, speed_m_per_s=12.0, wander_m=0.0
    )
    survey = simulated(tmp_path / "rolling", plan)
    truth = json.loads(survey.truth.read_text())
    np.testing.assert_allclose(truth["frames"][0]["velocity_enu_m_per_s"], [12.0, 0.0, 0.0], atol=1e-9)
    assert truth["plan"]["rolling_shutter_s"] == 0.04
    still = simulated(tmp_path / "still", dataclasses.replace(plan, rolling_shutter_s=0.0))
    a, b = (cv2.imread(str(s.frames / "F0001.tif")).astype(float) for s in (survey, still))
    middle, edge = np.abs(a - b)[118:122].mean(), np.abs(a - b)[:4].mean()
    assert middle < 1.0 < edge, "the middle row is the pose's own"


def test_the_ground_is_that_of_the_dem(tmp_path: Path) -> None:
    east_0, north_0 = write_dem(tmp_path / "ground.tif", 200.0)
    plan = dataclasses.replace(PLAN, dem=tmp_path / "ground.tif", lon_deg=LON, lat_deg=LAT)
    survey = simulated(tmp_path / "out", plan)
    truth = json.loads(survey.truth.read_text())
    middle = float(hill_m(np.array(0.0), np.array(0.0)))
    assert truth["plan"]["ground_height_m"] == pytest.approx(middle, abs=0.05)
    assert truth["plan"]["dem"] == "ground.tif"
    with survey.positions.open(newline="") as f:
        heights = [float(row["height_ellipsoidal_m"]) for row in csv.DictReader(f)]
    assert heights == pytest.approx([middle + 60.0] * 2, abs=4.0)
    with rasterio.open(survey.dem) as dem:
        offsets = np.array([[-12.0, 9.0], [7.0, -11.0], [15.0, 14.0], [0.0, 3.0]])
        found = [v[0] for v in dem.sample(np.add(offsets, [east_0, north_0]))]
    np.testing.assert_allclose(found, hill_m(*offsets.T), atol=0.15)


def test_frames_on_a_dem_keep_the_collinearity_equations(tmp_path: Path) -> None:
    write_dem(tmp_path / "ground.tif", 200.0)
    plan = dataclasses.replace(
        PLAN, dem=tmp_path / "ground.tif", lon_deg=LON, lat_deg=LAT, ground_height_m=1409.0
    )
    flight, camera = fly(plan), plan.camera()
    world, pose = world_of(plan, flight), flight.poses[1]
    sight = sight_of(camera, pose, world)
    px = np.random.default_rng(0).uniform([0, 0], [320, 240], (1000, 2))
    east, north = (s.ev(px[:, 1], px[:, 0]) for s in (sight.easting, sight.northing))
    ground = world.enu_from_map(east, north, world.relief.height_at(east, north))
    np.testing.assert_allclose(pose.image_from_ground(camera, ground), px, atol=0.02)


def test_a_dem_that_ends_within_the_survey_is_refused(tmp_path: Path) -> None:
    write_dem(tmp_path / "small.tif", 20.0)
    plan = dataclasses.replace(PLAN, dem=tmp_path / "small.tif", lon_deg=LON, lat_deg=LAT)
    with pytest.raises(InputError, match=r"small.tif: the DEM has no heights for \d+ % of the survey"):
        simulate_frames(tmp_path / "out", plan)
    with pytest.raises(InputError, match="does not cover"):
        simulate_frames(tmp_path / "out", dataclasses.replace(plan, lon_deg=12.0))
    with pytest.raises(InputError, match="both a DEM and hills"):
        dataclasses.replace(plan, relief_m=10.0)


def test_water_and_canopy_have_no_texture_and_water_shines_anew(tmp_path: Path) -> None:
    plan = dataclasses.replace(PLAN, water_share=1.0, buildings=0.0, forward_overlap=0.95)
    survey = simulate_frames(tmp_path, plan)
    assert survey.cover is not None
    with rasterio.open(survey.cover) as cover, rasterio.open(survey.ortho) as ortho:
        water, image = cover.read(1) == 1, ortho.read()
        assert (cover.transform, cover.shape) == (ortho.transform, ortho.shape)
        inside = ortho.dataset_mask() > 0
    inner = cv2.erode((water & inside).astype(np.uint8), np.ones((9, 9))) > 0
    assert inner.sum() > 10_000
    np.testing.assert_array_equal(image[:, inner].std(axis=1) < 0.5, True)
    frames = [cv2.imread(str(survey.frames / f"F000{i}.tif")).astype(float) for i in (1, 2)]
    assert np.abs(frames[0] - frames[1]).mean() > 2.0
    forest = Landscape(4, 1.0, 0.0, 1.0)
    assert {p.cover for p in forest.parcels((0.0, 0.0, 500.0, 500.0))} == {"smooth_forest"}


@pytest.mark.proof
def test_shares_are_of_the_land() -> None:
    cells = [c.cover for c in Landscape(9, 1.0, 0.2, 0.3).parcels((0.0, 0.0, 4000.0, 4000.0))]
    assert cells.count("water") / len(cells) == pytest.approx(0.2, abs=0.03)
    assert cells.count("smooth_forest") / len(cells) == pytest.approx(0.3, abs=0.03)
    with pytest.raises(InputError, match="more than all land"):
        SurveyPlan(water_share=0.7, smooth_forest_share=0.4)


def test_cars_are_where_truth_says_and_nothing_else_changed(tmp_path: Path) -> None:
    plan = dataclasses.replace(PLAN, seed=6, width_px=800, height_px=600, frames_per_line=1)
    empty = simulate_frames(tmp_path / "empty", plan)
    busy = simulate_frames(tmp_path / "busy", dataclasses.replace(plan, moving_cars=3.0))
    assert busy.moving_cars is not None and empty.moving_cars is None
    assert empty.ortho.read_bytes() == busy.ortho.read_bytes()
    with busy.moving_cars.open(newline="") as f:
        cars = [(float(row["easting_m"]), float(row["northing_m"])) for row in csv.DictReader(f)]
    a, b = (cv2.imread(str(s.frames / "F0001.tif")).astype(float) for s in (empty, busy))
    flight, camera = fly(plan), plan.camera()
    world = world_of(plan, flight)
    px = [
        flight.poses[0].image_from_ground(
            camera, world.enu_from_map(np.array(e), np.array(n), np.array(520.0))
        )
        for e, n in cars
    ]
    px = [p for p in px if (p > 30).all() and p[0] < 770 and p[1] < 570]
    assert len(px) >= 3
    changed = np.abs(a - b).max(axis=2) > 4.0
    near = np.zeros(changed.shape, np.uint8)
    for col, row in px:
        assert changed[int(row) - 6 : int(row) + 7, int(col) - 6 : int(col) + 7].mean() > 0.5
    for col, row in px:
        cv2.circle(near, (int(col), int(row)), 32, 255, -1)
    assert changed[40:560, 40:760][near[40:560, 40:760] == 0].mean() < 0.01


def test_a_tree_leans_away_from_the_nadir_point() -> None:
    """A tree of 8 m at 30 m from the nadir point: its tip shows at 30 * 100 / 92 m."""
    camera = Camera("c", 800, 600, 1000.0, 400.0, 300.0)
    world = World(LocalFrame(11.3, 48.1, 520.0), MapProjection("EPSG:32632"), Relief(1, 520.0))
    east_m, north_m, _ = world.map_from_enu(np.array([30.0, -6.0, 0.0]))
    standing = dataclasses.replace(world, trees=np.array([[east_m, north_m, 3.0, 8.0]]))
    pose = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    sight = sight_of(camera, pose, world)
    west_m, top_m = np.floor(sight.bounds_m[0]) - 2.0, np.ceil(sight.bounds_m[3]) + 2.0
    texture = np.zeros((700, 900, 3), np.uint8)
    for name, radius_m in (("crown", 3.0), ("tip", 0.5)):
        col, row = (east_m - west_m) * 10.0 - 0.5, (top_m - north_m) * 10.0 - 0.5
        paint = (90, 90, 0) if name == "crown" else (0, 0, 255)
        cv2.circle(texture, (round(col * 64), round(row * 64)), round(radius_m * 640), paint, -1, shift=6)
    flat, raised = (render(camera, pose, w, sight, texture, west_m, top_m, 0.1) for w in (world, standing))
    centres = []
    for frame in (flat, raised):
        rows, cols = np.nonzero(frame[..., 2] > 128)
        centres.append((cols.mean() + 0.5, rows.mean() + 0.5))
    assert centres[0] == pytest.approx((700.0, 360.0), abs=0.3)
    assert centres[1] == pytest.approx((400.0 + 300.0 / 0.92, 300.0 + 60.0 / 0.92), abs=1.5)
    z = np.linspace(0.0, 8.0, 200)
    edge_m = ((30.0 + 3.0 * np.sqrt(1.0 - z / 8.0)) / (1.0 - z / 100.0)).max()
    assert edge_m > 33.4
    far = np.nonzero((raised > 40).any(axis=(0, 2)))[0].max() + 1.0
    assert far == pytest.approx(400.0 + 10.0 * edge_m, abs=1.5), "it hides the ground behind it"


def test_standing_trees_are_in_the_surface_model_and_not_in_the_ortho(tmp_path: Path) -> None:
    flat = simulate_frames(tmp_path / "flat", PLAN)
    tall = simulate_frames(tmp_path / "tall", dataclasses.replace(PLAN, trees_stand=True))
    assert flat.ortho.read_bytes() == tall.ortho.read_bytes()
    assert tall.dsm is not None and flat.dsm is None
    with rasterio.open(tall.dsm) as dsm:
        trees = Landscape(PLAN.seed).trees_in(tuple(dsm.bounds))
        inside = (np.abs(trees[:, :2] - [np.mean(dsm.bounds[::2]), np.mean(dsm.bounds[1::2])]) < 30.0).all(
            axis=1
        )
        top = np.array([v[0] for v in dsm.sample(trees[inside, :2])])
        assert float(dsm.read(1).min()) == pytest.approx(520.0, abs=0.01)
    assert inside.sum() > 3
    assert (top > 520.0 + 0.9 * trees[inside, 3]).all()


def test_cars_drive_along_their_road() -> None:
    land, bounds = Landscape(9), (0.0, 0.0, 800.0, 800.0)
    now, then = cars_at(land, 1.5, 1000.0, bounds), cars_at(land, 1.5, 1000.1, bounds)
    assert 60 < len(now) < 300
    nearest = np.linalg.norm(then[None, :, :2] - now[:, None, :2], axis=2)
    j = nearest.argmin(axis=1)
    step = then[j, :2] - now[:, :2]
    moved = np.linalg.norm(step, axis=1)
    ahead = (step * np.column_stack([np.cos(now[:, 2]), np.sin(now[:, 2])])).sum(axis=1)
    share = np.mean((moved > 0.7) & (moved < 1.9) & (ahead > 0.6))
    assert share > 0.9, "0.8 to 1.8 m in a tenth of a second, forward"
    assert cars_at(land, 0.0, 1000.0, bounds).shape == (0, 4)


def test_the_ortho_is_the_mean_over_each_pixels_square() -> None:
    """A wave of wavelength 5 pixels: the box takes sin(pi / 5) / (pi / 5) of its amplitude."""
    wave = 128.0 + 100.0 * np.cos(2.0 * np.pi * np.arange(60) / 5.0)
    texture = np.repeat(np.round(wave).astype(np.uint8)[None, :, None], 60, axis=0).repeat(3, axis=2)
    mean = square_mean(texture)[30, 5:55, 1].astype(float) - 128.0
    amplitude = 2.0 / 50.0 * abs((mean * np.exp(2j * np.pi * np.arange(5, 55) / 5.0)).sum())
    assert amplitude == pytest.approx(100.0 * np.sin(np.pi / 5.0) / (np.pi / 5.0), rel=0.03)


def test_an_epoch_is_another_flight_over_the_same_ground() -> None:
    plan = SurveyPlan(seed=4, lines=1, frames_per_line=3)
    first, again, later = (fly(dataclasses.replace(plan, epoch=epoch)) for epoch in (0, 0, 1))
    assert (first.poses.positions_m == again.poses.positions_m).all()
    off = np.linalg.norm(first.poses.positions_m - later.poses.positions_m, axis=1)
    assert (off > 0.01).all() and (off < 20.0).all()


def test_changes_are_squares_of_the_ground_apart_from_each_other() -> None:
    land, bounds = Landscape(4), (100.0, 200.0, 160.0, 260.0)
    squares = changes_at(land, 5, 1.0, bounds)
    assert squares.shape == (5, 4) and (changes_at(land, 5, 1.0, bounds) == squares).all()
    assert squares[:, 2] - squares[:, 0] == pytest.approx([1.0] * 5)
    middle = squares[:, :2] + 0.5
    assert ((middle > bounds[:2]) & (middle < bounds[2:])).all()
    apart = np.linalg.norm(middle[:, None] - middle[None], axis=2)[np.triu_indices(5, 1)]
    assert apart.min() > 5.0
    for grey, painted in ((60, 225), (200, 40)):
        window = np.full((600, 600, 3), grey, np.uint8)
        paint_changes(window, squares, 100.0, 260.0, 0.1)
        changed = (window != grey).any(axis=2)
        assert changed.sum() == 500 and window[changed][:, 0].max() in (painted, grey)
        row, col = round((260.0 - middle[0, 1]) / 0.1), round((middle[0, 0] - 100.0) / 0.1)
        assert changed[row, col]
