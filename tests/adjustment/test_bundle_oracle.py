"""The bundle against an oracle: the same cost written down apart from it, minimised by scipy's least squares.

The oracle takes nothing from the solver but the deviations it estimated and which numbers it fixed. It has
its own residuals by `Pose.image_from_ground`, derivatives by differences, and all unknowns in one dense
system. It starts from what was reported.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from adjustment_blocks import camera_unknowns, fly, hills
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation as Turn

from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.solver.problem import BlockProblem
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.solver.solve import solve
from geomosaic.adjustment.terms.attitudes import HEADINGS, TILT, YAW, Attitudes
from geomosaic.adjustment.terms.gnss_positions import HORIZONTAL, VERTICAL
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.camera.exterior import Pose
from geomosaic.camera.rotation import Rotation
from geomosaic.matching.tracks import Tracks, join_tracks
from geomosaic.projection.footprint import ground_from_images

LENS = ("focal_length_px", "principal_col_px", "principal_row_px", "k1", "k2", "k3", "p1", "p2")
LENS_SDS = {
    "some of the lens, all determined": [120.0, 120.0, 120.0, 0.1, 0.0, 0.0, 0.0, 0.0],
    "all of the lens, in part fixed": [10.0, 10.0, 10.0, 0.1, 0.1, 0.1, 0.003, 0.003],
}
OFF_PX = {7: [2.5, -1.0], 60: [0.0, 3.0], 131: [-1.5, 1.5]}
"""Observations with an error of 5 to 14 deviations."""
FREEDOM = 5.0
"""Of Student's distribution, in pairs: density (1 + s^2 / FREEDOM) ** -(FREEDOM / 2 + 1), s over its scale."""
TELLS = 7.0 / 9.0
"""Fisher's information of such a pair times its squared scale."""
STEP = 1e-5


