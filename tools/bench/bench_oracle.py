"""The project's bundle against COLMAP's: the same tie points, positions and start, solved by both.

    .venv/bin/python -m pip install --no-deps --target out/oracle pycolmap
    python -m tools.bench.bench_oracle [--pycolmap out/oracle] [--only NAME ...] [--seed N]

pycolmap (with Ceres inside) is an outside oracle and no part of the project's environment; without it the
tool says so and ends with 0. Flights are drawn as in `bench_monte_carlo.py`, geometry alone, with a lens of
k1 = -0.05 that is reported as straight. Solvers:

- geomosaic: the default method, which knows attitudes, what lenses are like and what ground is like.
- geomosaic, positions alone: its bundle without any of it, for focal length, principal point, k1 and k2.
- COLMAP, the same problem: pose priors, its RADIAL lens (the same five numbers), Cauchy's function of the
  same width, each position with the deviation it counted with in the project's. Both minimise one function,
  so that they must agree: *apart* is the largest difference of a position, focal length or k1 in its stated
  deviations; exit code 1 above 0.05.
- COLMAP, OPENCV: the same with two focal lengths and decentring.
- COLMAP as it comes: OPENCV, principal point fixed, squares, an image deviation of 1 px.
- COLMAP without positions: the same, gauge fixed by two frames.

Reprojection: root mean square of the residuals' lengths. Block: the tie points' true image coordinates, taken
back to the ground by intersecting the found poses' and lenses' rays, against the true points. It is given as
plan and height after the best similarity in space (mm), and as plan without it (m). So what is left is the
block's error, not that of single points. Seconds of processor time, all solves of the project's with
covariances, COLMAP's without.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.kernels.interior import INTERIOR
from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Settings
from geomosaic.adjustment.procedure.block_problem import block_problem
from geomosaic.adjustment.solver.solution import Solution
from geomosaic.adjustment.solver.solve import solve
from geomosaic.adjustment.terms.attitudes import Attitudes
from geomosaic.adjustment.terms.gnss_positions import GnssPositions
from geomosaic.adjustment.terms.image_observations import IMAGE
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.matching.tracks import Tracks
from geomosaic.projection.footprint import ground_from_images
from tools.bench.bench_monte_carlo import FRAMES, DrawnCase, draw
from tools.bench.cramer_rao import Draw
from tools.bench.result_rows import RowKind, add_options, write_rows
from tools.docs.results_page import BLOCK

Floats = NDArray[np.float64]
K1 = -0.05
CAUCHY = 3.0
APART_LIMIT = 0.05
ROWS = {
    "apart": RowKind(
        BLOCK,
        "poses against COLMAP's on the same tie points, largest difference",
        "",
        "{apart:.3f} of a deviation",
    )
}
CASES = (
    DrawnCase("3 x 8", replace(FRAMES, k1=K1), 0.19, lens_drawn=False),
    DrawnCase("10 x 20", replace(FRAMES, k1=K1, lines=10, frames_per_line=20), 0.06, lens_drawn=False),
)
_UNKNOWN_SD = {
    "focal_length_px": 1e3,
    "principal_col_px": 1e3,
    "principal_row_px": 1e3,
    "k1": 10.0,
    "k2": 10.0,
}
_COLMAP_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Problem:
    """What every solver is given: a draw with a straight lens reported, its tracks, points to begin from."""

    draw: Draw
    reported: Camera
    tracks: Tracks
    start_m: Floats

    @property
    def pos(self) -> Poses:
        return self.draw.block.poses


@dataclass(frozen=True)
class Found:
    """A solution: poses, image residuals (m, 2), viewing directions in camera axes (k, 3) of `image_px`
    coordinates, seconds of processor time."""

    poses: Poses
    camera: Camera
    residual_px: Floats
    seconds: float
    rays: Callable[[Floats], Floats]


def problem(case: DrawnCase, seed: int) -> Problem:
    """The draw with its lens reported as straight, every point seen by two frames or more."""
    d = draw(case, seed)
    reported = replace(d.camera, k1=0.0)
    d = replace(d, block=replace(d.block, cameras=(reported,) * len(d.poses)))
    order = np.lexsort((d.frame, d.point))
    tracks = Tracks(d.frame[order].astype(np.intp), d.point[order].astype(np.intp), d.image_px[order])
    at = ground_from_images(tracks.frame, tracks.image_px, d.block.poses, d.block.cameras, d.block.ground)
    sums = np.stack([np.bincount(tracks.point, column) for column in at.T], axis=1)
    return Problem(d, reported, tracks, sums / tracks.lengths[:, None])


def by_default(p: Problem) -> Found:
    """The project's default method."""
    begun = time.process_time()
    adjusted = METHODS["bundle"](p.draw.block, Settings())
    seconds = time.process_time() - begun
    residuals = adjusted.image_residuals
    assert residuals is not None
    camera = adjusted.cameras[0]
    return Found(adjusted.poses, camera, residuals.residual_px, seconds, camera.ray_from_image)


