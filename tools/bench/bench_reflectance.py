"""Reflectance of simulated multispectral flights against the truth, frame by frame and in a mosaic.

    python -m tools.bench.bench_reflectance [--seed N] [--out out/bench-reflectance]
                                            [--results docs/results/reflectance]

A flight has vignetting, a row gradient, black level, noise of 30 digital numbers, and exposure and gain of
each frame drawn. Light falls by 40 % in the middle of the flight, or evenly where there is no sun sensor.
A case is right if 99 % of the values lie within 0.02 of the true reflectance. Exit code 1 if one is not.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import rasterio

import geomosaic as gm
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.read import read_survey
from geomosaic_simulate.multispectral import BANDS, RigFlight, panel_albedo, reflectance, rig_flight
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.survey import SimulatedSurvey, simulate_frames
from tools.bench.bench_flights import commit

WITHIN = 0.02
BLOCK_PX = 10
CASES = {
    "MicaSense, panels and sun sensor": RigFlight("micasense"),
    "MicaSense, panels alone": RigFlight("micasense", sun_sensor=""),
    "MicaSense, sun sensor alone": RigFlight("micasense", panels=False),
    "MicaSense, tilted sun sensor alone": RigFlight("micasense", panels=False, sun_sensor="tilted"),
    "MicaSense, panels given with a table": RigFlight("micasense", with_code=False),
    "DJI, panels and sun sensor": RigFlight("dji"),
    "DJI, panels alone": RigFlight("dji", sun_sensor=""),
    "Parrot, panels and sun sensor": RigFlight("parrot"),
    "Parrot, panels alone": RigFlight("parrot", sun_sensor=""),
}


def figures(off: np.ndarray[Any, Any]) -> dict[str, float]:
    """Mean, root mean square and the size that 99 % are below."""
    return {
        "bias": float(off.mean()),
        "rms": float(np.sqrt(np.mean(off**2))),
        "q99": float(np.quantile(np.abs(off), 0.99)),
    }


def frames_case(name: str, flight: RigFlight, survey: SimulatedSurvey, out: Path) -> dict[str, Any]:
    """All frames and bands of a flight."""
    folder = out / name.replace(", ", "-").replace(" ", "_")
    shutil.rmtree(folder, ignore_errors=True)
    truth = rig_flight(survey.frames, folder, flight)
    panel = None
    if not flight.with_code:
        table = out / "panel.csv"
        lines = [f"{band},{panel_albedo(nm)}" for band, (nm, _) in BANDS.items()]
        table.write_text("\n".join(["band,albedo", *lines]) + "\n")
        panel = f"P0001_1.tif={table},P0002_1.tif={table}"
    read = read_survey(SurveyInputs(folder, radiometry="reflectance", panel=panel))
    frames = [*read.frames, *(f for band in read.other_bands for f in band.frames if f)]
    off = np.concatenate([(read_pixels(f)[0][..., 0] / 32768.0 - truth[f.name]).ravel() for f in frames])
    return {"case": name, "of": f"{len(frames)} frames of one band", **figures(off)}


def mosaic_case(survey: SimulatedSurvey, out: Path) -> dict[str, Any]:
    """Means of 10 x 10 pixels of a whole run's mosaic, all bands, against the true map."""
    folder, run = out / "mosaic-frames", out / "mosaic"
    for path in (folder, run):
        shutil.rmtree(path, ignore_errors=True)
    rig_flight(survey.frames, folder, RigFlight("micasense"))
    assert survey.pos is not None
    pos = out / "pos.csv"
    pos.write_text(survey.pos.read_text().replace(".jpg", "_1.tif"))
    gm.mosaic(folder, run, pos=pos, camera=survey.camera, radiometry="reflectance", workers=1)
    with rasterio.open(run / "mosaic.tif") as found, rasterio.open(survey.ortho) as ortho:
        gsd = found.res[0]
        left = round((found.bounds.left - ortho.bounds.left) / gsd)
        top = round((ortho.bounds.top - found.bounds.top) / gsd)
        rgb = np.moveaxis(ortho.read([1, 2, 3]), 0, -1)[top:, left:]
        bands, valid = found.read() / 32768.0, found.dataset_mask() > 0
    rows, cols = (n // BLOCK_PX * BLOCK_PX for n in valid.shape)
    offs = []
    for k, band in enumerate(BANDS):
        off = np.where(valid, bands[k] - reflectance(band, rgb)[: valid.shape[0], : valid.shape[1]], np.nan)
        blocks = off[:rows, :cols].reshape(rows // BLOCK_PX, BLOCK_PX, cols // BLOCK_PX, BLOCK_PX)
        means = blocks.mean(axis=(1, 3))
        offs.append(means[np.isfinite(means)])
    of = f"means of {BLOCK_PX} x {BLOCK_PX} px of the mosaic"
    return {"case": "MicaSense, panels and sun sensor, mosaic", "of": of, **figures(np.concatenate(offs))}


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| flight | values | bias | root mean square | 99 % within | right |",
        "|---|---|---|---|---|---|",
    ]
    for r in rows:
        numbers = (
            f"{r[name]:+.5f}" if name == "bias" else f"{r[name]:.4f}" for name in ("bias", "rms", "q99")
        )
        lines.append(f"| {r['case']} | {r['of']} | {' | '.join(numbers)} | {'yes' if r['right'] else 'no'} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("out/bench-reflectance"))
    parser.add_argument("--results", type=Path, help="without suffix, such as docs/results/reflectance")
    asked = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    shutil.rmtree(asked.out, ignore_errors=True)
    asked.out.mkdir(parents=True)
    plan = SurveyPlan(
        lines=2, frames_per_line=4, width_px=480, height_px=360, height_above_ground_m=50.0,
        position_sd_m=0.02, height_sd_m=0.02, seed=asked.seed,
    )  # fmt: skip
    survey = simulate_frames(asked.out / "survey", plan)
    rows = []
    for name, flight in CASES.items():
        rows.append(frames_case(name, flight, survey, asked.out))
    rows.append(mosaic_case(survey, asked.out))
    for row in rows:
        row["right"] = row["q99"] < WITHIN
    print(table(rows))
    if asked.results:
        whole = {
            "title": "Reflectance",
            "command": f"make bench-reflectance SEED={asked.seed}",
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
            "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
            "commit": commit(),
            "rows": rows,
        }
        asked.results.with_suffix(".json").write_text(json.dumps(whole, indent=1) + "\n")
        asked.results.with_suffix(".md").write_text(f"# Reflectance\n\n`{whole['command']}`\n\n{table(rows)}")
    return 0 if all(row["right"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
