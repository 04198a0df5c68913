"""Where frames see sweep, what hides them, and how neighbours' costs are summed."""

from __future__ import annotations

import dataclasses
import tracemalloc

import cv2
import numpy as np
import pytest

from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.aggregation import aggregated, cheapest, ring
from geomosaic.surface.agreement import agreeing
from geomosaic.surface.cells import Cells
from geomosaic.surface.census import census
from geomosaic.surface.costs import PER_BIT, SweepHeights, census_costs
from geomosaic.surface.plane_sweep import PlaneSweep, SweepView
from geomosaic.surface.squares import Squares
from geomosaic.surface.tile_sgm import search_steps
from geomosaic.surface.visibility import asked_frames, hidden_below

LEVEL = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
CAMERA = Camera("test", 800, 600, 700.0, 400.0, 300.0, k1=-0.05)


def looking_down(east_m: float, north_m: float, up_m: float = 100.0, yaw_deg: float = 20.0) -> Pose:
    rotation = Rotation.from_yaw_pitch_roll(*np.radians([yaw_deg, 2.0, -1.5]))
    return Pose(np.array([east_m, north_m, up_m]), rotation)


def test_places_are_the_collinearity_equations() -> None:
    pose = looking_down(3.0, -4.0)
    cells = Cells(-70.0, -60.0, 0.5, 240, 280)
    sweep = PlaneSweep(cells, LEVEL, [SweepView(pose, CAMERA, 2.0)], -10.0, 30.0)
    east, north = cells.axes_m()
    for height_m in (-8.0, 0.0, 13.0, 28.0):
        points = np.stack(np.broadcast_arrays(east, north[:, None], height_m), axis=-1)
        col, row = np.moveaxis(pose.image_from_ground(CAMERA, points), -1, 0)
        seen = (col >= 0.0) & (col <= 800.0) & (row >= 0.0) & (row <= 600.0)
        places = sweep.places(0, sweep.bent(np.full(seen.shape, height_m, dtype=np.float32)))
        for found, true in zip(places, (col / 2.0 - 0.5, row / 2.0 - 0.5), strict=True):
            assert seen.sum() > 10_000
            assert float(np.abs(found - true)[seen].max()) < 0.15


def test_a_frame_sees_up_to_its_rim_where_high_points_are_out_of_its_lens() -> None:
    """Verticals whose top no lens shows are fitted by their foot."""
    pose = looking_down(0.0, 0.0, yaw_deg=0.0)
    narrow = dataclasses.replace(CAMERA, k1=-0.35)
    cells = Cells(-60.0, -45.0, 0.5, 180, 240)
    sweep = PlaneSweep(cells, LEVEL, [SweepView(pose, narrow, 1.0)], -10.0, 60.0)
    east, north = cells.axes_m()
    points = np.stack(np.broadcast_arrays(east, north[:, None], 0.0), axis=-1)
    col, row = np.moveaxis(pose.image_from_ground(narrow, points), -1, 0)
    inside = (col >= 0.0) & (col <= 800.0) & (row >= 0.0) & (row <= 600.0)
    found = sweep.places(0, np.zeros(inside.shape, dtype=np.float32))[0]
    assert np.isfinite(found[inside]).all()


def test_a_wall_hides_what_lies_behind_it() -> None:
    pose = looking_down(40.0, 0.0)
    cells = Cells(-10.0, -10.0, 1.0, 20, 20)
    sweep = PlaneSweep(cells, LEVEL, [SweepView(pose, CAMERA, 1.0)], -5.0, 30.0)
    land = np.zeros((20, 20), dtype=np.float32)
    land[:, 12] = 8.0  # a wall to the east, where the camera is
    low = hidden_below(sweep, 0, land, 1.0)
    behind, away_m = low[10, 10], 2.0
    # the line of sight over the wall's top falls by 100 / 40 a metre; what is a cell too low counts as seen
    assert behind == pytest.approx(8.0 - away_m * 100.0 / 40.0 - 1.0, abs=1.7)
    assert low[10, 15] < 0.0  # before it nothing is hidden


def test_frames_that_see_all_of_a_square_are_asked_first_and_of_those_the_steepest() -> None:
    frames = [
        looking_down(60.0, 0.0),
        looking_down(10.0, 0.0),
        looking_down(0.0, 400.0),
        looking_down(0.0, 0.0),
    ]
    cells = Cells(-8.0, -8.0, 0.5, 32, 32)
    sweep = PlaneSweep(cells, LEVEL, [SweepView(f, CAMERA, 1.0) for f in frames], -5.0, 30.0)
    [(_, asked)] = asked_frames(sweep, [(600, 800)] * 4, 32, 0, 3)
    assert asked[:2] == (3, 1)
    assert 2 not in asked


