"""RUN/report.html: the run for people; with it its accuracy for programs, and a PDF if asked for."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.model import Mosaic
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.function_stage import InputGroup, stage
from geomosaic.pipeline.params import StageParams, param
from geomosaic.pipeline.stage import Context, RunFile
from geomosaic.quality.compare import Comparison
from geomosaic.quality.control import known_residuals_m
from geomosaic.quality.surface import SurfaceComparison
from geomosaic.quality.verdict import Verdict
from geomosaic.report.control import CHECK_POINTS, point_figures
from geomosaic.report.frames import FramesReport, OtherImages, render_report
from geomosaic.report.given import GivenMosaic
from geomosaic.report.glance import Glance
from geomosaic.report.map_images import ReferenceSeen
from geomosaic.report.pdf import print_page
from geomosaic.report.surface import SurfaceSection, surface_section
from geomosaic.stages.quality_compare import FlownFrames
from geomosaic.stages.reporting import run_name

ACCURACY_REPORT: Final = "accuracy_report.json"
PDF: Final = "report.pdf"


@dataclass(frozen=True)
class AdjustedFlight(FlownFrames):
    """These with the tie points between the frames."""

    ties: TiePoints


@dataclass(frozen=True)
class JudgedMosaic(InputGroup):
    """The mosaic, and what other stages found about it."""

    mosaic: Mosaic
    mosaic_file: RunFile
    comparison: Comparison | None = None
    verdict: Verdict | None = None
    given: GivenMosaic | None = None
    reference_seen: ReferenceSeen | None = None
    accuracy_file: RunFile | None = None


@dataclass(frozen=True)
class SurfaceFiles(InputGroup):
    """The rasters of a surface, and how it compares with another one."""

    surface_file: RunFile
    confidence_file: RunFile
    terrain_file: RunFile
    surface_comparison: SurfaceComparison | None = None


class ReportParams(StageParams):
    """See each parameter's help."""

    pdf: bool = param(False, help=f"also print the page to {PDF}, by a browser of the Chromium family")


@stage(
    "export.report", "Write the report", group="Export", version=13, outputs="report_file", cached=False,
    results=("report.html", ACCURACY_REPORT, PDF),
)  # fmt: skip
def export_report(
    of: AdjustedFlight, made: JudgedMosaic, params: ReportParams, context: Context,
    surface: SurfaceFiles | None = None,
) -> RunFile:  # fmt: skip
    """Runs every time, since it also reports what run.json holds so far."""
    mosaic_file, seen, accuracy = context.path_of(made.mosaic_file), made.reference_seen, made.accuracy_file
    page = render_report(
        FramesReport(
            survey=of.survey,
            placement=of.placement,
            ties=of.ties,
            adjusted=of.adjusted,
            mosaic=made.mosaic,
            mosaic_file=mosaic_file,
            image=context.optional_cache(Glance, str(mosaic_file)).found(),
            comparison=made.comparison,
            verdict=made.verdict,
            surface=None if surface is None else _section(surface, context),
            others=OtherImages(
                None if made.given is None else made.given.image,
                None if seen is None else seen.image,
                None if accuracy is None else context.path_of(accuracy),
            ),
            summary=context.summary(),
            name=run_name(context),
        )
    )
    with context.writing("report.html") as path:
        path.write_text(page, encoding="utf-8")
    if made.verdict is not None:
        with context.writing(ACCURACY_REPORT) as path:
            path.write_text(_accuracy_report(context.summary(), of.adjusted), encoding="utf-8")
    if params.pdf:
        with context.writing(PDF) as path:
            print_page(context.path_of(context.run_file("report.html")), path)
    return context.run_file("report.html")


def _accuracy_report(summary: Mapping[str, Any], adjusted: Adjusted) -> str:
    """Accuracy, verdict, figures of control and of check points and every one of them, as JSON."""
    kinds = point_figures(adjusted)
    blunders = {(f.title == CHECK_POINTS, name) for f in kinds for name in f.blunders}
    known = np.isfinite(known_residuals_m(adjusted.control))
    points = [
        {
            "name": c.name,
            "check": c.check,
            "blunder": (c.check, c.name) in blunders,
            "images": c.images,
            **{
                name: [float(v) if its else None for v, its in zip(getattr(c, name), of, strict=True)]
                for name in ("residual_m", "sd_m", "surveyed_sd_m")
            },
        }
        for c, of in zip(adjusted.control, known, strict=True)
    ]
    figures = {
        "check" if f.title == CHECK_POINTS else "control": {
            "points": len(f.points),
            "used": f.used,
            "rmse_h_m": f.rmse_h_m,
            "rmse_v_m": f.rmse_v_m if math.isfinite(f.rmse_v_m) else None,
            "blunders": f.blunders,
        }
        for f in kinds
    }
    parts = {"accuracy": summary.get("accuracy"), "verdict": summary.get("verdict")}
    parts |= {"figures": figures, "points": points}
    return json.dumps(parts, indent=1) + "\n"


def _section(of: SurfaceFiles, context: Context) -> SurfaceSection:
    surface, confidence, terrain = (
        context.path_of(file) for file in (of.surface_file, of.confidence_file, of.terrain_file)
    )
    return surface_section(surface, confidence, terrain, context.summary(), of.surface_comparison)
