"""Faults named by `geomosaic inspect --worst` on simulated surveys, against those that were simulated.

    python -m tools.bench.bench_worst [--out DIR] [--seed FIRST] [--seeds N] [--dry N] [--kinds a,b]
        [--results NAME]

Three kinds of surveys, with frames of 600 x 450 px. plain: 4 x 5 frames over hills of 25 m, 30 % of it water.
Two positions are 60 m off, a tenth of the headings are wrong, and one image is turned by 180 degrees. varied:
size, relief, overlap, course, water and faults are drawn by the seed. many: 3 x 4 frames, two positions 100 m
off, 40 % of the headings wrong, and two images turned. --dry: how many besides have no faults. A run ends
with the adjustment.

Each fault of a frame is right, missed, or named as another one; a named fault of a frame that has none is
false. Ground without tie points has to be named where a tenth of what three frames see is water, and mustn't
be where a hundredth is or less. --results: writes NAME.json and NAME.md. Exit code 1 if a fault is missed or
false, or if fewer than 99 % of the faults called sure are right.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import rasterio

from tools.bench.result_rows import RowKind, add_options, write_rows
from tools.docs.results_page import FAULTS

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
WATER, NO_WATER = 0.10, 0.01
"""Of the ground that three frames see: as much has to be named, as little mustn't."""
SEEN_BY = 3
CODES = {"turned-frame": "frame-turned", "wrong-yaw": "yaw-wrong", "position-outlier": "position-wrong"}
"""How the simulation and `inspect` name a fault."""
KINDS = ("plain", "varied", "many")
LEAST_RIGHT = 0.99
STAGES = ("survey.read", "matching.flying_height", "projection.ground", "placement.pos", "mosaic.estimate",
          "matching.sift", "adjustment.solve")  # fmt: skip
BARE = "ground-without-ties"
ROWS = {
    "unseen": RowKind(
        FAULTS,
        "unseen surveys with faults of headings, images and positions: named right; "
        "named where there is none",
        "all; none",
        "{right:d} of {simulated:d}; {false:d}",
    )
}


@dataclass(frozen=True)
class Named:
    """A fault of a frame: code simulated and code named, empty if none; probability of the named one."""

    survey: str
    frame: str
    simulated: str
    named: str
    probability: float | None


def survey(kind: str, seed: int, dry: bool) -> dict[str, float | str]:
    """The simulator's parameters."""
    rng = Random(f"{seed} worst")
    size: dict[str, float | str] = {"width-px": 600, "height-px": 450, "ground-pixel-m": 1.0 / 6.0}
    flown: dict[str, float | str] = {"lines": 4, "frames-per-line": 5, "relief-m": 25}
    faults: dict[str, float | str] = {
        "gps-outliers": 2, "gps-outlier-m": 60, "yaw-wrong-share": 0.1, "water-share": 0.3,
        "turned": str(5 + seed * 7 % 15),
    }  # fmt: skip
    if kind == "varied":
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
    elif kind == "many":
        flown = {}
        turned = rng.sample(range(1, 13), 2)
        faults = {"gps-outliers": 2, "yaw-wrong-share": 0.4, "turned": ",".join(map(str, turned))}
    return {**size, **flown, **({} if dry else faults)}


def judged(kind: str, seed: int, dry: bool, out: Path) -> tuple[list[Named], list[str]]:
    """Each fault that was simulated or named, and what was said wrongly of water."""
    name = f"{kind}{'-dry' if dry else ''}-{seed}"
    folder = out / name
    if not (folder / "run" / "run.json").exists():
        words = [w for key, value in survey(kind, seed, dry).items() for w in (f"--{key}", value)]
        _call("simulate", "frames", folder, *words, "--seed", seed, "--workers", "1")
        recipe = folder / "adjusted.yaml"
        recipe.write_text("name: adjusted\nstages:\n" + "".join(f"  - {stage}\n" for stage in STAGES))
        _call("run", recipe, "--frames", folder / "frames", "-o", folder / "run", "--workers", "1")
    said = json.loads(_call("inspect", folder / "run", "--worst", 1000, "--json"))["worst"]["faults"]
    truth = json.loads((folder / "truth" / "truth.json").read_text())
    simulated = [(CODES[w["code"]], w["frame"]) for w in truth["warnings"]]
    named = [(f["code"], frame, f["probability"]) for f in said for frame in f["frames"] if f["code"] != BARE]
    share, bare = water_seen(folder / "truth"), any(f["code"] == BARE for f in said)
    water = ["water missed"] if share >= WATER and not bare else []
    water += ["water false"] if share <= NO_WATER and bare else []
    return paired(name, simulated, named), water


