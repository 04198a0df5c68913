"""How well the strips lie on one another, seen in the strips themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

from geomosaic.ccd.model import StripOffsets
from geomosaic.export.offsets_csv import read_true_offsets
from geomosaic.pipeline.stage import Context, Stage, StageParams, param
from geomosaic.quality.strip_figures import scene_errors
from geomosaic.quality.strips import StripQuality, misplacement, quality_metrics
from geomosaic.stages.strip_input import opened_strips
from geomosaic.survey.strips import StripGeometry


class QualityStrips(Stage):
    """Measures what misplacement the offsets leave, by line, by segment and for the scene."""

    id = "quality.strips"
    display_name = "Misplacement of the strips"
    group = "Quality"
    version = 1
    inputs: ClassVar[dict[str, type]] = {"strips": StripGeometry, "offsets": StripOffsets}
    outputs: ClassVar[dict[str, type]] = {"strip_quality": StripQuality}

    class Params(StageParams):
        """See each parameter's help."""

        truth: Path | None = param(None, help="true offsets, as simulate strips writes them, to compare with")

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Independent of how the offsets were found."""
        with opened_strips(inputs["strips"]) as strips:
            quality = misplacement(
                strips, inputs["offsets"], lambda done, total: context.progress(done, total, "misplacement")
            )
        context.metric("misplacement", quality_metrics(quality))
        if params.truth is not None:
            true = read_true_offsets(params.truth, inputs["strips"])
            context.metric("errors", asdict(scene_errors(inputs["offsets"], true, inputs["strips"])))
        if quality.misplaced:
            worst = quality.figures.worst_segment_px
            text = f"a segment of 512 lines is off by {worst:.1f} px; the limit is 1 px"
            context.warn("scene-misplaced", "", text)
        return {"strip_quality": quality}