def by_positions(p: Problem) -> tuple[Found, Solution, Floats]:
    """The project's bundle with tie points and positions alone, its solution, and deviations (f, 3). With
    these each position counted in the end: its component, and more for a position beyond three deviations."""
    unknown = np.array([_UNKNOWN_SD.get(name, 0.0) for name in INTERIOR])
    alone = replace(p.pos, rotations_sd_rad=np.full((len(p.pos), 3), np.inf))
    problem = block_problem(p.draw.block, Settings(), p.tracks, p.start_m)
    problem = replace(
        problem,
        interior=(replace(problem.interior[0], sd=unknown),),
        points=replace(problem.points, sd_m=np.full(p.start_m.shape, 1e4)),
        frames=tuple(
            replace(term, reported=alone)
            for term in problem.frames
            if isinstance(term, GnssPositions | Attitudes)
        ),
        terrain=None,
    )
    begun = time.process_time()
    solution = solve(problem, p.pos)
    seconds = time.process_time() - begun
    camera, components = solution.cameras[0], solution.components
    found = Found(solution.poses, camera, solution.residual_px, seconds, camera.ray_from_image)
    positions = problem.reweighted(solution.estimate, components).frames[0]
    return found, solution, positions.sd(components) / np.sqrt(positions.weight)


def by_colmap(
    colmap: Any,
    p: Problem,
    *,
    lens: str,
    sigma_px: float = 1.0,
    position_sd_m: Floats | None,
    alike: bool = True,
) -> Found:
    """COLMAP's bundle adjustment. alike: Cauchy's function and a free principal point, as the project has
    them; sigma_px: of image coordinates, which COLMAP takes for 1: the positions' deviations are divided by
    it; position_sd_m (f, 3): None to leave the positions out."""
    block = _reconstruction(colmap, p, lens)
    options = colmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = alike
    options.ceres.solver_options.num_threads = 1
    if alike:
        options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = CAUCHY * sigma_px
        options.ceres.solver_options.gradient_tolerance = 1e-10
        options.ceres.solver_options.function_tolerance = 1e-12
    config = colmap.BundleAdjustmentConfig()
    for i in block.images:
        config.add_image(i)
    begun = time.process_time()
    if position_sd_m is None:
        config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        summary = colmap.create_default_bundle_adjuster(options, config, block).solve()
    else:
        priors = [
            colmap.PosePrior(
                pose_prior_id=i,
                corr_data_id=block.image(i).data_id,
                position=p.pos.positions_m[i - 1],
                position_covariance=np.diag((position_sd_m[i - 1] / sigma_px) ** 2),
                coordinate_system=colmap.PosePriorCoordinateSystem.CARTESIAN,
            )
            for i in sorted(block.images)
        ]
        prior_options = colmap.PosePriorBundleAdjustmentOptions()
        adjuster = colmap.create_pose_prior_bundle_adjuster(options, prior_options, config, priors, block)
        summary = adjuster.solve()
    seconds = time.process_time() - begun
    if not summary.is_solution_usable():
        raise RuntimeError(f"COLMAP: {summary.brief_report()}")
    return _found(block, p, seconds)


