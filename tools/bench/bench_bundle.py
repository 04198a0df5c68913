"""How fast and how large the bundle is: a simulated block of 20 lines of 50 frames, geometry alone.

    python -m tools.bench.bench_bundle [--lines 20] [--per-line 50] [--observations 300000] [--relief]

Prints seconds by part, iterations, and the peak memory of the process. Exit code 1 if the whole method takes
more than 60 s or the process more than 2 GB.
"""

from __future__ import annotations

import argparse
import cProfile
import resource
import sys
import time
from pathlib import Path

import numpy as np

from geomosaic.adjustment.kernels.collinearity import Projections, project
from geomosaic.adjustment.kernels.interior import interior_of
from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation, exp_turn
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.projection.ground import GroundSurface
from tools.bench.result_rows import ResultRow, RowKind, add_options, write_rows
from tools.docs.results_page import FAST

MOST_S, MOST_GB = 60.0, 2.0
TARGETS = {1000: (MOST_S, MOST_GB), 5000: (159.0, 3.28)}
"""Seconds and GB of the rows of results, by the number of frames."""
ROWS = {
    "with target": RowKind(
        FAST,
        "adjustment of {frames:,} frames, {observations:,} observations",
        "{most_s:g} s, {most_gb:g} GB",
        "{seconds} s, {peak_gb:.2f} GB",
        measured=("observations",),
    ),
    "other size": RowKind(
        FAST,
        "adjustment of {frames:,} frames, {observations:,} observations",
        "",
        "{seconds} s, {peak_gb:.2f} GB",
        measured=("observations",),
    ),
}
LEAST_TIES = 12
POSITION_SD_M = np.array([1.5, 1.5, 2.0])
TURN_SD_RAD = np.radians([0.3, 0.3, 1.0])
PARTS = {
    "tracks.py:join_tracks": "tracks joined",
    "tracks.py:thin_tracks": "tracks thinned",
    "initialisation.py:start_poses": "start: block of similarities",
    "block_solution.py:points_on_ground": "start: points on the ground",
    "solve.py:solve": "solves, in all",
    "collinearity.py:project_by_levers": "  derivatives",
    "collinearity.py:image_from_ground": "  image coordinates alone",
    "normal_equations.py:build_normals": "  normal equations",
    "normal_equations.py:reduce_normals": "  points eliminated",
    "normal_equations.py:solve": "  corrections",
    "normal_equations.py:covariance": "  covariances",
    "ground_choice.py:chosen_ground": "ground",
    "outcome.py:residuals_m": "residuals of pairs",
    "misalignment.py:misalignments_m": "misalignments of pairs",
}


def fly(lines: int, per_line: int, observations: int, relief_m: float, seed: int) -> tuple[Block, Poses]:
    """Nadir frames of 4000 x 3000 px at 100 m, 70 % forward and 50 % side overlap; and the true poses."""
    rng = np.random.default_rng(seed)
    n = lines * per_line
    camera = Camera("plain", 4000, 3000, 5000.0, 2010.0, 1485.0, k1=-0.02)
    line, along = np.divmod(np.arange(n), per_line)
    truth = Poses(
        np.column_stack([40.0 * line, 18.0 * along, np.full(n, 100.0)]) + rng.normal(0, [1, 1, 0.5], (n, 3)),
        Rotation.from_yaw_pitch_roll(*rng.normal(0, np.radians([2.0, 1.0, 1.0]), (n, 3)).T).matrix,
        np.zeros((n, 3)),
        np.zeros((n, 3)),
    )
    low = truth.positions_m[:, :2].min(axis=0) - [35.0, 25.0]
    size = np.ptp(truth.positions_m[:, :2], axis=0) + np.array([70.0, 50.0])
    plan = low + size * rng.random((int(observations / (n * 80.0 * 60.0) * np.prod(size)), 2))
    plan = plan[np.argsort(plan[:, 0])]
    up = relief_m * np.sin(plan[:, 0] / 53.0 + 0.4) * np.cos(plan[:, 1] / 71.0)
    land = np.column_stack([plan, up])
    seen = [_seen(truth, i, camera, land, rng) for i in range(n)]
    ties = []
    for i in range(n):
        near = np.abs(truth.positions_m[i + 1 :, :2] - truth.positions_m[i, :2]) < [90.0, 70.0]
        for j in i + 1 + np.flatnonzero(near.all(axis=1)):
            both, a, b = np.intersect1d(seen[i][0], seen[j][0], assume_unique=True, return_indices=True)
            if len(both) >= LEAST_TIES:
                number = both.astype(np.int32)
                ties.append(TiePair(i, int(j), seen[i][1][a], seen[j][1][b], number, number))
    poses = Poses(
        truth.positions_m + rng.normal(0, POSITION_SD_M, (n, 3)),
        exp_turn(rng.normal(0, TURN_SD_RAD, (n, 3))) @ truth.rotations,
        np.tile(POSITION_SD_M, (n, 1)),
        np.tile(TURN_SD_RAD, (n, 1)),
    )
    block = Block(
        names=tuple(f"{i:04d}.jpg" for i in range(n)),
        cameras=(camera,) * n,
        poses=poses,
        ground=GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1))),
        ties=TiePoints(tuple(ties)),
        sequence=tuple(range(n)),
        lines=tuple(line.tolist()),
        ground_pixel_m=0.02,
    )
    return block, truth


