"""What `geomosaic inspect --worst` says of surveys with known faults, against what was planted.

    .venv/bin/python tools/bench_worst.py [--out DIR] [--seed FIRST] [--seeds N] [--dry N]

Each survey has 4 x 5 frames over hills of 25 m, 30 % of it water, two positions 60 m off, a tenth of the
headings wrong, and one frame whose pixels were turned; --dry: how many besides have none of it. A frame that
was turned and whose heading is wrong too is named where it stands against its line. Exit code 1 if one fault
is missed, or one is named that isn't there.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
FLOWN = ["--lines", "4", "--frames-per-line", "5", "--relief-m", "25", "--workers", "1"]
FAULTS = ["--gps-outliers", "2", "--gps-outlier-m", "60", "--yaw-wrong-share", "0.1", "--water-share", "0.3"]
MEANS = {
    "turned-frame": {"frame-turned", "against-its-line"},
    "wrong-yaw": {"yaw-wrong", "against-its-line"},
    "position-outlier": {"position-wrong"},
}
WATER = "ground-without-ties"


def judged(seed: int, dry: bool, out: Path) -> tuple[list[str], list[str]]:
    """What was missed, and what was named that isn't there."""
    folder = out / f"{'dry' if dry else 'bad'}-{seed}"
    if not (folder / "run" / "run.json").exists():
        turned = ["--turned", str(5 + seed * 7 % 15)]
        _call("simulate", "frames", folder, *FLOWN, "--seed", seed, *([] if dry else [*FAULTS, *turned]))
        _call("mosaic", folder / "frames", "-o", folder / "run", "--workers", "1")
    said = json.loads(_call("inspect", folder / "run", "--worst", 1000, "--json"))["worst"]["faults"]
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    planted = [(w["code"], w["frame"]) for w in truth["warnings"]]
    named = [(f["code"], name) for f in said for name in f["frames"] if f["code"] != WATER]
    missed = [f"{c} {n}" for c, n in planted if not any(m == n and d in MEANS[c] for d, m in named)]
    false = [f"{c} {n}" for c, n in named if not any(m == n and c in MEANS[d] for d, m in planted)]
    water = any(f["code"] == WATER for f in said)
    if water == dry:
        (false if dry else missed).append("water")
    return missed, false


def _call(*words: Any) -> str:
    done = subprocess.run([str(GEOMOSAIC), *map(str, words)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, words))}: {done.stderr[-400:]}")
    return done.stdout


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench-worst"))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--dry", type=int, default=3)
    args = parser.parse_args()
    good = True
    print("| seed | planted | missed | named, but not there |\n|---|---|---|---|")
    for dry, count in ((False, args.seeds), (True, args.dry)):
        for seed in range(args.seed, args.seed + count):
            missed, false = judged(seed, dry, args.out)
            good &= not missed and not false
            cells = (seed, "none" if dry else "all", ", ".join(missed), ", ".join(false))
            print(f"| {' | '.join(map(str, cells))} |", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
