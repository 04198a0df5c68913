"""The reduced normal equations against the whole ones as one dense matrix."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from geomosaic.adjustment.kernels.collinearity import (
    Projections,
    Rows,
    image_from_ground,
    project,
    readout_of,
)
from geomosaic.adjustment.kernels.normal_equations import Normals, build_normals
from geomosaic.adjustment.kernels.observation_groups import Sightings
from geomosaic.adjustment.kernels.pose_jacobian import Levers
from geomosaic.adjustment.kernels.reduced_equations import reduce_normals
from geomosaic.camera.exterior import Poses
from geomosaic.camera.rotation import exp_turn
from geomosaic.errors import NotSolvableError

MOUNTING = 3


def random_normals(
    seed: int, frames: int = 5, cameras: int = 2, points: int = 12, numbers: int = 8, d: int = 6
) -> tuple[Normals, np.ndarray]:
    """Normals of random derivatives with weak priors, a level and a mounting, and the same as one dense
    matrix with its right side: poses, cameras, level, mounting, points."""
    rng = np.random.default_rng(seed)
    frame, point = np.nonzero(rng.random((frames, points)) < 0.7)
    order = np.lexsort((frame, point))
    frame, point = frame[order], point[order]
    camera_of = np.arange(frames) % cameras
    m, fd, ck = len(frame), d * frames, numbers * cameras
    terms = max((d - 9) // 3, 0)
    axes = exp_turn(rng.normal(0, 1, (m if terms else 0, 3))).transpose(1, 2, 0)
    levers = Levers(*(rng.normal(0, 1, (k, m)) for k in (3, terms, min(terms, 1))), axes)
    by_interior, by_point = rng.normal(0, 1, (2, numbers, m)), rng.normal(0, 1, (2, 3, m))
    by_pose = levers.by_pose(by_point)
    residual, weight = rng.normal(0, 1, (2, m)), rng.uniform(0.5, 2.0, m)
    n = build_normals(
        Sightings.of(frame, point, frames, points),
        camera_of,
        (cameras, numbers, 0),
        lambda which: (
            residual[:, which],
            weight[which],
            Levers(
                *(a[:, which] for a in (levers.arms_m, levers.terms, levers.shares)),
                axes[..., which] if terms else axes,
            ),
            by_interior[..., which],
            by_point[..., which],
        ),
        terms,
    )
    level_point = rng.normal(0, 0.1, (points, 3))
    for block, prior in ((n.pose, 0.3), (n.interior, 0.2), (n.points, 1.0)):
        i = np.arange(block.shape[-1])
        block[:, i, i] += prior
    by_mounting = rng.normal(0, 0.3, (d * frames, MOUNTING))
    n = replace(
        n,
        level_point=level_point,
        level=7.0,
        level_side=1.3,
        pose_mounting=by_mounting.reshape(frames, d, MOUNTING),
        mounting=by_mounting.T @ by_mounting + 2.0 * np.eye(MOUNTING),
        mounting_side=np.array([0.7, -1.1, 0.4]),
    )
    shared = fd + ck + 1 + MOUNTING
    design = np.zeros((2 * m, shared + 3 * points))
    for i in range(m):
        rows = slice(2 * i, 2 * i + 2)
        design[rows, d * frame[i] : d * frame[i] + d] = by_pose[..., i]
        at = fd + numbers * camera_of[frame[i]]
        design[rows, at : at + numbers] = by_interior[..., i]
        at = shared + 3 * point[i]
        design[rows, at : at + 3] = by_point[..., i]
    p = np.repeat(weight, 2)
    dense = design.T @ (p[:, None] * design)
    priors = [np.full(fd, 0.3), np.full(ck, 0.2), [7.0], np.zeros(MOUNTING), np.full(3 * points, 1.0)]
    dense += np.diag(np.concatenate(priors))
    dense[fd + ck, shared:] = dense[shared:, fd + ck] = level_point.ravel()
    here = slice(shared - MOUNTING, shared)
    dense[here, here] = n.mounting
    dense[:fd, here] = by_mounting
    dense[here, :fd] = by_mounting.T
    side = design.T @ (p * residual.T.ravel())
    side[fd + ck] = 1.3
    side[here] = n.mounting_side
    return n, np.column_stack([dense, side])


@pytest.mark.parametrize(("seed", "numbers", "d"), [(0, 8, 6), (7, 9, 12)])
def test_the_reduced_system_solves_the_whole_one(seed: int, numbers: int, d: int) -> None:
    n, whole = random_normals(seed, numbers=numbers, d=d)
    inverse = np.linalg.inv(whole[:, :-1])
    x = inverse @ whole[:, -1]
    ck = 2 * numbers
    poses = 5 * d
    level = poses + ck
    end = level + 1 + MOUNTING
    reduced = reduce_normals(n)
    pose, interior, points, up, mounting = reduced.solve()
    assert pose.ravel() == pytest.approx(x[:poses])
    assert interior.ravel() == pytest.approx(x[poses:level])
    assert up == pytest.approx(x[level])
    assert mounting == pytest.approx(x[level + 1 : end])
    assert points.ravel() == pytest.approx(x[end:])
    by_frame, shared = reduced.covariance()
    assert by_frame[3] == pytest.approx(inverse[3 * d : 4 * d, 3 * d : 4 * d])
    assert shared == pytest.approx(inverse[poses:end, poses:end])
    gradient = np.random.default_rng(1).normal(0, 1, (end, 3))
    gradient[:poses].reshape(5, d, 3)[:, 6:] = 0.0
    by_pose = gradient[:poses].reshape(5, d, 3)[:, :6]
    assert reduced.propagate(by_pose, gradient[poses:]) == pytest.approx(
        gradient.T @ inverse[:end, :end] @ gradient
    )


def test_fixed_numbers_keep_their_variance_and_make_the_others_wrong_by_it() -> None:
    """Of the whole matrix M: P_uu = M_uu^-1 + S V S' with S = -M_uu^-1 M_uh, and P_hh = V."""
    n, whole = random_normals(3)
    fixed_numbers, given = np.array([30, 35, 41]), np.array([0.7, 1.9, 0.04])
    others = np.setdiff1d(np.arange(len(whole)), fixed_numbers)
    alone = np.linalg.inv(whole[np.ix_(others, others)])
    lever = -alone @ whole[np.ix_(others, fixed_numbers)]
    want = np.zeros((len(whole), len(whole)))
    want[np.ix_(others, others)] = alone + lever @ np.diag(given) @ lever.T
    want[np.ix_(others, fixed_numbers)] = lever * given
    want[np.ix_(fixed_numbers, others)] = (lever * given).T
    want[np.ix_(fixed_numbers, fixed_numbers)] = np.diag(given)
    reduced = reduce_normals(n)
    end = 30 + len(reduced.shared)
    variance = np.zeros(len(reduced.shared))
    variance[fixed_numbers - 30] = given
    considered = reduced.considering(variance)
    by_frame, shared = considered.covariance()
    assert by_frame[3] == pytest.approx(want[18:24, 18:24])
    assert shared == pytest.approx(want[30:end, 30:end])
    gradient = np.random.default_rng(1).normal(0, 1, (end, 3))
    assert considered.propagate(gradient[:30].reshape(5, 6, -1), gradient[30:]) == pytest.approx(
        gradient.T @ want[:end, :end] @ gradient
    )


