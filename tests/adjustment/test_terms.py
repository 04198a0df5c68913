"""Terms of the adjustment: equations against differences of the cost, and the layout of shared unknowns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from adjustment_blocks import camera_unknowns, estimate_of, fly, frame_terms, hills

from geomosaic.adjustment.kernels.interior import INTERIOR
from geomosaic.adjustment.kernels.normal_equations import Normals
from geomosaic.adjustment.kernels.reduced_equations import Reduced, reduce_normals
from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.problem.estimate import Estimate, Step, UnknownLayout
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.procedure.block_solution import points_on_ground
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.solution import Start
from geomosaic.adjustment.terms.attitudes import BORESIGHT
from geomosaic.adjustment.terms.gnss_positions import DELAY, LEVER_ARM, OFFSET, GnssPositions
from geomosaic.adjustment.terms.rolling_shutter_rotation import RollingShutterRotation
from geomosaic.adjustment.terms.term import Components, FrameTerm, Term
from geomosaic.adjustment.terms.terrain import LEVEL, Terrain, level_unknown
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import exp_turn
from geomosaic.matching.tracks import join_tracks
from geomosaic.projection.ground import GroundSurface

ONE = Camera("one", 800, 600, 1000.0, 402.0, 297.0, k1=-0.02, readout_s=0.05)
TWO = Camera("two", 640, 480, 900.0, 318.0, 243.0, k1=0.01)
COMPONENTS = Components(
    {
        "image": 0.4,
        "horizontal": 1.3,
        "vertical": 0.8,
        "tilt": 1.1,
        "yaw": 0.7,
        "control plan": 1.6,
        "control height": 0.9,
        "rotation term 1": 0.6,
        "rotation term 2": 1.2,
        "drift across the view": 0.4,
        "drift along the view": 0.9,
    }
)
STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6])


def flown_problem(*, terms: int = 0) -> tuple[BlockProblem, Estimate]:
    """Six frames with lever arm, delay, boresight and offset, away from where all residuals are zero."""
    flown = fly(3, 2, 3, points=60, relief=hills, there_and_back=True)
    block, rng = flown.block, np.random.default_rng(8)
    points, tracks = points_on_ground(flown.truth, block.cameras, block.ground, join_tracks(block.ties))
    n, p = len(block.names), tracks.points
    frames: tuple[FrameTerm, ...] = tuple(
        replace(term, weight=rng.uniform(0.3, 1.0, (n, 3))) for term in frame_terms(block.poses)
    )
    if terms:
        sds = rng.uniform(0.001, 0.003, (n, terms, 3)), rng.uniform(0.01, 0.03, (n, 3))
        frames = (
            *frames,
            RollingShutterRotation(*sds, focal_length_px=800.0, common=False, most_rotation=10.0),
        )
    problem = block_problem(block, Settings(), tracks, points)
    problem = replace(
        problem,
        image=replace(problem.image, rolling=bool(terms), local=rng.uniform(0.8, 1.3, p)),
        points=replace(
            problem.points,
            sd_m=rng.uniform(0.5, 2.0, (p, 3)),
            control=np.arange(p) % 4 == 0,
            weight=rng.uniform(0.3, 1.0, (p, 3)),
        ),
        frames=frames,
    )
    at = estimate_of(problem, block.poses)
    values = rng.normal(0.0, 0.3, at.layout.size) * np.maximum(at.layout.sd, 1e-9)
    values[at.layout.slices[BORESIGHT]] = [2e-4, -1e-4, 3e-4]
    at = replace(
        at,
        positions_m=at.positions_m + rng.normal(0.0, 0.5, (n, 3)),
        rotations=exp_turn(rng.normal(0.0, 2e-4, (n, 3))) @ at.rotations,
        points_m=at.points_m + rng.normal(0.0, 0.2, (p, 3)),
        shared=at.shared + values,
        rotation_terms_rad=rng.normal(0.0, 0.002, (n, terms, 3)),
        drift=rng.normal(0.0, 0.02, (n, 3)),
    )
    return problem, at


def moved_frame(at: Estimate, frame: int, k: int, step: float) -> Estimate:
    """One of a frame's unknowns changed: position, turn from the left, terms, drift."""
    pose = np.zeros((len(at.positions_m), 6 + at.while_read.shape[1]))
    pose[frame, k] = step
    rotation_terms_rad, drift = at.rotation_terms_rad, at.drift
    if pose.shape[1] > 6:
        rotation_terms_rad, drift = (
            rotation_terms_rad + pose[:, 6:-3].reshape(rotation_terms_rad.shape),
            drift + pose[:, -3:],
        )
    rotations = exp_turn(pose[:, 3:6]) @ at.rotations
    positions_m = at.positions_m + pose[:, :3]
    return replace(
        at, positions_m=positions_m, rotations=rotations, rotation_terms_rad=rotation_terms_rad, drift=drift
    )


