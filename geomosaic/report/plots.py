"""Plots as SVG text: lines, histograms. For the report and for images in the documentation.

Every function returns one self-contained `<svg>`. Axes carry their unit, series differ by colour and by dash
or marker, colours are kept apart by colour-blind eyes, and it reads on white and on black.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from geomosaic.arrays import Floats
from geomosaic.report.numbers import short
from geomosaic.report.svg import (
    COLOURS,
    DASHES,
    document,
    nice_ticks,
    number,
    points,
    power_ticks,
    tag,
    text,
    tick_texts,
)

LEFT, RIGHT, TOP, _BOTTOM = 66.0, 16.0, 34.0, 46.0


@dataclass(frozen=True)
class Axis:
    """What an axis shows; the unit stands in brackets behind its name.

    low, high: fixed ends. whole: ticks at whole numbers only. powers: logarithmic, four decades at most.
    """

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    whole: bool = False
    powers: bool = False

    @property
    def label(self) -> str:
        """`name [unit]`."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class Series:
    """One line: x and y (n,), NaN where nothing is known. marks: draw a dot at each value.

    colour, dash, thick: how it is drawn; by its place among the others where None.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    marks: bool = True
    line: bool = True
    colour: str | None = None
    dash: str | None = None
    thick: float = 2.0

    def drawn(self, i: int) -> Series:
        """Itself with the colour and dash of the i-th."""
        return replace(
            self,
            colour=COLOURS[i % len(COLOURS)] if self.colour is None else self.colour,
            dash=DASHES[i % len(DASHES)] if self.dash is None else self.dash,
        )


@dataclass(frozen=True)
class Scale:
    """Values between the first and the last tick, and where these two stand in the plot."""

    ticks: Sequence[float]
    start: float
    end: float
    powers: bool = False

    def at(self, values: ArrayLike) -> Floats:
        """Places (n,) of values (n,); on an axis of powers what lies below it stands at its beginning."""
        ends, at = np.array([self.ticks[0], self.ticks[-1]]), np.asarray(values, dtype=np.float64)
        if self.powers:
            ends, at = np.log10(ends), np.log10(np.maximum(at, ends[0]))
        return np.asarray(self.start + (at - ends[0]) / (ends[1] - ends[0]) * (self.end - self.start))

    def marks(self) -> list[tuple[float, str]]:
        """Place and text of every tick."""
        words = [f"{t:g}" for t in self.ticks] if self.powers else tick_texts(self.ticks)
        return list(zip(self.at(self.ticks).tolist(), words, strict=True))


@dataclass(frozen=True)
class PlotFrame:
    """A plot's box: grid, ticks and names of its axes."""

    x: Scale
    y: Scale

    def x_grid(self, label: str, name_at: float, below: float = 17.0) -> list[str]:
        """Lines at the ticks, their texts that far below the box, the axis' name at a height of the plot."""
        out = []
        for at, words in self.x.marks():
            out.append(tag("line", x1=at, x2=at, y1=self.y.end, y2=self.y.start, class_="grid"))
            out.append(text(at, self.y.start + below, words, text_anchor="middle"))
        return [*out, text((self.x.start + self.x.end) / 2, name_at, label, text_anchor="middle")]

    def y_grid(self, label: str, **style: object) -> list[str]:
        """Lines at the ticks, their texts and the axis' name next to the box."""
        out = []
        for at, words in self.y.marks():
            out.append(tag("line", x1=self.x.start, x2=self.x.end, y1=at, y2=at, class_="grid"))
            out.append(text(self.x.start - 7, at + 4.5, words, text_anchor="end"))
        middle = (self.y.start + self.y.end) / 2
        turn = f"rotate(-90 15 {number(middle)})"
        return [*out, text(15, middle, label, text_anchor="middle", transform=turn, **style)]

    def box(self) -> str:
        """The two axes."""
        d = f"M{number(self.x.start)},{number(self.y.end)}V{number(self.y.start)}H{number(self.x.end)}"
        return tag("path", d=d, class_="axis")

    def at(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Places (n, 2) of values (n,)."""
        return np.stack([self.x.at(x), self.y.at(y)], axis=-1)


def _ticks(values: Floats, axis: Axis, from_zero: bool = False) -> list[float]:
    seen = values[np.isfinite(values) & ((values > 0.0) | (not axis.powers))]
    low = axis.low if axis.low is not None else float(seen.min()) if seen.size else 0.0
    high = axis.high if axis.high is not None else float(seen.max()) if seen.size else 1.0
    if axis.powers:
        return power_ticks(low, high)
    if from_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    return nice_ticks(low, high, least_step=1.0 if axis.whole else 0.0)


def line_plot(series: Sequence[Series], x: Axis, y: Axis, *, label: str, width: float = 720) -> str:
    """Several series over common axes; the y axis begins at zero where all values are positive.

    A value that isn't finite breaks its line.
    """
    height = 340
    series = [s.drawn(i) for i, s in enumerate(series)]
    xs = np.concatenate([np.asarray(s.x, dtype=np.float64) for s in series] or [np.zeros(0)])
    ys = np.concatenate([np.asarray(s.y, dtype=np.float64) for s in series] or [np.zeros(0)])
    seen = ys[np.isfinite(ys)]
    near_zero = seen.size > 0 and 0.0 <= seen.min() < 0.5 * seen.max()
    frame = PlotFrame(
        Scale(_ticks(xs, x), LEFT, width - RIGHT, x.powers),
        Scale(_ticks(ys, y, from_zero=near_zero), height - _BOTTOM, TOP, y.powers),
    )
    out = [*frame.x_grid(x.label, height - 8), *frame.y_grid(y.label), frame.box()]
    for s in series:
        out += _drawn(frame, s)
    return document(width, height, [*out, *_legend(series, width)], label)


def _drawn(frame: PlotFrame, series: Series) -> list[str]:
    at = frame.at(series.x, series.y)
    good = np.isfinite(at).all(axis=1)
    out = []
    if series.line:
        stroke = {"stroke": series.colour, "stroke_width": series.thick, "stroke_dasharray": series.dash}
        breaks = np.flatnonzero(np.diff(good.astype(int)) != 0) + 1
        for part, keep in zip(np.split(at, breaks), np.split(good, breaks), strict=True):
            if keep.all() and len(part) > 1:
                out.append(tag("polyline", None, points=points(part), fill="none", **stroke))
    if series.marks and good.sum() <= 400:
        radius = 3.0 if good.sum() <= 80 else 1.8
        dots = at[good].tolist()
        out += [tag("circle", cx=px, cy=py, r=radius, fill=series.colour) for px, py in dots]
    return out


def _legend(series: Sequence[Series], width: float) -> list[str]:
    out, at = [], LEFT
    for s in series if len(series) > 1 else ():
        stroke = {"stroke": s.colour, "stroke_width": 3, "stroke_dasharray": s.dash}
        out.append(tag("line", None, x1=at, x2=at + 24, y1=16.0, y2=16.0, **stroke))
        out.append(text(at + 30, 20.5, s.name))
        at += 48 + 7.4 * len(s.name)
        if at > width - 60:
            break
    return out


def histogram(
    values: ArrayLike,
    axis: Axis,
    *,
    label: str,
    bins: int = 40,
    mark: tuple[str, float] | None = None,
) -> str:
    """How often values lie in equal bins; the highest 1 % are gathered in the last bin, as the image says.

    mark: a value to be marked by a line, and its name.
    """
    width, height = 720, 300
    seen = np.asarray(values, dtype=np.float64).ravel()
    seen = seen[np.isfinite(seen)]
    top = float(np.quantile(seen, 0.99)) if seen.size else 1.0
    low = min(0.0, float(seen.min())) if seen.size else 0.0
    ticks = nice_ticks(low, top if top > low else low + 1.0)
    count, edges = np.histogram(np.minimum(seen, ticks[-1]), bins=bins, range=(ticks[0], ticks[-1]))
    upwards = nice_ticks(0.0, float(max(count.max(), 1)), least_step=1.0)
    frame = PlotFrame(Scale(ticks, LEFT, width - RIGHT), Scale(upwards, height - _BOTTOM, TOP))
    out = [*frame.x_grid(axis.label, height - 8), *frame.y_grid("number"), frame.box()]
    at = frame.at(edges[1:], count).tolist()
    for n, x0, (x1, y) in zip(count, frame.x.at(edges[:-1]).tolist(), at, strict=True):
        if n:
            place = {"x": x0 + 0.5, "y": y, "width": x1 - x0 - 1.0, "height": frame.y.start - y}
            out.append(tag("rect", None, **place, fill=COLOURS[0]))
    beyond = int((seen > ticks[-1]).sum())
    if beyond:
        words = f"last bin holds {beyond} beyond {short(ticks[-1])}, largest {short(float(seen.max()))}"
        out.append(text(frame.x.end, 20, words, text_anchor="end", class_="faint"))
    if mark is not None and ticks[0] <= mark[1] <= ticks[-1]:
        at_mark = float(frame.x.at(mark[1]))
        line = {"x1": at_mark, "x2": at_mark, "y1": TOP - 8, "y2": frame.y.start}
        out.append(tag("line", None, **line, stroke=COLOURS[1], stroke_width=2, stroke_dasharray="6 3"))
        out.append(text(at_mark, TOP - 13, mark[0], text_anchor="middle"))
    return document(width, height, out, label)