def test_image_coordinates_without_derivatives_are_the_same() -> None:
    rng = np.random.default_rng(4)
    positions, points = rng.normal([3.0, -8.0, 90.0], 4.0, (50, 3)), rng.normal(0.0, 20.0, (50, 3))
    points[7, 2] = 200.0
    interior = np.tile([812.0, 403.0, 291.0, -0.11, 0.05, -0.02, 0.003, -0.002, 0.03], (50, 1))
    turned, velocities = exp_turn(rng.normal(0, 0.2, (50, 3))), rng.normal(0.0, 5.0, (50, 3))
    poses = Poses(positions, turned, np.ones((50, 3)), np.ones((50, 3)), velocities)
    read = readout_of(
        poses,
        turned,
        Rows(np.arange(50), rng.uniform(0.0, 600.0, 50), np.full(50, 600.0), interior[:, 8]),
    )
    for rolling in (None, read):
        seen = Projections(positions, turned, interior, points, rolling)
        image = image_from_ground(seen)
        np.testing.assert_allclose(image, project(seen)[0], rtol=1e-13)
        assert np.flatnonzero(np.isnan(image).any(axis=1)).tolist() == [7]


def test_a_system_without_a_solution_says_so() -> None:
    n, _ = random_normals(0)
    n.pose[2] = -np.eye(6)
    with pytest.raises(NotSolvableError):
        reduce_normals(n).solve()


def test_a_wild_point_that_came_to_lie_at_a_camera_stops_nothing() -> None:
    """Sharp to 1e-10 m across its ray and unknown along it: to sixteen digits its matrix has no inverse. (As
    found in a survey of a spiral; eigenvalues 2.4e3, 1.5e19, 1.9e19.)"""
    n, _ = random_normals(3)
    points = n.points.copy()
    points[4] = [
        [1.5265490409243978e19, 9.264643013237158e16, -6.035918030200584e17],
        [9.264643013237158e16, 9.738797973860553e18, 9.484422315818312e18],
        [-6.035918030200584e17, 9.484422315818312e18, 9.26822684916111e18],
    ]
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.inv(points[4])
    plain, wild = reduce_normals(n).solve(), reduce_normals(replace(n, points=points)).solve()
    assert all(np.isfinite(a).all() for a in wild)
    assert np.abs(wild[0] - plain[0]).max() < np.abs(plain[0]).max()


def test_equations_of_many_sightings_have_few_numbers_each() -> None:
    """Of the 36 derivatives of each, by pose, interior and point, 6 are left, and where it lies (3); of each
    point, here a fifth as many, 45 numbers."""

    def most_bytes(points: int, frames: int = 40, views: int = 5, k: int = 9) -> int:
        rng = np.random.default_rng(5)
        first = np.sort(rng.integers(0, frames - views + 1, points))
        frame, point = (first[:, None] + np.arange(views)).ravel(), np.repeat(np.arange(points), views)
        sightings = Sightings.of(frame, point, frames, points)

        def linearised(which: np.ndarray) -> tuple[np.ndarray, np.ndarray, Levers, np.ndarray, np.ndarray]:
            n = len(which)
            levers = Levers.rigid(rng.normal(0, 1, (3, n)))
            by_interior, by_point = rng.normal(0, 1, (2, k, n)), rng.normal(0, 1, (2, 3, n))
            return rng.normal(0, 1, (2, n)), np.ones(n), levers, by_interior, by_point

        tracemalloc.start()
        normals = build_normals(sightings, np.zeros(frames, np.intp), (1, k, 0), linearised)
        normals.pose[:, range(6), range(6)] += 1.0
        reduce_normals(replace(normals, level=1.0)).solve()
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    more = 8_000
    assert (most_bytes(12_000 + more) - most_bytes(12_000)) / (5 * more) < 24 * 8
