"""Planning a survey of 50,000 windows, apart from all pixels: candidate pairs, who owns and who sees what.

    python -m tools.bench.bench_scale_plan [--windows 50000]

Frames are nadir ones of 4000 x 3000 px at their own ground pixel over flat land, with 70 % forward and 50 %
side overlap. There are as many as the mosaic has room for (some 7,000), at their true poses; pairs are of
frames that may be 5 m off. Prints JSON: frames, pairs, windows, steps with more than one frame, seconds of
processor of each part, peak memory.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from typing import Any

import numpy as np

from geomosaic.camera.exterior import Poses
from geomosaic.camera.interior import Camera
from geomosaic.camera.rotation import Rotation
from geomosaic.composition.blends import BLENDS
from geomosaic.composition.frame_source import FrameSource
from geomosaic.composition.grid import output_grid
from geomosaic.composition.model import MapPixels
from geomosaic.composition.ownership import cell_px_of, nearest_nadir
from geomosaic.composition.plan import Asking, Planning, windows
from geomosaic.composition.scene import Scene
from geomosaic.composition.tiles import TILE_PX
from geomosaic.composition.views import PosedFrames, frame_views
from geomosaic.composition.visibility import cells_in_view
from geomosaic.geodesy.local import LocalFrame
from geomosaic.placement.graph import overlapping_pairs
from geomosaic.projection.footprint import footprint
from geomosaic.projection.ground import GroundSurface
from geomosaic.survey.model import Survey
from tools.bench.result_rows import RowKind, add_options, write_rows
from tools.docs.results_page import FAST

GSD_M, HEIGHT_M, CRS = 0.025, 100.0, "EPSG:32632"
WIDE_PX, HIGH_PX = 4000, 3000
STEP_M = 0.5 * WIDE_PX * GSD_M, 0.3 * HIGH_PX * GSD_M
REACH_PX = 32.0
MISPLACED_M, NEIGHBOURS = 5.0, 12
ROWS = {
    "planned": RowKind(
        FAST,
        "{windows:,} windows over {frames:,} frames planned, with {pairs:,} candidate pairs",
        "",
        "{took_s:.0f} s of the processors, {peak_gb:.2f} GB",
        measured=("pairs",),
    ),
}


def scene_of(number_of_windows: int) -> tuple[Scene, tuple[bool, ...]]:
    """A square block whose mosaic has about so many windows, and which of its frames are in use: all."""
    side_m = number_of_windows**0.5 * TILE_PX * GSD_M
    across, along = (
        max(int((side_m - px * GSD_M) / step) + 1, 1)
        for px, step in zip((WIDE_PX, HIGH_PX), STEP_M, strict=True)
    )
    east, north = np.meshgrid(np.arange(across) * STEP_M[0], np.arange(along) * STEP_M[1])
    n = east.size
    centred = [a.ravel() - a.mean() for a in (east, north)]
    poses = Poses(
        np.column_stack([*centred, np.full(n, HEIGHT_M)]),
        np.broadcast_to(Rotation.from_yaw_pitch_roll(0.0, 0.0, 0.0).matrix, (n, 3, 3)),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
    )
    camera = Camera("plain", WIDE_PX, HIGH_PX, HEIGHT_M / GSD_M, WIDE_PX / 2.0, HIGH_PX / 2.0)
    work_frame = LocalFrame(9.0, 48.0, 500.0)
    ground = GroundSurface("flat", 0.0, 0.0, 1.0, np.zeros((1, 1)))
    used = (True,) * n
    survey = Survey((), (camera,), work_frame, CRS)
    views = frame_views(PosedFrames(survey, poses, [camera] * n, used, ground), CRS)
    names = [f"{i:05d}.jpg" for i in range(n)]
    grid = output_grid(MapPixels(CRS, GSD_M), views, names)
    return Scene(work_frame, ground, grid, views), used


def planned(number_of_windows: int) -> dict[str, Any]:
    """Seconds of processor of each part, and what came out."""
    clock = {}

    def took(name: str, since: float) -> float:
        now = time.process_time()
        clock[name] = round(now - since, 3)
        return now

    at = time.process_time()
    scene, used = scene_of(number_of_windows)
    at = took("frames on the map", at)
    outlines = [footprint(view.pose, view.camera, scene.ground) for view in scene.views]
    pairs = overlapping_pairs(outlines, MISPLACED_M, NEIGHBOURS)
    at = took("candidate pairs", at)
    ownership, _ = nearest_nadir(scene, used, cell_px_of(scene))
    at = took("who owns what", at)
    halo_px = BLENDS["multi_band"].halo_px(REACH_PX)
    seen = {v.frame: cells_in_view(scene, v, halo_px) for v in scene.views}
    at = took("who sees what", at)
    order = windows(scene.grid, TILE_PX)
    at = took("order of windows", at)
    sources = {v.frame: FrameSource(scene.grid, ownership, v) for v in scene.views}
    planning = Planning(ownership, sources, seen, halo_px, REACH_PX)
    steps, asking = [], Asking(seen)
    for of_window in planning.steps(order):
        asking.add(of_window)
        steps.append(of_window.step)
    took("steps and cells asked of frames", at)
    return {
        "frames": len(scene.views),
        "pairs": len(pairs),
        "windows": len(order),
        "steps_of_several": sum(len(step.parts) > 1 for step in steps),
        "seconds": clock,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def main() -> None:
    """Prints what planning took."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--windows", type=int, default=50_000)
    add_options(ask)
    asked = ask.parse_args()
    found = planned(asked.windows)
    print(json.dumps(found))
    took_s, peak_gb = sum(found["seconds"].values()), found["peak_mb"] / 1e3
    write_rows(asked, [ROWS["planned"].row(None, took_s=took_s, peak_gb=peak_gb, **found)])


if __name__ == "__main__":
    main()
