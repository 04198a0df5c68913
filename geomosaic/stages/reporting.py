"""What several stages report to the recording and run.json in the same words."""

from __future__ import annotations

import shutil
import stat
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from geomosaic.adjustment.model import Adjusted, Block
from geomosaic.adjustment.paper.misalignment import offset_net
from geomosaic.arrays import Floats
from geomosaic.camera.exterior import Poses
from geomosaic.composition.estimate import SizeEstimate, room
from geomosaic.composition.model import Trimmed
from geomosaic.errors import OutputError
from geomosaic.geodesy.local import LocalFrame
from geomosaic.geodesy.mapcrs import is_local
from geomosaic.pipeline.stage import Context, Stage
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.footprint import footprint
from geomosaic.quality.bare_ground import bare_outlines
from geomosaic.quality.solved_tables import (
    move_columns,
    pair_columns,
    pose_columns,
    sampled_ties,
    tie_weights,
)
from geomosaic.survey.model import Survey

_CORNERS = 3  # the fewest of an area


def record_locations(
    context: Context, survey: Survey, names: Iterable[str], poses: Poses, status: Iterable[str]
) -> None:
    """Positions of the frames on the map, but of those of which nothing is known."""
    geodetic = survey.work_frame.geodetic_from_enu(poses.positions_m)
    anywhere, captured_s = position_assumed(poses), capture_times_s(survey)
    for name, at, sd, state, nowhere in zip(
        names, geodetic, poses.positions_sd_m, status, anywhere, strict=True
    ):
        if nowhere:
            continue
        context.recorder.location(name, tuple(at.tolist()), tuple(sd.tolist()), state, captured_s.get(name))


def record_origin(context: Context, survey: Survey) -> None:
    """Where the origin of the work frame lies, which poses and points are reckoned from."""
    origin, nan = survey.work_frame, float("nan")
    at = origin.lon_deg, origin.lat_deg, origin.height_ellipsoidal_m
    context.recorder.location("map", at, (nan, nan, nan), "origin", first_capture_s(survey))


def capture_times_s(survey: Survey) -> dict[str, float]:
    """When frames were exposed, by name, seconds since 1970; of those whose tags say so."""
    return {f.name: f.time_s for f in survey.frames if f.time_s is not None}


def first_capture_s(survey: Survey) -> float | None:
    """When the first frame was exposed: what holds for the whole block is shown from then on."""
    return min(capture_times_s(survey).values(), default=None)


def outline_feature(work_frame: LocalFrame, outline_m: Floats, properties: dict[str, Any]) -> dict[str, Any]:
    """A GeoJSON polygon of an outline (k, 3) in the work frame."""
    seen = outline_m[np.isfinite(outline_m).all(axis=1)]
    ring = [[float(lon), float(lat)] for lon, lat, _ in work_frame.geodetic_from_enu(seen)]
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "Polygon", "coordinates": [[*ring, *ring[:1]]]},
    }


def record_steps(context: Context, adjusted: Adjusted, method: str) -> None:
    """Each step of a solve; of methods that slide frames, each round and what it found."""
    for step in adjusted.steps:
        figures = asdict(step)
        solve, cost = figures.pop("solve"), figures.pop("cost")
        context.recorder.iteration(context.stage_id, solve, cost, figures=figures)
    for round_ in () if adjusted.steps else adjusted.rounds:
        off = round_.misalignments_m[np.isfinite(round_.misalignments_m).all(axis=1)]
        context.recorder.iteration(
            context.stage_id,
            method,
            float(np.sqrt((off**2).sum(axis=1).mean())) if len(off) else float("nan"),
            "m",
            {"step_m": float(np.nanmax(np.hypot(*round_.moves_m.T), initial=0.0))},
        )


def record_footprints(
    context: Context, work_frame: LocalFrame, what: str, names: Sequence[str], outlines_m: Sequence[Floats]
) -> None:
    """Footprints, given in the work frame, on the map."""
    shown = [
        (n, o) for n, o in zip(names, outlines_m, strict=True) if np.isfinite(o).all(axis=1).sum() >= _CORNERS
    ]
    features = [outline_feature(work_frame, o, {"frame": n}) for n, o in shown]
    context.recorder.geojson(f"/footprints/{what}", features)


def _record_tables(context: Context, survey: Survey, block: Block, adjusted: Adjusted) -> None:
    """Frames and pairs in figures, and where frames lie now."""
    ties, names = block.ties, block.names
    lefts, rights = ([names[pair[side]] for pair in ties.frames] for side in (0, 1))
    weights = tie_weights(ties, adjusted.image_residuals)
    context.recorder.table("pairs.adjusted", lefts, pair_columns(ties, adjusted.residuals_m, weights), rights)
    for tie, left, right, residual, weight in zip(
        ties.pairs, lefts, rights, adjusted.residuals_m, weights, strict=True
    ):
        context.recorder.tie_points((left, right), tie.left_px, tie.right_px, residual, weight)
    left_of, right_of, at_m, of_ties = sampled_ties(ties, adjusted)
    lengths = {"residual_m": of_ties["residual_m"]}
    context.recorder.points("ties", at_m, lengths, first_capture_s(survey))
    captured_s = capture_times_s(survey)
    flown = [i for i, status in enumerate(adjusted.status) if status != "rejected"]
    flown.sort(key=lambda i: captured_s.get(names[i], 0.0))
    context.recorder.flown_path(adjusted.poses.positions_m[flown], first_capture_s(survey))
    for i, name in enumerate(names):
        if adjusted.status[i] != "rejected":
            at, rotation = adjusted.poses.positions_m[i], adjusted.poses.rotations[i]
            context.recorder.pose(name, adjusted.cameras[i], at, rotation, captured_s.get(name))
    context.recorder.table("ties.ground", [names[i] for i in left_of], of_ties, [names[i] for i in right_of])
    columns = pose_columns(adjusted.poses) | move_columns(block.poses, adjusted, ties)
    context.recorder.table("frames.adjusted", names, columns, notes=adjusted.status)
    shown = [i for i, status in enumerate(adjusted.status) if status != "rejected"]
    outlines = [footprint(adjusted.poses[i], adjusted.cameras[i], adjusted.ground, 4) for i in shown]
    shown_names = [names[i] for i in shown]
    context.recorder.outlines("adjusted", shown_names, outlines)
    if not is_local(survey.map_crs):
        record_footprints(context, survey.work_frame, "adjusted", shown_names, outlines)
    bare = bare_outlines(adjusted, ties) if context.recorder.wants("outlines") else []
    if bare:
        context.recorder.outlines("bare", [f"{k + 1}" for k in range(len(bare))], bare)


