"""Whether the bundle's stated covariance is true, and whether its error reaches the Cramér-Rao bound.

    python -m tools.bench.bench_monte_carlo [--out out/bench-monte-carlo] [--only NAME ...] [--seeds N]

Geometry alone: flights, tie points and their noise are drawn from seeds 1 to N and adjusted by the default
method; no image is made. Three figures a survey:

- NEES, normalised squared error: e' P^-1 e / 6 with e a frame's pose error and P its stated covariance, mean
  over frames and seeds, expectation 1. By groups it comes from the marginal deviations.
- RMSE of a grid of ground points, each seen by the frame whose nadir is nearest, absolute and after the best
  similarity, against the Cramér-Rao bound. The bound is the inverse of the Fisher information at the truth,
  with priors of POS, and of the lens where it is drawn. It comes from central differences of
  `Pose.image_from_ground` and the true deviations. Points are known to lie on the ground's shape, at an
  unknown common level; `3D` is the bound of tie points with three unknowns each. Nothing of the solver's own
  is used.
- Slope of the error against frame number, mean over the seeds (Student's t, 99 %).

The oracle is the bound's own estimate of the same draws: linear least squares about the truth with the true
deviations, which no solver knows. Frames of a block share their errors, so that 30 seeds leave NEES uncertain
by a tenth; what the oracle has of this luck, the solver has too. Where the lens is reported exactly, the
stated covariance, which trusts it less, must be too large; there NEES isn't judged.

The table goes to standard output as Markdown and to OUT/monte_carlo.json; exit code 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.terms.interior_orientation import interior_deviations
from geomosaic.camera.exterior import Poses
from geomosaic.matching.model import TiePair, TiePoints
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import flat_ground
from geomosaic_simulate.flight import fly
from geomosaic_simulate.plan import SurveyPlan
from tools.bench.cramer_rao import (
    LENS,
    Draw,
    Grid,
    axes_of,
    bound_m,
    cramer_rao,
    grid,
    lens_of,
    pose_errors,
    size_px,
    turned,
    with_lens,
)  # fmt: skip
from tools.bench.result_rows import ResultRow, RowKind, add_options, write_rows
from tools.docs.results_page import BLOCK, STATED

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]
POSITION_SD_M = np.array([1.5, 1.5, 2.0])
TURN_SD_RAD = np.radians([0.3, 0.3, 1.0])
DRAWN_SHARE = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 1.0, 1.0])
"""k1 to k3 are determined by any block; drawn as widely as their prior deviations some would be no lens."""
GROUPS = {"east, north": (0, 1), "up": (2,), "tilt": (3, 4), "yaw": (5,)}
NEES_LIMITS, RATIO_LIMIT, SLOPE_LEVEL = (0.85, 1.15), 1.15, 0.99
_MARGIN_PX = 5.0
STATED_LIMITS = (0.8, 1.25)
"""Of normalised squared errors in the rows of results."""
_LIMITS = f"{STATED_LIMITS[0]} to {STATED_LIMITS[1]}"
ROWS = {
    "block": RowKind(
        STATED,
        "normalised squared error of the poses, flat block, {seeds:d} seeds",
        _LIMITS,
        "{nees:.2f} ± {nees_se:.2f}",
    ),
    "line": RowKind(
        STATED,
        "normalised squared error of the poses, line of {frames:d} frames",
        _LIMITS,
        "{nees:.2f} ± {nees_se:.2f}",
    ),
    "yaw": RowKind(
        STATED,
        "normalised squared error of the yaw, flat block and line",
        _LIMITS,
        "{block:.2f} and {line:.2f}",
    ),
    "bound": RowKind(
        BLOCK,
        "error over the Cramér-Rao bound: absolute, shape, flat block",
        "1",
        "{absolute:.2f}, {shape:.2f}",
    ),
}


@dataclass(frozen=True)
class DrawnCase:
    """A survey: its plan, tie points a m², the share of its views in which a point is found, image noise.

    lens_drawn: the reported lens is drawn about the true one with the solver's prior deviations, which
    the bound has too. Else it is reported exactly, and the bound knows that.
    """

    name: str
    plan: SurveyPlan
    per_m2: float
    found: float = 0.7
    noise_px: float = 0.1
    lens_drawn: bool = True
    ground: str = "auto"


FRAMES = SurveyPlan(width_px=1336, height_px=1002, lines=3, frames_per_line=8, k1=0.0, k2=0.0)
LINE = replace(FRAMES, kind="line", frames_per_line=200, forward_overlap=0.6)
CASES = (
    DrawnCase("flat", FRAMES, 0.19),
    DrawnCase("flat, lens reported exactly", FRAMES, 0.19, lens_drawn=False),
    DrawnCase("line of 200", LINE, 0.03),
)


def draw(case: DrawnCase, seed: int) -> Draw:
    """A flight, its tie points and what the platform says, all of one seed."""
    plan = replace(case.plan, seed=seed)
    flight, rng = fly(plan), np.random.default_rng([seed, 20])
    poses, true, n = flight.poses, plan.camera(), len(flight.poses)
    nadir = poses.positions_m[:, :2]
    ground = flat_ground(flight.work_frame, plan.ground_height_m, float(np.abs(nadir).max()) + 200.0)
    axes = axes_of(np.radians(plan.heading_deg))
    low, high = (nadir @ axes).min(axis=0) - 90.0, (nadir @ axes).max(axis=0) + 90.0
    at = rng.uniform(low, high, (round(case.per_m2 * float(np.prod(high - low))), 2)) @ axes
    points = np.column_stack([at, ground.up_at(*at.T)])
    seen = np.zeros((n, len(points)), dtype=bool)
    for i in range(n):
        near = np.flatnonzero(np.linalg.norm(at - nadir[i], axis=1) < 120.0)
        px = poses[i].image_from_ground(true, points[near])
        inside = np.all((px > _MARGIN_PX) & (px < size_px(true) - _MARGIN_PX), axis=1)
        seen[i, near] = inside & (rng.random(len(near)) < case.found)
    tied = seen.sum(axis=0) >= 2
    points, seen = points[tied], seen[:, tied]
    frame, point = np.nonzero(seen)
    px = np.concatenate([poses[i].image_from_ground(true, points[seen[i]]) for i in range(n)])
    px += rng.normal(0.0, case.noise_px, px.shape)
    lens_sd = interior_deviations(true)[: len(LENS)] if case.lens_drawn else None
    reported = true
    if lens_sd is not None:
        reported = with_lens(true, lens_of(true) + rng.normal(0.0, DRAWN_SHARE * lens_sd))
    position = poses.positions_m + rng.normal(0.0, POSITION_SD_M, (n, 3))
    rotations = turned(poses.rotations, rng.normal(0.0, TURN_SD_RAD, (n, 3)))
    pos = Poses(position, rotations, np.tile(POSITION_SD_M, (n, 1)), np.tile(TURN_SD_RAD, (n, 1)))
    names = tuple(f"{i:03d}.jpg" for i in range(n))
    lines = tuple(int(k) for k in flight.line)
    block = Block(
        names, (reported,) * n, pos, ground, _ties(seen, px), tuple(range(n)), lines, plan.ground_pixel_m
    )
    return Draw(block, poses, true, points, frame, point, px, case.noise_px, lens_sd)


def _ties(seen: NDArray[np.bool_], image_px: Floats) -> TiePoints:
    """Pairs of all frames with a dozen points in common; image_px in the order of `seen`, frame by frame."""
    number = np.cumsum(seen.ravel()).reshape(seen.shape) - 1
    ties = []
    for i, j in np.argwhere(np.triu(seen.astype(np.float32) @ seen.T.astype(np.float32), 1) >= 12.0):
        both = np.flatnonzero(seen[i] & seen[j])
        name = both.astype(np.int32)
        left_px, right_px = image_px[number[i, both]], image_px[number[j, both]]
        ties.append(TiePair(int(i), int(j), left_px, right_px, name, name))
    return TiePoints(tuple(ties))


def shown(g: Grid, adjusted: Adjusted) -> Floats:
    """East and north (k, 2) of where the mosaic puts the grid's points minus where they are."""
    return np.concatenate([
        (ground_from_image(adjusted.poses[i], adjusted.cameras[i], adjusted.ground, g.image_px[g.frame == i])
         - g.points_m[g.frame == i])[:, :2] for i in np.unique(g.frame)
    ])  # fmt: skip


