"""How true the mosaic is: simulated surveys, judged apart from the pipeline against the true ortho.

    python -m tools.bench.bench_accuracy [--out DIR] [--only NAME ...] [--seeds N] [--rivals]

Each survey is simulated, mosaicked by the command line and compared with its true ortho; the table goes to
standard output as Markdown and to OUT/accuracy.json. What was wrong on purpose must be named in the run's
warnings, frame by frame. The Monte Carlo row is geometry alone: see bench_monte_carlo.py. Exit code 1
if a bound is missed.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.paper.misalignment import fullest_bin_mean
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.run_results import load_artefact
from geomosaic.placement.graph import connected_parts
from geomosaic.quality.compare import Comparison
from geomosaic.quality.figures import Figures, figures, touching_patches
from geomosaic.quality.misalignment import trend
from tools.bench.bench_accuracy_rows import result_rows
from tools.bench.result_rows import add_options, write_rows

Floats = NDArray[np.float64]
GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
PIXELS = ["--width-px", "1336", "--height-px", "1002", "--k2", "0"]
SIZE = [*PIXELS, "--k1", "0"]
LINES = ["--lines", "3", "--frames-per-line", "8"]
BLOCK = [*SIZE, *LINES]
NAMED = {"turned-frame": "frame-turned", "wrong-yaw": "yaw-wrong", "position-outlier": "position-wrong"}
"""What truth.json calls a thing that is wrong on purpose, and what a run's warning calls it. Of a frame with
two things wrong one must be named: an image turned by 180 degrees and a heading wrong by 180
cancel."""


@dataclass(frozen=True)
class Case:
    """A survey and what it must reach: after the best similarity, and jumps (99 %), both in ground px.

    pairs_px: the largest misalignment of a tied pair by the paper's equation 5. straight: the error must not
    grow or fall with the frame number. parts: how many parts without ties to each other the survey has; each
    is judged alone. ground: see the stage adjustment.solve. warned: warnings that must be there
    besides those of frames that are wrong on purpose.
    """

    name: str
    simulate: list[str]
    after_px: float | None = None
    jumps_px: float | None = None
    pairs_px: float | None = None
    straight: bool = False
    parts: int = 1
    warned: tuple[str, ...] = ()
    ground: str = "auto"
    dem: bool = False
    gsd_m: float = 0.1


CASES = [
    Case("flat", BLOCK, 0.15, 0.5),
    Case("k1 unknown", [*PIXELS, *LINES, "--k1", "-0.08", "--no-lens-reported"], 0.3),
    Case("hills, DEM", [*BLOCK, "--relief-m", "20"], 0.3, dem=True),
    Case("hills, no DEM", [*BLOCK, "--relief-m", "20"], 0.6, 1.2),
    Case("hills, no DEM, as if flat", [*BLOCK, "--relief-m", "20"],
         ground="flat"),
    Case("line of 200", [*SIZE, "--kind", "line", "--frames-per-line", "200", "--forward-overlap", "0.6",
                         "--heading-deg", "91.7"], jumps_px=0.7, straight=True),
    Case("the paper's nine", ["--kind", "paper", "--scale", "0.2"], pairs_px=0.5, gsd_m=0.5),
    Case("lies", [*BLOCK, "--yaw-wrong-share", "0.2", "--turned", "9-16", "--gps-outliers", "1"], 0.15, 0.5),
    Case("yaw 10 deg, said 1", [*BLOCK, "--yaw-sd-deg", "10", "--stated-yaw-sd-deg", "1"], 0.15, 0.5),
    Case("yaw 15 deg, said 2", [*BLOCK, "--yaw-sd-deg", "15", "--stated-yaw-sd-deg", "2"], 0.15, 0.5),
    Case("stale yaw on a line", [*BLOCK, "--stale-yaw-line", "2"], 0.15, 0.5),
    Case("heights off and drifting", [*BLOCK, "--height-bias-m", "-30", "--height-drift-m", "25"], 0.15, 0.5,
         warned=("heights-drift",)),
    Case("the same, no relative height", [*BLOCK, "--height-bias-m", "-30", "--height-drift-m", "25",
                                          "--no-relative-height-reported"], 0.15, 0.5,
         warned=("heights-drift",)),
    Case("no attitude", [*BLOCK, "--no-attitude-reported"], 0.3),
    Case("no attitude, no height", [*BLOCK, "--no-attitude-reported", "--no-height-reported"], 0.5),
    Case("two parts", [*BLOCK, "--lost", "4-6,11-13,20-22"], 0.15, 0.5, parts=2, warned=("separate-part",)),
    Case("RTK positions", [*BLOCK, "--position-sd-m", "0.02", "--height-sd-m", "0.03"], 0.15, 0.5),
    Case("deviations said a fifth", [*BLOCK, "--stated-sd-factor", "0.2"], 0.15, 0.5),
    Case("deviations said five times", [*BLOCK, "--stated-sd-factor", "5"], 0.15, 0.5),
]  # fmt: skip
RIVALS = ("none", "chain", "layered", "base_frame", "error_sharing", "least_squares")


def run(case: Case, out: Path, seed: int, method: str = "bundle") -> dict[str, Any]:
    """Simulates (once per case and seed), mosaics, and reads the judge's figures.

    Rivals go on from the bundle's tie points, in one folder after each other.
    """
    folder = out / f"{''.join(c for c in case.name.replace(' ', '_') if c.isalnum() or c == '_')}-{seed}"
    if not (folder / "truth" / "truth.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        _call("simulate", "frames", folder, *case.simulate, "--seed", seed)
    bundle, target = folder / "run-bundle", folder / ("run-bundle" if method == "bundle" else "run-rival")
    if method == "bundle" or method == RIVALS[0]:
        shutil.rmtree(target, ignore_errors=True)
    if method == RIVALS[0] and bundle.exists():
        shutil.copytree(bundle, target)
    options = ["--pos", folder / "pos.csv", "--camera", folder / "cameras.json", "--adjust", method]
    options += ["--set", f"adjustment.solve.ground={case.ground}"] if case.ground != "auto" else []
    options += ["--dem", folder / "truth" / "dem.tif", "--dem-offset", "0"] if case.dem else []
    _call("mosaic", folder / "frames", "-o", target, *options,
          "--gsd", case.gsd_m, "--reference", folder / "truth" / "ortho.tif")  # fmt: skip
    return {"case": case.name, "method": method, "seed": seed, **judged(case, folder, target)}


def judged(case: Case, folder: Path, target: Path) -> dict[str, Any]:
    """The figures of a run, and whether they are good."""
    run_summary = json.loads((target / "run.json").read_text())
    comparison = load_artefact(target, run_summary, "comparison", Comparison)
    adjusted = load_artefact(target, run_summary, "adjusted", Adjusted)
    ties = load_artefact(target, run_summary, "ties", TiePoints)
    with (target / "positions.csv").open(newline="") as file:
        at_m = np.array([[float(r["easting_m"]), float(r["northing_m"])] for r in csv.DictReader(file)])
    parts = connected_parts(len(at_m), [(t.left, t.right) for t in ties.pairs])
    parts = parts[: case.parts] if case.parts > 1 else [list(range(len(at_m)))]
    by_part = [_of_frames(comparison, at_m, part) for part in parts]
    worst = max(by_part, key=lambda f: f.after_similarity_px)
    slope, slope_sd = _slope_m(comparison, at_m)
    left_m = [r[np.isfinite(r).all(axis=1)] for r in adjusted.residuals_m]
    pairs = [np.linalg.norm(fullest_bin_mean(r / case.gsd_m)) for r in left_m if len(r)]
    wrong = {
        (NAMED[w["code"]], w["frame"])
        for w in json.loads((folder / "truth" / "truth.json").read_text())["warnings"]
    }
    warned = {(w["code"], w["frame"]) for w in run_summary["warnings"]}
    once = [w for w in wrong if sum(frame == w[1] for _, frame in wrong) == 1]
    named = {frame for code, frame in warned if code in NAMED.values()}
    row: dict[str, Any] = {
        "absolute_m": comparison.figures.absolute_rmse_m,
        "after_px": worst.after_similarity_px,
        "jumps_px": max(f.jump_99_px for f in by_part),
        "slope_mm": 1000.0 * slope,
        "slope_sd_mm": 1000.0 * slope_sd,
        "pairs_px": float(max(pairs, default=np.nan)),
        "measured": comparison.figures.share_measured,
        "tied": run_summary["frames"]["tied"],
        "frames": run_summary["frames"]["total"],
        "wrong": len(wrong),
        "named": len(wrong & warned),
        "named_by_code": {c: _named(wrong, warned, c) for c in NAMED.values()},
        "sigma_px": run_summary["metrics"]["adjustment"].get("sigma_px"),
        "ground": run_summary["metrics"]["ground"]["kind"],
        "seconds": sum(run_summary["timings_s"].values()),
    }
    bounds = (
        (row["after_px"], case.after_px),
        (row["jumps_px"], case.jumps_px),
        (row["pairs_px"], case.pairs_px),
    )
    row["good"] = (
        all(bound is None or value <= bound for value, bound in bounds)
        and (not case.straight or abs(slope) <= 2.0 * slope_sd)
        and warned.issuperset(once)
        and named.issuperset(frame for _, frame in wrong)
        and set(case.warned) <= {code for code, _ in warned}
    )
    return row


def _named(wrong: set[tuple[str, str]], warned: set[tuple[str, str]], code: str) -> tuple[int, int]:
    """How many frames are wrong in this way, and how many of them are named."""
    mine = {w for w in wrong if w[0] == code}
    return len(mine & warned), len(mine)


def _of_frames(comparison: Comparison, at_m: Floats, frames: list[int]) -> Figures:
    """The judge's figures of the patches whose nearest frame is one of these."""
    mine = np.isin(cKDTree(at_m).query(comparison.vectors_m[:, :2])[1], frames)
    patches, moved = comparison.vectors_m[mine, :2], comparison.vectors_m[mine, 2:]
    touching = touching_patches(patches / comparison.gsd_m, comparison.patch_px, comparison.step_px)
    return figures(patches, moved, touching, comparison.gsd_m, int(mine.sum()))