def moved_shared(at: Estimate, k: int, step: float) -> Estimate:
    return replace(at, shared=at.shared + step * np.eye(at.layout.size)[k])


def moved_point(at: Estimate, point: int, k: int, step: float) -> Estimate:
    points_m = at.points_m.copy()
    points_m[point, k] += step
    return replace(at, points_m=points_m)


def slope(value: Callable[[float], np.ndarray | float], step: float) -> np.ndarray:
    """Central difference."""
    return np.asarray((np.asarray(value(step)) - np.asarray(value(-step))) / (2.0 * step))


def cost_slopes(of: Term | BlockProblem, at: Estimate) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of the cost by the frames' unknowns (f, d), points (p, 3) and shared unknowns (s,)."""
    f, d = len(at.positions_m), 6 + at.while_read.shape[1]
    steps = np.append(STEPS, np.full(d - 6, 1e-5))
    pose = [
        [slope(lambda h, i=i, k=k: of.cost(moved_frame(at, i, k, h), COMPONENTS), steps[k]) for k in range(d)]
        for i in range(f)
    ]
    points = [
        [slope(lambda h, i=i, k=k: of.cost(moved_point(at, i, k, h), COMPONENTS), 1e-4) for k in range(3)]
        for i in range(len(at.points_m))
    ]
    size = 1e-3 * np.where(at.layout.sd > 0.0, at.layout.sd, 1e-3)
    shared = [
        slope(lambda h, k=k: of.cost(moved_shared(at, k, h), COMPONENTS), size[k])
        for k in range(at.layout.size)
    ]
    return np.array(pose), np.array(points), np.array(shared)


def without_images(problem: BlockProblem, at: Estimate) -> Normals:
    """Normal equations that hold no observation yet."""
    left_out = np.ones(len(at.positions_m), dtype=bool)
    return replace(problem.image, left_out=left_out).normals(at, COMPONENTS)


def assert_alike(found: np.ndarray, expected: np.ndarray, rel: float) -> None:
    """Column by column, as a share of the column's largest value."""
    off, size = np.abs(found - expected).max(axis=0), np.abs(expected).max(axis=0)
    assert np.all(off <= rel * size + 1e-9), off / np.maximum(size, 1e-300)


def frame_cases() -> Iterator[tuple[BlockProblem, Estimate, FrameTerm]]:
    problem, at = flown_problem(terms=2)
    yield from ((problem, at, term) for term in problem.frames)


@pytest.mark.parametrize("which", [0, 1, 2], ids=["positions", "attitudes", "rolling shutter rotation"])
def test_a_frame_terms_right_side_is_the_slope_of_its_cost(which: int) -> None:
    """Turns of 0.2 to 20 mrad: an attitude's residual turns with its frame but for a hundredth."""
    problem, at, term = list(frame_cases())[which]
    normals = term.add_to(without_images(problem, at), at, COMPONENTS)
    pose, points, shared = cost_slopes(term, at)
    assert np.abs(pose).max() > 1.0
    rel = 0.02 if which == 1 else 1e-5
    assert_alike(-2.0 * normals.pose_side, pose, rel)
    assert not points.any() and not normals.point_side.any()
    first = at.layout.level + 1
    assert not shared[:first].any()
    assert_alike(-2.0 * normals.mounting_side[:, None], shared[first:, None], rel)
    solved = [shared[at.layout.slices[u.name]] for u in term.unknowns()]
    assert all(np.all(np.abs(values) > 1e-3) for values in solved)