def similarities(points_m: Floats) -> Floats:
    """Orthonormal columns (2k, 4): shifts, turn and scale of points in the plane."""
    east, north = (points_m[:, :2] - points_m[:, :2].mean(axis=0)).T
    zero, one = np.zeros_like(east), np.ones_like(east)
    moves = [(one, zero), (zero, one), (-north, east), (east, north)]
    return np.linalg.qr(np.stack([np.stack(m, axis=1).ravel() for m in moves], axis=1))[0]


def rmse_m(errors_m: Floats, basis: Floats) -> tuple[float, float]:
    """Of plane errors (k, 2): root of the mean squared length, as they are and after the best similarity."""
    flat = errors_m.ravel()
    left = flat - basis @ (basis.T @ flat)
    return float(np.sqrt(flat @ flat * 2.0 / len(flat))), float(np.sqrt(left @ left * 2.0 / len(flat)))


def nees(errors: Floats, covariance: Floats) -> dict[str, float]:
    """Mean over frames of normalised squared errors (f, 6) for covariances (f, 6, 6): of poses, of groups."""
    full = np.einsum("fi,fi->f", errors, np.linalg.solve(covariance, errors[..., None])[..., 0]) / 6.0
    marginal = errors**2 / np.diagonal(covariance, axis1=1, axis2=2)
    return {"pose": float(full.mean())} | {k: float(marginal[:, c].mean()) for k, c in GROUPS.items()}


