"""Rendered frames against the collinearity equations worked out by hand, and against the ortho."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic_simulate.buildings import Building, bridge
from geomosaic_simulate.flight import fly
from geomosaic_simulate.landscape import Landscape
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.relief import Relief
from geomosaic_simulate.render import World, develop, render, sight_of
from geomosaic_simulate.survey import world_of
from geomosaic_simulate.terrain import GroundImage

WORK = LocalFrame(11.3, 48.1, 520.0)
MAP = MapProjection("EPSG:32632")
CAMERA = Camera("c", 800, 600, 1000.0, 410.0, 295.0, k1=-0.06, k2=0.01)
PIXEL_M = 0.1


def marker_frame(pose: Pose, east_m: float, north_m: float, world: World) -> tuple[np.ndarray, np.ndarray]:
    """A frame of grey ground with one soft white disc at a place in the work frame, and where it shows."""
    up = float(world.relief.base_m - 520.0)
    easting, northing, _ = world.map_from_enu(np.array([east_m, north_m, up]))
    sight = sight_of(CAMERA, pose, world)
    west, south, east, north = sight.bounds_m
    west_m, north_top_m = np.floor(west) - 2.0, np.ceil(north) + 2.0
    rows, cols = int((north_top_m - south + 3.0) / PIXEL_M), int((east - west_m + 3.0) / PIXEL_M)
    x = west_m + (np.arange(cols) + 0.5) * PIXEL_M - easting
    y = north_top_m - (np.arange(rows) + 0.5) * PIXEL_M - northing
    spot = np.exp(-(x**2 + y[:, None] ** 2) / (2.0 * 0.4**2))
    texture = np.repeat(np.round(40.0 + 200.0 * spot).astype(np.uint8)[..., None], 3, axis=2)
    light = render(CAMERA, pose, world, sight, texture, west_m, north_top_m, PIXEL_M)[..., 1] - 40.0
    light = np.where(light > 5.0, light, 0.0)
    total = light.sum()
    return light, np.array([
        (light.sum(axis=0) * (np.arange(800) + 0.5)).sum() / total,
        (light.sum(axis=1) * (np.arange(600) + 0.5)).sum() / total,
    ])  # fmt: skip


def by_hand(x: float, y: float) -> list[float]:
    """Col and row of ideal image coordinates, x right and y down, over the depth."""
    r_sq = x * x + y * y
    factor = 1.0 - 0.06 * r_sq + 0.01 * r_sq * r_sq
    return [410.0 + 1000.0 * x * factor, 295.0 + 1000.0 * y * factor]


@pytest.mark.parametrize(
    ("yaw_deg", "x", "y"),
    [(0.0, 0.20, -0.12), (90.0, -0.12, -0.20), (180.0, -0.20, 0.12), (270.0, 0.12, 0.20)],
)
def test_a_marker_20_m_east_and_12_m_north_at_the_nadir(yaw_deg: float, x: float, y: float) -> None:
    pose = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(np.radians(yaw_deg), 0.0, 0.0))
    _, found = marker_frame(pose, 20.0, 12.0, World(WORK, MAP, Relief(1, 520.0)))
    np.testing.assert_allclose(found, by_hand(x, y), atol=0.03)


def test_a_marker_under_a_tilted_camera_on_low_ground() -> None:
    pitch = np.radians(9.0)
    pose = Pose(np.array([3.0, -5.0, 96.0]), Rotation.from_yaw_pitch_roll(0.0, pitch, 0.0))
    _, found = marker_frame(pose, 15.0, 22.0, World(WORK, MAP, Relief(1, 512.0)))
    ahead, right, down = 27.0, 12.0, 104.0
    depth = down * np.cos(pitch) + ahead * np.sin(pitch)
    forward = ahead * np.cos(pitch) - down * np.sin(pitch)
    np.testing.assert_allclose(found, by_hand(right / depth, -forward / depth), atol=0.03)


@pytest.mark.parametrize(
    ("frame", "numbers"),
    [
        (5, {}),
        (3, {"relief_m": 20.0, "relief_wavelength_m": 120.0, "k1": -0.1}),
        (0, {"kind": "paper", "scale": 0.25}),
        (
            2,
            {
                "lat_deg": -33.2,
                "lon_deg": 18.9,
                "heading_deg": 250.0,
                "p1": 0.003,
                "principal_col_offset_px": 8.0,
            },
        ),
    ],
    ids=["flat", "hills", "paper", "south"],
)
def test_sight_lines_keep_the_collinearity_equations(frame: int, numbers: dict[str, object]) -> None:
    plan = SurveyPlan(**numbers)  # type: ignore[arg-type]
    flight, camera = fly(plan), plan.camera()
    world, pose = world_of(plan, flight), flight.poses[frame]
    sight = sight_of(camera, pose, world)
    px = np.random.default_rng(0).uniform([0, 0], [camera.width_px, camera.height_px], (3000, 2))
    east, north, height = (s.ev(px[:, 1], px[:, 0]) for s in (sight.easting, sight.northing, sight.height))
    true_height = world.relief.height_at(east, north)
    np.testing.assert_allclose(height, true_height, atol=2e-3)
    back = pose.image_from_ground(camera, world.enu_from_map(east, north, true_height))
    np.testing.assert_allclose(back, px, atol=4e-3)


def test_a_frame_lies_on_the_ortho_everywhere() -> None:
    plan = SurveyPlan(relief_m=15.0, relief_wavelength_m=150.0, width_px=800, height_px=600, k1=-0.08)
    flight, camera = fly(plan), plan.camera()
    world, pose = world_of(plan, flight), flight.poses[1]
    sight = sight_of(camera, pose, world)
    west, south, east, north = sight.bounds_m
    col, row = int(west / 0.1) - 8, int(-north / 0.1) - 8
    shape = (int((north - south) / 0.1) + 17, int((east - west) / 0.1) + 17)
    ortho = GroundImage(Landscape(plan.seed), 0.1).window(col, row, shape)
    frame = render(camera, pose, world, sight, ortho, col * 0.1, -row * 0.1, 0.1)

    e, n = np.meshgrid((col + np.arange(shape[1]) + 0.5) * 0.1, -(row + np.arange(shape[0]) + 0.5) * 0.1)
    px = pose.image_from_ground(camera, world.enu_from_map(e, n, world.relief.height_at(e, n)))
    back = cv2.remap(frame, *(px[..., k].astype(np.float32) - 0.5 for k in (0, 1)), cv2.INTER_CUBIC)
    seen, true = (cv2.GaussianBlur(a[..., 1].astype(np.float64), (0, 0), 1.0) for a in (back, ortho))
    inside = ((px > 8.0) & (px < [792.0, 592.0])).all(axis=-1)
    found = []
    for top in range(0, shape[0] - 80, 80):
        for left in range(0, shape[1] - 80, 80):
            part = np.s_[top : top + 80, left : left + 80]
            if inside[part].all():
                found.append(displacement_px(seen[part], true[part]))
    assert len(found) > 40
    assert np.abs(found).max() < 0.02
    assert np.abs(np.mean(found, axis=0)).max() < 0.002
    assert np.sqrt(np.mean((back[inside] - ortho[inside].astype(float)) ** 2)) < 6.0
    shifted = displacement_px(np.roll(true, 1, axis=1)[100:180, 100:180], true[100:180, 100:180])
    assert shifted[0] == pytest.approx(1.0, abs=0.2), "the measure sees a shift"


def displacement_px(seen: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Where `seen` shows things minus where they are (col, row): least squares on the gradients."""
    mean = (seen + true) / 2.0
    d_row, d_col = np.gradient(mean)
    design = np.stack([d_col.ravel(), d_row.ravel(), mean.ravel(), np.ones(mean.size)], axis=1)
    return np.linalg.lstsq(design, (true - seen).ravel(), rcond=None)[0][:2]


