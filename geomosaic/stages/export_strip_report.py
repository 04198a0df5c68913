"""RUN/report.html of a scene of strips: the run for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from geomosaic.ccd.model import StripOffsets
from geomosaic.ccd.radiometry import Radiometry
from geomosaic.composition.strip_compose import StripMosaic
from geomosaic.pipeline.stage import Context, RunFile, Stage
from geomosaic.quality.strips import StripQuality
from geomosaic.report.strips import render_strips_report
from geomosaic.stages.reporting import run_name
from geomosaic.survey.strips import StripGeometry

REPORT = "report.html"


class ExportStripReport(Stage):
    """Runs every time, since it also reports what run.json holds so far."""

    id = "export.strip_report"
    display_name = "Write the strips' report"
    group = "Export"
    version = 1
    cached = False
    inputs: ClassVar[dict[str, type]] = {
        "strips": StripGeometry, "offsets": StripOffsets, "radiometry": Radiometry,
        "strip_mosaic": StripMosaic, "strip_quality": StripQuality, "mosaic_file": RunFile,
    }  # fmt: skip
    outputs: ClassVar[dict[str, type]] = {"report_file": RunFile}
    results: ClassVar[tuple[str, ...]] = (REPORT,)

    def run(self, inputs: Mapping[str, Any], params: Any, context: Context) -> dict[str, Any]:
        """Renders the page and writes it."""
        page = render_strips_report(
            geometry=inputs["strips"],
            offsets=inputs["offsets"],
            quality=inputs["strip_quality"],
            radiometry=inputs["radiometry"],
            mosaic=inputs["strip_mosaic"],
            mosaic_file=context.path_of(inputs["mosaic_file"]),
            summary=context.summary(),
            name=run_name(context),
        )
        with context.writing(REPORT) as path:
            path.write_text(page, encoding="utf-8")
        return {"report_file": context.run_file(REPORT)}