def paired(
    survey: str, simulated: list[tuple[str, str]], named: list[tuple[str, str, float | None]]
) -> list[Named]:
    """Faults of the same frame and code together; of the rest, those of headings and images of one frame."""
    left, out = sorted(simulated), []
    others = []
    for code, frame, probability in named:
        if (code, frame) in left:
            left.remove((code, frame))
            out.append(Named(survey, frame, code, code, probability))
        else:
            others.append((code, frame, probability))
    for code, frame, probability in others:
        same = [c for c, f in left if f == frame and "position-wrong" not in (c, code)]
        if same:
            left.remove((same[0], frame))
        out.append(Named(survey, frame, same[0] if same else "", code, probability))
    return out + [Named(survey, frame, code, "", None) for code, frame in left]


def rows(found: list[Named]) -> list[dict[str, Any]]:
    """Faults by kind: how many were simulated, named right, named as another, missed and false."""
    out = []
    for code in CODES.values():
        mine = [f for f in found if f.simulated == code]
        right = sum(f.named == code for f in mine)
        missed = sum(not f.named for f in mine)
        false = sum(f.named == code and not f.simulated for f in found)
        wrong = len(mine) - right - missed
        out.append({"fault": code, "simulated": len(mine), "right": right, "wrong": wrong, "missed": missed,
                    "false": false})  # fmt: skip
    return out


def calibration(found: list[Named]) -> list[dict[str, Any]]:
    """Of named faults by how sure they are: how many, their mean probability, how many are right."""
    out = []
    for word, low, high in (("sure", 0.99, 1.1), ("likely", 0.5, 0.99), ("unsure", 0.0, 0.5)):
        mine = [f for f in found if f.probability is not None and low <= f.probability < high]
        mean = sum(f.probability or 0.0 for f in mine) / len(mine) if mine else None
        right = sum(f.named == f.simulated for f in mine)
        out.append({"called": word, "faults": len(mine), "mean probability": mean, "right": right})
    return out


def table(of: list[dict[str, Any]]) -> str:
    """Rows as Markdown."""
    lines = [list(of[0]), ["---"] * len(of[0])]
    lines += [[f"{v:.4f}" if isinstance(v, float) else "-" if v is None else str(v) for v in row.values()]
              for row in of]  # fmt: skip
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


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
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--dry", type=int, default=1)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--results", type=Path)
    add_options(parser)
    args = parser.parse_args()
    found: list[Named] = []
    surveys, water = [], []
    print("| survey | faults | not named right | water |\n|---|---|---|---|")
    for kind in args.kinds.split(","):
        for dry, count in ((False, args.seeds), (True, args.dry)):
            for seed in range(args.seed, args.seed + count):
                of_survey, of_water = judged(kind, seed, dry, args.out)
                found, water = found + of_survey, water + of_water
                name = f"{kind}{' without faults' if dry else ''} {seed}"
                odd = [
                    f"{f.frame} {f.simulated or 'nothing'} named {f.named or 'nothing'}"
                    for f in of_survey
                    if f.simulated != f.named
                ]
                surveys.append(
                    {
                        "survey": name,
                        "faults": sum(bool(f.simulated) for f in of_survey),
                        "not named right": ", ".join(odd),
                        "water": ", ".join(of_water),
                    }
                )
                print(f"| {' | '.join(str(v) for v in surveys[-1].values())} |", flush=True)
    text = f"\n{table(rows(found))}\n{table(calibration(found))}"
    print(text)
    if args.results:
        about = {
            "command": " ".join(["python -m tools.bench.bench_worst", *sys.argv[1:]]),
            "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
            "date": datetime.now(UTC).date().isoformat(),
            "commit": _commit(),
            "seeds": f"{args.seed} to {args.seed + args.seeds - 1} of {args.kinds}",
        }
        all_of = {**about, "faults": rows(found), "called": calibration(found), "surveys": surveys}
        args.results.with_suffix(".json").write_text(json.dumps(all_of, indent=1) + "\n")
        head = (
            "# Faults that `inspect` names\n\n`make bench-worst`; machine, date, command, commit and seeds:"
        )
        head += " [worst.json](worst.json). What the columns mean: `tools/bench/bench_worst.py`.\n"
        args.results.with_suffix(".md").write_text(f"{head}{text}\n{table(surveys)}")
    right, simulated, false = (sum(of[key] for of in rows(found)) for key in ("right", "simulated", "false"))
    met = right == simulated and not false
    write_rows(args, [ROWS["unseen"].row(met, right=right, simulated=simulated, false=false)])
    sure = calibration(found)[0]
    return int(bool(water) or any(f.simulated != f.named for f in found)
               or sure["right"] < LEAST_RIGHT * sure["faults"])  # fmt: skip


def _commit() -> str:
    """The commit of the program."""
    call = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    done = subprocess.run(call, cwd=Path(__file__).parent, capture_output=True, text=True, check=False)
    return done.stdout.strip()


if __name__ == "__main__":
    raise SystemExit(main())
