"""CCD strips against known truth: the table of cases, and the misplacement rate of mixed scenes.

    python -m tools.bench.bench_strips --seeds 20                 # joint on the five cases
    python -m tools.bench.bench_strips --seeds 5 --methods all    # its rivals too
    python -m tools.bench.bench_strips --mixed 60                 # the paper's two chains and joint
    python -m tools.bench.bench_strips --small 20                 # short scenes of two cameras
    python -m tools.bench.bench_strips --resampled 20             # scenes that are sampled otherwise

Scenes are simulated anew (7 pairs of strips 4096 px wide, of which the overlaps alone are made; 16,384
lines, mixed scenes 8,192). Short scenes have 6,000 lines, of TH-1 narrowed (4 CCDs, 2 m) or of a camera of
three CCDs and 5 m pixels with jitter at other frequencies. Scenes sampled otherwise (`strips_resampled`)
have 8,192 lines and 4 pairs.
What was measured is kept in OUT/strips.jsonl; a killed bench goes on where it was.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from geomosaic.ccd.methods import METHODS
from geomosaic.ccd.model import CcdSettings, StripOffsets
from geomosaic.quality.strip_figures import scene_errors
from geomosaic.survey.strips import StripGeometry
from geomosaic_simulate.strip_overlaps import simulate_overlaps, strips_in_memory
from geomosaic_simulate.strip_plan import StripPlan
from tools.bench.bench_strips_rows import result_rows
from tools.bench.result_rows import add_options, write_rows
from tools.bench.strips_resampled import resampled_scene

LINES, MIXED_LINES, WIDTH_PX = 16384, 8192, 4096
RIVALS = ("whole_scene", "mean_offset", "piecewise_linear", "image_registration")
CASES = ("clean", "low contrast 40 %", "clouds 20 %", "clouds 50 %", "all together")
AIMS = {"clean": (0.05, 0.10), "low contrast 40 %": (0.3, None), "clouds 20 %": (0.3, None),
        "clouds 50 %": (0.5, None), "all together": (0.8, None)}  # fmt: skip


SHORT = {"width_px": 512, "lines": 6000}
SENSORS: dict[str, dict[str, Any]] = {
    "TH-1": {"ccds": 4},
    "5 m": {
        "ccds": 3, "overlap_px": 64, "read_px": 80, "first_row": 2, "bit_depth": 12,
        "ground_pixel_m": 5.0, "line_rate_hz": 1400.0, "row_separation_lines": 700.0,
        "parallax_m_per_line": 830.0,  # 640 km above the ground
        "jitter_1hz_px": 0.0, "jitter_5hz_px": 0.0, "jitter_22hz_px": 0.0, "drift_px_per_s": 1.0,
    },
}  # fmt: skip
JITTER_5M = ((0.7, 1.0), (9.0, 0.25), (38.0, 0.05))  # Hz, px along the track; across 0.6 of it
SKIES: dict[str, dict[str, Any]] = {
    "clear": {},
    "clouds 20 %": {"cloud_cover": 0.2},
    "clouds 50 %": {"cloud_cover": 0.5},
    "clouds 30 %, ground as bright": {"cloud_cover": 0.3, "brightness": 0.75},
}
SMALL = tuple(f"{sensor}, {sky}" for sensor in SENSORS for sky in SKIES)
RESAMPLED: dict[str, tuple[float, float]] = {
    "resampled, clean": (0.0, 0.0),
    "resampled, low contrast 40 %": (0.4, 0.0),
    "resampled, clouds 50 %": (0.0, 0.5),
}
"""Shares of faint lines and of clouds."""


def small_plan(case: str, seed: int) -> StripPlan:
    """A short scene; clouds from 500 to 8000 m and wind from 2 to 49 m/s, drawn by the seed."""
    sensor, sky = case.split(", ", 1)
    rng = np.random.default_rng([seed, 1805])
    deck = {
        "cloud_height_m": float(rng.uniform(500, 8000)),
        "wind_m_per_s": float(rng.uniform(2, 49)),
        "wind_deg": float(rng.uniform(0, 360)),
    }
    motion = jitter_file(seed) if sensor == "5 m" else None
    return StripPlan(seed=seed, motion=motion, **SHORT, **SENSORS[sensor], **SKIES[sky], **deck)


def jitter_file(seed: int) -> Path:
    """A table of the 5 m camera's jitter, its phases drawn by the seed."""
    rng = np.random.default_rng([seed, 1806])
    time_s = np.arange(-2.0, 8.0, 0.0025)
    along, across = np.zeros_like(time_s), np.zeros_like(time_s)
    for hz, px in JITTER_5M:
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        along += px * np.sin(2.0 * np.pi * hz * time_s + phase[0])
        across += 0.6 * px * np.sin(2.0 * np.pi * hz * time_s + phase[1])
    path = Path(tempfile.gettempdir()) / f"bench_strips_jitter_{os.getpid()}_{seed}.csv"
    table = np.stack([time_s, along, across], axis=1)
    np.savetxt(path, table, fmt="%.6f", delimiter=",", header="time_s,along_px,across_px", comments="")
    return path


