"""The mosaic against a reference, and the frames against the truth where it is known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.model import Mosaic
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.quality.compare import Comparison, compare
from geomosaic.quality.compared_block import ComparisonOptions
from geomosaic.quality.misalignment import FramesOverGround, frame_ground_errors, trend
from geomosaic.quality.positions import read_poses
from geomosaic.quality.rasters import open_map
from geomosaic.report.map_images import ReferenceSeen, reference_image
from geomosaic.survey.model import Survey

_LITTLE = 0.5


@dataclass(frozen=True)
class FlownFrames(InputGroup):
    """A survey's frames, where they were reported, in order of flight, and where the adjustment puts them."""

    survey: Survey
    placement: Placement
    adjusted: Adjusted


class CompareParams(StageParams):
    """See each parameter's help."""

    reference: Path = param(help="true ortho or satellite image of the same place")
    truth: Path | None = param(None, help="positions.csv with the frames' true positions and attitudes")
    patch_px: int = param(64, help="side of the patches that are matched", unit="px", ge=16, le=512)
    step_px: int = param(64, help="distance between patches", unit="px", ge=1, le=4096)
    search_px: int = param(128, help="longest displacement looked for", unit="px", ge=1, le=4096)
    min_correlation: float = param(0.5, help="weakest match that counts", ge=0.0, le=1.0)
    match_tone: bool = param(False, help="bring the mosaic's brightness to the reference's before SSIM")


def _check(params: CompareParams) -> None:
    """The reference is a raster with a place on the map."""
    open_map(params.reference).close()


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How true the map is."""
    found = summary["metrics"].get("quality", {})
    rmse_m, ce90_m = found.get("absolute_rmse_m"), found.get("ce90_m")
    if rmse_m is None or ce90_m is None:
        return []
    places = f"at {found['measured']} places of the reference"
    return [("reference", f"{rmse_m:.3g} m RMSE, 90 % within {ce90_m:.3g} m, {places}")]


@stage(
    "quality.compare", "Compare with a reference", group="Quality", version=6, outputs=("comparison",
    "reference_seen"), check=_check, conclusions=_conclusions,
)  # fmt: skip
def quality_compare(
    mosaic_file: RunFile,
    params: CompareParams,
    context: Context,
    flown: FlownFrames | None = None,
    mosaic: Mosaic | None = None,
) -> tuple[Comparison, ReferenceSeen]:
    """Measures the mosaic; it judges and changes nothing."""
    comparison = compare(
        context.path_of(mosaic_file),
        params.reference,
        ComparisonOptions(
            params.patch_px, params.step_px, params.search_px, params.match_tone, params.min_correlation
        ),
        progress=context.progress,
    )
    figures = asdict(comparison.figures)
    for name, value in {**figures, "overlap_share": comparison.overlap_share}.items():
        context.metric(f"quality.{name}", value)
    context.metric("quality.ssim", asdict(comparison.ssim))
    if comparison.ssim_registered is not None:
        context.metric("quality.ssim_registered", asdict(comparison.ssim_registered))
    if comparison.figures.share_measured < _LITTLE:
        context.warn(
            "little-measured",
            "",
            f"only {100 * comparison.figures.share_measured:.0f} % of the patches match "
            f"{comparison.reference}; the figures hold for those alone; give a --reference of the "
            "same season and pixel size to measure more",
        )
    if params.truth is not None and flown is not None:
        _report_frame_errors(flown, params.truth, context)
    seen = None if mosaic is None else reference_image(mosaic.grid, params.reference)
    return comparison, ReferenceSeen(seen)


def _report_frame_errors(flown: FlownFrames, truth: Path, context: Context) -> None:
    """How far each frame's middle lands from its true place, in order of flight, and whether that grows."""
    survey, adjusted = flown.survey, flown.adjusted
    true_poses = read_poses(truth, [f.name for f in survey.frames], survey.work_frame)
    given = [survey.camera_of(i) for i in range(len(survey.frames))]
    errors = frame_ground_errors(
        FramesOverGround(adjusted.poses, adjusted.cameras, adjusted.ground),
        FramesOverGround(true_poses, given, adjusted.ground),
    )
    length = np.linalg.norm(errors, axis=1)[list(flown.placement.sequence)]
    line = trend(np.arange(len(length)), length)
    context.metric("quality.frames.error_m", length)
    context.metric("quality.frames.rmse_m", float(np.sqrt(np.nanmean(length**2))))
    context.metric("quality.frames.slope_m_per_frame", line.slope)
    context.metric("quality.frames.slope_sd_m_per_frame", line.slope_sd)
