"""The ground from tie points: how it goes on beyond them, what it ignores, when flat ground is enough."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import POSITION_SD_M, TURN_SD_RAD, Flown, fly, hills, level
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from geomosaic.adjustment.ground.ground_choice import levelled, lies_flat, surface_of
from geomosaic.adjustment.ground.tie_surface import tie_surface
from geomosaic.adjustment.ground.trial_surface import Heights, even_ground
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.adjustment.procedure.bundle_method import pose_block
from geomosaic.adjustment.solver.solve import solve
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, exp_turn
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.matching.tracks import join_tracks
from geomosaic.projection.ground import GroundSurface

LOW, HIGH = np.array([-130.0, -110.0]), np.array([130.0, 110.0])


def dome(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Hills of 20 m and 300 m from top to top, a fifth of a flying height of 100 m."""
    return 312.0 + 10.0 * np.cos((east - 20.0) / 48.0) * np.cos((north + 30.0) / 48.0)


def slope(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """A hillside that rises by a tenth to the north."""
    return 0.1 * north + 0.0 * east


def points(seed: int, n: int = 4000, noise_m: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    at = rng.uniform([-100.0, -80.0], [100.0, 80.0], (n, 2))
    up = dome(*at.T) + rng.normal(0.0, noise_m, n)
    return np.column_stack([at, up]), np.full(n, noise_m)


def off_m(surface: GroundSurface, beyond_m: float) -> float:
    """Largest miss along the line beyond_m outside the points."""
    e, n = np.linspace(-100.0, 100.0, 41), np.linspace(-80.0, 80.0, 41)
    sides = [(e, 0 * e + 80.0 + beyond_m), (e, 0 * e - 80.0 - beyond_m)]
    sides += [(0 * n + 100.0 + beyond_m, n), (0 * n - 100.0 - beyond_m, n)]
    return float(max(np.abs(surface.up_at(*at) - dome(*at)).max() for at in sides))


def test_hills_go_on_beyond_the_last_points_as_they_curve_there() -> None:
    """The edge kept level would be off by 2 m at 10 m and by 5 m at 25 m. The true slope straight on would be
    off by 0.2 and 1.2 m, and slopes of noisy points by more."""
    surface = tie_surface(Heights(*points(1), LOW, HIGH, 100.0))
    assert surface.kind == "tie_surface"
    assert (surface.east_0_m, surface.north_0_m) == (-130.0, -110.0)
    assert surface.up_at(20.0, -30.0) == pytest.approx(322.0, abs=0.02)
    assert surface.up_at(-70.0, 40.0) == pytest.approx(311.664, abs=0.02)
    assert off_m(surface, 10.0) < 0.3
    assert off_m(surface, 25.0) < 1.0


def test_mountains_are_followed_where_points_show_them() -> None:
    """Summits of 60 m every 75 m, seen from 100 m, by a point on 13 m². A surface of a third derivative of at
    most 32 per squared flying height would lie 10 m off them."""
    rng = np.random.default_rng(3)

    def mountains(at: np.ndarray) -> np.ndarray:
        return np.asarray(30.0 * np.cos(at[:, 0] / 12.0) * np.cos(at[:, 1] / 12.0))

    at, between = rng.uniform([-100.0, -80.0], [100.0, 80.0], (2, 2500, 2))
    up = mountains(at) + rng.normal(0.0, 0.02, len(at))
    surface = tie_surface(Heights(np.column_stack([at, up]), np.full(len(at), 0.02), LOW, HIGH, 100.0))
    off = np.abs(surface.up_at(between[:, 0], between[:, 1]) - mountains(between))
    assert np.median(off) < 0.2
    assert np.quantile(off, 0.95) < 1.0


def test_trees_do_not_lift_the_ground() -> None:
    at, sd = points(2)
    rng = np.random.default_rng(3)
    for middle, reach in zip(rng.uniform(-90, 90, (40, 2)), rng.uniform(2.0, 7.0, 40), strict=True):
        crown = np.linalg.norm(at[:, :2] - middle, axis=1) < reach
        at[crown, 2] += rng.uniform(3.0, 10.0, crown.sum())
    surface = tie_surface(Heights(at, sd, LOW, HIGH, 100.0))
    e, n = np.meshgrid(np.linspace(-80.0, 80.0, 60), np.linspace(-60.0, 60.0, 50))
    assert np.abs(surface.up_at(e, n) - dome(e, n)).max() < 0.3
    assert np.mean(at[:, 2] - dome(*at[:, :2].T) > 1.0) > 0.05


@pytest.mark.proof
def test_a_finer_grid_gives_the_same_surface() -> None:
    at, sd = points(4, 8000)
    fine, coarse = (tie_surface(Heights(at[::k], sd[::k], LOW, HIGH, 100.0)) for k in (1, 4))
    assert coarse.spacing_m == pytest.approx(2.0 * fine.spacing_m, rel=0.05)
    for reach_m, most_m in ((-5.0, 0.06), (10.0, 0.5)):
        east, north = 100.0 + reach_m, 80.0 + reach_m
        e, n = np.meshgrid(np.linspace(-east, east, 45), np.linspace(-north, north, 37))
        assert np.abs(fine.up_at(e, n) - coarse.up_at(e, n)).max() < most_m


def test_rough_ground_gets_a_softer_surface_than_smooth_ground() -> None:
    """Hills of 6 m and 60 m from top to top: one stiffness for both would cut them by metres."""
    at, sd = points(5, 3000)
    at[:, 2] = 3.0 * np.sin(at[:, 0] / 9.5) * np.cos(at[:, 1] / 9.5)
    surface = tie_surface(Heights(at, sd, LOW, HIGH, 100.0))
    e, n = np.meshgrid(np.linspace(-90.0, 90.0, 60), np.linspace(-70.0, 70.0, 50))
    off = surface.up_at(e, n) - 3.0 * np.sin(e / 9.5) * np.cos(n / 9.5)
    assert np.sqrt(np.mean(off**2)) < 0.15


@pytest.mark.proof
@given(st.floats(0.02, 50.0), st.integers(0, 1000))
@examples(max_examples=8, deadline=None)
def test_a_block_of_another_size_gets_the_surface_of_that_size(factor: float, seed: int) -> None:
    at, sd = points(seed, 300)
    one = tie_surface(Heights(at, sd, LOW, HIGH, 100.0))
    other = tie_surface(Heights(factor * at, factor * sd, factor * LOW, factor * HIGH, factor * 100.0))
    assert other.spacing_m == pytest.approx(factor * one.spacing_m)
    assert other.up_m / factor == pytest.approx(one.up_m, rel=1e-5)


def rolling_land(seed: int):  # type: ignore[no-untyped-def]
    """Hills of all sizes from 80 m on, the longer the higher, by chance."""
    rng = np.random.default_rng(seed)
    waves = np.exp(rng.uniform(np.log(80.0), np.log(500.0), 12))
    way, phase, share = rng.uniform(0.0, 2.0 * np.pi, (2, 12)).tolist() + [rng.normal(0.0, 0.012, 12)]
    towards = np.array([np.cos(way), np.sin(way)]) / waves * 2.0 * np.pi

    def up(east: np.ndarray, north: np.ndarray) -> np.ndarray:
        at = np.multiply.outer(east, towards[0]) + np.multiply.outer(north, towards[1])
        return np.asarray((share * waves * np.sin(at + np.array(phase))).sum(axis=-1))

    return up


@pytest.mark.proof
def test_heights_beyond_the_points_are_off_by_what_is_stated() -> None:
    shares = []
    for seed in range(40, 48):
        land, (at, sd) = rolling_land(seed), points(seed, 2500)
        at[:, 2] = land(at[:, 0], at[:, 1]) + at[:, 2] - dome(at[:, 0], at[:, 1])
        found = tie_surface(Heights(at, sd, LOW, HIGH, 100.0))
        assert found.sd_at(0.0, 0.0) < 0.3
        assert found.sd_at(128.0, 0.0) > 2.0 * found.sd_at(110.0, 0.0)
        n = np.linspace(-75.0, 75.0, 31)
        for beyond_m in (8.0, 16.0, 28.0):
            for side in (-1.0, 1.0):
                east = np.full_like(n, side * (100.0 + beyond_m))
                shares.append((found.up_at(east, n) - land(east, n)) / found.sd_at(east, n))
    assert 0.4 < np.sqrt(np.mean(np.square(shares))) < 1.6


@pytest.mark.proof
def test_errors_in_a_gap_are_as_stated_and_smaller_than_beyond_the_points() -> None:
    shares, closer = [], []
    for seed in range(60, 68):
        land, (at, sd) = rolling_land(seed), points(seed, 2500)
        at[:, 2] = land(at[:, 0], at[:, 1]) + at[:, 2] - dome(at[:, 0], at[:, 1])
        gap = np.hypot(at[:, 0] - 30.0, at[:, 1] + 20.0) < 12.0
        found = tie_surface(Heights(at[~gap], sd[~gap], LOW, HIGH, 100.0))
        around = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
        east, north = 30.0 + 5.0 * np.cos(around), 5.0 * np.sin(around) - 20.0
        shares.append((found.up_at(east, north) - land(east, north)) / found.sd_at(east, north))
        closer.append(found.sd_at(30.0, -20.0) / found.sd_at(112.0, 0.0))
    assert 0.4 < np.sqrt(np.mean(np.square(shares))) < 1.6
    assert np.median(closer) < 0.9


def test_houses_do_not_raise_the_deviation_of_the_ground_between_points() -> None:
    at, sd = points(3)
    bare = tie_surface(Heights(at, sd, LOW, HIGH, 100.0))
    at[:, 2] += 6.0 * (np.floor(at[:, :2] / 12.0).sum(axis=1) % 7 == 0)
    built = tie_surface(Heights(at, sd, LOW, HIGH, 100.0))
    assert np.median(built.sd_m) < 2.0 * np.median(bare.sd_m)


def test_level_land_goes_on_level_and_says_so() -> None:
    at, sd = points(9, 2500)
    at[:, 2] += 300.0 - dome(at[:, 0], at[:, 1])
    found = tie_surface(Heights(at, sd, LOW, HIGH, 100.0))
    assert found.sd_at(125.0, 0.0) < 0.15
    assert tie_surface(Heights(at, sd, LOW, HIGH, 100.0), rough=True).sd_m is None


def woods(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Trees of 8 m on a third of the hills."""
    return np.asarray(hills(east, north) + 8.0 * (np.sin(east / 19.0 + 1.0) + np.cos(north / 27.0) > 0.6))


def waves(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """The hills by a model whose errors are alike over tens of metres."""
    off = np.sin(2.0 * np.pi * east / 150.0 + 0.3) * np.cos(2.0 * np.pi * north / 150.0 + 1.0)
    return np.asarray(hills(east, north) + 2.0 * off)


@pytest.mark.parametrize(
    ("land", "model", "most_m"), [(woods, hills, 1.0), (hills, waves, 1.0), (hills, hills, 0.6)]
)
def test_errors_of_a_dem_do_not_drag_the_block(land, model, most_m: float) -> None:  # type: ignore[no-untyped-def]
    """Woods above a terrain model, a model off by 2 m, an exact one. Were each of 2,500 tie points an
    observation of its own, the first two would move the block by 5 and 6 m."""
    axis = np.arange(-300.0, 500.0, 5.0)
    dem = GroundSurface("dem", -300.0, -300.0, 5.0, model(*np.meshgrid(axis, axis)))
    flown = fly(1, 4, 8, relief=land, points=2500, ground=dem, there_and_back=True)
    adjusted = pose_block(flown.block, Settings(model="given"))
    off_m = adjusted.poses.positions_m - flown.truth.positions_m
    assert np.sqrt(np.mean(off_m[:, :2] ** 2, axis=0)).max() < most_m
    assert (np.abs(off_m) < 3.5 * adjusted.poses.positions_sd_m).all()


def line(seed: int, base_m: float, relief=level, frames: int = 8) -> Block:  # type: ignore[no-untyped-def]
    """One line of frames that reach 60 m along it, 100 m above zero, base_m apart."""
    rng = np.random.default_rng(seed)
    camera = Camera("plain", 800, 600, 1000.0, 402.0, 297.0, k1=-0.02)
    at = np.array([[0.0, base_m * i, 100.0] for i in range(frames)])
    attitude = rng.normal(0, np.radians([2.0, 1.0, 1.0]), (frames, 3))
    rotations = Rotation.from_yaw_pitch_roll(*attitude.T).matrix
    none = np.zeros((frames, 3))
    truth = Poses(at + rng.normal(0, [1.0, 1.0, 0.5], (frames, 3)), rotations, none, none)
    plan = rng.uniform([-35.0, -25.0], [35.0, at[-1, 1] + 25.0], (1200, 2))
    land = np.column_stack([plan, relief(*plan.T)])
    seen = [truth[i].image_from_ground(camera, land) for i in range(frames)]
    inside = [np.all((px > 5.0) & (px < [795.0, 595.0]), axis=1) for px in seen]
    measured = [px + rng.normal(0, 0.3, px.shape) for px in seen]
    ties = []
    for i in range(frames):
        for j in range(i + 1, frames):
            both = np.flatnonzero(inside[i] & inside[j]).astype(np.int32)
            if len(both) >= 12:
                ties.append(TiePair(i, j, measured[i][both], measured[j][both], both, both))
    poses = Poses(
        truth.positions_m + rng.normal(0, POSITION_SD_M, (frames, 3)),
        exp_turn(rng.normal(0, TURN_SD_RAD, (frames, 3))) @ truth.rotations,
        np.tile(POSITION_SD_M, (frames, 1)),
        np.tile(TURN_SD_RAD, (frames, 1)),
    )
    flat = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    names = tuple(f"{i:03d}.jpg" for i in range(frames))
    order = tuple(range(frames))
    return Block(names, (camera,) * frames, poses, flat, TiePoints(tuple(ties)), order, (0,) * frames, 0.1)


@pytest.mark.parametrize("base_m", [pytest.param(48.0, marks=pytest.mark.proof), 42.0])
def test_a_line_of_pairs_over_flat_land_is_flat(base_m: float) -> None:
    """20 and 30 % overlap: no point in three frames, and free points bend by metres with the frames' tilts."""
    block = line(1, base_m)
    auto = pose_block(block, Settings(model="given"))
    assert auto.ground.kind == "flat"
    assert auto.figures["sigma_px"] == pytest.approx(0.3, rel=0.15)
    bent = pose_block(block, Settings(model="given", ground="tie_surface")).ground
    n = np.linspace(-20.0, base_m * 7 + 20.0, 80)
    assert np.ptp(bent.up_at(0 * n, n)) > 3.0


@pytest.mark.parametrize(
    ("base_m", "relief"),
    [
        (48.0, hills),
        pytest.param(42.0, slope, marks=pytest.mark.proof),
        (24.0, slope),
        pytest.param(24.0, hills, marks=pytest.mark.proof),
    ],
)
def test_a_line_over_relief_is_not_flattened(base_m, relief) -> None:  # type: ignore[no-untyped-def]
    assert pose_block(line(2, base_m, relief), Settings(model="given")).ground.kind == "tie_surface"


def bowl(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """A metre higher at the block's corners than in its middle."""
    return 0.5 * (((east - 40.0) / 60.0) ** 2 + ((north - 45.0) / 70.0) ** 2)


@pytest.mark.parametrize(("relief", "flat"), [(bowl, False), (level, True)])
def test_land_that_stays_bent_when_it_is_bound_to_level_ground_is_not_flat(relief, flat: bool) -> None:  # type: ignore[no-untyped-def]
    """A block without height control may bend so, but then it straightens at no cost. Here the bound block is
    the free one, as where many images a point refuse (dirty surveys 1711 and 1239: 2.9 and 1.7 px in the
    map)."""
    block = fly(1, 3, 6, points=1500, noise_px=0.1, crossed=True, relief=relief).block
    tracks = join_tracks(block.ties)
    points, kept = points_on_ground(block.poses, block.cameras, block.ground, tracks)
    solved = solve(block_problem(block, Settings(), kept, points), block.poses)
    assert lies_flat(block, levelled(block.ground, solved), solved, solved) is flat


def tilt_of(adjusted: Adjusted, flown: Flown) -> np.ndarray:
    """Mean turn of the frames against the truth about east and north, rad."""
    turn = adjusted.poses.rotations @ np.swapaxes(flown.truth.rotations, 1, 2)
    return np.array([turn[:, 2, 1].mean(), turn[:, 0, 2].mean()])


def test_a_hillside_does_not_tilt_the_block() -> None:
    """The attitudes' mean is good to 0.3 degrees over the root of 18, 1.2 mrad; the hillside rises by 100."""
    flown = fly(3, points=3000, relief=slope)
    adjusted = pose_block(flown.block, Settings(model="given"))
    assert adjusted.ground.kind == "tie_surface"
    assert np.abs(tilt_of(adjusted, flown)).max() < 3.0 * 1.3e-3
    assert adjusted.figures["sigma_tilt"] < 1.5
    e, n = np.meshgrid(np.linspace(0.0, 80.0, 9), np.linspace(0.0, 90.0, 10))
    rise = np.polyfit(n.ravel(), adjusted.ground.up_at(e, n).ravel(), 1)[0]
    assert rise == pytest.approx(0.1, abs=0.005)


def test_the_surface_reaches_as_far_as_the_frames() -> None:
    """Corners that one frame alone sees have no points, yet a ground."""
    flown = fly(4, relief=hills)
    ground = pose_block(flown.block, Settings(model="given")).ground
    rows, cols = ground.up_m.shape
    last = ground.east_0_m + (cols - 1) * ground.spacing_m, ground.north_0_m + (rows - 1) * ground.spacing_m
    outlines = [
        flown.truth[i].image_from_ground(c, [[ground.east_0_m, 45.0, 0.0], [last[0], 45.0, 0.0]])
        for i, c in enumerate(flown.block.cameras)
    ]
    cols_px = np.array(outlines)[..., 0]
    assert not ((cols_px > 30.0) & (cols_px < 770.0)).any()


def test_a_view_of_the_horizon_leaves_the_nodes_fine() -> None:
    """Two hills 30 km away would stretch the grid over 900 km², and its nodes to 100 m."""
    block = fly(4, relief=hills).block
    points, kept = points_on_ground(block.poses, block.cameras, block.ground, join_tracks(block.ties))
    near = solve(block_problem(block, Settings(), kept, points), block.poses)
    hill_m = np.array([[30e3, 20e3, 400.0], [-25e3, 10e3, 300.0]])
    estimate = replace(near.estimate, points_m=np.concatenate([near.points_m, hill_m]))
    far = replace(near, estimate=estimate, points_sd_m=np.concatenate([near.points_sd_m, [[1e3] * 3] * 2]))
    fine, ground = (surface_of(block, block.ground, its)[0] for its in (near, far))
    assert ground.spacing_m == pytest.approx(fine.spacing_m, rel=0.01)
    assert max(ground.up_m.shape) * ground.spacing_m < 1.2e3
    east, north = np.meshgrid(np.linspace(0.0, 80.0, 9), np.linspace(0.0, 90.0, 10))
    off = [np.std(its.up_at(east, north) - hills(east, north)) for its in (fine, ground)]
    assert off[1] < 1.2 * off[0] < 0.5


@pytest.mark.proof
def test_beyond_a_wood_lies_the_ground_it_stands_on() -> None:
    """Level meadows and woods of 9 m in every fifth square of 40 m, seen from 90 m. The last 25 m in the
    east, behind a wood, have no points. And hills there go on as hills."""
    rng = np.random.default_rng(3)
    at = rng.uniform(0.0, 275.0, (9000, 2))
    wood = ((at[:, 0] // 40 + at[:, 1] // 40) % 5 == 0) | (at[:, 0] > 240.0)
    slope = 0.03 * at[:, 0]
    up = slope + np.where(wood, 9.0 + rng.normal(0.0, 1.0, 9000), 0.0) + rng.normal(0.0, 0.1, 9000)
    low, high = np.zeros(2), np.array([300.0, 275.0])
    found = tie_surface(Heights(np.column_stack([at, up]), np.full(9000, 0.2), low, high, 90.0))
    north = np.linspace(20.0, 255.0, 40)
    beyond = found.up_at(np.full(40, 297.0), north) - 0.03 * 297.0
    assert np.abs(beyond).mean() < 3.0, "not the crowns' 9 m"
    hills = 12.0 * np.sin(at[:, 0] / 60.0) + 9.0 * np.cos(at[:, 1] / 70.0) + rng.normal(0.0, 0.1, 9000)
    found = tie_surface(Heights(np.column_stack([at, hills]), np.full(9000, 0.2), low, high, 90.0))
    true = 12.0 * np.sin(285.0 / 60.0) + 9.0 * np.cos(north / 70.0)
    assert np.abs(found.up_at(np.full(40, 285.0), north) - true).max() < 1.0


@pytest.mark.parametrize("terms", [3, 6])
def test_unknown_heights_do_not_tilt_even_ground(terms: int) -> None:
    """One point in 13 lies up to 90 flying heights below, known to 10 to 4,000 m alone. By their residual over
    their own deviation they counted as the others: the plane rose by 300 m along the block."""
    rng = np.random.default_rng(3)
    good = np.column_stack([rng.uniform(-100.0, 100.0, (8000, 2)), rng.normal(-0.8, 0.3, 8000)])
    depth = rng.uniform(50.0, 2700.0, 650)
    wild = np.column_stack([-100.0 - 0.05 * depth, rng.uniform(-250.0, 250.0, 650), -depth])
    points_m = np.concatenate([good, wild])
    sd_m = np.concatenate([np.full(8000, 0.08), 10.0 ** rng.uniform(1.0, 3.6, 650)])
    east, north = np.meshgrid([-250.0, 0.0, 250.0], [-250.0, 0.0, 250.0])
    up_m = even_ground(points_m, sd_m, terms)(east, north)
    assert np.abs(up_m + 0.8).max() < (1.0 if terms == 3 else 3.0)
