"""Whether the mosaic can be trusted, from all that is known of it without its truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, ClassVar

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.adjustment.procedure.residual_pattern import residual_patterns
from geomosaic.export.on_map import work_from_map
from geomosaic.matching.model import TiePoints
from geomosaic.mosaic.model import Mosaic
from geomosaic.mosaic.ownership import Ownership
from geomosaic.pipeline.stage import Context, Stage
from geomosaic.placement.graph import connected_parts
from geomosaic.projection.ground import GroundSurface
from geomosaic.quality.ground_doubt import land_doubt
from geomosaic.quality.seam_check import check_seams
from geomosaic.quality.verdict import Verdict, verdict_of
from geomosaic.stages.chips import Chips
from geomosaic.survey.model import Survey


class QualityVerdict(Stage):
    """Checks the seams in the pixels, the residuals for patterns, and judges; it changes nothing."""

    id = "quality.verdict"
    display_name = "Judge the mosaic"
    group = "Quality"
    version = 15
    wants_frames: ClassVar[bool] = True
    beside: ClassVar[bool] = True
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey, "ground": GroundSurface, "ties": TiePoints, "adjusted": Adjusted, "mosaic": Mosaic,
        "ownership": Ownership,
    }  # fmt: skip
    outputs: ClassVar[dict[str, type]] = {"verdict": Verdict}

    @classmethod
    def conclusions(cls, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """The grade, why, and what would mend it."""
        verdict = summary.get("verdict")
        if not isinstance(verdict, dict):
            return []
        why = f" {verdict['cause']};" if verdict["cause"] else ""
        mend = [("mend", verdict["mend"])] if verdict["mend"] else []
        return [("verdict", f"{verdict['grade']}:{why} {verdict['text']}"), *mend]

    @classmethod
    def shortcoming(cls, summary: Mapping[str, Any]) -> str:
        """The verdict, if it is bad."""
        verdict = summary.get("verdict")
        if not isinstance(verdict, dict) or verdict["grade"] != "bad":
            return ""
        (_, text), *mend = cls.conclusions(summary)
        return "; ".join([f"the verdict is {text}", *(mended for _, mended in mend)])

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Judges, and says it in run.json where nobody can miss it."""
        survey: Survey = inputs["survey"]
        adjusted: Adjusted = inputs["adjusted"]
        mosaic: Mosaic = inputs["mosaic"]
        chips = Chips(context, survey, inputs["ties"], adjusted)
        seams = check_seams(
            survey.frames,
            adjusted.poses,
            adjusted.cameras,
            survey.work_frame,
            inputs["ground"],
            mosaic.grid,
            mosaic.seamlines,
            context,
            chips.look,
        )
        image = adjusted.image_residuals
        at = adjusted.poses.positions_m
        verdict = verdict_of(
            adjusted,
            seams,
            () if image is None else residual_patterns(image, adjusted.cameras),
            connected_parts(len(survey.frames), inputs["ties"].frames),
            mosaic.frames_used,
            float(np.median(at[:, 2] - inputs["ground"].up_at(at[:, 0], at[:, 1]))),
            land_doubt(
                inputs["ownership"], adjusted.poses, survey.work_frame, inputs["ground"], adjusted.ground
            ),
        )
        chips.record()
        rings = [(s.frame, polygon[0]) for s in mosaic.seamlines for polygon in s.polygons]
        edges = [work_from_map(survey, ring) for _, ring in rings]
        context.recorder.outlines("seams", [survey.frames[frame].name for frame, _ in rings], edges)
        context.report("verdict", reported(verdict))
        if verdict.grade != "good":
            context.warn(f"verdict-{verdict.grade}", "", f"{verdict.cause}; {verdict.mend}")
        known = seams.length_px[np.isfinite(seams.length_px)]
        median_px, most_px = np.quantile(known, [0.5, 0.95]).tolist() if known.size else (None, None)
        context.metric("seams.median_px", median_px)
        context.metric("seams.percentile_95_px", most_px)
        context.metric("seams.measured", int(known.size))
        context.metric("seams.asked", len(seams.left))
        return {"verdict": verdict}


def reported(verdict: Verdict) -> dict[str, Any]:
    """What run.json says of it."""
    return {
        "grade": verdict.grade,
        "text": verdict.text,
        "cause": verdict.cause,
        "mend": verdict.mend,
        "absolute_sd_m": verdict.absolute_sd_m,
        "evidence": [asdict(e) for e in verdict.evidence],
    }
