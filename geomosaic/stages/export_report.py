"""RUN/report.html: the run for people; with it its accuracy for programs, and a PDF if asked for."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, ClassVar, Final

from geomosaic.adjustment.model import Adjusted
from geomosaic.composition.model import Mosaic
from geomosaic.matching.model import TiePoints
from geomosaic.pipeline.params import StageParams, param
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.placement.model import Placement
from geomosaic.quality.compare import Comparison
from geomosaic.quality.surface import SurfaceComparison
from geomosaic.quality.verdict import Verdict
from geomosaic.report.control import CHECK_POINTS, point_figures
from geomosaic.report.frames import FramesReport, OtherImages, render_report
from geomosaic.report.given import GivenMosaic
from geomosaic.report.glance import Glance
from geomosaic.report.map_images import ReferenceSeen
from geomosaic.report.pdf import print_page
from geomosaic.report.surface import SurfaceSection, surface_section
from geomosaic.stages.reporting import run_name
from geomosaic.survey.model import Survey

ACCURACY_REPORT: Final = "accuracy_report.json"
PDF: Final = "report.pdf"


class ExportReport(Stage):
    """Runs every time, since it also reports what run.json holds so far."""

    id = "export.report"
    display_name = "Write the report"
    group = "Export"
    version = 9
    cached = False
    inputs: ClassVar[dict[str, type]] = {
        "survey": Survey, "placement": Placement, "ties": TiePoints, "adjusted": Adjusted,
        "mosaic": Mosaic, "mosaic_file": RunFile,
    }  # fmt: skip
    optional_inputs: ClassVar[dict[str, type]] = {
        "comparison": Comparison, "verdict": Verdict, "surface_file": RunFile, "confidence_file": RunFile,
        "terrain_file": RunFile, "surface_comparison": SurfaceComparison, "given": GivenMosaic,
        "reference_seen": ReferenceSeen, "accuracy_file": RunFile,
    }  # fmt: skip
    outputs: ClassVar[dict[str, type]] = {"report_file": RunFile}
    results: ClassVar[tuple[str, ...]] = ("report.html", ACCURACY_REPORT, PDF)

    class Params(StageParams):
        """See each parameter's help."""

        pdf: bool = param(False, help=f"also print the page to {PDF}, by a browser of the Chromium family")

    def run(self, inputs: Mapping[str, Any], params: Params, context: Context) -> dict[str, Any]:
        """Renders the page and writes it."""
        mosaic_file = context.path_of(inputs["mosaic_file"])
        page = render_report(
            FramesReport(
                survey=inputs["survey"],
                placement=inputs["placement"],
                ties=inputs["ties"],
                adjusted=inputs["adjusted"],
                mosaic=inputs["mosaic"],
                mosaic_file=mosaic_file,
                image=context.optional_cache(Glance, str(mosaic_file)).found(),
                comparison=inputs.get("comparison"),
                verdict=inputs.get("verdict"),
                surface=_surface(inputs, context),
                others=_other_images(inputs, context),
                summary=context.summary(),
                name=run_name(context),
            )
        )
        with context.writing("report.html") as path:
            path.write_text(page, encoding="utf-8")
        if "verdict" in inputs:
            with context.writing(ACCURACY_REPORT) as path:
                path.write_text(_accuracy_report(context.summary(), inputs["adjusted"]), encoding="utf-8")
        if params.pdf:
            with context.writing(PDF) as path:
                print_page(context.path_of(context.run_file("report.html")), path)
        return {"report_file": context.run_file("report.html")}


def _accuracy_report(summary: Mapping[str, Any], adjusted: Adjusted) -> str:
    """Accuracy, verdict, figures of control and of check points and every one of them, as JSON."""
    kinds = point_figures(adjusted)
    blunders = {(f.title == CHECK_POINTS, name) for f in kinds for name in f.blunders}
    points = [
        {
            "name": c.name,
            "check": c.check,
            "blunder": (c.check, c.name) in blunders,
            "images": c.images,
            "residual_m": c.residual_m.tolist(),
            "sd_m": c.sd_m.tolist(),
            "surveyed_sd_m": c.surveyed_sd_m.tolist(),
        }
        for c in adjusted.control
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


def _surface(inputs: Mapping[str, Any], context: Context) -> SurfaceSection | None:
    if "surface_file" not in inputs:
        return None
    surface, confidence, terrain = (
        context.path_of(inputs[name]) for name in ("surface_file", "confidence_file", "terrain_file")
    )
    return surface_section(surface, confidence, terrain, context.summary(), inputs.get("surface_comparison"))


def _other_images(inputs: Mapping[str, Any], context: Context) -> OtherImages:
    given, reference = (
        inputs[name].image if name in inputs else None for name in ("given", "reference_seen")
    )
    accuracy = inputs.get("accuracy_file")
    return OtherImages(given, reference, None if accuracy is None else context.path_of(accuracy))
