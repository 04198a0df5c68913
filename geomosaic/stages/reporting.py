"""What several stages report to the recording and run.json in the same words."""

from __future__ import annotations

import shutil
import stat
from collections.abc import Iterable
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from geomosaic.adjustment.model import Adjusted, Block
from geomosaic.camera.exterior import Poses
from geomosaic.errors import OutputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.mosaic.estimate import Estimate, room
from geomosaic.pipeline.stage import Context, Stage
from geomosaic.placement.prior import position_assumed
from geomosaic.report.solved_figures import ground_reason
from geomosaic.survey.model import Survey

Floats = NDArray[np.float64]


def record_locations(
    context: Context, work_frame: LocalFrame, names: Iterable[str], poses: Poses, status: Iterable[str]
) -> None:
    """Where the frames are believed to be now, those of which anything is known."""
    geodetic = work_frame.geodetic_from_enu(poses.positions_m)
    anywhere = position_assumed(poses)
    for name, at, sd, state, nowhere in zip(
        names, geodetic, poses.positions_sd_m, status, anywhere, strict=True
    ):
        if nowhere:
            continue
        lon, lat, height, sd_e, sd_n, sd_u = (float(v) for v in (*at, *sd))
        context.recorder.location(name, lon, lat, height, sd_e, sd_n, sd_u, state)


def outline_feature(work_frame: LocalFrame, outline_m: Floats, properties: dict[str, Any]) -> dict[str, Any]:
    """A GeoJSON polygon of an outline (k, 3) in the work frame."""
    seen = outline_m[np.isfinite(outline_m).all(axis=1)]
    ring = [[float(lon), float(lat)] for lon, lat, _ in work_frame.geodetic_from_enu(seen)]
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "Polygon", "coordinates": [[*ring, *ring[:1]]]},
    }


def record_adjusted(
    context: Context, survey: Survey, block: Block, adjusted: Adjusted, asked_ground: str = "auto"
) -> None:
    """The rounds of an adjustment, the residuals of every pair, where the frames ended up, on what ground."""
    context.metric("ground.reason", ground_reason(adjusted, asked_ground))
    pairs = [(block.names[t.left], block.names[t.right]) for t in block.ties.pairs]
    for number, round_ in enumerate(adjusted.rounds):
        context.recorder.offsets(
            context.stage_id,
            number,
            [
                (a, b, float(e), float(n))
                for (a, b), (e, n) in zip(pairs, round_.misalignments_m, strict=True)
            ],
            [(name, float(e), float(n)) for name, (e, n) in zip(block.names, round_.moves_m, strict=True)],
        )
    for tie, (left, right), residual in zip(block.ties.pairs, pairs, adjusted.residuals_m, strict=True):
        context.recorder.tie_points(left, right, tie.left_px, tie.right_px, residual)
    if not is_local(survey.map_crs):
        record_locations(context, survey.work_frame, block.names, adjusted.poses, adjusted.status)
    total = len(block.names) + len(survey.left_out)
    count = {s: adjusted.status.count(s) for s in ("tied", "placed", "rejected")}
    if survey.left_out:
        count["left_out"] = len(survey.left_out)
    context.report("frames", {"total": total, **count})
    used = {c.name: c for c in adjusted.cameras}
    context.report("camera", [vars_of(c) for c in used.values()])


def vars_of(camera: Any) -> dict[str, Any]:
    """A camera's numbers under their names."""
    return {k: getattr(camera, k) for k in camera.__dataclass_fields__}


def params_of(context: Context, stage: type[Stage]) -> Any:
    """The parameters that the run's recipe gives another stage, or its own defaults where it isn't in it."""
    steps = context.summary().get("recipe", {}).get("stages", [])
    given: dict[str, Any] = next((step["params"] for step in steps if step["stage"] == stage.id), {})
    return stage.Params.model_validate(given)


def report_estimate(context: Context, estimate: Estimate) -> None:
    """One line and `metrics.estimate`; `OutputError` where the disk hasn't the room for the least of it.

    What an earlier run left there counts as free. Memory and time depend on the workers, which results must
    not: they are reported and not kept.
    """
    left = [p.lstat() for p in context.run_folder.rglob("*")]
    before = sum(s.st_size for s in left if stat.S_ISREG(s.st_mode)) / 1e9
    free_gb = shutil.disk_usage(context.run_folder).free / 1e9
    kept = {k: v for k, v in asdict(estimate).items() if k not in ("memory_gb", "minutes")}
    context.metric("estimate", kept | {"disk_gb": estimate.disk_gb})
    context.inform(estimate.text())
    if estimate.disk_gb[0] > free_gb + before:
        raise OutputError(
            f"no space left on the disk: a mosaic of {estimate.width_px:,} x {estimate.height_px:,} px "
            f"takes {room(estimate.disk_gb)}, {room((free_gb, free_gb))} are free",
            file=context.run_folder,
            mend="free some, choose another output folder or a coarser --gsd",
        )
