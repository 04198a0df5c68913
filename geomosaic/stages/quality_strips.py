"""How well the strips lie on one another, seen in the strips themselves."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from geomosaic.ccd.model import StripOffsets
from geomosaic.export.offsets_csv import read_true_offsets
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.quality.jitter import jitter_spectrum, peaks_by_bin, residual_spectrum
from geomosaic.quality.strip_figures import scene_errors
from geomosaic.quality.strips import StripQuality, misplacement, quality_metrics
from geomosaic.stages.strip_input import better_offsets, opened_strips
from geomosaic.survey.strips import StripGeometry


class StripsParams(StageParams):
    """See each parameter's help."""

    truth: Path | None = param(None, help="true offsets, as simulate strips writes them, to compare with")


@stage("quality.strips", "Misplacement of the strips", group="Quality", version=7, outputs="strip_quality")
def quality_strips(
    strips: StripGeometry, offsets: StripOffsets, params: StripsParams, context: Context
) -> StripQuality:
    """Measures what misplacement the offsets leave, by line, by segment and for the scene."""
    with opened_strips(strips) as opened:
        quality = misplacement(
            opened, offsets, lambda done, total: context.progress(done, total, "misplacement")
        )
    metrics: dict[str, Any] = quality_metrics(quality)
    for figures, pair in zip(metrics["pairs"], quality.pairs, strict=True):
        figures["segments_px"] = pair.segments_px.round(6)
    context.metric("misplacement", metrics)
    _report(context, strips, offsets, quality)
    if params.truth is not None:
        true = read_true_offsets(params.truth, strips)
        context.metric("errors", asdict(scene_errors(offsets, true, strips)))
    if quality.misplaced:
        worst = quality.figures.worst_segment_px
        text = (
            f"512 lines of the scene are off by {worst:.1f} px, more than 1 px: seams show there; "
            f"give {better_offsets(strips, offsets.method)}"
        )
        context.warn("scene-misplaced", "", text)
    return quality


def _report(context: Context, geometry: StripGeometry, offsets: StripOffsets, quality: StripQuality) -> None:
    """What is left, and the spectra of what was found and of what is left."""
    names = ["" if ccd.path is None else ccd.path.name for ccd in geometry.ccds]
    for pair in quality.pairs:
        context.recorder.strip_residuals(
            (pair.pair, names[pair.pair], names[pair.pair + 1]),
            pair.centre_lines,
            pair.residual_px.T,
            pair.sd_px,
        )
    spectra = {
        "found": jitter_spectrum(offsets, geometry.line_rate_hz),
        "left": residual_spectrum(quality, geometry.line_rate_hz),
    }
    for what, spectrum in spectra.items():
        peaks = asdict(peaks_by_bin(spectrum))
        context.metric(f"jitter.{what}", {name: values.round(6) for name, values in peaks.items()})
        context.recorder.jitter(what, **peaks)