def test_a_building_leans_away_from_the_nadir_by_its_height() -> None:
    building = Building(0.0, 0.0, 6.0, 4.0, 0.3, 12.0, (200, 200, 200), False)
    world = World(WORK, MAP, Relief(1, 520.0))
    at = world.map_from_enu(np.array([18.0, -9.0, 0.0]))
    building = Building(at[0], at[1], 6.0, 4.0, 0.3, 12.0, (200, 200, 200), False)
    world = World(WORK, MAP, Relief(1, 520.0), (building,))
    camera = Camera("c", 800, 600, 1000.0, 400.0, 300.0)
    pose = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    sight = sight_of(camera, pose, world)
    west_m, north_m = np.floor(sight.bounds_m[0]) - 2.0, np.ceil(sight.bounds_m[3]) + 2.0
    texture = np.zeros((720, 960, 3), np.uint8)
    texture[..., 0] = 90
    px = (building.outline_m() - [west_m, north_m]) * [10.0, -10.0] - 0.5
    cv2.fillPoly(texture, [np.round(px * 64).astype(np.int32)], (0, 0, 255), shift=6)
    frame = render(camera, pose, world, sight, texture, west_m, north_m, 0.1)
    roof = (frame[..., 2] > 128) & (frame[..., 0] < 64) & (frame[..., 1] < 64)
    row, col = (a.mean() + 0.5 for a in np.nonzero(roof))
    assert col == pytest.approx(400.0 + 1000.0 * 18.0 / 88.0, abs=0.3)
    assert row == pytest.approx(300.0 + 1000.0 * 9.0 / 88.0, abs=0.3)
    assert roof.sum() == pytest.approx(12.0 * 8.0 * (1000.0 / 88.0) ** 2, rel=0.02)
    wall = (frame[..., 1] > 30) & ~roof
    wall_row, wall_col = (a.mean() for a in np.nonzero(wall))
    assert wall_col < col - 20 and wall_row < row - 5, "walls show on the side of the nadir point"
    ground_only = render(
        camera, pose, World(WORK, MAP, Relief(1, 520.0)), sight, texture, west_m, north_m, 0.1
    )
    flat = ground_only[..., 2] > 128
    assert np.nonzero(flat)[1].mean() + 0.5 == pytest.approx(400.0 + 180.0, abs=0.3)


