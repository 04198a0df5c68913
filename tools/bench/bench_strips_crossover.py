"""Object space against image space: how good model and DEM must be for `virtual_line` to beat the images.

    python -m tools.bench.bench_strips_crossover [--level 0.05] [--seeds 3] [--lines 16384] [--out FOLDER]

Scenes of 8 CCDs of 4096 columns over 300 m of relief; no images are needed, since `virtual_line` looks at
none. RMS, 95 % and worst of the vector (dcol, dline) against truth over all lines whose ground both strips
have. First come the true model and heights; the exit code is 1 if the vector is off by more than 0.1 px RMS.
Then come heights off by 20 m, then attitudes. These are off by an error that changes within 2 s (sd, each
axis), noise of each sample of 400 Hz, or a constant. `--level` is what image space reaches on such scenes
(RMS in px); where a row's error reaches it, the two cross over, by straight lines between the rows'
logarithms. `table` takes a number or a function of the plan, for a level measured scene by scene.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from geomosaic.ccd.model import CcdSettings
from geomosaic.ccd.object_space import ObjectSpace
from geomosaic.ccd.virtual_line import virtual_line
from geomosaic_simulate.strip_files import given_heights
from geomosaic_simulate.strip_overlaps import strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from geomosaic_simulate.strip_scene import PairTruth, StripWorld

Floats = NDArray[np.float64]
Level = float | Callable[[StripPlan], float]
GOAL_PX = 0.1
FIRST_SEED = 901
STEPS_URAD = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
CASES: dict[str, dict[str, float]] = {
    "true model, true heights": {},
    "heights 20 m too high": {"dem_bias_m": 20.0},
    "heights off by 20 m (sd)": {"dem_error_m": 20.0},
}
SWEEPS = {
    "attitude off within 2 s": "attitude_error_urad",
    "attitude noise": "attitude_noise_urad",
    "attitude off throughout": "attitude_bias_urad",
}


@dataclass(frozen=True)
class Row:
    """Errors (px) of one case over its seeds."""

    name: str
    rms_px: float
    most_px: float
    worst_px: float


def space_of(scene: StripWorld) -> ObjectSpace:
    """Model and heights as they are reported."""
    heights = given_heights(scene)

    def height_at(lon_deg: Floats, lat_deg: Floats) -> Floats:
        xy = scene.projection.map_from_geodetic(lon_deg, lat_deg)
        return np.asarray(heights.height_at(xy[..., 0], xy[..., 1]))

    return ObjectSpace(scene.cameras.reported, height_at, scene.relief.base_m)


def errors_px(plan: StripPlan, truth: list[PairTruth]) -> Floats:
    """Lengths of (dcol, dline) of virtual_line less truth, all pairs' lines one after another."""
    g = plan.geometry()
    strips = strips_in_memory(g, [])
    strips.object_space = space_of(StripWorld(plan))
    out = []
    for found, true in zip(
        virtual_line(strips, CcdSettings(), lambda _done, _total: None), truth, strict=True
    ):
        right = np.arange(plan.lines) + 0.5 + g.side(found.pair) * g.row_separation_lines + true.dline_px
        both = (right >= 0.0) & (right <= plan.lines)
        away = np.hypot(found.dcol_px - true.dcol_px, found.dline_px - true.dline_px)
        out.append(away[both])
    return np.concatenate(out)


def row(name: str, plans: list[StripPlan], truths: list[list[PairTruth]]) -> Row:
    """A case's errors over all its scenes."""
    away = np.concatenate([errors_px(plan, truth) for plan, truth in zip(plans, truths, strict=True)])
    return Row(name, float(np.sqrt((away**2).mean())), float(np.quantile(away, 0.95)), float(away.max()))


def crossing(at: tuple[float, ...], rms_px: list[float], level_px: float) -> float | None:
    """Where rising errors reach a level; None where they don't between the first and the last."""
    x, y, wanted = np.log(at), np.log(rms_px), np.log(level_px)
    if not y[0] <= wanted <= y[-1]:
        return None
    return float(np.exp(np.interp(wanted, np.maximum.accumulate(y), x)))


def table(level: Level, seeds: int, lines: int) -> tuple[str, bool]:
    """The table in Markdown, and whether the true model serves."""
    plans = [StripPlan(seed=FIRST_SEED + k, width_px=4096, lines=lines) for k in range(seeds)]
    level_px = float(np.mean([level(plan) for plan in plans])) if callable(level) else level
    origin = "measured on these scenes" if callable(level) else "as given, not measured here"
    scenes = [StripWorld(plan) for plan in plans]
    truths = [
        [scene.truth(pair) for pair in plan.geometry().pairs]
        for scene, plan in zip(scenes, plans, strict=True)
    ]

    def case(name: str, **changes: Any) -> Row:
        return row(name, [replace(plan, **changes) for plan in plans], truths)

    found = [case(name, **changes) for name, changes in CASES.items()]
    good = found[0].rms_px <= GOAL_PX
    crossings = []
    for name, key in SWEEPS.items():
        rows = [case(f"{name}, {step:g} urad", **{key: step}) for step in STEPS_URAD]
        found += rows
        at = crossing(STEPS_URAD, [r.rms_px for r in rows], level_px)
        where = "not in this range" if at is None else f"at {at:.2g} urad"
        crossings.append(
            f"- {name}: object space is worse than image space ({level_px:.3g} px, {origin}) from: {where}"
        )
    text = ["| case | RMS px | 95 % px | worst px | better |", "|---|---|---|---|---|"]
    for r in found:
        better = "object space" if r.rms_px < level_px else "image space"
        text.append(f"| {r.name} | {r.rms_px:.4f} | {r.most_px:.4f} | {r.worst_px:.4f} | {better} |")
    return "\n".join([*text, "", *crossings]) + "\n", good


def main() -> int:
    parser = argparse.ArgumentParser(description="virtual_line against the level of image space")
    parser.add_argument("--level", type=float, default=0.05, help="RMS of image space in px")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--lines", type=int, default=16384)
    parser.add_argument("--out", type=Path, help="folder for crossover.md")
    given = parser.parse_args()
    text, good = table(given.level, given.seeds, given.lines)
    print(text)
    if given.out is not None:
        given.out.mkdir(parents=True, exist_ok=True)
        (given.out / "crossover.md").write_text(text)
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