def plan_of(case: str, seed: int) -> StripPlan:
    """The plan of a case; clouds' height and wind are drawn by the seed."""
    if case in SMALL:
        return small_plan(case, seed)
    rng = np.random.default_rng([seed, 1804])
    deck = {
        "cloud_height_m": float(rng.uniform(1000, 8000)),
        "wind_m_per_s": float(rng.uniform(5, 49)),
        "wind_deg": float(rng.uniform(0, 360)),
    }
    more: dict[str, Any] = {
        "clean": {},
        "low contrast 40 %": {"low_contrast_share": 0.4},
        "clouds 20 %": {"cloud_cover": 0.2, **deck},
        "clouds 50 %": {"cloud_cover": 0.5, **deck},
        "all together": {"cloud_cover": 0.3, "low_contrast_share": 0.4, "relief_m": 600.0, **deck},
        "mixed": _mixed(rng, deck),
    }[case]
    lines = MIXED_LINES if case == "mixed" else LINES
    return StripPlan(seed=seed, width_px=WIDTH_PX, lines=lines, **more)


def _mixed(rng: np.random.Generator, deck: dict[str, float]) -> dict[str, Any]:
    """A scene as it comes: mostly a quiet platform, clouds below 20 % on half of them."""
    quiet = float(np.exp(rng.normal(math.log(0.25), 0.6)))
    return {
        "jitter_1hz_px": 1.2 * quiet,
        "jitter_5hz_px": 0.4 * quiet,
        "jitter_22hz_px": 0.06 * quiet,
        "drift_px_per_s": 2.0 * quiet,
        "drift_angle_deg": float(rng.normal(0.0, 0.02)),
        "relief_m": float(rng.uniform(0, 800)),
        "contrast": float(rng.uniform(0.04, 0.16)),
        "low_contrast_share": float(rng.uniform(0.1, 0.6)) if rng.random() < 0.4 else 0.0,
        **({"cloud_cover": float(rng.uniform(0.02, 0.2)), **deck} if rng.random() < 0.5 else {}),
    }


def scene_of(case: str, seed: int) -> tuple[StripGeometry, list[tuple[Any, Any]], dict[int, Any]]:
    """The geometry, both strips' columns of each pair, and the true offsets (lines, 2) by pair."""
    if case in RESAMPLED:
        scene = resampled_scene(seed, MIXED_LINES, 4, *RESAMPLED[case])
        return scene.geometry, scene.edges, scene.truth
    plan = plan_of(case, seed)
    geometry, pairs = simulate_overlaps(plan)
    if plan.motion is not None:
        plan.motion.unlink()
    truth = {p.truth.pair: np.stack([p.truth.dcol_px, p.truth.dline_px], axis=1) for p in pairs}
    return geometry, [(p.left, p.right) for p in pairs], truth


def measured(job: tuple[str, int, tuple[str, ...]]) -> list[dict[str, Any]]:
    """One scene by some methods."""
    case, seed, methods = job
    cv2.setNumThreads(1)
    geometry, edges, truth = scene_of(case, seed)
    strips = strips_in_memory(geometry, edges)
    rows = []
    for method in methods:
        worked = time.process_time()
        found = StripOffsets(method, METHODS[method](strips, CcdSettings(), lambda done, total: None))
        seconds = time.process_time() - worked
        errors = scene_errors(found, truth, geometry)
        rows.append(
            {"case": case, "seed": seed, "method": method, "cpu_s": seconds, **dataclasses.asdict(errors)}
        )
    return rows