def plan_frame(buildings: tuple[Building, ...], middle: np.ndarray) -> tuple[np.ndarray, World, Pose]:
    """A frame from 100 m above the work frame's origin. The land's red says how far east of a place it lies
    and its green how far north, 4 levels a metre about 128."""
    world = World(WORK, MAP, Relief(1, 520.0), buildings)
    pose = Pose(np.array([0.0, 0.0, 100.0]), Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0))
    sight = sight_of(CAMERA, pose, world)
    west_m, north_m = np.floor(sight.bounds_m[0]) - 2.0, np.ceil(sight.bounds_m[3]) + 2.0
    east = west_m + (np.arange(960) + 0.5) * PIXEL_M - middle[0]
    north = north_m - (np.arange(720) + 0.5) * PIXEL_M - middle[1]
    bands = np.broadcast_arrays(128.0 + 4.0 * east, 128.0 + 4.0 * north[:, None], 9.0)
    texture = np.clip(np.round(np.stack(bands, axis=-1)), 0, 255).astype(np.uint8)
    return render(CAMERA, pose, world, sight, texture, west_m, north_m, PIXEL_M), world, pose


def off_m(frame: np.ndarray, world: World, pose: Pose, middle: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of points (n, 3) on the map, how far off the frame's colours say they lie (m)."""
    col, row = (np.floor(pose.image_from_ground(CAMERA, world.enu_from_map(*at.T))).astype(int)).T
    return (frame[row, col, :2] - 128.0) / 4.0 - (at[:, :2] - middle[:2])


def test_each_place_on_a_hipped_roof_shows_where_it_stands() -> None:
    middle = World(WORK, MAP, Relief(1, 520.0)).map_from_enu(np.array([18.0, -9.0, 0.0]))
    house = Building(middle[0], middle[1], 7.0, 4.0, 0.3, 6.0, (200, 200, 200), True, ridge_m=2.8)
    frame, world, pose = plan_frame((house,), middle)
    uv = np.stack(np.meshgrid(np.linspace(-6.7, 6.7, 40), np.linspace(-3.7, 3.7, 30)), axis=-1).reshape(-1, 2)
    height = 520.0 + house.roof_m(uv)
    assert height.max() == pytest.approx(528.8, abs=0.1)
    off = off_m(frame, world, pose, middle, np.column_stack([uv @ house.axes + middle[:2], height]))
    assert np.abs(off).max() < 0.25, "a pixel covers 0.1 m, a colour's step 0.25 m"


def test_a_bridge_stands_in_the_air_with_shade_beneath_it() -> None:
    middle = World(WORK, MAP, Relief(1, 520.0)).map_from_enu(np.array([18.0, 0.0, 0.0]))
    parts = bridge(middle[:2] + np.array([[0.0, -20.0], [0.0, 0.0], [0.0, 20.0]]))
    frame, world, pose = plan_frame(parts, middle)
    uv = np.stack(np.meshgrid(np.linspace(-4.4, 4.4, 20), np.linspace(-14.0, 14.0, 40)), axis=-1).reshape(
        -1, 2
    )
    deck = np.column_stack([uv + middle[:2], np.full(len(uv), 527.0)])
    assert np.abs(off_m(frame, world, pose, middle, deck)).max() < 0.25
    land = np.array([[middle[0] - 5.4, middle[1], 520.0], [middle[0] - 4.2, middle[1], 520.0]])
    col, row = np.floor(pose.image_from_ground(CAMERA, world.enu_from_map(*land.T))).astype(int).T
    assert frame[row[0], col[0], 0] == pytest.approx(128.0 - 4.0 * 5.4, abs=1.0), "land before it"
    assert frame[row[1], col[1]] == pytest.approx([58, 57, 52], abs=1.0), "land beneath it"


def test_exposure_does_what_its_numbers_say() -> None:
    light = np.full((300, 400, 3), 100.0, np.float32)
    rng = np.random.default_rng(1)
    plain = develop(light, 1.25, 0.4, 0.0, 0.0, rng)
    assert plain[149, 199, 0] == pytest.approx(125.0, abs=0.1)
    assert plain[0, 0, 1] == pytest.approx(75.0, abs=0.5)
    assert plain[150, 0, 2] == pytest.approx(125.0 * (1.0 - 0.4 * 0.64), abs=0.5)
    noisy = develop(light, 1.0, 0.0, 0.0, 3.0, rng)
    assert noisy.std() == pytest.approx(3.0, rel=0.02)
    assert noisy.mean() == pytest.approx(100.0, abs=0.05)
    assert develop(light, 3.0, 0.0, 0.0, 0.0, rng).max() == 255.0
    edge = np.zeros((60, 60, 3), np.float32)
    edge[:, 30:] = 200.0
    soft = develop(edge, 1.0, 0.0, 2.0, 0.0, rng)[30, :, 0] / 200.0
    assert soft[29] == pytest.approx(0.40, abs=0.02) and soft[31] == pytest.approx(0.77, abs=0.02)
