"""Real surveys: a drone flight with turned frames, its halves compared to each other, and other people's
data.

    python -m tools.bench.bench_real [--shared ../shared] [--out out/bench-real]

Needs the data folders `brighton_beach`, `ngi` and `odm_oblique` below SHARED/data, and takes `garfield` and
`seneca` if they are there. Without the first it says so and ends with exit code 0. Prints a Markdown table
for docs/results.md; exit code 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from osgeo import gdal
from osgeo_utils.samples import validate_cloud_optimized_geotiff as cog

from geomosaic.camera.rotation import Rotation
from geomosaic.survey.inputs import SurveyInputs
from geomosaic.survey.read import read_survey
from tools.bench.bench_real_halves import halves
from tools.bench.bench_real_ngi import ngi
from tools.bench.bench_real_others import others
from tools.bench.bench_real_rows import ROWS, TIME_S, halves_rows
from tools.bench.bench_real_table import Row, print_table
from tools.bench.result_rows import ResultRow, add_options, write_rows

GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
TURNED = {f"DJI_00{n}.JPG" for n in range(24, 30)}


def brighton(data: Path, out: Path, results: list[ResultRow]) -> list[Row]:
    """The acceptance of the real flight: time, CRS, pixel, COG, tied and turned frames; adds to results."""
    run = out / "brighton"
    shutil.rmtree(run, ignore_errors=True)
    start = time.monotonic()
    subprocess.run([GEOMOSAIC, "mosaic", data / "brighton_beach" / "images", "-o", run], check=True)
    seconds = time.monotonic() - start
    run_summary = json.loads((run / "run.json").read_text())
    tied = run_summary["frames"]["tied"]
    turned = {w["frame"] for w in run_summary["warnings"] if w["code"] == "frame-turned"}
    gdal.UseExceptions()
    _, errors, _ = cog.validate(str(run / "mosaic.tif"), full_check=True)
    mosaic, metrics = run_summary["mosaic"], run_summary["metrics"]["adjustment"]
    results.append(
        ROWS["brighton"].row(seconds < TIME_S, seconds=seconds, peak_mb=run_summary["peak_memory_mb"])
    )
    return [
        ("wall time", f"{seconds:.0f} s", f"< {TIME_S:.0f} s", seconds < TIME_S),
        ("peak memory", f"{run_summary['peak_memory_mb']:.0f} MB", "", True),
        ("CRS", mosaic["crs"], "EPSG:32615", mosaic["crs"] == "EPSG:32615"),
        ("pixel", f"{100 * mosaic['gsd_m']:.2f} cm", "about 1.7 cm", abs(mosaic["gsd_m"] - 0.017) < 0.001),
        ("COG validator", "; ".join(errors) or "passes", "passes", not errors),
        ("frames tied", f"{tied} of {run_summary['frames']['total']}", "18", tied == 18),
        ("frames found turned", f"{len(turned)}", "0024 to 0029", turned == TURNED),
        ("mean reprojection error", f"{metrics['reprojection_mean_px']:.2f} px", "", True),
        ("tracks, mean length", f"{metrics['tracks']:.0f}, {metrics['track_length_mean']:.2f}", "", True),
    ]  # fmt: skip


def two_pose_files(data: Path) -> list[Row]:
    """Attitudes of the same frames, measured (roll, pitch, yaw) and adjusted (omega, phi, kappa)."""
    folder = data / "odm_oblique"
    camera = folder / "opensfm" / "reconstruction.json"
    measured = read_survey(SurveyInputs(folder / "images", pos=folder / "odm_lla_rpy.csv", camera=camera))
    adjusted = read_survey(
        SurveyInputs(folder / "images", pos=folder / "odm_xyz_opk.csv", camera=camera, pos_crs="EPSG:32651")
    )
    angles = []
    for a, b in zip(measured.frames, adjusted.frames, strict=True):
        r = [
            Rotation.from_yaw_pitch_roll(*np.radians([x.yaw_deg, x.pitch_deg, x.roll_deg])).matrix
            for x in (a.attitude, b.attitude)
        ]
        angles.append(np.degrees(np.arccos((np.trace(r[0].T @ r[1]) - 1.0) / 2.0)))
    worst = max(angles)
    return [("odm_oblique: two pose files", f"{worst:.2f} deg apart at most", "< 3 deg", worst < 3.0)]


def main() -> int:
    """Runs all of it and prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shared", type=Path, default=Path(__file__).resolve().parents[3] / "shared")
    parser.add_argument("--out", type=Path, default=Path("out/bench-real"))
    add_options(parser)
    args = parser.parse_args()
    data = args.shared / "data"
    if not (data / "brighton_beach").is_dir():
        print(f"skipped: {data} has no brighton_beach; name the data with --shared")
        return 0
    results: list[ResultRow] = []
    rows = two_pose_files(data) + ngi(data, args.out, results) + brighton(data, args.out, results)
    split = halves(data, args.out, args.out / "brighton")
    results += halves_rows(split)
    rows += split.rows + others(data, args.out, results)
    print_table(rows)
    write_rows(args, results)
    return 0 if all(row[3] for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
