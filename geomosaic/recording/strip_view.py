"""The strips' offsets in Rerun, and what they leave: two plots for each pair over the left strip's lines."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from geomosaic.quality.strip_figures import LIMIT_PX
from geomosaic.recording.model import Recording, StripCurve, StripResidual
from geomosaic.recording.summary import largest_length

LINE: Final = "line"
_INTERVAL_90 = 1.6449
_COLOURS = {"dcol": (90, 170, 250), "dline": (130, 200, 90), "not measured": (235, 110, 60)}
_LEFT: Final = "/strips_left"
_MEANING = "px; blue dcol, green dline, orange not measured"
_FAINT = [(60, 90, 125), (75, 105, 60)]


def log_strips(recording: Recording, stream: Any) -> None:
    """Each pair's curves, their 90 % intervals, and in another colour where they weren't measured."""
    import rerun

    for curve in _last(recording):
        at = f"/strips/{curve.pair}"
        interval = _INTERVAL_90 * curve.sd_px
        bounds = np.stack([curve.offset_px - interval, curve.offset_px + interval], axis=2).reshape(-1, 4)
        hidden = np.where(curve.label[:, None] > 0, curve.offset_px, np.nan)
        names = ["dcol, px", "dline, px"]
        both = [_COLOURS["dcol"], _COLOURS["dline"]]
        odd = [_COLOURS["not measured"]] * 2
        drawn: dict[str, tuple[Any, list[str], list[tuple[int, int, int]], float]] = {
            "interval": (bounds, ["dcol 90 %", "", "dline 90 %", ""], [_FAINT[0]] * 2 + [_FAINT[1]] * 2, 1.0),
            "offsets": (curve.offset_px, names, both, 1.5),
            "not_measured": (hidden, ["not measured", ""], odd, 5.0),
        }
        index = rerun.TimeColumn(LINE, sequence=curve.line)
        for name, (values, titles, colours, width) in drawn.items():
            lines = rerun.SeriesLines(names=titles, colors=colours, widths=[width] * len(titles))
            stream.log(f"{at}/{name}", lines, static=True)
            stream.send_columns(f"{at}/{name}", [index], rerun.Scalars.columns(scalars=values))
    for left in _last_left(recording):
        at = f"{_LEFT}/{left.pair}"
        points = rerun.SeriesPoints(
            names=["dcol left, px", "dline left, px"],
            colors=[_COLOURS["dcol"], _COLOURS["dline"]],
            marker_sizes=[2.0, 2.0],
        )
        stream.log(at, points, static=True)
        index = rerun.TimeColumn(LINE, sequence=left.line)
        stream.send_columns(at, [index], rerun.Scalars.columns(scalars=left.residual_px))


def strip_views(recording: Recording) -> list[Any]:
    """A plot for each pair, over all its lines; under it what is left, drawn to 1 px at least."""
    import rerun
    import rerun.blueprint as rrb

    reach_px = {r.pair: max(LIMIT_PX, largest_length(r.residual_px) or 0.0) for r in _last_left(recording)}
    views: list[Any] = []
    for c in _last(recording):
        ends = (rerun.TimeRangeBoundary.absolute(seq=int(v)) for v in (c.line[0], c.line[-1]))
        shared: dict[str, Any] = {
            "axis_x": rrb.TimeAxis(view_range=rerun.TimeRange(*ends)),
            "plot_legend": rrb.PlotLegend(visible=False),
        }
        pair = f"{c.left} - {c.right}"
        view: Any = rrb.TimeSeriesView(origin=f"/strips/{c.pair}", name=f"{pair}: {_MEANING}", **shared)
        if c.pair in reach_px:
            axis = rrb.ScalarAxis(range=(-reach_px[c.pair], reach_px[c.pair]))
            name = f"{pair}: what is left, px"
            under = rrb.TimeSeriesView(origin=f"{_LEFT}/{c.pair}", name=name, axis_y=axis, **shared)
            view = rrb.Vertical(view, under, row_shares=[3, 2])
        views.append(view)
    return views


def _last(recording: Recording) -> list[StripCurve]:
    """The latest curve of each pair that has any lines."""
    latest = {c.pair: c for c in recording.strips if len(c.line)}
    return [latest[pair] for pair in sorted(latest)]


def _last_left(recording: Recording) -> list[StripResidual]:
    """The latest of each pair of which anything was measured."""
    latest = {r.pair: r for r in recording.strip_residuals if np.isfinite(r.residual_px).any()}
    return [latest[pair] for pair in sorted(latest)]