@pytest.mark.parametrize("which", [0, 1], ids=["positions", "attitudes"])
def test_a_frame_terms_equations_are_those_of_its_residuals_slopes(which: int) -> None:
    problem, at, term = list(frame_cases())[which]
    normals = term.add_to(without_images(problem, at), at, COMPONENTS)
    f, first, size = len(at.positions_m), at.layout.level + 1, at.layout.size
    information = term.information(COMPONENTS)
    by = np.zeros((f, 3, 6 + size - first))
    for i in range(f):
        for k in range(6):
            by[i, :, k] = slope(lambda h, i=i, k=k: term.miss(moved_frame(at, i, k, h))[i], STEPS[k])
    for k in range(first, size):
        by[:, :, 6 + k - first] = slope(lambda h, k=k: term.miss(moved_shared(at, k, h)), 1e-5)
    whole = np.einsum("fai,fa,faj->fij", by, information, by)
    rel = 0.02 if which == 1 else 1e-6
    for found, expected in (
        (normals.pose[:, :6, :6], whole[:, :6, :6]),
        (normals.pose_mounting[:, :6], whole[:, :6, 6:]),
        (normals.mounting, whole[:, 6:, 6:].sum(axis=0)),
    ):
        assert np.abs(found - expected).max() <= rel * np.abs(expected).max()
    assert not normals.pose[:, 6:].any() and not normals.pose_mounting[:, 6:].any()


def test_rolling_shutter_rotations_add_their_weights_to_the_diagonal() -> None:
    problem, at, term = list(frame_cases())[2]
    assert isinstance(term, RollingShutterRotation)
    normals = term.add_to(without_images(problem, at), at, COMPONENTS)
    sd = term.sd(COMPONENTS)
    assert sd[4, [0, 5, 6, 8]] == pytest.approx(
        [
            0.6 * term.rotation_sd_rad[4, 0, 0],
            1.2 * term.rotation_sd_rad[4, 1, 2],
            0.4 * term.drift_sd[4, 0],
            0.9 * term.drift_sd[4, 2],
        ]
    )
    diagonal = np.diagonal(normals.pose, axis1=1, axis2=2)
    assert not diagonal[:, :6].any()
    assert diagonal[:, 6:] == pytest.approx(1.0 / sd**2)


def test_rolling_shutter_images_do_not_change_with_place_turn_and_scale_of_the_block() -> None:
    """Nor does what is assumed of rotation and drift, about and along a camera's axes and over the depth."""
    problem, at, term = list(frame_cases())[2]
    still = replace(problem.image.reported, velocities_m_per_s=None, turns=None)
    image = replace(problem.image, reported=still)
    turned, middle = exp_turn(np.array([[0.3, -0.5, 2.0]]))[0], np.array([5.0, -3.0, 40.0])
    after = replace(
        at,
        positions_m=0.1 * at.positions_m @ turned.T + middle,
        rotations=turned @ at.rotations,
        points_m=0.1 * at.points_m @ turned.T + middle,
    )
    own_px = np.abs(image.computed_px(at) - image.computed_px(replace(at, drift=0.0 * at.drift))).max()
    assert own_px > 2.0
    assert image.computed_px(after) == pytest.approx(image.computed_px(at), abs=1e-6)
    assert term.cost(after, COMPONENTS) == term.cost(at, COMPONENTS)


