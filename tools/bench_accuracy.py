"""How true the mosaic is: simulated surveys, judged apart from the pipeline against the true ortho.

    .venv/bin/python tools/bench_accuracy.py [--out out/bench-accuracy] [--only NAME ...] [--seeds N]

Each survey is simulated, mosaicked by the command line and compared with its true ortho; the table goes to
standard output as Markdown and to OUT/accuracy.json. The Monte Carlo row is geometry alone: see
tools/bench_monte_carlo.py. Exit code 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
FRAMES = ["--width-px", "1336", "--height-px", "1002", "--lines", "3", "--frames-per-line", "8"]
KNOWN_LENS = ["--k1", "0", "--k2", "0"]


@dataclass(frozen=True)
class Case:
    """A survey and what it must reach: after the best similarity, jumps (99 %), both in ground px."""

    name: str
    simulate: list[str]
    after_px: float | None = None
    jumps_px: float | None = None
    mosaic: list[str] = field(default_factory=list)
    dem: bool = False


CASES = [
    Case("flat", [*FRAMES, *KNOWN_LENS], 0.15, 0.5),
    Case("k1 unknown", [*FRAMES, "--k1", "-0.08", "--k2", "0", "--no-lens-told"], 0.3),
    Case("hills, DEM", [*FRAMES, *KNOWN_LENS, "--relief-m", "20"], 0.3, dem=True),
    Case("hills, no DEM", [*FRAMES, *KNOWN_LENS, "--relief-m", "20"], 0.6, 1.2),
    Case("line of 200", ["--kind", "line", "--frames-per-line", "200", "--forward-overlap", "0.6",
                         "--width-px", "1336", "--height-px", "1002", *KNOWN_LENS], None, 0.7),
    Case("lies", [*FRAMES, *KNOWN_LENS, "--yaw-wrong-share", "0.2", "--turned", "9-16", "--gps-outliers",
                  "1"],
         0.15, 0.5),
    Case("no attitude", [*FRAMES, *KNOWN_LENS, "--no-attitude-told"], 0.3),
    Case("no attitude, no height", [*FRAMES, *KNOWN_LENS, "--no-attitude-told", "--no-height-told"], 0.5),
]  # fmt: skip
RIVALS = ("none", "chain", "layered", "base_frame", "error_sharing", "least_squares")


def run(case: Case, out: Path, seed: int, method: str = "bundle") -> dict[str, float | str | bool | int]:
    """Simulates (once per case and seed), mosaics, and reads the judge's figures."""
    folder = out / f"{case.name.replace(' ', '_').replace(',', '')}-{seed}"
    if not (folder / "truth" / "truth.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        _call("simulate", "frames", folder, *case.simulate, "--seed", seed)
    target = folder / f"run-{method}"
    shutil.rmtree(target, ignore_errors=True)
    options = ["--pos", folder / "pos.csv", "--camera", folder / "cameras.json", "--adjust", method]
    options += ["--dem", folder / "truth" / "dem.tif", "--dem-offset", "0"] if case.dem else []
    _call("mosaic", folder / "frames", "-o", target, *options, *case.mosaic,
          "--gsd", "0.1", "--reference", folder / "truth" / "ortho.tif")  # fmt: skip
    told = json.loads((target / "run.json").read_text())
    quality = told["metrics"]["quality"]
    good = (case.after_px is None or quality["after_similarity_px"] <= case.after_px) and (
        case.jumps_px is None or quality["jump_99_px"] <= case.jumps_px
    )
    return {
        "case": case.name, "method": method, "seed": seed, "absolute_m": quality["absolute_rmse_m"],
        "after_px": quality["after_similarity_px"], "jumps_px": quality["jump_99_px"],
        "measured": quality["share_measured"], "ground": told["metrics"]["ground"]["kind"],
        "seconds": sum(told["timings_s"].values()), "good": good or method != "bundle",
    }  # fmt: skip


def _call(*words: object) -> None:
    done = subprocess.run([str(GEOMOSAIC), *map(str, words)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"geomosaic {' '.join(map(str, words))}\n{done.stderr}")


def main() -> int:
    """Runs the cases asked for, prints the table as it grows."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench-accuracy"))
    parser.add_argument("--only", nargs="*", help="names of cases")
    parser.add_argument("--seeds", type=int, default=1, help="seeds 1 to N of each case")
    parser.add_argument("--rivals", action="store_true", help="the other methods on the first case as well")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    rows = []
    print("| survey | method | seed | absolute, m | after similarity, px | jumps 99 %, px | ground | s | |")
    print("|---|---|---|---|---|---|---|---|---|")
    for case in CASES:
        if args.only and case.name not in args.only:
            continue
        methods = ("bundle", *RIVALS) if args.rivals and case is CASES[0] else ("bundle",)
        for seed in range(1, args.seeds + 1):
            for method in methods:
                r = run(case, args.out, seed, method)
                rows.append(r)
                wanted = f"<= {case.after_px or '-'}, {case.jumps_px or '-'}" if method == "bundle" else ""
                print(
                    f"| {r['case']} | {method} | {seed} | {r['absolute_m']:.3f} | {r['after_px']:.3f} | "
                    f"{r['jumps_px']:.2f} | {r['ground']} | {r['seconds']:.0f} | "
                    f"{'ok' if r['good'] else 'MISSED'} {wanted} |",
                    flush=True,
                )
    (args.out / "accuracy.json").write_text(json.dumps(rows, indent=1))
    return 0 if all(r["good"] for r in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