def run(jobs: list[tuple[str, int, tuple[str, ...]]], out: Path, workers: int) -> list[dict[str, Any]]:
    """All scenes, the ones already measured from the file."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "strips.jsonl"
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    have = {(r["case"], r["seed"], r["method"]) for r in done}
    left = [(c, s, tuple(m for m in ms if (c, s, m) not in have)) for c, s, ms in jobs]
    left = [job for job in left if job[2]]
    began = time.monotonic()
    with ProcessPoolExecutor(workers) as pool, path.open("a") as file:
        for i, rows in enumerate(pool.map(measured, left), 1):
            done += rows
            file.writelines(json.dumps(row) + "\n" for row in rows)
            file.flush()
            spent = time.monotonic() - began
            print(f"\r{i} of {len(left)} scenes, {spent:.0f} s", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    wanted = {(c, s, m) for c, s, ms in jobs for m in ms}
    return sorted((r for r in done if (r["case"], r["seed"], r["method"]) in wanted), key=lambda r: r["seed"])


HEAD = (
    "case", "method", "seeds", "RMS, px", "95 %, px", "worst line, px", "lines > 1 px",
    "scenes > 1 px (a segment)",
    "scenes > 1 px (RMS)", "measured lines > 1 px", "worst measured",
    "inside 90 % (scenes)", "measured, bridged, unreliable",
    "CPU time",
)  # fmt: skip


def table(rows: list[dict[str, Any]]) -> list[str]:
    """One line for each case and method: over all lines of all seeds."""
    lines = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    for case, method in sorted({(r["case"], r["method"]) for r in rows}, key=order):
        some = [r for r in rows if (r["case"], r["method"]) == (case, method)]
        lines.append("| " + " | ".join([case, f"`{method}`", *cells(case, method, some)]) + " |")
    return lines


def cells(case: str, method: str, rows: list[dict[str, Any]]) -> list[str]:
    """A case's figures by one method."""
    figures = [r["figures"] for r in rows]
    count = [f["lines"] for f in figures]

    def mean(values: list[float]) -> float:
        return float(np.average(values, weights=count))

    aim = AIMS.get(case, (None, None)) if method == "joint" else (None, None)
    aims = ["" if a is None else f" (aim {a:g})" for a in aim]
    inside = [float(np.mean(r["coverage"])) for r in rows]
    labels = [100 * mean([r["share_of_labels"][i] for r in rows]) for i in range(3)]
    return [
        str(len(rows)),
        f"{math.sqrt(mean([f['rms_px'] ** 2 for f in figures])):.3f}{aims[0]}",
        f"{mean([f['p95_px'] for f in figures]):.3f}{aims[1]}",
        f"{max(f['worst_line_px'] for f in figures):.2f}",
        f"{100 * mean([f['share_above'] for f in figures]):.2f} %",
        f"{100 * np.mean([f['misplaced'] is True for f in figures]):.0f} %",
        f"{100 * np.mean([f['rms_px'] > 1.0 for f in figures]):.0f} %",
        str(sum(r["measured_above"] for r in rows)),
        f"{max(r['measured_worst_px'] for r in rows):.2f}",
        f"{100 * mean(inside):.1f} % ({100 * min(inside):.0f} to {100 * max(inside):.0f})",
        ", ".join(f"{label:.0f}" for label in labels) + " %",
        f"{np.mean([r['cpu_s'] for r in rows]):.1f} s",
    ]


def order(of: tuple[str, str]) -> tuple[int, int]:
    """As the issue's table has them."""
    names = (*CASES, "mixed", *SMALL, *RESAMPLED)
    return names.index(of[0]), (*RIVALS, "joint").index(of[1])


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20, help="scenes of each case")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument(
        "--methods", help="names with commas, or all [joint; of mixed scenes the paper's two too]"
    )
    parser.add_argument("--cases", default=",".join(CASES), help="names with commas")
    parser.add_argument(
        "--mixed", type=int, default=0, help="so many mixed scenes by whole_scene, piecewise_linear, joint"
    )
    parser.add_argument("--small", type=int, default=0, help="so many short scenes of each sensor and sky")
    parser.add_argument("--resampled", type=int, default=0, help="so many scenes of each that is resampled")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=Path("out/bench-strips"))
    add_options(parser)
    asked = parser.parse_args()
    usual = "whole_scene,piecewise_linear,joint" if asked.mixed else "joint"
    methods = (*RIVALS, "joint") if asked.methods == "all" else tuple((asked.methods or usual).split(","))
    seeds = range(
        asked.first_seed, asked.first_seed + (asked.mixed or asked.small or asked.resampled or asked.seeds)
    )
    cases, name = asked.cases.split(","), "cases.md"
    if asked.mixed:
        cases, name = ["mixed"], "mixed.md"
    elif asked.small:
        cases, name = list(SMALL), "small.md"
    elif asked.resampled:
        cases, name = list(RESAMPLED), "resampled.md"
    jobs = [(case, seed, methods) for case in cases for seed in seeds]
    measured_rows = run(jobs, asked.out, asked.workers)
    lines = table(measured_rows)
    print("\n".join(lines))
    (asked.out / name).write_text("\n".join(lines) + "\n")
    write_rows(asked, result_rows(measured_rows, len(jobs)))


if __name__ == "__main__":
    main()