def test_the_point_coordinates_right_side_is_the_slope_of_their_cost() -> None:
    problem, at = flown_problem()
    normals = problem.points.add_to(without_images(problem, at), at, COMPONENTS)
    pose, points, shared = cost_slopes(problem.points, at)
    assert not pose.any() and not shared.any()
    assert_alike(-2.0 * normals.point_side, points, 1e-6)
    plan, up = problem.points.present_sd_m(COMPONENTS)[4, ::2]
    given, weight = problem.points.sd_m[4], problem.points.weight[4]
    assert (plan, up) == pytest.approx((1.6 * given[0] / weight[0] ** 0.5, 0.9 * given[2] / weight[2] ** 0.5))


@pytest.mark.parametrize("places", [1.0, 7.0, np.inf])
def test_the_terrains_right_side_is_the_slope_of_its_cost(places: float) -> None:
    """On a plane that rises by 0.1 to the east and falls by 0.05 to the north; its deviation goes with the
    frames' mean height and the level."""
    problem, at = flown_problem()
    east, north = np.meshgrid(np.arange(-100.0, 200.0, 5.0), np.arange(-100.0, 200.0, 5.0))
    plane = GroundSurface("dem", -100.0, -100.0, 5.0, 1.0 + 0.1 * east - 0.05 * north)
    bound, share = np.arange(len(at.points_m)) % 5 > 0, problem.image.frame_share()
    terrain = Terrain(plane, 0.02, 3.0, bound, share, places=places)
    at = replace(at, shared=at.shared + 1.5 * np.eye(at.layout.size)[at.layout.level])
    normals = terrain.add_to(without_images(problem, at), at, COMPONENTS)
    pose, points, shared = cost_slopes(terrain, at)
    assert_alike(-2.0 * normals.point_side, points, 1e-5)
    assert_alike(-2.0 * normals.pose_side[:, 2:3], pose[:, 2:3], 1e-4)
    assert -2.0 * normals.level_side == pytest.approx(shared[at.layout.level], rel=1e-5)
    others = np.delete(shared, at.layout.level)
    assert not others.any() and not points[~bound].any()
    weight = -normals.level_point[:, 2]
    assert normals.level_point[bound] == pytest.approx(-weight[bound, None] * [-0.1, 0.05, 1.0])
    assert normals.level == pytest.approx(weight.sum()) and not weight[~bound].any()


def test_points_far_below_unknown_ground_do_not_draw_its_level_down() -> None:
    """One point in 20 lies ten flying heights below the ground. Such depths come of wires and of what moves
    along a line. A deviation widened by the root of their number called them near: the level then went down
    by several flying heights, since a higher block fits such points better."""
    problem, at = flown_problem()
    points_m = at.points_m.copy()
    height = float(np.median(at.positions_m[:, 2]) - np.median(points_m[:, 2]))
    points_m[:, 2] = 0.0
    points_m[::20, 2] = -10.0 * height
    flat = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    bound, share = np.ones(len(points_m), dtype=bool), problem.image.frame_share()
    terrain = Terrain(flat, 0.042, 15.0, bound, share, places=1.0)
    levels_m = np.linspace(-5.0, 1.0, 601) * height
    at = replace(at, points_m=points_m)
    of_level = np.eye(at.layout.size)[at.layout.level]
    cost = [
        terrain.cost(replace(at, shared=at.shared + (m - at.level_m) * of_level), COMPONENTS)
        for m in levels_m
    ]
    assert abs(levels_m[int(np.argmin(cost))]) < 0.03 * height


def test_land_far_from_its_level_as_a_whole_is_drawn_to_it_in_full() -> None:
    """Of points that count as one, the bulk isn't far. Each had a tenth of its weight, and models that turn
    frames came to land 30 m off in their first steps."""
    problem, at = flown_problem()
    points_m = at.points_m.copy()
    points_m[:, 2] = np.random.default_rng(0).normal(0.0, 1.0, len(points_m))
    points_m[::20, 2] = 500.0
    flat = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    bound, share = np.ones(len(points_m), dtype=bool), problem.image.frame_share()
    terrain = Terrain(flat, 0.042, 15.0, bound, share, places=1.0)
    at = replace(at, points_m=points_m)
    sd_m = terrain.sd_m(at)
    assert terrain.weighed(at) is terrain
    higher = replace(at, points_m=points_m + [0.0, 0.0, 10.0 * sd_m])
    weighed = terrain.weighed(higher)
    assert weighed.bulk == pytest.approx(10.0, rel=0.05)
    weight, *_ = weighed.rows(higher.points_m, bound, weighed.sd_m(higher), 0.0)
    near, far = np.delete(weight, np.s_[::20]), weight[::20]
    assert near.min() > 0.88 / (len(points_m) * sd_m**2)
    assert far.max() < near.min()
    assert replace(terrain, places=7.0).weighed(higher).bulk == 1.0


