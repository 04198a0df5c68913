"""The surface against a reference: a better elevation model, or a point cloud."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2

from geomosaic.doors.scratch import scratch_folder
from geomosaic.export.cog import CogOptions, write_cog
from geomosaic.export.surface import write_difference
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.quality.reference_heights import check_reference
from geomosaic.quality.surface import SurfaceComparison, compare_surface
from geomosaic.report.surface import difference_picture

DIFFERENCE, PICTURE = "surface_difference.tif", "surface_difference.png"


class SurfaceCompareParams(StageParams):
    """See each parameter's help."""

    reference: Path = param(help="elevation model of the surface (a raster), or a point cloud (LAS, LAZ)")
    offset_m: float | None = param(
        None, help="what to add to its heights [by its vertical datum]", unit="m", ge=-12000.0, le=12000.0
    )
    threads: int = param(2, help="threads that compress", ge=1, le=256, affects_output=False)


def _check(params: SurfaceCompareParams) -> None:
    """The reference is an elevation model or a point cloud with a place on the map."""
    check_reference(params.reference)


def _conclusions(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """How true the surface is."""
    found = summary["metrics"].get("quality", {}).get("surface", {}).get("over_all")
    if not found:
        return []
    text = f"{found['nmad_m']:.3g} m NMAD, median {found['median_m']:+.3g} m, 95 % within"
    return [("heights", f"{text} {found['abs_95_m']:.3g} m, at {found['n']:,} points of the reference")]


@stage(
    "quality.surface", "Compare the surface with a reference", group="Quality", version=5,
    outputs="surface_comparison", results=(DIFFERENCE, PICTURE), check=_check, conclusions=_conclusions,
)  # fmt: skip
def quality_surface(
    surface_file: RunFile, confidence_file: RunFile, params: SurfaceCompareParams, context: Context
) -> SurfaceComparison:
    """Measures the surface; it judges and changes nothing."""
    surface = context.path_of(surface_file)
    comparison, difference_m = compare_surface(
        surface,
        context.path_of(confidence_file),
        params.reference,
        params.offset_m,
        lambda text: context.warn("reference-datum-assumed", "", text),
    )
    with scratch_folder(context.work_folder) as scratch:
        plain = Path(scratch) / DIFFERENCE
        write_difference(plain, surface, difference_m)
        with context.writing(DIFFERENCE) as out:
            write_cog(plain, out, CogOptions(threads=params.threads))
    with context.writing(PICTURE) as out:
        cv2.imwrite(str(out), difference_picture(comparison.difference_m))
    for name in ("over_all", "after_fit", "fit"):
        context.metric(f"quality.surface.{name}", asdict(getattr(comparison, name)))
    for name in ("by_slope", "by_kind", "by_support"):
        classes = {text: asdict(figures) for text, figures in getattr(comparison, name)}
        context.metric(f"quality.surface.{name}", classes)
    context.metric("quality.surface.reference", comparison.reference)
    context.metric("quality.surface.datum", comparison.datum)
    return comparison