def stated_over_bound(stated: Floats, bound: Floats) -> dict[str, float]:
    """Mean ratio of covariances (f, 6, 6): trace(stated bound^-1) / 6, and of the groups' variances."""
    full = np.trace(np.linalg.solve(bound, stated), axis1=1, axis2=2) / 6.0
    marginal = np.diagonal(stated, axis1=1, axis2=2) / np.diagonal(bound, axis1=1, axis2=2)
    return {"pose": float(full.mean())} | {k: float(marginal[:, c].mean()) for k, c in GROUPS.items()}


def measure(case: DrawnCase, seed: int) -> dict[str, Any]:
    """All figures of one draw."""
    d = draw(case, seed)
    n, pixel_m = len(d.poses), case.plan.ground_pixel_m
    bound, free = cramer_rao(d), cramer_rao(d, on_ground=False)
    started = time.monotonic()
    adjusted = METHODS["bundle"](d.block, Settings(ground=case.ground))
    seconds = time.monotonic() - started
    assert adjusted.pose_covariance is not None
    g = grid(d, np.radians(case.plan.heading_deg), 10.0)
    basis = similarities(g.points_m)
    off_m = shown(g, adjusted)
    absolute, after = rmse_m(off_m, basis)
    absolute_oracle, after_oracle = rmse_m(g.by_unknown @ bound.oracle, basis)
    absolute_bound, after_bound = bound_m(g.by_unknown, bound.covariance, basis)
    absolute_3d, after_3d = bound_m(
        free.points_by_unknown, free.covariance, similarities(free.points_m), free.points_own
    )
    frames = np.unique(g.frame)
    by_frame_m = [np.sqrt((off_m[g.frame == i] ** 2).sum(axis=1).mean()) for i in frames]
    true_covariance = bound.pose_covariance(n)
    return {
        "seed": seed, "frames": n, "observations": len(d.frame), "seconds": seconds,
        "ground": adjusted.ground.kind,
        "nees": nees(pose_errors(adjusted.poses, d.poses), adjusted.pose_covariance),
        "nees_oracle": nees(bound.oracle[: 6 * n].reshape(n, 6), true_covariance),
        "stated_over_bound": stated_over_bound(adjusted.pose_covariance, true_covariance),
        "absolute_m": absolute, "absolute_bound_m": absolute_bound, "absolute_oracle_m": absolute_oracle,
        "absolute_bound_3d_m": absolute_3d,
        "after_px": after / pixel_m, "after_bound_px": after_bound / pixel_m,
        "after_oracle_px": after_oracle / pixel_m, "after_bound_3d_px": after_3d / pixel_m,
        "slope_m": float(np.polyfit(frames, by_frame_m, 1)[0]),
        "figures": adjusted.figures,
    }  # fmt: skip


