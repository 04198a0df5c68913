"""Four aerial frames over 600 m of relief: do their orthos agree, by the given poses and by spoilt ones?"""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.compose import compose
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels
from geomosaic.composition.ownership import by_nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.errors import InputError
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.compare import compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.survey.model import Survey
from tools.bench.bench_real_rows import ROWS
from tools.bench.bench_real_table import Row
from tools.bench.bench_surface_rows import ROWS as SURFACE_ROWS
from tools.bench.result_rows import ResultRow, listed

Floats = NDArray[np.float64]
GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
FRAME_PIXEL_M = 5.63
"""What a pixel of a frame covers in the mean; the orthos have it too: their pixels are frame pixels."""
WANTED_PX = 0.5
WANTED_NMAD_PX = 1.2
"""Of heights, as on the ground of simulated towns."""
MOVED_M, TURNED_DEG = 20.0, 0.5
DRAWS = 3
_LEAST_PATCHES = 20


@dataclass(frozen=True)
class Agreement:
    """How far the orthos of two overlapping frames lie apart, in pixels; nothing is removed.

    rmse_px over all patches measured, median_px of their lengths, mean_px (2,) east and north.
    """

    pair: tuple[int, int]
    patches: int
    rmse_px: float
    median_px: float
    mean_px: Floats


def ngi(data: Path, out: Path, results: list[ResultRow]) -> list[Row]:
    """The rows of the table: orthos by the given poses, and by spoilt and adjusted ones; adds to results."""
    folder = data / "ngi"
    given = agreements(mosaic(folder, folder / "ngi_xyz_opk.csv", out / "ngi", "none"), out / "ngi-orthos")
    rows = [_row("ngi, orthos by the given poses", given)]
    adjusted_px: list[float] = []
    for seed in range(1, DRAWS + 1):
        pos = spoilt_poses(folder / "ngi_xyz_opk.csv", out / f"ngi-spoilt-{seed}.csv", seed)
        for method in ("none", "bundle"):
            name = f"ngi-spoilt-{seed}-{method}"
            found = agreements(mosaic(folder, pos, out / name, method), out / f"{name}-orthos")
            what = f"ngi, poses spoilt by {MOVED_M:g} m and {TURNED_DEG:g} deg (seed {seed})"
            if method == "none":
                rows.append(_row(f"{what}, as they are", found, wanted=False))
            else:
                rows.append(_row(f"{what}, adjusted", found))
                adjusted_px.append(rmse_px(found))
    given_px, fields = rmse_px(given), {"wanted_px": WANTED_PX, "moved_m": MOVED_M, "turned_deg": TURNED_DEG}
    met = max(given_px, *adjusted_px) < WANTED_PX
    results.append(ROWS["ngi"].row(met, given=given_px, adjusted=listed(adjusted_px, ".2f"), **fields))
    return rows


def ngi_surface(data: Path, out: Path, results: list[ResultRow]) -> list[Row]:
    """The dense surface by the given poses against the DEM; none without the data; adds to results."""
    folder = data / "ngi"
    if not folder.is_dir():
        print(f"skipped: {folder} is missing")
        return []
    dem = folder / "dem.tif"
    more = ["--surface", "dense", "--ortho", "surface", "--surface-reference", dem]
    more += ["--set", "quality.surface.offset_m=0"]
    run = mosaic(folder, folder / "ngi_xyz_opk.csv", out / "ngi-surface", "none", *more)
    run_summary = read_summary(run)
    matched = run_summary["metrics"]["quality"]["surface"]["by_support"]["matched"]
    with rasterio.open(run / "surface_confidence.tif") as raster:
        sd_m, views = raster.read(masked=True)
    with rasterio.open(run / "surface_difference.tif") as raster:
        off_m = np.abs(raster.read(1, masked=True))
    there = (views.filled(0) > 0) & ~np.ma.getmaskarray(off_m)
    within = [100.0 * float(np.mean((off_m < k * sd_m)[there])) for k in (1.0, 2.0)]
    nmad_px = matched["nmad_m"] / FRAME_PIXEL_M
    text = (
        f"NMAD {nmad_px:.2f} frame px ({matched['nmad_m']:.1f} m), median {matched['median_m']:+.2f} m at "
        f"{matched['n']:,} matched points; within 1 and 2 deviations {within[0]:.0f} and {within[1]:.0f} %; "
        f"verdict {run_summary['verdict']['grade']}: {run_summary['verdict']['text']}"
    )
    met = nmad_px < WANTED_NMAD_PX
    results.append(SURFACE_ROWS["ngi"].row(met, nmad_px=nmad_px, wanted_px=WANTED_NMAD_PX))
    return [
        ("ngi, dense surface against the DEM", text, f"NMAD < {WANTED_NMAD_PX} px", nmad_px < WANTED_NMAD_PX)
    ]


