"""The split-half test: mosaics from every second frame of one flight, compared to each other.

Frames 1, 3, 5 ... and 2, 4, 6 ... along each line: 65 % forward overlap leaves 30 % in a half, 63 % across.
Each half is a survey of its own (own matching, own adjustment, own ground). What is left of the
displacements after the best similarity, on bare ground alone, is what two users with half the images
would quarrel about. The same with one adjustment of all frames shows what part of it is the composition's.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.compose import compose
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels
from geomosaic.composition.occlusion import occluded_parts, occlusion_depth, side_px_of, with_occlusion
from geomosaic.composition.ownership import cell_px_of, nearest_nadir
from geomosaic.composition.raster import MosaicFiles
from geomosaic.composition.scene import Scene
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.pipeline.run_results import load_artefact, read_summary
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.compare import Comparison, compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.figures import best_similarity
from geomosaic.survey.model import Survey
from tools.bench.bench_real_cloud import bare_ground, read_cloud
from tools.bench.bench_real_table import Row

Floats = NDArray[np.float64]
GEOMOSAIC = Path(sys.executable).with_name("geomosaic")
GSD_M, CRS = 0.0171, "EPSG:32615"
_REACH_M = 1.0


@dataclass(frozen=True)
class Wanted:
    """At most what halves may differ by on bare ground, px."""

    rmse_px: float = np.inf
    median_px: float = np.inf
    p90_px: float = np.inf

    def __str__(self) -> str:
        each = (("RMSE", self.rmse_px), ("median", self.median_px), ("90 %", self.p90_px))
        return ", ".join(f"{name} < {limit:g} px" for name, limit in each if np.isfinite(limit))


SMOOTH = Wanted(rmse_px=1.0)


@dataclass(frozen=True)
class Halves:
    """Rows of the table, and the figures (px) of halves with their own adjustments and with one."""

    rows: list[Row]
    own: dict[str, float]
    one: dict[str, float]


def halves(
    data: Path, out: Path, full: Path, *options: str, own: Wanted = SMOOTH, one: Wanted = SMOOTH
) -> Halves:
    """Both halves; full: the run folder of the whole flight; options: of each half's command; own, one: what
    is wanted of halves with their own adjustments and with one."""
    folder = data / "brighton_beach"
    frames = sorted((folder / "images").glob("*.JPG"))
    cloud = read_cloud(folder / "model.laz")
    if cloud is None:
        print("no mask of trees and roofs: laspy and lazrs are missing ('pip install laspy lazrs')")
    mosaics = [
        _half(frames[k::2], out / f"brighton-{name}", options) for k, name in enumerate(("odd", "even"))
    ]
    found = compare(*mosaics, ComparisonOptions(search_px=160))
    row, figures = _row("split-half: own adjustments", found, cloud, out / "halves.json", own)
    row_of_one, figures_of_one = halves_of_one(full, out, cloud, one)
    return Halves([row, row_of_one], figures, figures_of_one)


def halves_of_one(
    full: Path, out: Path, cloud: Floats | None, wanted: Wanted
) -> tuple[Row, dict[str, float]]:
    """Row and figures of both halves' mosaics on the poses, lenses and ground of a run of all frames."""
    alike = [_composed(full, k, out / f"brighton-one-{name}.tif") for k, name in enumerate(("odd", "even"))]
    what = "split-half: one adjustment of all frames, composed from each half"
    return _row(what, compare(*alike), cloud, None, wanted)


def _half(frames: list[Path], run: Path, options: Sequence[str]) -> Path:
    """The mosaic that the command line makes of these frames alone."""
    shutil.rmtree(run, ignore_errors=True)
    folder = run.with_name(f"{run.name}-frames")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for frame in frames:
        (folder / frame.name).symlink_to(frame.resolve())
    command = [GEOMOSAIC, "mosaic", folder, "-o", run, "--gsd", str(GSD_M), "--crs", CRS, *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return run / "mosaic.tif"


def _composed(run: Path, first: int, path: Path) -> Path:
    """A mosaic of every second frame by the poses, lenses and ground of the whole run."""
    summary = read_summary(run)
    survey: Survey = load_artefact(run, summary, "survey", Survey)
    adjusted: Adjusted = load_artefact(run, summary, "adjusted", Adjusted)
    ground: GroundSurface = load_artefact(run, summary, "ground", GroundSurface)
    used = [i % 2 == first for i in range(len(survey.frames))]
    frames = PosedFrames(survey, adjusted.poses, adjusted.cameras, used, ground)
    views = frame_views(frames, CRS)
    grid = output_grid(MapPixels(CRS, GSD_M), views, [f.name for f in survey.frames])
    path.unlink(missing_ok=True)
    scene = Scene(survey.work_frame, ground, grid, views)
    if ground.has_walls:
        side_px = side_px_of(scene)
        hidden, _ = occluded_parts(grid, side_px, [occlusion_depth(scene, side_px, view) for view in views])
        scene = replace(scene, views=with_occlusion(views, hidden))
    ownership, _ = nearest_nadir(scene, used, cell_px_of(scene))
    if ground.has_walls:
        ownership = replace(ownership, hidden=hidden)
    compose(frames, ownership, MosaicFiles(path))
    return path


def _row(
    what: str, found: Comparison, cloud: Floats | None, file: Path | None, wanted: Wanted
) -> tuple[Row, dict[str, float]]:
    at, apart = found.vectors_m[:, :2], found.vectors_m[:, 2:]
    where = "all that matched"
    if cloud is not None:
        bare = bare_ground(cloud, at, _REACH_M)
        at, apart, where = at[bare], apart[bare], "bare ground"
    similarity, left_m = best_similarity(at, apart)
    length_px = np.linalg.norm(left_m, axis=1) / found.gsd_m
    figures = {
        "patches": len(length_px),
        "rmse_px": float(np.sqrt(np.mean(length_px**2))),
        "median_px": float(np.median(length_px)),
        "p90_px": float(np.quantile(length_px, 0.9)),
        "below_1_px": float(np.mean(length_px < 1.0)),
        "scale": similarity.scale,
        "rotation_deg": float(np.degrees(similarity.rotation_rad)),
    }
    if file is not None:
        file.write_text(json.dumps(figures, indent=1))
    row: Row = (
        f"{what} ({where}, {len(length_px)} patches of {found.patch_px} px)",
        f"RMSE {figures['rmse_px']:.2f} px, median {figures['median_px']:.2f}, 90 % {figures['p90_px']:.2f}; "
        f"scale {100.0 * (similarity.scale - 1.0):+.2f} %",
        str(wanted),
        all(figures[name] < limit for name, limit in asdict(wanted).items()),
    )
    return row, figures
