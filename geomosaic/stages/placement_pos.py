"""Frames onto the map by their position and attitude alone: the coarse mosaic."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from geomosaic.arrays import Floats
from geomosaic.errors import InputError
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.placement.graph import flight_lines, overlapping_pairs
from geomosaic.placement.heights import FrameHeights, frame_heights_m, possible_heights, with_missing_heights
from geomosaic.placement.model import Placement
from geomosaic.placement.prior import ATTITUDES, FORMULAS, prior_poses
from geomosaic.placement.reach import misplacement_m
from geomosaic.projection.footprint import footprint, survey_pixel_m
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.solved_tables import pose_columns
from geomosaic.stages.reporting import record_footprints, record_locations, record_origin
from geomosaic.survey.model import Survey
from geomosaic.survey.names import some


class PlacementParams(StageParams):
    """See each parameter's help."""

    formula: str = param("rigorous", help="how longitude and latitude become metres", choices=FORMULAS)
    attitude: str = param(
        "yaw_pitch_roll",
        help="how the three angles turn a frame; the paper's is phi_omega_kappa",
        choices=ATTITUDES,
    )
    neighbours: int = param(12, help="most neighbours a frame is compared with", ge=1, le=200)


def _plans(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How many pairs may have ground in common."""
    found = summary["metrics"]["placement"]
    return [("pairs", f"{found['candidate_pairs']} to compare, in {found['flight_lines']} flight lines")]


@stage(
    "placement.pos", "Place frames by POS", group="Placement", version=16, outputs="prior_placement",
    plans=_plans,
)  # fmt: skip
def placement_pos(
    levelled_survey: Survey, prior_ground: GroundSurface, params: PlacementParams, context: Context
) -> Placement:
    """Brings the survey's positions and attitudes into the work frame and finds who may overlap whom."""
    survey, ground = levelled_survey, prior_ground
    names = [f.name for f in survey.frames]
    cameras = [survey.camera_of(i) for i in range(len(names))]
    level = FORMULAS[params.formula](
        survey.work_frame,
        np.array([[f.position.lon_deg, f.position.lat_deg, 0.0] for f in survey.frames]),
    )[0]
    below = survey.work_frame.geodetic_from_enu(
        np.column_stack([level[:, :2], ground.up_at(*level[:, :2].T)])
    )
    heights = _heights(context, survey, below[:, 2])
    lines = flight_lines(level)
    poses = prior_poses(survey, heights, lines, params.formula, params.attitude)
    outlines = [footprint(poses[i], cameras[i], ground) for i in range(len(names))]
    for name, outline in zip(names, outlines, strict=True):
        if np.isnan(outline).any():
            context.warn(
                "horizon",
                name,
                "part of the frame shows sky or land beyond the horizon and is not used: nothing to do if it "
                "looked there, else correct its attitude with --pos",
            )
    outlines = [o[np.isfinite(o).all(axis=1)] for o in outlines]
    located = np.array(survey.located)
    outlines = [o if known else o[:0] for o, known in zip(outlines, located, strict=True)]
    reach_m = float(np.median(misplacement_m(poses, cameras, ground)[located])) if located.any() else 0.0
    if located.all():
        _warn_of_control_outside(context, survey, outlines, reach_m)
    placement = Placement(
        poses=poses,
        sequence=tuple(range(len(names))),
        lines=lines,
        pairs=overlapping_pairs(outlines, reach_m, params.neighbours),
        ground_pixel_m=survey_pixel_m(poses, cameras, [True] * len(names), ground),
        formula=params.formula,
    )
    record_origin(context, survey)
    record_locations(context, survey, names, poses, ["placed"] * len(names))
    nowhere = ["" if known else "no position" for known in survey.located]
    context.recorder.table("frames.placed", names, pose_columns(poses), notes=nowhere)
    context.recorder.outlines("placed", names, outlines)
    record_footprints(context, survey.work_frame, "placed", names, outlines)
    context.metric("placement.ground_pixel_m", placement.ground_pixel_m)
    context.metric("placement.flight_lines", max(lines) + 1)
    context.metric("placement.candidate_pairs", len(placement.pairs))
    return placement


def _heights(context: Context, survey: Survey, below_m: Floats) -> FrameHeights:
    """Heights that frames can have had above the ground below_m (n,), which is ellipsoidal too."""
    names = [f.name for f in survey.frames]
    given_m = frame_heights_m(survey, below_m)
    sd_m = np.array([f.position.sd_vertical_m for f in survey.frames])
    heights = with_missing_heights(FrameHeights(given_m, sd_m), below_m)
    filled = [
        f.name
        for f, a, b in zip(survey.frames, given_m, heights.m, strict=True)
        if np.isnan(a) and np.isfinite(b) and f.position.known
    ]
    if filled:
        text = f"no height of their own: taken from the frames before and after ({some(filled)}): "
        text += "nothing to do unless the aircraft climbed there, else give heights with --pos"
        context.warn("height-by-neighbours", filled[0] if len(filled) == 1 else "", text)
    heights, implausible = possible_heights(heights, below_m)
    if implausible.any():
        named = [n for n, wrong in zip(names, implausible, strict=True) if wrong]
        usual_m = float((heights.m - below_m)[implausible][0])
        text = (
            "the given height lies at the ground, below it or far above other frames: taken to fly "
            f"{usual_m:.0f} m above the ground, as others do; the images correct that where they show it "
            f"({some(named)}); leave out frames taken on the ground, correct heights with --pos, or the DEM "
            "with --dem-offset"
        )
        context.warn("height-implausible", named[0] if len(named) == 1 else "", text)
    for name, height, floor in zip(names, heights.m, below_m, strict=True):
        if not height > floor:
            problem = (
                "its height is unknown, and the images do not show it"
                if np.isnan(height)
                else f"lies {floor - height:.1f} m below the ground"
            )
            fix = "leave out frames taken on the ground, give heights with --pos, or correct --dem-offset"
            raise InputError(problem, file=name, fix=fix)
    return heights


def _warn_of_control_outside(
    context: Context, survey: Survey, outlines: Sequence[Floats], reach_m: float
) -> None:
    """Names the marked control points that no frame can have seen, however wrong its position is."""
    control = [p for p in survey.control if p.images]
    if not control:
        return
    seen = shapely.union_all([shapely.Polygon(o[:, :2]).buffer(reach_m) for o in outlines if len(o) >= 3])
    lonlat = np.array([[p.lon_deg, p.lat_deg, p.height_ellipsoidal_m] for p in control])
    at = survey.work_frame.enu_from_geodetic(*lonlat.T)
    outside = [p.name for p, x in zip(control, at, strict=True) if not seen.covers(shapely.Point(x[:2]))]
    if outside:
        text = (
            f"{len(outside)} of {len(control)} control and check points lie outside every frame, although "
            f"marked in images ({some(outside)}): correct their coordinates or the CRS in the --gcp file"
        )
        context.warn("control-outside", "", text)
