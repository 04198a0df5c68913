"""A small mosaic while frames still arrive, on a page that loads itself anew."""

from __future__ import annotations

from dataclasses import replace
from html import escape
from typing import Final

from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, RunFile, StageParams, param
from geomosaic.placement.model import Placement
from geomosaic.report.given import Decoding, given_image
from geomosaic.stages.input_groups import AdjustedSurvey
from geomosaic.stages.spares import spare_of
from geomosaic.survey.model import Frame
from geomosaic.survey.small import Spare

PREVIEW: Final = "preview.html"
_PAGE: Final = """<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="3">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>{title}</title>
<style>body{{margin:0;background:#222;color:#eee;font:16px sans-serif;text-align:center}}
p{{margin:.5em}}img{{max-width:100%;max-height:92vh}}</style><p>{title}; once the run has ended:
<a href="report.html" style="color:#9cf">report</a></p>{image}</html>
"""


class PreviewParams(StageParams):
    """See each parameter's help."""

    longest_px: int = param(1500, help="longer side of the preview", unit="px", ge=100, le=4000)


@stage(
    "mosaic.preview", "Compose a preview", group="Mosaic", version=1, outputs="preview_page",
    results=(PREVIEW,), wants_frames=True,
)  # fmt: skip
def mosaic_preview(
    placed: AdjustedSurvey, placement: Placement, params: PreviewParams, context: Context
) -> RunFile:
    """Writes preview.html: reduced frames where the adjustment put them, without balancing and blending.

    Frames without a position and without tie points are not shown.
    """

    def spare(frame: Frame) -> Spare:
        return spare_of(context, frame.path)

    frames = placed.survey.frames
    found = replace(placement, poses=placed.adjusted.poses)
    decoding = Decoding(context.spooled, spare)
    image = given_image(placed.survey, found, placed.ground, params.longest_px, decoding)
    what = f"{len(frames)} frames"
    shown = "<p>no picture: the frames have no positions</p>"
    if image is not None:
        shown = f'<img src="{image.uri}" alt="preview of the mosaic">'
    with context.writing(PREVIEW) as path:
        path.write_text(_PAGE.format(title=escape(what), image=shown), encoding="utf-8")
    return context.run_file(PREVIEW)
