"""The strips' offsets in Rerun, and what they leave: two plots for each pair over the left strip's lines."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.geodesy.local import LocalFrame
from geomosaic.quality.figures import interval_of
from geomosaic.quality.strip_figures import LIMIT_PX
from geomosaic.recording.file.model import Recording, StripCurve, StripResidual
from geomosaic.recording.file.reader import printable
from geomosaic.recording.inspect.summary import largest_length

LINE: Final = "line"
STRIP_PLAN: Final = "/strip_plan"
_COLOURS = {"dcol": (90, 170, 250), "dline": (130, 200, 90), "not measured": (235, 110, 60)}
_LEFT: Final = "/strips_left"
_MEANING = "px; blue dcol, green dline, orange not measured"
_FAINT = [(60, 90, 125), (75, 105, 60)]


def log_strips(recording: Recording, stream: Any) -> None:
    """Each pair's curves, their 90 % intervals, and in another colour where they weren't measured."""
    import rerun

    for curve in _last(recording):
        at = f"/strips/{curve.pair}"
        interval = interval_of(0.9) * curve.sd_px
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


def draw_strip_plan(recording: Recording, stream: Any) -> None:
    """Outlines of the strips in metres about their middle, north up."""
    import rerun

    rings = [(name, ring) for name, ring in recording.strips_lonlat if len(ring) and np.isfinite(ring).all()]
    if not rings:
        return
    lon, lat = np.concatenate([ring for _, ring in rings]).mean(axis=0)
    metres = LocalFrame(float(lon), float(lat), 0.0)
    drawn = [metres.enu_from_geodetic(ring[:, 0], ring[:, 1], 0.0)[:, :2] * [1.0, -1.0] for _, ring in rings]
    colours = [(90, 170, 250) if k % 2 else (130, 200, 90) for k in range(len(drawn))]
    stream.log(f"{STRIP_PLAN}/outlines", rerun.LineStrips2D(drawn, colors=colours), static=True)
    at = [_along(ring, (k + 1) / (len(drawn) + 1)) for k, ring in enumerate(drawn)]
    named = rerun.Points2D(at, labels=[printable(n) for n, _ in rings], colors=colours, show_labels=True)
    stream.log(f"{STRIP_PLAN}/names", named, static=True)


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


def _along(ring: Floats, share: float) -> Floats:
    """The place (2,) at a share of a strip's length: names in the middles would lie on one another."""
    along = ring[:, np.ptp(ring, axis=0).argmax()]
    first, last = ring[along.argmin()], ring[along.argmax()]
    return np.asarray(first + share * (last - first))