@pytest.mark.parametrize("position_sd", [1.0, 1e4])
def test_a_step_lifts_a_block_by_the_residuals_that_it_leaves(position_sd: float) -> None:
    """Also where positions are known to 10 km, so that hardly anything tells the block's scale."""
    problem, at = flown_problem()
    plane = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    every = np.ones(len(at.points_m), dtype=bool)
    terrain = Terrain(plane, 1e-3, 3.0, every, problem.image.frame_share())
    loose = tuple(
        replace(t, reported=replace(t.reported, positions_sd_m=position_sd * t.reported.positions_sd_m))
        if isinstance(t, GnssPositions)
        else t
        for t in problem.frames
    )
    problem = replace(problem, terrain=terrain, frames=loose)
    before = reduce_normals(problem.normals(at, COMPONENTS))

    def solution(reduced: Reduced) -> Step:
        pose, interior, points, level, platform = reduced.solve()
        return Step(pose, points, np.concatenate([interior.ravel(), [level], platform]))

    after, step = terrain.solved(before, at, solution)
    height = terrain.height_m(at)
    weight, miss, normal = terrain.rows(at.points_m, every, terrain.sd_m(at), at.level_m)
    left = miss + step.shared[before.level] - (normal * step.points).sum(axis=1)
    lift = (weight * miss**2).sum() / height - (after.shared_side - before.shared_side)[before.level]
    assert lift == pytest.approx((weight * miss * left).sum() / height, rel=1e-6)
    again = solution(after)
    assert step.pose == pytest.approx(again.pose, rel=1e-4, abs=1e-6 * np.abs(again.pose).max())


def test_the_blocks_right_side_is_the_slope_of_the_whole_sum() -> None:
    """Images, terms and priors of the shared unknowns together, with all rows read at once."""
    problem, at = flown_problem()
    flat = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    bound = ~problem.points.control
    problem = replace(problem, terrain=Terrain(flat, 0.02, 3.0, bound, problem.image.frame_share()))
    problem = replace(problem, frames=problem.frames[:1])  # attitudes are linear to a hundredth alone
    at = replace(at, layout=problem.layout, shared=at.shared[: problem.layout.size])
    normals = problem.normals(at, COMPONENTS)
    pose, points, shared = cost_slopes(problem, at)
    assert_alike(-2.0 * normals.pose_side, pose, 1e-4)
    assert_alike(-2.0 * normals.point_side, points, 1e-4)
    interior = np.array([name != "readout_s" for _, name in at.layout.names[: at.layout.level]])
    found = np.concatenate([normals.interior_side.ravel(), [normals.level_side], normals.mounting_side])
    solved = np.append(interior, np.ones(at.layout.size - len(interior), dtype=bool))
    assert -2.0 * found[solved] == pytest.approx(shared[solved], rel=2e-4)


def layout(cameras: tuple[Camera, ...], *, lever_arm: bool, boresight: bool) -> UnknownLayout:
    """Cameras, level and what is asked for of the platform, with the delay."""
    gnss, attitudes = frame_terms(fly(1, 1, 2, points=20).block.poses)
    terms = replace(gnss, lever_arm=lever_arm), replace(attitudes, boresight=boresight)
    interior = tuple(camera_unknowns(c, np.arange(1.0, 10.0)) for c in cameras)
    return UnknownLayout(interior, level_unknown(4.0), tuple(u for term in terms for u in term.unknowns()))