@dataclass(frozen=True)
class Oracle:
    """The cost of a block as a sum of squares. Unknowns are changes from what was reported, in units of `size`:
    of each pose (east, north, up; turn from the left), of the lens, of each point. The last is by how much all
    headings are off, clockwise."""

    problem: BlockProblem
    solved: Solution

    @property
    def tracks(self) -> Tracks:
        return self.problem.tracks

    @property
    def reported(self):
        """Reported poses."""
        return self.problem.image.reported

    @property
    def points(self):
        """Prior coordinates and deviations."""
        return self.problem.points

    @property
    def size(self):
        """Prior deviations: of poses those the solver estimated, of the lens and points those reported."""
        names = HORIZONTAL, HORIZONTAL, VERTICAL, TILT, TILT, YAW
        factor = [self.solved.components[name] for name in names]
        pose = np.column_stack([self.reported.positions_sd_m, self.reported.rotations_sd_rad]) * factor
        heading = next(t for t in self.problem.frames if isinstance(t, Attitudes)).groups_sd_rad
        return np.concatenate(
            [pose.ravel(), self.problem.interior[0].sd[:8], self.points.sd_m.ravel(), heading]
        )

    @property
    def prior(self):
        """Derivatives of the prior residuals by the unknowns, (n, n): of turns about the vertical also by what
        headings are off in common."""
        out, yaw = np.eye(len(self.size)), 6 * np.arange(len(self.reported)) + 5
        out[yaw, -1] = -self.size[-1] / self.size[yaw]
        return out

    @property
    def free(self):
        """Which unknowns are solved for."""
        free = self.size > 0.0
        free[self.lens] &= ~self.solved.fixed[:8]
        return np.flatnonzero(free)

    @property
    def lens(self):
        n = 6 * len(self.reported)
        return slice(n, n + 8)

    def of_solver(self):
        """The solver's solution."""
        reported, found = self.reported, self.solved.poses
        turn = Turn.from_matrix(found.rotations @ np.swapaxes(reported.rotations, 1, 2)).as_rotvec()
        pose = np.column_stack([found.positions_m - reported.positions_m, turn])
        after, before = self.solved.cameras[0], self.problem.cameras[0]
        lens = [getattr(after, name) - getattr(before, name) for name in LENS]
        points = self.solved.points_m - self.points.given_m
        heading = self.solved.estimate.value(HEADINGS, 1)
        off = np.concatenate([pose.ravel(), lens, points.ravel(), heading])
        return np.divide(off, self.size, out=np.zeros_like(off), where=self.size > 0.0)

    def image(self, x):
        """Residuals over the deviation that their points leave of them, (m, 2)."""
        pose, lens, points, _ = np.split(x * self.size, [self.lens.start, self.lens.stop, len(x) - 1])
        reported, before = self.reported, self.problem.cameras[0]
        camera = replace(before, **{k: getattr(before, k) + v for k, v in zip(LENS, lens, strict=True)})
        at = self.points.given_m + points.reshape(-1, 3)
        out = np.empty((len(self.tracks.frame), 2))
        for i, change in enumerate(pose.reshape(-1, 6)):
            seen = self.tracks.frame == i
            rotation = Rotation(Turn.from_rotvec(change[3:]).as_matrix() @ reported.rotations[i])
            here = Pose(reported.positions_m[i] + change[:3], rotation)
            out[seen] = self.tracks.image_px[seen] - here.image_from_ground(
                camera, at[self.tracks.point[seen]]
            )
        return out / (self.solved.components[IMAGE] * np.sqrt(self.shown[:, None]))

    @property
    def shown(self):
        """1 - 3 / 2k of observations of a point in k images, a half where they are two, (m,)."""
        return np.maximum(1.0 - 1.5 / self.tracks.lengths[self.tracks.point], 0.5)

    def derivatives(self, x):
        """Of `image`, (m, 2, n), by central differences: an observation sees one frame, the lens, one point."""
        n, m = len(x), np.arange(len(self.tracks.frame))
        pose, lens = np.arange(self.lens.start), np.arange(self.lens.start, self.lens.stop)
        seen = [6 * self.tracks.frame + k for k in range(6)]
        seen += [self.lens.stop + 3 * self.tracks.point + k for k in range(3)]
        together = [pose[k::6] for k in range(6)] + [
            np.arange(self.lens.stop + k, n - 1, 3) for k in range(3)
        ]
        out = np.zeros((len(m), 2, n))
        for unknowns, column in zip([*together, *lens[:, None]], [*seen, *lens], strict=True):
            step = np.zeros(n)
            step[unknowns] = STEP
            out[m, :, column] = (self.image(x + step) - self.image(x - step)) / (2.0 * STEP)
        return out

    def solve(self):
        """The unknowns at the least of sum rho(|image|) + sum x^2 that is nearest to the solver's.

        A long-tailed cost has several: an image that is off may be one of a point's four or another. The least
        that is found with squares for rho to begin with has to be as likely.

        rho(s) = c^2 log(1 + s^2 / c^2), times what makes of it the logarithm of a density: each image residual is
        shortened to a square root of rho.

        How near: the least to a thousandth of the deviations; the other, of which the cost alone counts, to a
        hundredth. The last iterations of a hundred and more would move nothing that is compared.
        """
        times = np.sqrt(self.shown * (FREEDOM + 2.0) / (FREEDOM * TELLS))[:, None]
        x, prior = np.zeros(len(self.size)), self.prior[np.ix_(self.free, self.free)]

        def all_of(free):
            x[self.free] = free
            return x.copy()

        def rows(free, c):
            r = self.image(all_of(free))
            s2 = (r**2).sum(axis=1, keepdims=True)
            image = times * r * np.sqrt(c**2 * np.log1p(s2 / c**2) / s2)
            return np.concatenate([image.ravel(), prior @ free])

        def slopes(free, c):
            now = all_of(free)
            r, by = self.image(now), self.derivatives(now)[:, :, self.free]
            s2 = (r**2).sum(axis=1)
            rho, weight = c**2 * np.log1p(s2 / c**2), 1.0 / (1.0 + s2 / c**2)
            short = np.sqrt(rho / s2)
            less = (weight / short - short) / s2
            by = times[:, :, None] * (
                short[:, None, None] * by
                + (less[:, None] * r)[:, :, None] * np.einsum("ma,man->mn", r, by)[:, None]
            )
            return np.concatenate([by.reshape(-1, len(free)), prior])

        def least(begin, c, near):
            return least_squares(
                rows, begin, slopes, method="lm", xtol=near, ftol=1e-4 * near, gtol=1e-15, args=(c,)
            )

        squares, c = least(np.zeros(len(self.free)), 1e4, 1e-4), np.sqrt(FREEDOM * TELLS)
        near, apart = least(self.of_solver()[self.free], c, 1e-5), least(squares.x, c, 1e-4)
        assert near.cost < apart.cost + 0.5
        return all_of(near.x)

    def covariance(self, x):
        """(J'PJ)^-1 of all unknowns in the units of `size`, P with Student's weights of a mean of 1;
        fixed numbers keep their prior deviation, and the others follow them."""
        n = len(self.size)
        r = self.image(x)
        weight = self.shown * (FREEDOM + 2.0) / (FREEDOM + (r**2).sum(axis=1) / TELLS)
        root = np.repeat(np.sqrt(weight), 2)
        jacobian = self.derivatives(x).reshape(-1, n) * root[:, None]
        free, fixed = self.free, self.lens.start + np.flatnonzero(self.solved.fixed[:8])
        prior = self.prior[np.ix_(free, free)]
        own = np.linalg.inv(jacobian[:, free].T @ jacobian[:, free] + prior.T @ prior)
        follow = -own @ jacobian[:, free].T @ jacobian[:, fixed]
        out = np.zeros((n, n))
        out[np.ix_(free, free)] = own + follow @ follow.T
        out[np.ix_(free, fixed)] = follow
        out[np.ix_(fixed, free)] = follow.T
        out[fixed, fixed] = 1.0
        return self.turned_from_here(x, out)

    def turned_from_here(self, x, covariance):
        """The covariance with turns counted from the attitudes found, not from those reported."""
        onward = np.eye(len(x))
        for i, turn in enumerate((x * self.size)[: self.lens.start].reshape(-1, 6)[:, 3:]):
            here = 6 * i + 3 + np.arange(3)
            back = Turn.from_rotvec(turn).inv()
            steps = [(Turn.from_rotvec(turn + u) * back).as_rotvec() / STEP for u in STEP * np.eye(3)]
            size = self.size[here]
            onward[np.ix_(here, here)] = np.column_stack(steps) * size / size[:, None]
        return onward @ covariance @ onward.T