def test_choosing_frames_keeps_no_cells_of_each() -> None:
    """Places of all cells take 2.8 MB a frame; only frames that are asked later need them."""
    frames = [looking_down(x, y) for x in np.linspace(-40.0, 40.0, 8) for y in np.linspace(-40.0, 40.0, 5)]
    cells = Cells(-44.0, -44.0, 0.25, 352, 352)
    sweep = PlaneSweep(cells, LEVEL, [SweepView(f, CAMERA, 1.0) for f in frames], -5.0, 30.0)
    tracemalloc.start()
    try:
        asked = asked_frames(sweep, [(600, 800)] * len(frames), 32, 8, 6)
        kept, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert all(len(its) == 6 for _, its in asked)
    assert peak < 10e6
    assert kept < 1e6


def test_places_of_the_base_are_those_of_no_height() -> None:
    cells = Cells(-70.0, -60.0, 0.5, 240, 280)
    sweep = PlaneSweep(cells, LEVEL, [SweepView(looking_down(3.0, -4.0), CAMERA, 2.0)], -10.0, 30.0)
    flat = np.zeros((240, 280), dtype=np.float32)
    for found, place in zip(sweep.base_places(0), sweep.places(0, flat), strict=True):
        np.testing.assert_array_equal(found, place)


def test_a_height_that_two_frames_agree_on_costs_least(  # of three, one of which shows something else
) -> None:
    random = np.random.default_rng(1)
    cells = Cells(-8.0, -8.0, 0.25, 64, 64)
    scene = np.kron(random.integers(0, 255, (80, 80)), np.ones((4, 4))).astype(np.uint8)
    poses = [looking_down(x, 0.0, yaw_deg=0.0) for x in (0.0, 30.0, -30.0)]
    sighted = [SweepView(p, CAMERA, 1.0) for p in poses]
    views = [_seen(scene, pose, 5.0) for pose in poses[:2]]
    views.append(random.integers(0, 255, (600, 800)).astype(np.uint8))
    sweep = PlaneSweep(cells, LEVEL, sighted, -5.0, 30.0)
    steps = np.broadcast_to(np.arange(-2, 12, dtype=np.int16)[:, None, None], (14, 64, 64))
    whole = [((slice(0, 64), slice(0, 64)), (0, 1, 2))]
    costs = census_costs(sweep, [census(v) for v in views], SweepHeights(steps, 1.0), whole, {})
    best = cheapest(aggregated(costs, steps), steps)
    assert float(np.median(np.abs(best[8:-8, 8:-8] - 5.0))) < 0.3
    blind = {k: np.full((64, 64), np.inf, dtype=np.float32) for k in range(3)}
    none = census_costs(sweep, [census(v) for v in views], SweepHeights(steps, 1.0), whole, blind)
    assert (none == none[0, 0, 0]).all()
    assert none[0, 0, 0] < 12 * PER_BIT