def test_each_shared_unknown_has_its_place() -> None:
    of = layout((TWO, ONE), lever_arm=True, boresight=True)
    assert of.slices == {
        "two": slice(0, 9),
        "one": slice(9, 18),
        LEVEL: slice(18, 19),
        LEVER_ARM: slice(19, 22),
        DELAY: slice(22, 23),
        OFFSET: slice(23, 26),
        BORESIGHT: slice(26, 29),
    }
    assert (of.size, of.level, of.interior, of.platform_size) == (29, 18, slice(0, 18), 10)
    assert of.platform_columns(LEVER_ARM) == slice(0, 3)
    assert of.platform_columns(BORESIGHT) == slice(7, 10)
    assert of.platform_columns("another") is None
    assert [of.names[k] for k in (0, 12, 17, 18)] == [
        ("two", "focal_length_px"),
        ("one", "k1"),
        ("one", "readout_s"),
        ("ground", "level_m"),
    ]
    assert [of.names[k][1] for k in (19, 21, 22, 24, 26, 28)] == [
        "lever_arm_forward_m",
        "lever_arm_down_m",
        "gps_lag_s",
        "offset_north_m",
        "boresight_roll_deg",
        "boresight_yaw_deg",
    ]
    assert of.given[[0, 9, 12, 17, 18, 28]].tolist() == [900.0, 1000.0, -0.02, 0.05, 0.0, 0.0]
    assert of.sd[[0, 8, 9, 18, 23, 24, 25]].tolist() == [1.0, 9.0, 1.0, 4.0, 1.0, 1.5, 3.0]
    assert of.unit[[19, 22, 26]] == pytest.approx([1.0, 1.0, np.pi / 180.0])
    assert np.flatnonzero(~of.optional).tolist() == [18, 23, 24, 25]
    assert of.of_readouts(of.given).tolist() == [0.0, 0.05]


def test_unknowns_that_nothing_solves_for_have_no_place_and_are_zero() -> None:
    of = layout((ONE,), lever_arm=False, boresight=False)
    assert list(of.slices) == ["one", LEVEL, DELAY, OFFSET]
    none = np.zeros((0, 3)), of.given + 1.0, np.zeros((1, 0, 3)), np.zeros((1, 3))
    at = Estimate(of, np.zeros((1, 3)), np.eye(3)[None], *none)
    assert at.value(BORESIGHT, 3).tolist() == [0.0, 0.0, 0.0]
    assert at.value(DELAY, 1).tolist() == [1.0]
    assert at.interior.shape == (1, len(INTERIOR)) and at.level_m == 1.0


def test_a_start_carries_values_by_name_into_another_layout() -> None:
    """Cameras in another order and a third one, boresight angles added, no lever arm any more."""
    third = replace(TWO, name="third", focal_length_px=700.0)
    before = layout((ONE, TWO), lever_arm=True, boresight=False)
    after = layout((TWO, third, ONE), lever_arm=False, boresight=True)
    shared, fixed = 100.0 + np.arange(before.size), np.zeros(before.size, dtype=bool)
    fixed[[3, 10, 22, 24]] = True  # k1 of one, principal column of two, delay, offset to the north
    none = np.zeros((0, 3)), shared, np.zeros((1, 0, 3)), np.zeros((1, 3))
    poses = fly(1, 1, 2, points=20).block.poses
    at = Estimate(before, np.zeros((1, 3)), np.eye(3)[None], *none)
    start = Start(poses, (ONE, TWO), at, Components(), fixed, None)
    values, kept = start.shared_in(after)
    assert values[:9].tolist() == shared[9:18].tolist()
    assert values[9:18].tolist() == after.given[9:18].tolist()
    assert values[18:27].tolist() == shared[:9].tolist()
    assert values[27] == shared[18]
    assert values[28:32].tolist() == shared[22:26].tolist()
    assert values[32:].tolist() == [0.0, 0.0, 0.0]
    assert np.flatnonzero(kept).tolist() == [1, 21, 28, 30]
