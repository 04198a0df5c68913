"""What `geomosaic inspect --worst` says of surveys with known faults, against what was planted.

    .venv/bin/python tools/bench_worst.py [--out DIR] [--seed FIRST] [--seeds N] [--dry N] [--varied]

Each survey has 4 x 5 frames over hills of 25 m, 30 % of it water, two positions 60 m off, a tenth of the
headings wrong, and one frame whose pixels were turned; --dry: how many besides have none of it. --varied:
size, relief, overlap, course, water and faults are drawn by the seed. A frame that was turned and whose
heading is wrong too is named where it stands against its line. Ground without tie points has to be named
where a tenth of what three frames truly see is water, and mustn't be where a hundredth is or less. Exit code
1 if one fault is missed, or one is named that isn't there.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import rasterio

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
WATER, NO_WATER = 0.10, 0.01
"""Of the ground that three frames see: as much has to be named, as little mustn't."""
SEEN_BY = 3
MEANS = {
    "turned-frame": {"frame-turned", "against-its-line"},
    "wrong-yaw": {"yaw-wrong", "against-its-line"},
    "position-outlier": {"position-wrong"},
}
BARE = "ground-without-ties"


def survey(seed: int, dry: bool, varied: bool) -> dict[str, float | str]:
    """The simulator's parameters."""
    flown: dict[str, float | str] = {"lines": 4, "frames-per-line": 5, "relief-m": 25}
    faults: dict[str, float | str] = {
        "gps-outliers": 2, "gps-outlier-m": 60, "yaw-wrong-share": 0.1, "water-share": 0.3,
        "turned": str(5 + seed * 7 % 15),
    }  # fmt: skip
    if varied:
        rng = Random(f"{seed} worst")
        lines, per_line = rng.randint(3, 5), rng.randint(4, 6)
        flown = {
            "lines": lines, "frames-per-line": per_line, "relief-m": rng.choice((0, 10, 40, 60)),
            "forward-overlap": rng.uniform(0.65, 0.8), "side-overlap": rng.uniform(0.45, 0.65),
            "heading-deg": rng.uniform(0.0, 360.0),
        }  # fmt: skip
        turned = rng.sample(range(1, lines * per_line + 1), rng.choice((0, 1, 2)))
        faults = {
            "gps-outliers": rng.randint(0, 3), "gps-outlier-m": rng.choice((30, 60, 150)),
            "yaw-wrong-share": rng.choice((0.0, 0.05, 0.15)), "water-share": rng.choice((0.0, 0.2, 0.4)),
            "turned": ",".join(map(str, turned)),
        }  # fmt: skip
    return flown if dry else {**flown, **faults}


def judged(seed: int, dry: bool, varied: bool, out: Path) -> tuple[int, list[str], list[str]]:
    """How many faults were planted, what was missed, and what was named that isn't there."""
    folder = out / f"{'dry' if dry else 'bad'}{'-varied' if varied else ''}-{seed}"
    if not (folder / "run" / "run.json").exists():
        words = [w for name, value in survey(seed, dry, varied).items() for w in (f"--{name}", value)]
        _call("simulate", "frames", folder, *words, "--seed", seed, "--workers", "1")
        _call("mosaic", folder / "frames", "-o", folder / "run", "--workers", "1")
    said = json.loads(_call("inspect", folder / "run", "--worst", 1000, "--json"))["worst"]["faults"]
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    planted = [(w["code"], w["frame"]) for w in truth["warnings"]]
    named = [(f["code"], name) for f in said for name in f["frames"] if f["code"] != BARE]
    missed = [f"{c} {n}" for c, n in planted if not any(m == n and d in MEANS[c] for d, m in named)]
    false = [f"{c} {n}" for c, n in named if not any(m == n and c in MEANS[d] for d, m in planted)]
    share = water_seen(folder / "truth")
    bare = any(f["code"] == BARE for f in said)
    if share >= WATER and not bare:
        missed.append(f"water, {100 * share:.0f} %")
    if share <= NO_WATER and bare:
        false.append("water")
    return len(planted) + (share >= WATER), missed, false


def water_seen(truth: Path) -> float:
    """Share of water in the ground that three frames see, each as if straight down on level ground."""
    if not (truth / "cover.tif").exists():
        return 0.0
    with rasterio.open(truth / "cover.tif") as file:
        water, grid = file.read(1) == 1, file.transform
    with rasterio.open(truth / "dem.tif") as file:
        ground_m = float(np.median(file.read(1)))
    camera = json.loads((truth / "truth.json").read_text())["camera"]
    across, along = (camera[side] / camera["focal_length_px"] / 2.0 for side in ("width_px", "height_px"))
    seen = np.zeros(water.shape, np.uint8)
    with (truth / "positions.csv").open(newline="") as rows:
        for row in csv.DictReader(rows):
            east, north, height, yaw = (
                float(row[name]) for name in ("easting_m", "northing_m", "height_ellipsoidal_m", "yaw_deg")
            )
            turn = np.exp(-1j * np.radians(yaw))  # clockwise from north
            corners = [east + 1j * north + (height - ground_m) * turn * (a * across + 1j * b * along)
                       for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]  # fmt: skip
            ring = np.array([[(c.real - grid.c) / grid.a, (grid.f - c.imag) / grid.a] for c in corners])
            drawn = np.zeros_like(seen)
            cv2.fillConvexPoly(drawn, np.round(ring).astype(np.int32), 1)
            seen += drawn
    return float(water[seen >= SEEN_BY].mean()) if (seen >= SEEN_BY).any() else 0.0


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
    parser.add_argument("--varied", action="store_true")
    args = parser.parse_args()
    good = True
    print("| seed | planted | missed | named, but not there |\n|---|---|---|---|")
    for dry, count in ((False, args.seeds), (True, args.dry)):
        for seed in range(args.seed, args.seed + count):
            planted, missed, false = judged(seed, dry, args.varied, args.out)
            good &= not missed and not false
            cells = (seed, planted, ", ".join(missed), ", ".join(false))
            print(f"| {' | '.join(map(str, cells))} |", flush=True)
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