def test_squares_show_what_their_own_frames_see() -> None:
    """Of different frames and sizes, at the tile's edge, and one of a frame less than the other."""
    random = np.random.default_rng(3)
    cells = Cells(-8.0, -8.0, 0.25, 70, 40)
    frames = [looking_down(x, 3.0) for x in (0.0, 12.0, -14.0)]
    sweep = PlaneSweep(cells, LEVEL, [SweepView(f, CAMERA, 1.0) for f in frames], -5.0, 30.0)
    views = [random.integers(0, 255, (600, 800)).astype(np.uint8) for _ in frames]
    asked = [
        ((slice(0, 32), slice(0, 32)), (2, 0)),
        ((slice(32, 64), slice(8, 40)), (1, 2, 0)),
        ((slice(64, 70), slice(8, 40)), (0, 1)),
        ((slice(0, 32), slice(32, 40)), (1,)),
    ]
    height_m = random.uniform(0.0, 9.0, (70, 40)).astype(np.float32)
    low_m = np.full((70, 40), 4.0, dtype=np.float32)
    squares = Squares(sweep, views, asked, rim=2)
    several = squares.cut(height_m)[:, None]
    for rank, (grey, sees) in enumerate(squares.shown(several, {0: low_m})):
        shown, seen = (np.full((70, 40), 7, dtype=np.uint8) for _ in range(2))
        squares.put(grey[:, 0], shown)
        squares.put(np.ones_like(grey[:, 0]) if sees is None else sees[:, 0].astype(np.uint8), seen)
        for at, whom in asked[:3]:
            if rank >= len(whom):
                assert not seen[at].any()
                continue
            places = sweep.places(whom[rank], sweep.bent(height_m[at]), at)
            expected = cv2.remap(
                views[whom[rank]], *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            assert abs(shown[at].astype(int) - expected).max() <= 1
            assert (seen[at] == (height_m[at] >= 4.0 if whom[rank] == 0 else 1)).all()
    few = list(squares.some(10**9))
    assert [len(some) for some in few] == [1, 1, 1]
    assert np.array_equal(np.concatenate([some.cut(height_m) for some in few]), squares.cut(height_m))


def _seen(scene: np.ndarray, pose: Pose, height_m: float) -> np.ndarray:
    """What a frame sees of a level image 40 m wide at a height."""
    col, row = np.meshgrid(np.arange(800) + 0.5, np.arange(600) + 0.5)
    ray = pose.ray_from_image(CAMERA, np.stack([col, row], axis=-1))
    at = pose.position_m + ray * ((height_m - pose.position_m[2]) / ray[..., 2])[..., None]
    pixel_m = 40.0 / scene.shape[0]
    place = ((at[..., :2] + 20.0) / pixel_m).astype(int).clip(0, scene.shape[0] - 1)
    return np.asarray(scene[place[..., 1], place[..., 0]])


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_frames_of_any_heading_have_the_same_census(quarters: int) -> None:
    """Lines are flown there and back: by its own rows and columns a frame is like none of the next line."""
    grey = np.random.default_rng(4).integers(0, 255, (40, 50)).astype(np.uint8)
    turned = census(np.rot90(grey, quarters), turn_rad=-quarters * np.pi / 2.0)
    assert (np.rot90(census(grey), quarters) == turned)[4:-4, 4:-4].all()


def test_headings_between_have_nearly_the_same_census() -> None:
    noise = np.random.default_rng(4).integers(0, 255, (30, 30)).astype(np.uint8)
    grey = cv2.resize(noise, (120, 120), interpolation=cv2.INTER_CUBIC)
    by = cv2.getRotationMatrix2D((59.5, 59.5), 35.0, 1.0)
    turned = cv2.warpAffine(grey, by, (120, 120), flags=cv2.INTER_CUBIC)
    middle = slice(40, 80), slice(40, 80)
    differing = []
    for turn_rad in (np.radians(-35.0), 0.0):
        back = cv2.warpAffine(
            census(turned, turn_rad=turn_rad).view(np.float32),
            by,
            (120, 120),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
        )
        differing.append(float(np.bitwise_count(back.view(np.uint32) ^ census(grey))[middle].mean()))
    assert differing[0] < 2.5 < 5.0 < differing[1]


@pytest.mark.parametrize(("moved_m", "asked"), [(0.0, (0, 1, 2)), (0.5, (1, 2, 3))])
def test_a_frame_that_lies_off_the_others_is_not_what_they_are_compared_with(moved_m, asked) -> None:
    """Three to four pixels across the line, so that no height makes up for it."""
    cells = Cells(-8.0, -8.0, 0.25, 64, 64)
    scene = np.random.default_rng(1).integers(0, 255, (40, 40)).repeat(8, axis=0).repeat(8, axis=1)
    poses = [looking_down(x, 0.0, yaw_deg=0.0) for x in (0.0, 10.0, -10.0, 20.0)]
    taken = [looking_down(0.0, moved_m, yaw_deg=0.0), *poses[1:]]
    seen = [census(_seen(scene.astype(np.uint8), pose, 5.0)) for pose in taken]
    sweep = PlaneSweep(cells, LEVEL, [SweepView(p, CAMERA, 1.0) for p in poses], -5.0, 30.0)
    steps = np.broadcast_to(np.arange(-2, 12, dtype=np.int16)[:, None, None], (14, 64, 64))
    block = slice(16, 48), slice(16, 48)
    [(_, found)] = agreeing(sweep, seen, SweepHeights(steps, 1.0), [(block, (0, 1, 2, 3))], 3)
    assert found == asked


def test_next_to_a_wall_of_more_heights_than_are_looked_at_a_cell_has_those_of_its_side() -> None:
    about = np.zeros((20, 40), dtype=np.float32)
    about[:, 20:] = 100.0
    steps = search_steps(about)
    assert len(steps) < 100
    assert (steps.min(axis=0) <= about - 4).all()
    assert (steps.max(axis=0) >= about + 3).all()


def test_a_ring_holds_each_height_at_its_own_place() -> None:
    lowest = np.array([[-7, 0, 3]], dtype=np.int16)
    steps = ring(lowest, 8)
    assert (steps.min(axis=0) == lowest).all()
    assert (steps.max(axis=0) == lowest + 7).all()
    assert ((steps % 8) == np.arange(8)[:, None, None]).all()


def test_cells_with_other_ranges_are_summed_as_if_they_shared_all_heights() -> None:
    random = np.random.default_rng(2)
    whole = np.broadcast_to(np.arange(0, 12, dtype=np.int16)[:, None, None], (12, 9, 7))
    costs = np.full((12, 9, 7), 60, dtype=np.uint8)
    true = 4 + (np.indices((9, 7)).sum(axis=0) > 7)
    np.put_along_axis(costs, true[None], random.integers(0, 10, (1, 9, 7)).astype(np.uint8), axis=0)
    narrow = ring((true - 3).astype(np.int16), 8)
    of_narrow = np.take_along_axis(costs, narrow.astype(np.intp).clip(0, 11), axis=0)
    for given, steps in ((costs, whole), (of_narrow, narrow)):
        assert (np.round(cheapest(aggregated(given, steps), steps)) == true).all()