def _reconstruction(colmap: Any, p: Problem, lens: str) -> Any:
    """COLMAP's nouns for the block as reported, ids from 1."""
    block, c = colmap.Reconstruction(), p.reported
    numbers = {"RADIAL": [c.focal_length_px], "OPENCV": [c.focal_length_px] * 2}[lens]
    numbers += [c.principal_col_px, c.principal_row_px, *([0.0] * {"RADIAL": 2, "OPENCV": 4}[lens])]
    camera = colmap.Camera(model=lens, width=c.width_px, height=c.height_px, params=numbers, camera_id=1)
    block.add_camera_with_trivial_rig(camera)
    number = np.empty(len(p.tracks.frame), dtype=np.intp)
    for i in range(len(p.pos)):
        mine = np.flatnonzero(p.tracks.frame == i)
        number[mine] = np.arange(len(mine))
        turn = _COLMAP_FROM_CAMERA @ p.pos.rotations[i].T
        pose = colmap.Rigid3d(colmap.Rotation3d(turn), -turn @ p.pos.positions_m[i])
        image = colmap.Image(
            name=p.draw.block.names[i], keypoints=p.tracks.image_px[mine], camera_id=1, image_id=i + 1
        )
        block.add_image_with_trivial_frame(image, pose)
    starts = np.searchsorted(p.tracks.point, np.arange(p.tracks.points + 1))
    for k, at in enumerate(p.start_m):
        seen = range(starts[k], starts[k + 1])
        elements = [colmap.TrackElement(int(p.tracks.frame[m]) + 1, int(number[m])) for m in seen]
        block.add_point3D(at, colmap.Track(elements))
    return block


def _found(block: Any, p: Problem, seconds: float) -> Found:
    camera = block.camera(1)
    turns = np.stack([block.image(i + 1).cam_from_world().rotation.matrix() for i in range(len(p.pos))])
    positions = np.stack([block.image(i + 1).projection_center() for i in range(len(p.pos))])
    points = np.stack([block.point3D(i).xyz for i in sorted(block.point3D_ids())])
    frame = p.tracks.frame
    local = np.einsum("mij,mj->mi", turns[frame], points[p.tracks.point] - positions[frame])
    rotations = np.swapaxes(turns, 1, 2) @ _COLMAP_FROM_CAMERA
    named = {
        "f": "focal_length_px",
        "fx": "focal_length_px",
        "cx": "principal_col_px",
        "cy": "principal_row_px",
    }
    names = [named.get(name.strip(), name.strip()) for name in camera.params_info.split(",")]
    numbers = {k: float(v) for k, v in zip(names, camera.params, strict=True) if k != "fy"}

    def rays(image_px: Floats) -> Floats:
        return np.column_stack([camera.cam_from_img(image_px), np.ones(len(image_px))]) @ _COLMAP_FROM_CAMERA

    return Found(
        replace(p.pos, positions_m=positions, rotations=rotations),
        replace(p.reported, **numbers),  # type: ignore[arg-type]
        p.tracks.image_px - camera.img_from_cam(local),
        seconds,
        rays,
    )


def intersected_m(p: Problem, found: Found) -> Floats:
    """Tie points (k, 3) where rays of their true image coordinates meet, by linear least squares."""
    d, frame, point = p.draw, p.tracks.frame, p.tracks.point
    true_px = np.empty((len(frame), 2))
    for i in range(len(d.poses)):
        mine = frame == i
        true_px[mine] = d.poses[i].image_from_ground(d.camera, d.points_m[point[mine]])
    ray = np.einsum("mij,mj->mi", found.poses.rotations[frame], found.rays(true_px))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    side = np.einsum("mij,mj->mi", across, found.poses.positions_m[frame])
    starts = np.searchsorted(point, np.arange(p.tracks.points))
    met = np.linalg.solve(np.add.reduceat(across, starts), np.add.reduceat(side, starts)[:, :, None])
    return np.asarray(met[:, :, 0])


def after_similarity_m(found_m: Floats, true_m: Floats) -> Floats:
    """Errors (k, 3) left by the best similarity in space (Umeyama 1991)."""
    found, true = found_m - found_m.mean(axis=0), true_m - true_m.mean(axis=0)
    u, size, vt = np.linalg.svd(true.T @ found)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = (size * sign).sum() / (found**2).sum()
    return np.asarray(scale * found @ (u * sign @ vt).T - true)


