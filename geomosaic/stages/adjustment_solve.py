"""Tie points in, adjusted poses out, by the method of choice."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geomosaic.adjustment.methods import METHODS
from geomosaic.adjustment.model import Adjusted, Block, Settings
from geomosaic.adjustment.procedure.changed_part import SHIFT, EarlierBlock
from geomosaic.adjustment.procedure.control_points import ground_control
from geomosaic.adjustment.procedure.lens_start import lens_notes
from geomosaic.adjustment.procedure.local_adjustment import adjusted_in_part, kept_poses
from geomosaic.adjustment.procedure.outcome import unplaced_parts
from geomosaic.composition.composed_tiles import MOST_MOVED_PX
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.earlier_run import EarlierRun
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.placement.flights import flights_of
from geomosaic.placement.graph import connected_parts
from geomosaic.placement.model import Placement
from geomosaic.placement.prior import position_assumed
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.control import control_blunders, control_figures, control_warnings, precision_warnings
from geomosaic.report.solved_figures import ground_reason
from geomosaic.stages.reporting import record_adjusted
from geomosaic.survey.height_reference import height_reference
from geomosaic.survey.model import MapPlaces, Survey
from geomosaic.survey.names import some

_OF_SURVEYED = ("control-disagrees", "control-imprecise")
"""Warnings about surveyed points that do not hold for places of a map."""


@dataclass(frozen=True)
class MatchedFrames(InputGroup):
    """A survey's frames where they were reported, the ground below, and the tie points between them."""

    survey: Survey
    prior_ground: GroundSurface
    placement: Placement
    ties: TiePoints