PARTLY = "all of the lens, in part fixed"


@pytest.fixture(
    scope="module",
    params=[pytest.param(one, marks=[] if one == PARTLY else [pytest.mark.proof]) for one in LENS_SDS],
)
def both(request):
    """The solver's solution in an oracle, and what the oracle finds for the same block: six frames over hills,
    71 points, three observations off."""
    block = fly(11, 2, 3, points=75, relief=hills, there_and_back=True).block
    tracks = join_tracks(block.ties)
    image_px = tracks.image_px.copy()
    image_px[list(OFF_PX)] += list(OFF_PX.values())
    tracks = replace(tracks, image_px=image_px)
    at = ground_from_images(tracks.frame, image_px, block.poses, block.cameras, block.ground)
    points = (
        np.stack([np.bincount(tracks.point, column) for column in at.T], axis=1) / tracks.lengths[:, None]
    )
    problem = block_problem(block, Settings(), tracks, points)
    lens_sd = np.array([*LENS_SDS[request.param], 0.0])
    problem = replace(
        problem,
        interior=(camera_unknowns(block.cameras[0], lens_sd),),
        points=replace(problem.points, sd_m=np.full(points.shape, 5.0)),
        terrain=None,
    )
    oracle = Oracle(problem, solve(problem, block.poses))
    x = oracle.solve()
    covariance = oracle.covariance(x)
    return oracle, x, covariance


def test_the_block_is_what_it_should_be(both, request):
    """What is compared has free and fixed numbers, observations without much say, and no tag that lies."""
    oracle, x, _ = both
    fixed = [name for name, h in zip(LENS, oracle.solved.fixed, strict=False) if h]
    some = "some" in request.node.callspec.params["both"]
    assert fixed == ([] if some else ["focal_length_px", "k2", "k3", "p2"])
    assert np.all(oracle.solved.weight[list(OFF_PX)] < 0.5)
    assert np.linalg.norm(x[: oracle.lens.start].reshape(-1, 3), axis=1).max() < 3.0


def test_poses_lens_and_points_are_those_of_the_least_cost(both):
    """To some hundredths of their deviations: the solver stops where a step gains 1e-4 of the cost. Points that
    have an image far off go on longest."""
    oracle, x, covariance = both
    off = (x - oracle.of_solver())[oracle.free]
    sd = np.sqrt(np.diag(covariance))[oracle.free]
    shared = oracle.free < oracle.lens.stop
    assert np.abs(off / sd)[shared].max() < 0.06
    assert np.abs(off / sd).max() < 0.2
    assert np.abs(x[oracle.free] / sd).max() > 1.0


def test_stated_covariances_are_those_of_the_whole_system(both):
    oracle, _, covariance = both
    sized = covariance * np.outer(oracle.size, oracle.size)
    stated = oracle.solved.stated.pose_covariance
    for i, own in enumerate(stated):
        here = slice(6 * i, 6 * i + 6)
        sd = np.sqrt(np.diag(sized[here, here]))
        assert np.abs((own - sized[here, here]) / np.outer(sd, sd)).max() < 0.02
    free = np.flatnonzero(oracle.problem.interior[0].sd[:8])
    lens = sized[oracle.lens, oracle.lens][np.ix_(free, free)]
    sd = np.sqrt(np.diag(lens))
    assert oracle.solved.stated.shared_sd[free] == pytest.approx(sd, rel=0.002)
    assert oracle.solved.stated.shared_correlation[np.ix_(free, free)] == pytest.approx(
        lens / np.outer(sd, sd), abs=0.01
    )


@pytest.mark.proof
@pytest.mark.parametrize("both", [next(iter(LENS_SDS))], indirect=True)
def test_other_degrees_of_freedom_would_show(both, monkeypatch):
    oracle, _, covariance = both
    monkeypatch.setitem(globals(), "FREEDOM", 2.0)
    off = (oracle.solve() - oracle.of_solver())[oracle.free]
    assert np.abs(off / np.sqrt(np.diag(covariance))[oracle.free]).max() > 0.2