def mosaic(folder: Path, pos: Path, run: Path, method: str, *more: object) -> Path:
    """The run folder of `geomosaic mosaic` on the frames with these poses and the DEM."""
    shutil.rmtree(run, ignore_errors=True)
    command = [
        GEOMOSAIC, "mosaic", folder, "-o", run, "--pos", pos, "--camera", folder / "ngi_int_param.yaml",
        "--dem", folder / "dem.tif", "--dem-offset", "0", "--adjust", method, "--gsd", str(FRAME_PIXEL_M),
        "--pos-crs", (folder / "ngi_xyz_opk.prj").read_text().strip(), *map(str, more),
    ]  # fmt: skip
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return run


def spoilt_poses(given: Path, path: Path, seed: int) -> Path:
    """The POS file with 20 m and 0.5 degrees of normal noise on every axis, and with these deviations."""
    rng = np.random.default_rng(seed)
    with given.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        for names, sd, digits in (("x y z", MOVED_M, 3), ("omega phi kappa", TURNED_DEG, 4)):
            for name in names.split():
                row[name] = f"{float(row[name]) + rng.normal(0.0, sd):.{digits}f}"
        row |= {"sd_horizontal": f"{MOVED_M}", "sd_vertical": f"{MOVED_M}"}
        row |= {"sd_yaw": f"{TURNED_DEG}", "sd_tilt": f"{TURNED_DEG}"}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return path


def agreements(run: Path, orthos: Path) -> list[Agreement]:
    """Single-frame orthos on the run's ground, compared pair by pair by least-squares matching."""
    summary = read_summary(run)
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    adjusted: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    ground: GroundSurface = load_artefact(run, summary, "ground", GroundSurface)
    shutil.rmtree(orthos, ignore_errors=True)
    orthos.mkdir(parents=True)
    names = [f.name for f in survey.frames]
    files = []
    for i, name in enumerate(names):
        alone = [k == i for k in range(len(names))]
        frames = PosedFrames(survey, adjusted.poses, adjusted.cameras, alone, ground)
        views = frame_views(frames, survey.map_crs)
        grid = output_grid(MapPixels(survey.map_crs, FRAME_PIXEL_M), views, names)
        files.append(orthos / f"{Path(name).stem}.tif")
        compose(frames, by_nearest_nadir(frames, grid), MosaicFiles(files[-1]))
    out = []
    for a, b in combinations(range(len(names)), 2):
        try:
            found = compare(files[a], files[b], ComparisonOptions(patch_px=32, step_px=16, search_px=64))
        except InputError:
            continue
        if found.figures.measured < _LEAST_PATCHES:
            continue
        apart_px = found.vectors_m[:, 2:] / FRAME_PIXEL_M
        length = np.linalg.norm(apart_px, axis=1)
        out.append(
            Agreement(
                (a, b),
                len(length),
                float(np.sqrt(np.mean(length**2))),
                float(np.median(length)),
                apart_px.mean(axis=0),
            )
        )
    (orthos / "agreements.json").write_text(
        json.dumps([replace(a, mean_px=a.mean_px.tolist()).__dict__ for a in out], indent=1)
    )
    return out


def rmse_px(found: list[Agreement]) -> float:
    """Over the patches of all pairs; infinite without a pair."""
    if not found:
        return float("inf")
    patches = np.array([a.patches for a in found])
    return float(np.sqrt((patches * np.array([a.rmse_px for a in found]) ** 2).sum() / patches.sum()))


def _row(what: str, found: list[Agreement], *, wanted: bool = True) -> Row:
    """RMSE over the patches of all pairs against the bound, and that of every pair."""
    if not found:
        return (what, "no pair could be compared", f"< {WANTED_PX} px" if wanted else "", not wanted)
    patches, all_px = sum(a.patches for a in found), rmse_px(found)
    pairs = ", ".join(f"{a.pair[0]}-{a.pair[1]}: {a.rmse_px:.2f}" for a in found)
    return (
        what,
        f"RMSE {all_px:.2f} frame px at {patches} patches ({pairs})",
        f"< {WANTED_PX} px" if wanted else "",
        not wanted or all_px < WANTED_PX,
    )