def summed_up(case: DrawnCase, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A case's figures over its seeds, and whether they are good."""

    def rms(key: str) -> float:
        return float(np.sqrt(np.mean([r[key] ** 2 for r in rows])))

    out: dict[str, Any] = {"case": case.name, "seeds": [r["seed"] for r in rows]}
    for key in ("nees", "nees_oracle", "stated_over_bound"):
        out[key] = {k: float(np.mean([r[key][k] for r in rows])) for k in rows[0][key]}
    out["grounds"] = sorted({r["ground"] for r in rows})
    out["seconds"] = float(np.mean([r["seconds"] for r in rows]))
    for key in [k for k in rows[0] if k.startswith(("absolute", "after"))]:
        out[key] = rms(key)
    out["absolute_ratio"] = out["absolute_m"] / out["absolute_bound_m"]
    out["after_ratio"] = out["after_px"] / out["after_bound_px"]
    out["slope_m"] = float(np.mean([r["slope_m"] for r in rows]))
    out["nees_se"] = _standard_error([r["nees"]["pose"] for r in rows])
    out["slope_se_m"] = _standard_error([r["slope_m"] for r in rows])
    out["missed"] = _missed(case, out, len(rows))
    return out


def _standard_error(values: Sequence[float]) -> float | None:
    """Of the mean; None for a single value."""
    return float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else None


def _missed(case: DrawnCase, out: dict[str, Any], seeds: int) -> list[str]:
    missed = []
    if case.lens_drawn and not NEES_LIMITS[0] <= out["nees"]["pose"] <= NEES_LIMITS[1]:
        missed.append("NEES")
    if out["absolute_ratio"] > RATIO_LIMIT:
        missed.append("absolute")
    if seeds > 1:
        limit = student.ppf(0.5 + SLOPE_LEVEL / 2.0, seeds - 1) * out["slope_se_m"]
        if abs(out["slope_m"]) > limit:
            missed.append("slope")
    return missed


_COLUMNS = (
    "survey", "seeds", "NEES of poses", "oracle's", *GROUPS, "absolute, m", "bound", "ratio", "oracle",
    "bound 3D", "after similarity, px", "bound", "ratio", "oracle", "bound 3D", "slope, mm a frame",
    "ground", "s a solve", "",
)  # fmt: skip
HEADER = f"| {' | '.join(_COLUMNS)} |\n|{'---|' * len(_COLUMNS)}"


def row(s: dict[str, Any]) -> str:
    """The case's line of the table."""
    several = len(s["seeds"]) > 1
    cells = [
        s["case"],
        f"{s['seeds'][0]} to {s['seeds'][-1]}",
        f"{s['nees']['pose']:.2f}" + (f" ± {s['nees_se']:.2f}" if several else ""),
        f"{s['nees_oracle']['pose']:.2f}",
        *(f"{s['nees'][k]:.2f}" for k in GROUPS),
        *(f"{s[f'absolute_{k}']:.3f}" for k in ("m", "bound_m")),
        f"{s['absolute_ratio']:.2f}",
        *(f"{s[f'absolute_{k}']:.3f}" for k in ("oracle_m", "bound_3d_m")),
        *(f"{s[f'after_{k}']:.3f}" for k in ("px", "bound_px")),
        f"{s['after_ratio']:.2f}",
        *(f"{s[f'after_{k}']:.3f}" for k in ("oracle_px", "bound_3d_px")),
        f"{1e3 * s['slope_m']:+.2f}" + (f" ± {1e3 * s['slope_se_m']:.2f}" if several else ""),
        ", ".join(s["grounds"]),
        f"{s['seconds']:.1f}",
        f"MISSED {', '.join(s['missed'])}" if s["missed"] else "ok",
    ]
    return f"| {' | '.join(cells)} |"


def result_rows(by_case: Mapping[str, dict[str, Any]]) -> list[ResultRow]:
    """The rows of results of the surveys that were measured with more than one seed."""

    def within(*values: float) -> bool:
        return all(STATED_LIMITS[0] <= value <= STATED_LIMITS[1] for value in values)

    rows = []
    several = {name: s for name, s in by_case.items() if len(s["seeds"]) > 1}
    block, line = several.get("flat"), several.get("line of 200")
    if block:
        nees = block["nees"]["pose"]
        figures = {"nees": nees, "nees_se": block["nees_se"], "seeds": len(block["seeds"])}
        rows.append(ROWS["block"].row(within(nees), **figures))
        bound = {"absolute": block["absolute_ratio"], "shape": block["after_ratio"]}
        rows.append(ROWS["bound"].row(None, **bound))
    if line:
        nees, frames = line["nees"]["pose"], LINE.frames_per_line
        rows.append(ROWS["line"].row(within(nees), nees=nees, nees_se=line["nees_se"], frames=frames))
    if block and line:
        yaws = block["nees"]["yaw"], line["nees"]["yaw"]
        rows.append(ROWS["yaw"].row(within(*yaws), block=yaws[0], line=yaws[1]))
    return rows


def main() -> int:
    """Runs the cases asked for, prints the table as it grows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench-monte-carlo"))
    parser.add_argument("--only", nargs="*", choices=[c.name for c in CASES], help="names of surveys")
    parser.add_argument("--seeds", type=int, default=30, help="seeds 1 to N of each survey")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    add_options(parser)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    reports = []
    print(HEADER, flush=True)
    with ProcessPoolExecutor(args.workers) as pool:
        for case in CASES:
            if args.only and case.name not in args.only:
                continue
            rows = list(pool.map(partial(measure, case), range(1, args.seeds + 1)))
            summary = summed_up(case, rows)
            reports.append({**summary, "draws": rows})
            print(row(summary), flush=True)
    (args.out / "monte_carlo.json").write_text(json.dumps(reports, indent=1))
    write_rows(args, result_rows({s["case"]: s for s in reports}))
    return 1 if any(s["missed"] for s in reports) else 0


if __name__ == "__main__":
    raise SystemExit(main())
