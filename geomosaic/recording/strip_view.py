"""The strips' offsets in Rerun: a plot for each pair over the left strip's lines."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from geomosaic.recording.model import Recording, StripCurve

LINE: Final = "line"
_INTERVAL_90 = 1.6449
_COLOURS = {"dcol": (90, 170, 250), "dline": (130, 200, 90), "not measured": (235, 110, 60)}
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


def strip_views(recording: Recording) -> list[Any]:
    """A plot for each pair, over all its lines."""
    import rerun
    import rerun.blueprint as rrb

    views = []
    for c in _last(recording):
        ends = (rerun.TimeRangeBoundary.absolute(seq=int(v)) for v in (c.line[0], c.line[-1]))
        views.append(
            rrb.TimeSeriesView(
                origin=f"/strips/{c.pair}",
                name=f"{c.left} - {c.right}: {_MEANING}",
                axis_x=rrb.TimeAxis(view_range=rerun.TimeRange(*ends)),
                plot_legend=rrb.PlotLegend(visible=False),
            )
        )
    return views


def _last(recording: Recording) -> list[StripCurve]:
    """The latest curve of each pair that has any lines."""
    latest = {c.pair: c for c in recording.strips if len(c.line)}
    return [latest[pair] for pair in sorted(latest)]
