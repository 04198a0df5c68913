"""Split halves of real flights: whether two maps differ by no more than both state.

    python -m tools.bench.bench_halves DATA [--only NAME...] [--out out/bench-halves]
                                           [--results docs/results/halves]

Every second frame makes one map, the others another; frames of neither half are in the other, so their images
and positions are independent but for the flight's common errors. Where both maps show the ground, the
displacement between them is measured. It is within what both state where it is shorter than the radius that
holds 90 % by both accuracy rasters; distances between places, by both runs' relative accuracy. Exit code 1
if one of them holds at fewer than 90 % of the places.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import rasterio
from numpy.typing import NDArray

from geomosaic.constants import sourced
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import interval_of
from geomosaic.survey.header import JPEG_SUFFIXES, TIFF_SUFFIXES
from tools.bench.bench_dirty_judge import MOST_PLACES
from tools.bench.bench_flights import PROGRAM, commit
from tools.bench.bench_flights_sheet import SheetFlight, read_flights

Floats = NDArray[np.float64]
FLIGHTS = ("brighton", "garfield", "seneca20")
CIRCLE_90 = sourced(2.1460, "deviations of a coordinate", "circle that holds 90 %", "Rayleigh")
LEAST_SHARE = 0.9


def halves(flight: SheetFlight, out: Path) -> tuple[Path, Path]:
    """Runs of both halves of a flight."""
    names = sorted(p for p in flight.frames.iterdir() if p.suffix.lower() in JPEG_SUFFIXES | TIFF_SUFFIXES)
    runs = []
    for half in (0, 1):
        frames, run = out / f"{flight.name}-{half}", out / f"{flight.name}-{half}-run"
        for folder in (frames, run):
            shutil.rmtree(folder, ignore_errors=True)
        frames.mkdir(parents=True)
        for path in names[half::2]:
            (frames / path.name).symlink_to(path.resolve())
        words = [PROGRAM, "mosaic", frames, *flight.words, "-o", run, "-q"]
        done = subprocess.run([*map(str, words)], capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{flight.name}, half {half}: {done.stderr.strip()[-300:]}")
        runs.append(run)
    return runs[0], runs[1]


def compared(one: Path, other: Path) -> dict[str, Any]:
    """How far two runs' maps differ, and the accuracy that they state."""
    said = [json.loads((run / "run.json").read_text()) for run in (one, other)]
    relative = [s["accuracy"]["relative"] for s in said]
    found = compare(one / "mosaic.tif", other / "mosaic.tif", ComparisonOptions(step_px=48, search_px=256))
    at = found.vectors_m[np.isfinite(found.vectors_m).all(axis=1)]
    # places count from the other map, displacements are this one minus the other
    sd_m = np.hypot(stated_m(one, at[:, :2] + at[:, 2:]), stated_m(other, at[:, :2]))
    length_m, known = np.hypot(*at[:, 2:].T), np.isfinite(sd_m)
    row = {
        "grades": [s["verdict"]["grade"] for s in said],
        "places": int(known.sum()),
        "apart_m": float(np.median(length_m)),
        "apart_after_similarity_px": found.figures.after_similarity_px,
        "stated_m": float(np.median(CIRCLE_90 * sd_m[known])),
        "within": float((length_m <= CIRCLE_90 * sd_m)[known].mean()),
    }
    some = at[np.linspace(0, len(at) - 1, min(len(at), MOST_PLACES)).astype(int)]
    a, b = np.triu_indices(len(some), 1)
    there_m = some[b, :2] - some[a, :2]
    from_m = np.hypot(*there_m.T)
    off_m = np.abs(np.hypot(*(there_m + some[b, 2:] - some[a, 2:]).T) - from_m)
    for name, over_m, key in (
        ("100_m", 100.0, "rmse_m_per_100m"),
        ("whole", min(r["whole_m"] for r in relative), "rmse_m_whole"),
    ):
        rmse = [r[key] for r in relative]
        near = (from_m > 0.7 * over_m) & (from_m < 1.4 * over_m)
        if near.any() and None not in rmse:
            most_m = interval_of(0.9) * float(np.hypot(*rmse))
            row |= {
                f"off_{name}_m": float(np.sqrt(np.mean(off_m[near] ** 2))),
                f"stated_{name}_m": float(np.hypot(*rmse)),
                f"within_{name}": float((off_m[near] <= most_m).mean()),
            }
    return row


def stated_m(run: Path, place_m: Floats) -> Floats:
    """Stated deviation of a coordinate at places (n, 2) on the map, NaN where the raster states none."""
    with rasterio.open(run / "accuracy.tif") as source:
        return np.array([value[0] for value in source.sample(place_m, indexes=1)], dtype=np.float64)


def table(rows: dict[str, dict[str, Any]]) -> str:
    """One line a flight."""
    lines = [
        "| flight | verdicts | places | apart, m | stated (90 %), m | within, % | over 100 m apart, m "
        "| stated, m | within, % | over the whole apart, m | stated, m | within, % |",
        f"|{'---|' * 12}",
    ]
    for name, r in rows.items():
        cells = [name, ", ".join(r["grades"]), r["places"], f"{r['apart_m']:.3f}", f"{r['stated_m']:.3f}",
                 f"{100 * r['within']:.0f}"]  # fmt: skip
        for which in ("100_m", "whole"):
            if f"within_{which}" in r:
                apart, stated = r[f"off_{which}_m"], r[f"stated_{which}_m"]
                cells += [f"{apart:.3f}", f"{stated:.3f}", f"{100 * r[f'within_{which}']:.0f}"]
            else:
                cells += ["-"] * 3
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="folder of sheets NAME.yaml, as for bench_flights.py")
    parser.add_argument("--only", nargs="+", default=FLIGHTS, metavar="NAME")
    parser.add_argument("--out", type=Path, default=Path("out/bench-halves"))
    parser.add_argument("--results", type=Path, help="without suffix, such as docs/results/halves")
    asked = parser.parse_args()
    if not asked.data.is_dir():
        print(f"skipped: there is no folder {asked.data}; name the folder of flights with DATA=folder")
        return 0
    rows = {}
    for flight in read_flights(asked.data.resolve(), asked.only):
        rows[flight.name] = compared(*halves(flight, asked.out))
        print(table({flight.name: rows[flight.name]}).splitlines()[-1], flush=True)
    if asked.results:
        whole = {
            "title": "Split halves",
            "command": "make bench-halves DATA=folder",
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
            "commit": commit(),
            "flights": rows,
        }
        asked.results.with_suffix(".json").write_text(json.dumps(whole, indent=1) + "\n")
        asked.results.with_suffix(".md").write_text(
            f"# Split halves\n\n`{whole['command']}`\n\n{table(rows)}"
        )
    shares = [v for r in rows.values() for key, v in r.items() if key.startswith("within")]
    return 0 if all(v >= LEAST_SHARE for v in shares) else 1


if __name__ == "__main__":
    sys.exit(main())
