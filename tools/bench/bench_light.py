"""Whether mosaics keep the light of the ground: simulated flights against the true radiance up to one factor.

    python -m tools.bench.bench_light [--seed FIRST] [--seeds N] [--out out/bench-light]
                                      [--results docs/results/light]

A flight has 15 frames of a wide lens with the sun behind the camera. A hot spot is half brighter than the
ground about it, and a quarter of the light is lost in the corners. An automatic evens out each frame's
brightness and reports its exposure time, and exposures scatter by 1 % besides. A second kind has clouds that
shade 30 % of the ground. The positions are given to 2 cm, so that what remains is light.

Radiance: logarithm of the mosaic over the true ortho, means of squares of 4 m, less their median. Hot spot:
how much brighter the ground about the places is at which frames look with the sun behind, than farther away.
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
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.warp import reproject

from geomosaic.geodesy.sun import sun_direction
from geomosaic_simulate.flight import fly
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import simulate_frames, world_of
from tools.bench.bench_flights import commit

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
PLAN = SurveyPlan(
    lines=3, frames_per_line=5, width_px=480, height_px=360, height_above_ground_m=25.0, side_overlap=0.6,
    position_sd_m=0.02, height_sd_m=0.02, exposure_sd=0.01, auto_exposure=1.0, exposure_reported=True,
    vignetting=0.25, hot_spot=0.5,
)  # fmt: skip
KINDS = {"sun": 0.0, "sun and clouds": 0.3}
WAYS: dict[str, list[str]] = {
    "default": [],
    "one exposure": ["--set", "mosaic.tones.level=common"],
    "not balanced": ["--set", "mosaic.tones.even=never"],
}
SQUARE_PX = 41
RADIANCE, HOT_SPOT = 0.02, 0.01


def brighter(mosaic: Path, ortho: Path) -> tuple[np.ndarray[Any, Any], Any]:
    """Logarithm of how much brighter the mosaic is than the truth about each pixel, NaN at its rim; and the
    transform of both."""
    with rasterio.open(mosaic) as found, rasterio.open(ortho) as true:
        ours, valid = found.read([1, 2, 3]).astype(np.float32), found.dataset_mask() > 0
        theirs = np.zeros_like(ours)
        for k in range(3):
            reproject(rasterio.band(true, k + 1), theirs[k], dst_transform=found.transform, dst_crs=found.crs)
        transform = found.transform
    valid &= theirs.min(axis=0) > 0.0
    square = (SQUARE_PX, SQUARE_PX)
    means = [cv2.blur(np.where(valid, of.mean(axis=0), 0.0), square) for of in (ours, theirs)]
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.log(means[0] / means[1])
    off[cv2.erode(valid.astype(np.uint8), np.ones(square, np.uint8)) == 0] = np.nan
    return off - np.nanmedian(off), transform


def figures(plan: SurveyPlan, off: np.ndarray[Any, Any], transform: Any) -> dict[str, float]:
    """What a mosaic leaves of the light."""
    flight = fly(plan)
    world = world_of(plan, flight)
    near, far = [], []
    rows, cols = np.indices(off.shape)
    for i, position in enumerate(flight.poses.positions_m):
        behind = -sun_direction(plan.lon_deg, plan.lat_deg, float(flight.time_s[i]))
        down_m = float(flight.lon_lat_height[i, 2]) - plan.ground_height_m
        ground = position - behind * down_m / behind[2]
        col, row = ~transform @ tuple(world.map_from_enu(ground[None])[0, :2])
        away_m = np.hypot(cols - col, rows - row) * transform.a
        values = [off[(away_m >= a * down_m) & (away_m < b * down_m)] for a, b in ((0.0, 0.1), (0.3, 0.6))]
        values = [of[np.isfinite(of)] for of in values]
        if min(len(of) for of in values):
            near.append(float(values[0].mean()))
            far.append(float(values[1].mean()))
    spot = float(np.mean(np.subtract(near, far))) if near else float("nan")
    return {"radiance_rms": float(np.sqrt(np.nanmean(off**2))), "hot_spot": spot, "spots": len(near)}


def rows_of(seed: int, kind: str, out: Path) -> list[dict[str, Any]]:
    """One flight, in all ways."""
    plan = replace(PLAN, seed=seed, clouds=KINDS[kind])
    folder = out / f"{kind.replace(' ', '-')}-{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    survey = simulate_frames(folder, plan)
    rows = []
    for way, settings in WAYS.items():
        run = folder / way.replace(" ", "-")
        command = ["mosaic", survey.frames, "--pos", survey.pos, "--camera", survey.camera, "--workers", "1"]
        if settings:
            command = ["replay", folder / "default", "--from", "mosaic.tones", "--workers", "1", *settings]
        subprocess.run([str(a) for a in (GEOMOSAIC, *command, "-o", run)], check=True, capture_output=True)
        rows.append({"seed": seed, "kind": kind, "way": way})
        rows[-1] |= figures(plan, *brighter(run / "mosaic.tif", survey.ortho))
    return rows


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A case for each kind and way: median and worst of its seeds."""
    cases = []
    for kind in KINDS:
        for way in WAYS:
            mine = [r for r in rows if r["kind"] == kind and r["way"] == way]
            if not mine:
                continue
            rms, spot = ([abs(r[name]) for r in mine] for name in ("radiance_rms", "hot_spot"))
            cases.append(
                {
                    "kind": kind, "way": way, "flights": len(mine),
                    "radiance_median": float(np.median(rms)), "radiance_worst": max(rms),
                    "hot_spot_median": float(np.median(spot)), "hot_spot_worst": max(spot),
                }
            )  # fmt: skip
    return cases


def table(cases: list[dict[str, Any]]) -> str:
    """A line for each kind and way."""
    lines = [
        "| flights | tones | radiance, RMS, median | worst | hot spot, median | worst |",
        "|---" * 6 + "|",
    ]
    for case in cases:
        names = ("radiance_median", "radiance_worst", "hot_spot_median", "hot_spot_worst")
        shares = [f"{100.0 * case[name]:.1f} %" for name in names]
        lines.append(f"| {case['flights']}, {case['kind']} | {case['way']} | {' | '.join(shares)} |")
    return "\n".join(lines)


def main() -> int:
    """Exit code 1 where a flight misses what is wanted by one exposure."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--seed", type=int, default=9101)
    asked.add_argument("--seeds", type=int, default=10)
    asked.add_argument("--out", type=Path, default=Path("out/bench-light"))
    asked.add_argument("--results", type=Path, help="without suffix, such as docs/results/light")
    options = asked.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    rows: list[dict[str, Any]] = []
    for seed in range(options.seed, options.seed + options.seeds):
        for kind in KINDS:
            rows += rows_of(seed, kind, options.out)
            print(*rows[-len(WAYS) :], sep="\n", flush=True)
    cases = summary(rows)
    print(table(cases))
    if options.results:
        whole = {
            "title": "Light",
            "command": f"python -m tools.bench.bench_light --seed {options.seed} --seeds {options.seeds}",
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
            "commit": commit(),
            "cases": cases,
            "rows": rows,
        }
        options.results.with_suffix(".json").write_text(json.dumps(whole, indent=1) + "\n")
        text = f"# Light\n\n`{whole['command']}`, {whole['date']}, {whole['machine']}\n\n{table(cases)}\n"
        options.results.with_suffix(".md").write_text(text)
    judged = [c for c in cases if c["way"] == "one exposure"]
    return int(any(c["radiance_worst"] > RADIANCE or c["hot_spot_worst"] > HOT_SPOT for c in judged))


if __name__ == "__main__":
    sys.exit(main())