def apart(found: Found, solution: Solution) -> float:
    """Largest difference of a position, the focal length or k1 in the deviations the solution states."""
    position = (found.poses.positions_m - solution.poses.positions_m) / solution.poses.positions_sd_m
    lens = [
        (getattr(found.camera, name) - getattr(solution.cameras[0], name))
        / solution.stated.shared_sd[INTERIOR.index(name)]
        for name in ("focal_length_px", "k1")
    ]
    return float(np.abs([*position.ravel(), *lens]).max())


HEADER = (
    "| frames | solver | reprojection, px | plan after similarity, mm | height after similarity, mm "
    "| plan, m | focal length, % off | k1 off | apart, sd | s |\n|---|---|---|---|---|---|---|---|---|---|"
)


def row(case: DrawnCase, name: str, p: Problem, found: Found, difference: float | None = None) -> str:
    """A solver's line of the table."""

    def rms(errors: Floats) -> float:
        return float(np.sqrt((errors**2).sum(axis=1).mean()))

    points, true = intersected_m(p, found), p.draw.points_m
    after = after_similarity_m(points, true)
    focal = 100.0 * (found.camera.focal_length_px / p.draw.camera.focal_length_px - 1.0)
    cells = [
        f"{case.name}, {len(p.tracks.frame)} observations",
        name,
        f"{rms(found.residual_px):.4f}",
        f"{1e3 * rms(after[:, :2]):.1f}",
        f"{1e3 * rms(after[:, 2:]):.1f}",
        f"{rms((points - true)[:, :2]):.2f}",
        f"{focal:+.3f}",
        f"{found.camera.k1 - p.draw.camera.k1:+.5f}",
        "" if difference is None else f"{difference:.3f}",
        f"{found.seconds:.1f}",
    ]
    return f"| {' | '.join(cells)} |"


def compare(colmap: Any, case: DrawnCase, seed: int) -> float:
    """Prints the case's rows; returns how far apart the two solutions of one problem are."""
    p = problem(case, seed)
    print(row(case, "geomosaic", p, by_default(p)), flush=True)
    mine, solution, counted = by_positions(p)
    print(row(case, "geomosaic, positions alone", p, mine), flush=True)
    same: dict[str, Any] = {"sigma_px": solution.components[IMAGE], "position_sd_m": counted}
    theirs = by_colmap(colmap, p, lens="RADIAL", **same)
    difference = apart(theirs, solution)
    print(row(case, "COLMAP, the same problem", p, theirs, difference), flush=True)
    others: dict[str, dict[str, Any]] = {
        "COLMAP, OPENCV": same,
        "COLMAP as it comes": {"alike": False, "position_sd_m": p.pos.positions_sd_m},
        "COLMAP without positions": {"alike": False, "position_sd_m": None},
    }
    for name, reported in others.items():
        print(row(case, name, p, by_colmap(colmap, p, lens="OPENCV", **reported)), flush=True)
    return difference


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pycolmap", type=Path, default=Path("out/oracle"), help="where pip put it")
    parser.add_argument("--only", nargs="*", choices=[c.name for c in CASES], help="names of surveys")
    parser.add_argument("--seed", type=int, default=1)
    add_options(parser)
    args = parser.parse_args()
    sys.path.append(str(args.pycolmap))
    try:
        import pycolmap  # type: ignore[import-not-found]
    except ImportError:
        install = f"{sys.executable} -m pip install --no-deps --target {args.pycolmap} pycolmap"
        print(f"skipped: no pycolmap. {install}")
        return 0
    pycolmap.logging.minloglevel = 2
    print(f"pycolmap {pycolmap.__version__}, seed {args.seed}\n\n{HEADER}", flush=True)
    apart_sd = [compare(pycolmap, c, args.seed) for c in CASES if not args.only or c.name in args.only]
    write_rows(args, [ROWS["apart"].row(None, apart=max(apart_sd))])
    if max(apart_sd) > APART_LIMIT:
        print(f"the two are {max(apart_sd):.3f} deviations apart", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
