"""Whether accuracy.tif is true: simulated surveys, true errors over the deviations stated at each place.

    python -m tools.bench.bench_accuracy_raster [--out DIR] [--only NAME ...] [--seeds N] [--first-seed N]
                                                    [--results docs/results/accuracy_raster]

A place of the map shows what its frame's true ray meets on the true ground. The frame is the one that
sources.tif names; its image coordinates come from the run's pose, lens and ground, the ray from the true
pose and lens. The horizontal error is true minus mapped place, the vertical one that of the ground's height.
Figures are root mean squares of error over stated deviation, 1 where the raster is true, by class (band 3).

A mosaic on a surface that shows what stands is judged everywhere. One on the ground below, where roofs and
crowns lean, is judged at places of open ground that show open ground.

One survey says little. With GNSS positions nearly all of its error is one shift, turn and scale of the block.
Since these are four numbers, the figure of a true raster scatters by a third. Half of the seeds have RTK
positions, which leave the errors of the heights to be seen. Surveys of all seeds are pooled, each counted
alike. ± is one deviation: of one survey what the covariance of its places leads one to expect, of several
what they show.

Results go to standard output as Markdown, and to RESULTS.json and .md if asked for; exit code 1 if a class of
all surveys together misses 0.8 to 1.25.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import rasterio
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.camera.exterior import Pose
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.export.on_map import grid_from_work, map_from_work
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.projection.footprint import ground_from_image
from geomosaic.projection.ground import GroundSurface
from geomosaic.projection.map_grid import MapGrid
from geomosaic.projection.warp import ground_window
from geomosaic.survey.model import Survey
from geomosaic_simulate.plan import SurveyPlan
from geomosaic_simulate.relief import Relief
from geomosaic_simulate.standing import heights_on_grid
from geomosaic_simulate.survey import landscape_of
from tools.bench.bench_accuracy_raster_judge import Errors, Row, freedoms, judged, missed, table, together
from tools.bench.bench_flights import commit

Floats = NDArray[np.float64]
GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
POSITIONS = {"RTK": ["--position-sd-m", "0.02", "--height-sd-m", "0.03"], "GNSS": []}
"""By the seed, even ones first: GNSS as the simulator has it, 1.5 m in plan and 2 m in height."""
GSD_M = 0.2
"""Of mosaics: half the resolution of the frames takes less time and changes no place."""
PLACES_ACROSS = 4
"""Of a cell, which is looked at in so many places squared: its figures are of all of it."""
SIZE = ["--width-px", "512", "--height-px", "384", "--height-above-ground-m", "50"]
BLOCK = [*SIZE, "--lines", "3", "--frames-per-line", "5"]
MOST_CELLS = 60_000
SEEDS_APART = 100
"""Between surveys: equal seeds have equal errors of positions."""
AROUND_M = 60.0
"""True ground about what the mosaic shows: rays lean."""
STANDING_M, BARE_M = 0.25, 2.0
"""Between nodes of the true ground, with and without what stands on it."""
OPEN_M = 0.1
"""Less than that stands on open ground."""


@dataclass(frozen=True)
class RasterCase:
    """A survey, and how it is mosaicked."""

    name: str
    simulate: list[str]
    mosaic: tuple[str, ...] = ()


CASES = [
    RasterCase("hills", [*BLOCK, "--relief-m", "20"]),
    RasterCase("town", [*BLOCK, "--relief-m", "10", "--buildings-stand", "--trees-stand", "--buildings", "2",
                  "--forward-overlap", "0.8", "--side-overlap", "0.6"], ("--surface", "dense")),
    RasterCase("rim", [*SIZE, "--lines", "2", "--frames-per-line", "6", "--relief-m", "25",
                 "--relief-wavelength-m", "200", "--side-overlap", "0.3"], ("--edges", "keep")),
    RasterCase("flat", BLOCK),
    RasterCase("oblique, light, wind", [*BLOCK, "--relief-m", "12", "--trees-stand",
                                  "--wind-in-trees-m", "0.3",
                                  "--vignetting", "0.3", "--auto-exposure", "0.5", "--clouds", "0.2",
                                  "--oblique-frames", "4"]),
]  # fmt: skip


def positions_of(seed: int) -> str:
    """The receiver of a seed's survey."""
    return tuple(POSITIONS)[seed % len(POSITIONS)]


