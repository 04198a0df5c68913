"""Whether the mosaic can be trusted, from all that is known of it without its truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, Literal

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.procedure.residual_pattern import residual_patterns
from geomosaic.composition.model import Mosaic
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.views import PosedFrames
from geomosaic.export.on_map import work_from_map
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.params import StageParams, param
from geomosaic.pipeline.stage import Context
from geomosaic.placement.graph import connected_parts
from geomosaic.quality import statement
from geomosaic.quality.accuracy import Requirement, accuracy_of, usual_requirement
from geomosaic.quality.ground_doubt import Land, land_doubt
from geomosaic.quality.mapped_land import left_out_land
from geomosaic.quality.seam_check import check_seams
from geomosaic.quality.verdict import Verdict, VerdictInputs, verdict_of
from geomosaic.stages.chips import Chips
from geomosaic.stages.input_groups import AdjustedBlock
from geomosaic.survey.model import Survey


class VerdictParams(StageParams):
    """See each parameter's help."""

    accuracy_m: float | Literal["auto"] = param(
        "auto",
        help="required horizontal RMSE against the world; auto: what the positions can give",
        unit="m",
        ge=0.0,
    )
    accuracy_vertical_m: float | Literal["none"] = param(
        "none", help="required vertical RMSE", unit="m", ge=0.0
    )
    accuracy_relative_permille: float | Literal["auto"] = param(
        "auto",
        help="required RMSE of distances in the map; auto: what the positions can give",
        unit="per mille",
        ge=0.0,
    )


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """The grade, why, and what would fix it."""
    verdict = summary.get("verdict")
    if not isinstance(verdict, dict):
        return []
    why = f" {verdict['cause']};" if verdict["cause"] else ""
    fix = [("fix", verdict["fix"])] if verdict["fix"] else []
    answered = [(q.removesuffix(" accuracy"), answer) for q, answer in verdict.get("answers", [])]
    return [("verdict", f"{verdict['grade']}:{why} {verdict['text']}"), *fix, *answered]


def _shortcoming(summary: Mapping[str, Any]) -> str:
    """The verdict, if it is bad."""
    verdict = summary.get("verdict")
    if not isinstance(verdict, dict) or verdict["grade"] != "bad":
        return ""
    (_, text), *others = _conclusions(summary)
    return "; ".join([f"the verdict is {text}", *(fix for what, fix in others if what == "fix")])


@stage(
    "quality.verdict", "Judge the mosaic", group="Quality", version=35, outputs="verdict", wants_frames=True,
    concurrent=True, conclusions=_conclusions, shortcoming=_shortcoming,
)  # fmt: skip
def quality_verdict(
    of: AdjustedBlock, mosaic: Mosaic, ownership: Ownership, params: VerdictParams, context: Context
) -> Verdict:
    """Checks the seams in the pixels, the residuals for patterns, and judges; it changes nothing."""
    survey, adjusted, ties = of.survey, of.adjusted, of.ties
    chips = Chips(context, survey, ties, adjusted)
    used = ownership.used.tolist()
    frames = PosedFrames(survey, adjusted.poses, adjusted.cameras, used, of.ground)
    seams = check_seams(frames, mosaic.grid, mosaic.seamlines, context, chips.look)
    image, pixel_m = adjusted.image_residuals, mosaic.grid.gsd_m
    land = Land(ownership, adjusted.poses, survey.work_frame, of.ground, adjusted.ground)
    required = _required(params, survey, adjusted, pixel_m)
    seen = VerdictInputs(
        seams,
        () if image is None else residual_patterns(image, adjusted.cameras),
        connected_parts(len(survey.frames), ties.frames),
        ownership.shares(),
        land_doubt(land, required.local_m / pixel_m),
        {warning["code"] for warning in context.summary().get("warnings", ())},
        [f.name for f in survey.frames],
        pixel_m,
        left_out_land(replace(frames, used=[s != "rejected" for s in adjusted.status]), ownership),
    )
    known = seams.length_px[np.isfinite(seams.length_px)]
    median_px, most_px = np.quantile(known, [0.5, 0.95]).tolist() if known.size else (None, None)
    placed = any(f.position.known for f in survey.frames) or any(not c.check for c in adjusted.control)
    seam_px = float("nan") if median_px is None else median_px
    accuracy = accuracy_of(adjusted, seam_px, pixel_m, placed=placed)
    verdict = verdict_of(adjusted, seen, accuracy, required)
    chips.record()
    rings = [(s.frame, polygon[0]) for s in mosaic.seamlines for polygon in s.polygons]
    edges = [work_from_map(survey, ring) for _, ring in rings]
    context.recorder.outlines("seams", [survey.frames[frame].name for frame, _ in rings], edges)
    context.report("verdict", reported(verdict, pixel_m))
    context.report("accuracy", statement.reported(accuracy, verdict.required))
    if verdict.grade != "good":
        context.warn(f"verdict-{verdict.grade}", "", f"{verdict.cause}; {verdict.fix}")
    context.metric("seams.median_px", median_px)
    context.metric("seams.percentile_95_px", most_px)
    context.metric("seams.measured", int(known.size))
    context.metric("seams.asked", len(seams.left))
    return verdict


def _required(params: VerdictParams, survey: Survey, adjusted: Adjusted, pixel_m: float) -> Requirement:
    """What the user asks for, else what the inputs can give."""
    stated_m = [max(f.position.deviations_m[:2]) for f in survey.frames if f.position.known]
    usual = usual_requirement(adjusted, np.array(stated_m), pixel_m)
    own = params.accuracy_m, params.accuracy_vertical_m, params.accuracy_relative_permille
    return usual.asked(*(None if isinstance(value, str) else value for value in own))


def reported(verdict: Verdict, pixel_m: float) -> dict[str, Any]:
    """What run.json says of it."""
    return {
        "grade": verdict.grade,
        "text": verdict.text,
        "cause": verdict.cause,
        "fix": verdict.fix,
        "mend": verdict.fix,
        "answers": statement.answers(verdict.accuracy, verdict.required, verdict.seams, pixel_m),
        "evidence": [asdict(e) | {"mend": e.fix} for e in verdict.evidence],
    }