def _slope_m(comparison: Comparison, at_m: Floats) -> tuple[float, float]:
    """Metres a frame by which the length of the judge's mean vector in it grows, and its deviation."""
    nearest = cKDTree(at_m).query(comparison.vectors_m[:, :2])[1]
    count = np.bincount(nearest, minlength=len(at_m))
    mean = [
        np.bincount(nearest, comparison.vectors_m[:, k], len(at_m)) / np.where(count, count, np.nan)
        for k in (2, 3)
    ]
    line = trend(np.arange(len(at_m)), np.hypot(*mean))
    return line.slope, line.slope_sd


def _call(*words: object) -> None:
    done = subprocess.run([str(GEOMOSAIC), *map(str, words)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"geomosaic {' '.join(map(str, words))}\n{done.stderr}")


HEAD = ("survey", "method", "seed", "absolute, m", "after similarity, px", "jumps 99 %, px", "pairs, px",
        "slope, mm/frame", "tied", "named", "ground", "s", "")  # fmt: skip


def _line(case: Case, r: dict[str, Any]) -> str:
    wanted = [
        f"{name} <= {bound:g}"
        for name, bound in (("after", case.after_px), ("jumps", case.jumps_px), ("pairs", case.pairs_px))
        if bound is not None
    ]
    wanted += ["slope 0"] if case.straight else []
    verdict = f"{'ok' if r['good'] else 'MISSED'} {', '.join(wanted)}" if r["method"] == "bundle" else ""
    cells = (
        r["case"], r["method"], r["seed"], f"{r['absolute_m']:.3f}", f"{r['after_px']:.3f}",
        f"{r['jumps_px']:.2f}", f"{r['pairs_px']:.2f}", f"{r['slope_mm']:+.1f} ± {r['slope_sd_mm']:.1f}",
        f"{r['tied']} of {r['frames']}", f"{r['named']} of {r['wrong']}" if r["wrong"] else "", r["ground"],
        f"{r['seconds']:.0f}", verdict,
    )  # fmt: skip
    return f"| {' | '.join(map(str, cells))} |"


def main() -> int:
    """Runs the cases asked for, prints the table as it grows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench-accuracy"))
    parser.add_argument("--only", nargs="*", choices=[c.name for c in CASES], help="names of cases")
    parser.add_argument("--seeds", type=int, default=1, help="seeds 1 to N of each case")
    parser.add_argument(
        "--rivals",
        action="store_true",
        help="the other methods as well: on the cases of --only, or the first",
    )
    add_options(parser)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    for case in CASES:
        if args.only and case.name not in args.only:
            continue
        with_rivals = args.rivals and (args.only or case is CASES[0])
        for seed in range(1, args.seeds + 1):
            for method in ("bundle", *RIVALS) if with_rivals else ("bundle",):
                rows.append(run(case, args.out, seed, method))
                print(_line(case, rows[-1]), flush=True)
                (args.out / "accuracy.json").write_text(json.dumps(rows, indent=1))
    bounds = {c.name: (c.after_px, c.jumps_px) for c in CASES}
    write_rows(args, result_rows([r for r in rows if r["method"] == "bundle"], bounds))
    return 0 if all(r["good"] for r in rows if r["method"] == "bundle") else 1


if __name__ == "__main__":
    raise SystemExit(main())