class SolveParams(StageParams):
    """See each parameter's help."""

    method: str = param("bundle", help="adjustment method", choices=METHODS)
    epsilon_px: float = param(
        10.0,
        help="error sharing stops when no misalignment is larger",
        unit="ground px",
        ge=0.01,
        le=1000.0,
    )
    max_rounds: int = param(12, help="most rounds of error sharing", unit="rounds", ge=1, le=1000)
    ground: str = param(
        "auto",
        help="without a DEM, what a bundle makes of its points",
        choices=("auto", "flat", "tie_surface"),
    )
    boresight: bool = param(False, help="a bundle solves for the attitude between platform and camera")
    lever_arm: bool = param(False, help="a bundle solves for where positions are given, from the camera")
    gps_lag: bool = param(False, help="a bundle solves for how late positions are, along the flight")
    model: str = param(
        "auto",
        help="lens and shutter: chosen by cross-validation with left-out tie points, or as given",
        choices=("auto", "given"),
    )
    turning: bool = param(False, help="a bundle solves for how frames turn while their rows are read")
    rolling_shutter: bool = param(False, help="a bundle solves for the time from first to last row")


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How many frames are tied, and how well they agree."""
    frames = ", ".join(f"{count} {name}" for name, count in summary.get("frames", {}).items())
    error_px = summary["metrics"].get("adjustment", {}).get("reprojection_mean_px")
    if error_px is None:
        return [("frames", frames)]
    return [("frames", frames), ("agreement", f"{error_px:.2f} px mean reprojection error")]


@stage(
    "adjustment.solve", "Adjust the frames", group="Adjustment", version=132, outputs=("adjusted", "ground"),
    conclusions=_conclusions, goes_on=True,
)  # fmt: skip
def adjustment_solve(
    matched: MatchedFrames, params: SolveParams, context: Context, map_places: MapPlaces | None = None
) -> tuple[Adjusted, GroundSurface]:
    """Moves the frames so that they agree."""
    survey = matched.survey
    if map_places is not None:
        survey = replace(survey, control=(*survey.control, *map_places.points))
    block = block_of(survey, matched.prior_ground, matched.placement, matched.ties)
    adjusted = _adjusted(block, survey, params, context)
    of_control = (*precision_warnings(block.control, adjusted.figures), *control_warnings(adjusted.control))
    adjusted = replace(adjusted, warnings=(*adjusted.warnings, *of_control))
    _warn_of_loose_frames(context, block, adjusted, params.method == "bundle")
    residual = np.concatenate([np.zeros((0, 2)), *adjusted.residuals_m])
    residual = residual[np.isfinite(residual).all(axis=1)]
    context.metric("adjustment.method", params.method)
    context.metric("adjustment.rounds", len(adjusted.rounds))
    context.metric(
        "adjustment.ground_residual_rms_m",
        float(np.sqrt((residual**2).mean())) if residual.size else None,
    )
    lens_found, lens_warnings = lens_notes(block, adjusted.cameras)
    for note in lens_found:
        context.inform(note)
    if map_places is not None:
        adjusted = _of_map(context, adjusted)
    for warning in (*lens_warnings, *adjusted.warnings):
        context.warn(warning.code, warning.frame, warning.text)
    _report_control(context, adjusted)
    _report_shared(context, adjusted)
    apart_m = 0.0 if adjusted.shared is None else adjusted.shared.flights_apart_m()
    if apart_m:
        text = f"the positions of {1 + max(block.flights)} flights differ by up to {apart_m:.2g} m in plan"
        context.inform(f"{text}; each flight has an offset of its own")
    if adjusted.model is not None:
        context.metric("adjustment.model", asdict(adjusted.model))
    for name, value in adjusted.figures.items():
        context.metric(f"adjustment.{name}", value)
    context.metric("ground.kind", adjusted.ground.kind)
    context.metric("ground.reason", ground_reason(adjusted, params.ground))
    record_adjusted(context, matched.survey, block, adjusted, params.method)
    return adjusted, adjusted.ground


def _adjusted(block: Block, survey: Survey, params: SolveParams, context: Context) -> Adjusted:
    """By the method of choice; a bundle goes on from the run before where all but the changed part would
    stay. A shift, turn or scale of the whole may be as large as what its place is known to. Otherwise it
    begins anew and ends as in a fresh run. Where it begins decides on the model of lens and shutter, on what
    of it counts, and on weights."""
    settings, before = Settings(**params.model_dump(exclude={"method"})), context.earlier
    if before is None:
        return METHODS[params.method](block, settings, context)
    unchanged = before.unchanged({f.name: Path(f.path) for f in survey.frames})
    context.metric("reused.frames", len(unchanged))
    context.metric("reused.frames_of", len(survey.frames))
    if params.method != "bundle":
        return METHODS[params.method](block, settings, context)
    earlier = _earlier_block(block, survey, unchanged, before)
    found = None if earlier is None else adjusted_in_part(block, earlier)
    context.metric("reused.adjustment", found is not None)
    if found is None or earlier is None:
        context.inform("all frames are adjusted anew, as in a first run")
        return METHODS[params.method](block, settings, context)
    kept = int(kept_poses(found, earlier).sum())
    context.metric("reused.poses", kept)
    context.inform(f"{kept:,} of {len(block.names):,} frames stay where they are")
    shift_m = found.figures.get(SHIFT, 0.0)
    if shift_m > earlier.bound_m:
        by, known = f"{shift_m:.2g} m", f"{earlier.datum_sd_m:.2g} m"
        text = f"the map stays in its place, known to {known}; all positions together would move it by {by}"
        context.inform(f"{text}, as a run without --incremental does")
    return found


def _earlier_block(
    block: Block, survey: Survey, unchanged: frozenset[str], before: EarlierRun
) -> EarlierBlock | None:
    """What the run before found; None where its cameras were given otherwise, or in another work frame."""
    was: Survey | None = before.artefact("survey", Survey)
    placed: Placement | None = before.artefact("placement", Placement)
    ties: TiePoints | None = before.artefact("ties", TiePoints)
    adjusted: Adjusted | None = before.artefact("adjusted", Adjusted)
    ground: GroundSurface | None = before.artefact("prior_ground", GroundSurface)
    if was is None or placed is None or ties is None or adjusted is None or adjusted.solved is None:
        return None
    given = {camera.name: camera for camera in survey.cameras}
    if ground is None or was.work_frame != survey.work_frame:
        return None
    if any(given.get(c.name, c) != c for c in was.cameras):
        return None
    names, bound_m = tuple(f.name for f in was.frames), MOST_MOVED_PX * block.ground_pixel_m
    return EarlierBlock(names, placed.poses, ties, adjusted, unchanged, bound_m, ground)


def _of_map(context: Context, adjusted: Adjusted) -> Adjusted:
    """The outcome without places of a reference map that contradict the others: ground that changed."""
    used = [c for c in adjusted.control if not c.check]
    changed = {c.name for c, wrong in zip(used, control_blunders(used), strict=True) if wrong}
    context.metric("reference.contradicting", len(changed))
    sd_m = adjusted.figures.get("control_sd_m.plan")
    if sd_m is not None:
        text = f"places of the reference map agree with the frames to {sd_m:.2g} m per axis"
        context.inform(text + (f"; {len(changed)} contradict the others" if changed else ""))
    warnings = tuple(w for w in adjusted.warnings if w.code not in _OF_SURVEYED)
    control = tuple(c for c in adjusted.control if c.check or c.name not in changed)
    return replace(adjusted, warnings=warnings, control=control)


def block_of(survey: Survey, ground: GroundSurface, placement: Placement, ties: TiePoints) -> Block:
    """What the stages before found, ready to be adjusted."""
    turned = placement.turned or (0,) * len(survey.frames)
    return Block(
        names=tuple(f.name for f in survey.frames),
        cameras=tuple(survey.camera_of(i).turned(2 if q == 2 else 0) for i, q in enumerate(turned)),
        poses=placement.poses,
        ground=ground,
        ties=ties,
        sequence=placement.sequence,
        lines=placement.lines,
        ground_pixel_m=placement.ground_pixel_m,
        turned=placement.turned,
        control=ground_control(survey, ground),
        times_s=np.where([f.velocity_m_per_s is None for f in survey.frames], survey.clock_times_s, np.nan),
        heights=height_reference(survey),
        flights=tuple(flights_of(survey.clock_times_s, [f.name for f in survey.frames]).tolist()),
    )


def _warn_of_loose_frames(context: Context, block: Block, adjusted: Adjusted, by_control: bool) -> None:
    """Names frames and parts of the block without tie points to the rest. by_control: whether the method
    places frames by control points."""
    controlled = {i for c in block.control if not c.check for i, _, _ in c.observations}
    parts = connected_parts(len(block.names), block.ties.frames)
    nowhere = {i for part in unplaced_parts(block) for i in part}
    if nowhere:
        left = [block.names[i] for i in sorted(nowhere)]
        if position_assumed(block.poses).all():
            mapped = sum(status != "rejected" for status in adjusted.status)
            text = (
                f"no tie points with the {mapped} frames that are mapped: left out of the mosaic; mosaic "
                "such frames by themselves, or give positions with --pos"
            )
        else:
            text = (
                "no position, and no tie points with a frame that has one: left out of the mosaic; give "
                "its position with --pos"
            )
        few = f" ({some(left)})" if len(left) > 1 else ""
        context.warn("not-placed", left[0] if len(left) == 1 else "", text + few)
    parts = [part for part in parts if part[0] not in nowhere]
    reasons = dict(block.ties.reasons)
    for frame in (part[0] for part in parts if len(part) == 1 and len(block.names) > 1):
        how = " and by control points" if by_control and frame in controlled else ""
        moved = adjusted.poses.positions_m[frame] - block.poses.positions_m[frame]
        if not how and moved.any():
            sd_m = float(np.linalg.norm(adjusted.poses.positions_sd_m[frame, :2])) / np.sqrt(2.0)
            how = f", corrected by {np.linalg.norm(moved):.1f} m as the frames around it"
            how += f" (standard deviation in plan {sd_m:.1f} m)"
        why = f" ({reasons[frame]})" if frame in reasons else ""
        text = (
            f"no tie points with other frames{why}: placed by its position and attitude{how}: "
            "seams may show there; fly more overlap, or take it out of the folder"
        )
        context.warn("no-tie-points", block.names[frame], text)
    large = [part for part in parts if len(part) > 1]
    for part in large[1:]:
        context.warn(
            "separate-part",
            block.names[part[0]],
            f"{len(part)} frames from here on have tie points with each other but none with the rest; "
            "placed by their own positions: fly more overlap, or give control points with --gcp",
        )


def _report_control(context: Context, adjusted: Adjusted) -> None:
    """Figures of control and of check points apart."""
    for kind, check in (("control", False), ("check", True)):
        points = [c for c in adjusted.control if c.check == check]
        if points:
            context.metric(f"adjustment.{kind}", asdict(control_figures(points)))


def _report_shared(context: Context, adjusted: Adjusted) -> None:
    """What frames share, each with what was given, found, its deviation, and whether it was kept as given."""
    shared = adjusted.shared
    if shared is not None:
        columns = (shared.of, shared.names, shared.given, shared.found, shared.sd, shared.fixed)
        unknowns = [
            {
                "of": of,
                "name": name,
                "given": float(given),
                "found": float(found),
                "sd": float(sd),
                "fixed": bool(fixed),
                "held": bool(fixed),  # the name of earlier versions, for one release
            }
            for of, name, given, found, sd, fixed in zip(*columns, strict=True)
        ]
        context.metric("adjustment.shared", unknowns)