def _seen(
    truth: Poses, i: int, camera: Camera, land: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Which points of the land a frame sees and where, with 0.5 px of noise."""
    east, north = np.abs(land[:, :2] - truth.positions_m[i, :2]).T
    near = np.flatnonzero((east < 60.0) & (north < 50.0))
    m = len(near)
    image_px, *_ = project(
        Projections(
            np.broadcast_to(truth.positions_m[i], (m, 3)),
            np.broadcast_to(truth.rotations[i], (m, 3, 3)),
            np.broadcast_to(interior_of(camera), (m, len(interior_of(camera)))),
            land[near],
        )
    )
    inside = np.all((image_px > 5.0) & (image_px < [camera.width_px - 5.0, camera.height_px - 5.0]), axis=1)
    return near[inside], image_px[inside] + rng.normal(0, 0.5, (int(inside.sum()), 2))


def _printed(profile: cProfile.Profile, adjusted: Adjusted, truth: Poses) -> None:
    figures = adjusted.figures
    off = adjusted.poses.positions_m - truth.positions_m
    off = np.sqrt(np.mean((off - off.mean(axis=0)) ** 2, axis=0))
    print(
        f"{len(truth)} frames, {figures['observations']:.0f} image observations of {figures['tracks']:.0f} "
        f"points; {figures['iterations']:.0f} iterations in the last solve; "
        f"sigma {figures['sigma_px']:.3f} px; positions off by {off[0]:.2f} {off[1]:.2f} {off[2]:.2f} m"
    )
    profile.create_stats()
    print(f"{'part':32s} {'calls':>6s} {'s':>7s}")
    for name, title in PARTS.items():
        rows = [v for (file, _, called), v in profile.stats.items() if f"{Path(file).name}:{called}" == name]
        if rows:
            print(f"{title:32s} {sum(r[0] for r in rows):6d} {sum(r[3] for r in rows):7.2f}")


def result_row(frames: int, observations: int, took_s: float, peak_gb: float) -> ResultRow:
    """The row of results; the target is that of a block of so many frames."""
    seconds = f"{took_s:.{1 if took_s < 100.0 else 0}f}"
    figures = {"frames": frames, "observations": observations, "seconds": seconds, "peak_gb": peak_gb}
    if frames not in TARGETS:
        return ROWS["other size"].row(None, **figures)
    most_s, most_gb = TARGETS[frames]
    met = took_s <= most_s and peak_gb <= most_gb
    return ROWS["with target"].row(met, most_s=most_s, most_gb=most_gb, **figures)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--lines", type=int, default=20)
    parser.add_argument("--per-line", type=int, default=50)
    parser.add_argument("--observations", type=int, default=300_000)
    parser.add_argument("--relief", action="store_true", help="hills of 20 m instead of flat land")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stats", type=Path, help="write the profile here")
    parser.add_argument("--whole", action="store_true", help="time the whole alone, without its parts")
    add_options(parser)
    args = parser.parse_args()
    relief_m = 10.0 if args.relief else 0.0
    block, truth = fly(args.lines, args.per_line, args.observations, relief_m, args.seed)
    before_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    ties = sum(map(len, block.ties.pairs))
    print(f"{len(block.ties.pairs)} pairs, {ties} tie points; {before_gb:.2f} GB so far")
    profile = cProfile.Profile()
    begun, begun_cpu = time.perf_counter(), time.process_time()
    if not args.whole:
        profile.enable()
    adjusted = METHODS["bundle"](block, Settings())
    profile.disable()
    took_s, took_cpu_s = time.perf_counter() - begun, time.process_time() - begun_cpu
    _printed(profile, adjusted, truth)
    print(f"{'whole':32s} {'':6s} {took_s:7.2f}, of processors {took_cpu_s:.2f}")
    if args.stats:
        profile.dump_stats(args.stats)
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak_gb:.2f} GB")
    write_rows(args, [result_row(len(truth), round(adjusted.figures["observations"]), took_s, peak_gb)])
    if took_s > MOST_S or peak_gb > MOST_GB:
        print(f"over {MOST_S:.0f} s or {MOST_GB:.0f} GB", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
