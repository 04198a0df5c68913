"""The offsets of neighbouring strips, line by line."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.ccd.gaps import gaps
from geomosaic.ccd.joint import far_from_nominal
from geomosaic.ccd.methods import METHODS, SEARCHED_WITHIN_OVERLAP
from geomosaic.ccd.model import UNRELIABLE, CcdSettings, PairOffsets, StripOffsets
from geomosaic.ccd.volumes import within_overlap
from geomosaic.pipeline.function_stage import stage
from geomosaic.pipeline.stage import Context, StageParams, param
from geomosaic.quality.strip_figures import common_lines
from geomosaic.stages.strip_input import better_offsets, opened_strips
from geomosaic.survey.strips import StripGeometry

_SETTINGS = CcdSettings()
_RECORDED_LINES = 8


class OffsetsParams(StageParams):
    """See each parameter's help."""

    method: str = param("joint", help="how the offsets are found", choices=METHODS)
    search_cols_px: int = param(
        _SETTINGS.search_cols_px,
        help="how far across they may be from the nominal ones",
        unit="px",
        ge=2,
        le=64,
    )
    search_lines_px: int = param(
        _SETTINGS.search_lines_px,
        help="how far along they may be from the nominal ones",
        unit="px",
        ge=2,
        le=200,
    )
    knot_lines: int = param(
        _SETTINGS.knot_lines,
        help="joint: lines between the knots of its curves, even; 0: every 5 ms",
        unit="lines",
        ge=0,
        le=256,
    )
    segment_lines: int = param(
        _SETTINGS.segment_lines, help="piecewise_linear: lines of a segment", unit="lines", ge=64, le=20000
    )
    enhance: bool = param(
        _SETTINGS.enhance, help="piecewise_linear: stretch each segment's greys for matching"
    )
    ratio: float = param(_SETTINGS.ratio, help="SIFT: nearest distance to second, at most", ge=0.1, le=1.0)


@stage("ccd.offsets", "Offsets between the strips", group="CCD strips", version=16, outputs="offsets")
def ccd_offsets(strips: StripGeometry, params: OffsetsParams, context: Context) -> StripOffsets:
    """Where the right strip of each pair sees what the left one sees."""
    settings = CcdSettings(**params.model_dump(exclude={"method"}))
    with opened_strips(strips) as opened:
        pairs = METHODS[params.method](
            opened, settings, lambda done, total: context.progress(done, total, "offsets")
        )
    used_px = settings.search_cols_px
    if params.method in SEARCHED_WITHIN_OVERLAP:
        used_px = within_overlap(settings, strips.overlap_px).search_cols_px
    narrowed = f" within {used_px} columns" if used_px < settings.search_cols_px else ""
    if narrowed:
        text = (
            f"overlaps of {strips.overlap_px} columns allow a search of {used_px} columns across instead of "
            f"{settings.search_cols_px}: CCDs mounted further off nominal are not matched; correct "
            "overlap_px in the geometry file if the strips share more"
        )
        context.warn("search-narrowed", "", text)
    if params.method == "virtual_line" and strips.dem is None:
        text = (
            "no DEM: heights are unknown, so offsets without matches are less accurate; give 'dem' in "
            "the geometry file"
        )
        context.warn("dem-missing", "geometry", text)
    for offsets in pairs:
        _report(context, strips, offsets, narrowed, better_offsets(strips, params.method))
    _record_gaps(context, strips, pairs)
    far = far_from_nominal(strips, pairs)
    if far is not None:
        text = (
            f"all matches lie {far[0]:+.0f} columns and {far[1]:+.0f} lines off the nominal "
            "geometry, so seams are off: the scene shows only clouds, or row_separation_lines is wrong; "
            "correct it in the geometry file"
        )
        context.warn("far-from-nominal", "", text)
    context.metric("offsets.method", params.method)
    return StripOffsets(params.method, pairs)


def _record_gaps(context: Context, geometry: StripGeometry, pairs: Sequence[PairOffsets]) -> None:
    found = [
        (offsets.pair, gap)
        for offsets in pairs
        for gap in gaps(offsets, common_lines(geometry, offsets.pair, offsets.dline_px))
    ]
    names = ["" if ccd.path is None else ccd.path.name for ccd in geometry.ccds]
    context.recorder.table(
        "strips.bridged",
        [names[pair] for pair, _ in found],
        {
            "pair": [pair for pair, _ in found],
            "first_line": [gap.first_line for _, gap in found],
            "last_line": [gap.last_line for _, gap in found],
            "label": [gap.label for _, gap in found],
            "largest_sd_px": [gap.largest_sd_px for _, gap in found],
        },
        others=[names[pair + 1] for pair, _ in found],
        notes=[gap.why for _, gap in found],
    )


def _report(
    context: Context, geometry: StripGeometry, offsets: PairOffsets, narrowed: str, better: str
) -> None:
    left, right = (geometry.ccds[k].path for k in (offsets.pair, offsets.pair + 1))
    assert left is not None
    assert right is not None
    unreliable = (offsets.label == UNRELIABLE)[common_lines(geometry, offsets.pair, offsets.dline_px)]
    if not unreliable.size or unreliable.all():
        guessed = offsets.dcol_px.any() or offsets.dline_px.any()
        text = (
            f"no matches with {right.name}{narrowed}: joined by "
            f"{'a best guess' if guessed else 'the nominal geometry'}, so the seam may be off: nothing to do "
            "over clouds or water, else check the order of 'ccds' in the geometry file"
        )
        context.warn("overlap-unmeasured", left.name, text)
    elif unreliable.mean() > 0.1:
        text = (
            f"few matches with {right.name} on {100 * unreliable.mean():.0f} % of the lines: the seam "
            f"may be off there; nothing to do over clouds or water, else give {better}"
        )
        context.warn("offsets-unreliable", left.name, text)
    line = np.arange(0, len(offsets.label), _RECORDED_LINES)
    context.recorder.strip_offsets(
        (offsets.pair, left.name, right.name),
        line,
        np.stack([offsets.dcol_px, offsets.dline_px])[:, line],
        np.stack([offsets.sd_col_px, offsets.sd_line_px])[:, line],
        offsets.label[line],
    )
