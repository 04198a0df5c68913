"""The bundle's stated covariance and its accuracy, against a Cramér-Rao bound computed apart from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from geomosaic.adjustment.kernels.collinearity import INTERIOR, Projections, project
from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from tools.bench import bench_monte_carlo as bench
from tools.bench.cramer_rao import LENS, cramer_rao, derivatives, lens_of, pose_errors

SMALL = replace(
    bench.CASES[0],
    plan=replace(bench.FRAMES, lines=2, frames_per_line=5, width_px=800, height_px=600),
    per_m2=0.06,
)
SEEDS = range(1, 9)


@pytest.fixture(scope="module")
def draws():
    """Per seed: draw, bound and what the bundle makes of it."""
    out = []
    for seed in SEEDS:
        d = bench.draw(SMALL, seed)
        out.append((d, cramer_rao(d), METHODS["bundle"](d.block, Settings())))
    return out


def _share_of_oracle(draws, scale: float = 1.0) -> float:
    """Mean NEES of the bundle, its covariance scaled, over that of the oracle on the same draws."""
    bundle, oracle = [], []
    for d, bound, adjusted in draws:
        n = len(d.poses)
        errors = pose_errors(adjusted.poses, d.poses)
        bundle.append(bench.nees(errors, scale * adjusted.pose_covariance)["pose"])
        oracle.append(bench.nees(bound.oracle[: 6 * n].reshape(n, 6), bound.pose_covariance(n))["pose"])
    return float(np.mean(bundle) / np.mean(oracle))


@pytest.mark.proof
def test_errors_are_as_large_as_stated(draws):
    assert 0.8 < _share_of_oracle(draws) < 1.25


@pytest.mark.proof
@pytest.mark.parametrize("scale", [1.5, 1.0 / 1.5])
def test_a_wrong_scale_of_the_covariance_would_show(draws, scale):
    assert not 0.8 < _share_of_oracle(draws, scale) < 1.25


@pytest.mark.proof
def test_stated_covariance_is_the_bound(draws):
    ratios = [
        bench.stated_over_bound(a.pose_covariance, bound.pose_covariance(len(d.poses)))
        for d, bound, a in draws
    ]
    for group in ("pose", *bench.GROUPS):
        assert 0.8 < np.mean([r[group] for r in ratios]) < 1.25, group


@pytest.mark.proof
def test_errors_on_the_ground_are_those_of_the_best_estimate(draws):
    squares = []
    for d, bound, adjusted in draws:
        g = bench.grid(d, np.radians(SMALL.plan.heading_deg), 10.0)
        basis = bench.similarities(g.points_m)
        found, oracle = bench.shown(g, adjusted), g.by_unknown @ bound.oracle
        squares.append(np.square([*bench.rmse_m(found, basis), *bench.rmse_m(oracle, basis)]))
    absolute, after, absolute_oracle, after_oracle = np.sqrt(np.mean(squares, axis=0))
    assert absolute < 1.1 * absolute_oracle
    assert after < 1.15 * after_oracle
    assert after < 0.1 * absolute


@pytest.mark.proof
def test_the_oracle_keeps_its_own_bound():
    """Whitened by the bound's covariance, the linear estimate's errors are standard normal: 30 draws."""
    case = replace(SMALL, per_m2=0.02)
    squared, unknowns = 0.0, 0
    for seed in range(1, 31):
        bound = cramer_rao(bench.draw(replace(case, lens_drawn=False), seed))
        poses = bound.oracle[:-1]
        squared += poses @ np.linalg.solve(bound.covariance[:-1, :-1], poses)
        unknowns += len(poses)
    assert squared / unknowns == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / unknowns))


def test_bound_and_bundle_have_the_same_derivatives():
    """Central differences of `Pose.image_from_ground` against the solver's analytic ones."""
    assert INTERIOR[: len(LENS)] == LENS
    d = bench.draw(replace(SMALL, per_m2=0.01), 3)
    camera = replace(d.camera, k1=-0.05, k2=0.01, p1=0.001, p2=-0.002)
    points = d.points_m[d.point[d.frame == 4]] + [0.0, 0.0, 3.0]
    many = np.ones((len(points), 1))
    interior = np.append(lens_of(camera), np.zeros(len(INTERIOR) - len(LENS)))
    pose = d.poses[4]
    _, by_pose, by_interior, by_point, *_ = project(
        Projections(many * pose.position_m, many[:, None] * pose.rotation.matrix, many * interior, points)
    )
    own = derivatives(pose, camera, points)
    for mine, theirs in zip(own, (by_pose, by_interior[:, :, : len(LENS)], by_point), strict=True):
        scale = np.abs(theirs).max(axis=(0, 1))
        assert np.abs(mine - theirs).max(axis=(0, 1)) == pytest.approx(0.0, abs=1e-5 * scale.max())