def run(case: RasterCase, out: Path, seed: int) -> tuple[Path, Path]:
    """The survey's folder and its run, made anew."""
    folder = out / f"{case.name.replace(', ', '-')}-{seed}"
    positions = POSITIONS[positions_of(seed)]
    if not (folder / "truth" / "truth.json").exists():
        shutil.rmtree(folder, ignore_errors=True)
        _call("simulate", "frames", folder, *case.simulate, *positions, "--seed", seed)
    given = [
        "--pos",
        folder / "pos.csv",
        "--camera",
        folder / "cameras.json",
        "--gsd",
        GSD_M,
        "--record",
        "off",
    ]
    _call("mosaic", folder / "frames", "-o", folder / "run", *given, *case.mosaic, "--overwrite")
    return folder, folder / "run"


def errors_of(folder: Path, run: Path) -> Errors:
    """True minus mapped places of a run, in the cells of its accuracy.tif."""
    summary = read_summary(run)
    survey = load_artefact(run, summary, "survey", Survey)
    adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    ground = load_artefact(run, summary, "ground", GroundSurface)
    with rasterio.open(run / "accuracy.tif") as tiff, rasterio.open(run / "sources.tif") as sources:
        to_map, crs, pixel_m = tiff.transform, survey.map_crs, sources.transform.a
        by = round(to_map.a / pixel_m) // PLACES_ACROSS
        stated = tiff.read().repeat(PLACES_ACROSS, axis=1).repeat(PLACES_ACROSS, axis=2)
        frame = np.zeros(stated.shape[1:], dtype=np.int64)
        middles = sources.read(1)[by // 2 :: by, by // 2 :: by]
        frame[: middles.shape[0], : middles.shape[1]] = middles
    shape = stated.shape[2], stated.shape[1]
    points = ground_window(
        MapGrid(crs, to_map.c, to_map.f, by * pixel_m, *shape), survey.work_frame, ground
    ).points_m()
    step = int(np.ceil(np.sqrt(frame.size / MOST_CELLS)))
    thin = np.zeros(frame.shape, dtype=bool)
    thin[::step, ::step] = True
    known = thin & (frame > 0) & np.isfinite(stated[0])
    at_m, of = points[known], frame[known] - 1
    truth = json.loads((folder / "truth" / "truth.json").read_text(encoding="utf-8"))
    camera = Camera(**truth["camera"])
    true_ground, bare = (_true_ground(truth, survey, at_m, standing=standing) for standing in (True, False))
    poses, met = _true_poses(folder, survey), np.full(at_m.shape, np.nan)
    for i in np.unique(of).tolist():
        mine = of == i
        image_px = adjusted.poses[i].image_from_ground(adjusted.cameras[i], at_m[mine])
        met[mine] = ground_from_image(poses[survey.frames[i].name], camera, true_ground, image_px)
    seen = np.isfinite(met).all(axis=1)
    up_m = true_ground.up_at(at_m[:, 0], at_m[:, 1]) - at_m[:, 2]
    if not ground.has_walls:
        for places in (at_m, met):
            seen &= np.abs(true_ground.up_at(*places[:, :2].T) - bare.up_at(*places[:, :2].T)) < OPEN_M
    horizontal, vertical, source = (values[known][seen].astype(float) for values in stated)
    plan_m, free = (met - at_m)[seen, :2], freedoms(adjusted.places)
    return Errors(source.astype(int), at_m[seen, :2], plan_m, up_m[seen], horizontal, vertical, free)


def _true_ground(truth: dict[str, Any], survey: Survey, at_m: Floats, *, standing: bool) -> GroundSurface:
    """The relief in the work frame; standing: with the buildings and trees that stand there."""
    plan, relief = SurveyPlan(**truth["plan"]), Relief(**truth["relief"])
    stands = standing and (plan.buildings_stand or plan.trees_stand)
    spacing = STANDING_M if stands else BARE_M
    low, high = at_m[:, :2].min(axis=0) - AROUND_M, at_m[:, :2].max(axis=0) + AROUND_M
    east, north = (np.arange(a, b, spacing) for a, b in zip(low, high, strict=True))
    nodes = np.stack([*np.meshgrid(east, north), np.zeros((len(north), len(east)))], axis=-1)
    places = map_from_work(survey, nodes)
    if stands:
        land = landscape_of(plan)
        west, south = places.reshape(-1, 2).min(axis=0) - 2.0
        far_east, far_north = places.reshape(-1, 2).max(axis=0) + 2.0
        bounds = west - 20.0, south - 20.0, far_east + 20.0, far_north + 20.0
        size = int((far_north - south) / spacing), int((far_east - west) / spacing)
        buildings = land.buildings_in(bounds) if plan.buildings_stand else []
        trees = land.trees_in(bounds) if plan.trees_stand else None
        heights = heights_on_grid(relief, buildings, trees, west, far_north, spacing, size)[0]
        row = ((far_north - places[..., 1]) / spacing).astype(int).clip(0, size[0] - 1)
        col = ((places[..., 0] - west) / spacing).astype(int).clip(0, size[1] - 1)
        height = heights[row, col].astype(float)
    else:
        height = relief.height_at(places[..., 0], places[..., 1])
    level = survey.work_frame.geodetic_from_enu(nodes)[..., 2]
    kind = "dense" if stands else "dem"
    return GroundSurface(kind, float(east[0]), float(north[0]), spacing, height - level)


def _true_poses(folder: Path, survey: Survey) -> dict[str, Pose]:
    """By the frame's name, in the survey's work frame."""
    with (folder / "truth" / "positions.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def columns(*names: str) -> Floats:
        return np.array([[float(row[name]) for name in names] for row in rows])

    at_m = survey.work_frame.enu_from_geodetic(*columns("lon_deg", "lat_deg", "height_ellipsoidal_m").T)
    angles = np.radians(columns("omega_deg", "phi_deg", "kappa_deg"))
    turns = np.swapaxes(grid_from_work(survey, at_m), 1, 2) @ Rotation.from_omega_phi_kappa(*angles.T).matrix
    return {row["frame"]: Pose(at_m[k], Rotation(turns[k])) for k, row in enumerate(rows)}


def _call(*words: object) -> None:
    done = subprocess.run([str(GEOMOSAIC), *map(str, words)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"geomosaic {' '.join(map(str, words))}\n{done.stderr}")


def main() -> int:
    """Runs the surveys and prints their tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/bench-accuracy-raster"))
    parser.add_argument("--only", nargs="+", choices=[case.name for case in CASES])
    parser.add_argument("--seeds", type=int, default=4, help="of each survey")
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--results", type=Path, help="without suffix")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for number, case in enumerate(CASES):
        if asked.only and case.name not in asked.only:
            continue
        first = asked.first_seed + SEEDS_APART * number
        for seed in range(first, first + asked.seeds):
            rows += judged(case.name, positions_of(seed), seed, errors_of(*run(case, asked.out, seed)))
            print(f"{case.name} {seed}: done", file=sys.stderr, flush=True)
    pooled = together(rows)
    print(f"{table(pooled)}\n{table(rows)}")
    if asked.results:
        words = ["--first-seed", str(asked.first_seed), "--seeds", str(asked.seeds)]
        words += ["--only", *asked.only] if asked.only else []
        _write(asked.results, words, rows, pooled)
    wrong = missed(pooled)
    print("\n".join(f"missed: {line}" for line in wrong) or "ok")
    return 1 if wrong else 0


def _write(results: Path, words: list[str], rows: list[Row], pooled: list[Row]) -> None:
    made = {
        "title": "Accuracy raster against the truth",
        "command": shlex.join(["python", "-m", "tools.bench.bench_accuracy_raster", *words]),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}",
        "commit": commit(),
        "seeds": sorted({row["seed"] for row in rows}),
    }
    results.parent.mkdir(parents=True, exist_ok=True)
    whole = {**made, "pooled": pooled, "surveys": rows}
    results.with_suffix(".json").write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    head = (
        f"# {made['title']}\n\n`{made['command']}`, {made['date']}, {made['machine']}, {made['commit']}.\n\n"
    )
    results.with_suffix(".md").write_text(head + f"{table(pooled)}\n{table(rows)}", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