def record_adjusted(
    context: Context, survey: Survey, block: Block, adjusted: Adjusted, method: str = "bundle"
) -> None:
    """The rounds of an adjustment, the residuals of every pair, where the frames ended up."""
    ends: Sequence[tuple[int, int]] = block.ties.frames
    if any(len(round_.misalignments_m) != len(ends) for round_ in adjusted.rounds):
        ends = offset_net(block).edges  # pairs that see no ground together have no misalignment
    pairs = [(block.names[left], block.names[right]) for left, right in ends]
    for number, round_ in enumerate(adjusted.rounds):
        missed = round_.misalignments_m
        context.recorder.offsets(
            context.stage_id,
            number,
            [
                (a, b, float(e), float(n))
                for (a, b), (e, n) in zip(pairs if len(missed) else (), missed, strict=True)
            ],
            [(name, float(e), float(n)) for name, (e, n) in zip(block.names, round_.moves_m, strict=True)],
        )
    record_steps(context, adjusted, method)
    _record_tables(context, survey, block, adjusted)
    if not is_local(survey.map_crs):
        record_locations(context, survey, block.names, adjusted.poses, adjusted.status)
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


def run_name(context: Context) -> str:
    """The run folder's name; empty with `fixed_time`, since equal runs then make equal pages."""
    return "" if context.fixed_time else context.run_folder.absolute().name


def in_recipe(context: Context, stage: type[Stage]) -> bool:
    """Whether the run's recipe has another stage."""
    return any(step["stage"] == stage.id for step in context.summary().get("recipe", {}).get("stages", []))


def params_of(context: Context, stage: type[Stage]) -> Any:
    """The parameters that the run's recipe gives another stage, or its own defaults where it isn't in it."""
    steps = context.summary().get("recipe", {}).get("stages", [])
    given: dict[str, Any] = next((step["params"] for step in steps if step["stage"] == stage.id), {})
    return stage.Params.model_validate(given)


def report_estimate(context: Context, estimate: SizeEstimate) -> None:
    """One line and `metrics.estimate`; `OutputError` where the disk hasn't the room for the least of it.

    What an earlier run left there counts as free. Memory and time depend on the workers, which equal bytes
    must not: with `fixed_time` they aren't kept.
    """
    left = {(s.st_dev, s.st_ino): s for s in (p.lstat() for p in context.run_folder.rglob("*"))}
    before = sum(s.st_size for s in left.values() if stat.S_ISREG(s.st_mode)) / 1e9
    free_gb = shutil.disk_usage(context.run_folder).free / 1e9
    left_out = ("memory_gb", "minutes") if context.fixed_time else ()
    kept = {k: v for k, v in asdict(estimate).items() if k not in left_out}
    context.metric("estimate", kept | {"disk_gb": estimate.disk_gb})
    context.inform(estimate.text())
    if estimate.disk_gb[0] > free_gb + before:
        raise OutputError(
            f"no space left on the disk: a mosaic of {estimate.width_px:,} x {estimate.height_px:,} px "
            f"takes {room(estimate.disk_gb)}, but {room((free_gb, free_gb))} are free",
            file=context.run_folder,
            fix="free some, choose another folder with -o, or a coarser --gsd",
        )


def reported_trimmed(trimmed: Trimmed, map_crs: str) -> dict[str, Any]:
    """What run.json says of it; areas are square metres where the map has a scale."""
    scaled = not is_local(map_crs)
    parts = {part.reason: part.area_m2 for part in trimmed.parts}
    return {
        "seen_m2": trimmed.seen_m2,
        "area_m2": trimmed.area_m2,
        "share": trimmed.share,
        "parts": parts,
        "scaled": scaled,
    }


def trimmed_text(reported: Mapping[str, Any]) -> str:
    """The same in words: in hectares, or as shares of the land seen where the map has no scale."""
    seen_m2, scaled = reported["seen_m2"], reported.get("scaled", True)

    def area(area_m2: float) -> str:
        if not scaled:
            return f"{area_m2 / seen_m2:.1%}"
        if area_m2 < 1e3:
            return f"{area_m2:,.0f} m²"
        return f"{area_m2 / 1e4:,.{0 if area_m2 >= 1e5 else 2}f} ha"

    each = ", ".join(f"{area(area_m2)} {why}" for why, area_m2 in reported["parts"].items())
    mapped = f"{area(seen_m2 - reported['area_m2'])} {'are' if scaled else 'of the land seen is'} mapped"
    return f"{mapped}; trimmed: {each}; --edges keep keeps it"
