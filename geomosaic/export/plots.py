"""Plots as SVG text: lines, bars, histograms. For the report and for pictures in the documentation.

Every function returns one self-contained `<svg>`; axes carry their unit, series differ by colour and by
dash or marker, colours are told apart by colour-blind eyes, and it reads on white and on black.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from geomosaic.export.svg import COLOURS, DASHES, document, nice_ticks, number, points, tag, text, tick_texts

Floats = NDArray[np.float64]

_LEFT, _RIGHT, _TOP, _BOTTOM = 66.0, 16.0, 34.0, 46.0


@dataclass(frozen=True)
class Axis:
    """What an axis shows; the unit stands in brackets behind its name.

    low, high: fixed ends. whole: ticks at whole numbers only.
    """

    name: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    whole: bool = False

    @property
    def label(self) -> str:
        """`name [unit]`."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


@dataclass(frozen=True)
class Series:
    """One line: x and y (n,), NaN where nothing is known. marks: draw a dot at each value."""

    name: str
    x: ArrayLike
    y: ArrayLike
    marks: bool = True
    line: bool = True


class _Frame:
    """A plot's box: places of values, grid, labels."""

    def __init__(
        self,
        x: list[float],
        y: list[float],
        width: float,
        height: float,
        left: float = _LEFT,
        top: float = _TOP,
    ) -> None:
        self.x, self.y, self.width, self.height = x, y, width, height
        self.left, self.right, self.top, self.bottom = left, width - _RIGHT, top, height - _BOTTOM

    def at_x(self, value: ArrayLike) -> Floats:
        share = (np.asarray(value, dtype=np.float64) - self.x[0]) / (self.x[-1] - self.x[0])
        return self.left + share * (self.right - self.left)

    def at_y(self, value: ArrayLike) -> Floats:
        share = (np.asarray(value, dtype=np.float64) - self.y[0]) / (self.y[-1] - self.y[0])
        return np.asarray(self.bottom - share * (self.bottom - self.top))

    def x_grid(self, label: str) -> list[str]:
        out = []
        for value, words in zip(self.x, tick_texts(self.x), strict=True):
            at = float(self.at_x(value))
            out.append(tag("line", x1=at, x2=at, y1=self.top, y2=self.bottom, class_="grid"))
            out.append(text(at, self.bottom + 17, words, text_anchor="middle"))
        middle = (self.left + self.right) / 2
        return [*out, text(middle, self.height - 8, label, text_anchor="middle")]

    def y_grid(self, label: str) -> list[str]:
        out = []
        for value, words in zip(self.y, tick_texts(self.y), strict=True):
            at = float(self.at_y(value))
            out.append(tag("line", x1=self.left, x2=self.right, y1=at, y2=at, class_="grid"))
            out.append(text(self.left - 7, at + 4.5, words, text_anchor="end"))
        middle = (self.top + self.bottom) / 2
        turn = f"rotate(-90 15 {number(middle)})"
        return [*out, text(15, middle, label, text_anchor="middle", transform=turn)]

    def box(self) -> str:
        return tag(
            "path",
            d=f"M{number(self.left)},{number(self.top)}V{number(self.bottom)}H{number(self.right)}",
            class_="axis",
        )


def _ticks(values: Floats, axis: Axis, from_zero: bool = False) -> list[float]:
    seen = values[np.isfinite(values)]
    low = axis.low if axis.low is not None else float(seen.min()) if seen.size else 0.0
    high = axis.high if axis.high is not None else float(seen.max()) if seen.size else 1.0
    if from_zero:
        low, high = min(low, 0.0), max(high, 0.0)
    return nice_ticks(low, high, least_step=1.0 if axis.whole else 0.0)


def line_plot(
    series: Sequence[Series], x: Axis, y: Axis, *, label: str, width: float = 720, height: float = 340
) -> str:
    """Several series over common axes; the y axis begins at zero where all values are positive.

    A value that isn't finite breaks its line.
    """
    xs = np.concatenate([np.asarray(s.x, dtype=np.float64) for s in series] or [np.zeros(0)])
    ys = np.concatenate([np.asarray(s.y, dtype=np.float64) for s in series] or [np.zeros(0)])
    seen = ys[np.isfinite(ys)]
    near_zero = seen.size > 0 and 0.0 <= seen.min() < 0.5 * seen.max()
    frame = _Frame(_ticks(xs, x), _ticks(ys, y, from_zero=near_zero), width, height)
    out = [*frame.x_grid(x.label), *frame.y_grid(y.label), frame.box()]
    for i, s in enumerate(series):
        out += _drawn(frame, s, i)
    return document(width, height, [*out, *_legend([s.name for s in series], width)], label)


def _drawn(frame: _Frame, series: Series, i: int) -> list[str]:
    colour, at = COLOURS[i % len(COLOURS)], np.stack([frame.at_x(series.x), frame.at_y(series.y)], axis=-1)
    good = np.isfinite(at).all(axis=1)
    out = []
    if series.line:
        breaks = np.flatnonzero(np.diff(good.astype(int)) != 0) + 1
        for part, keep in zip(np.split(at, breaks), np.split(good, breaks), strict=True):
            if keep.all() and len(part) > 1:
                dash = DASHES[i % len(DASHES)]
                out.append(
                    tag(
                        "polyline",
                        points=points(part),
                        fill="none",
                        stroke=colour,
                        stroke_width=2,
                        stroke_dasharray=dash,
                    )
                )
    if series.marks and good.sum() <= 400:
        radius = 3.0 if good.sum() <= 80 else 1.8
        out += [tag("circle", cx=float(px), cy=float(py), r=radius, fill=colour) for px, py in at[good]]
    return out


def _legend(names: Sequence[str], width: float) -> list[str]:
    out, at = [], _LEFT
    for i, name in enumerate(names if len(names) > 1 else ()):
        colour, dash = COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]
        out.append(
            tag(
                "line",
                x1=at,
                x2=at + 24,
                y1=16.0,
                y2=16.0,
                stroke=colour,
                stroke_width=3,
                stroke_dasharray=dash,
            )
        )
        out.append(text(at + 30, 20.5, name))
        at += 48 + 7.4 * len(name)
        if at > width - 60:
            break
    return out


def bar_plot(names: Sequence[str], values: ArrayLike, axis: Axis, *, label: str, width: float = 720) -> str:
    """Horizontal bars, one a name, each with its value; not-a-number draws no bar."""
    lengths = np.asarray(values, dtype=np.float64)
    left = 24.0 + 7.2 * min(max((len(n) for n in names), default=0), 34)
    top = 6.0
    height = top + 26.0 * len(names) + _BOTTOM
    frame = _Frame(_ticks(lengths, axis, from_zero=True), [0.0, 1.0], width, height, left, top)
    frame.right -= 44
    out = frame.x_grid(axis.label)
    for i, (name, value) in enumerate(zip(names, lengths, strict=True)):
        y = top + 26.0 * i
        shown = name if len(name) <= 34 else name[:33] + "…"
        out.append(text(left - 8, y + 17, shown, text_anchor="end"))
        if np.isfinite(value):
            start, end = sorted((float(frame.at_x(0.0)), float(frame.at_x(value))))
            out.append(
                tag("rect", x=start, y=y + 4, width=max(end - start, 1.0), height=18.0, fill=COLOURS[0])
            )
            out.append(text(end + 6, y + 17, f"{value:.3g}"))
    return document(width, height, out, label)


def histogram(
    values: ArrayLike,
    axis: Axis,
    *,
    label: str,
    bins: int = 40,
    width: float = 720,
    height: float = 300,
    mark: tuple[str, float] | None = None,
) -> str:
    """How often values lie in equal bins; the highest 1 % are gathered in the last bin, as the picture says.

    mark: a value to be marked by a line, and its name.
    """
    seen = np.asarray(values, dtype=np.float64).ravel()
    seen = seen[np.isfinite(seen)]
    top = float(np.quantile(seen, 0.99)) if seen.size else 1.0
    low = min(0.0, float(seen.min())) if seen.size else 0.0
    ticks = nice_ticks(low, top if top > low else low + 1.0)
    count, edges = np.histogram(np.minimum(seen, ticks[-1]), bins=bins, range=(ticks[0], ticks[-1]))
    frame = _Frame(ticks, nice_ticks(0.0, float(max(count.max(), 1)), least_step=1.0), width, height)
    out = [*frame.x_grid(axis.label), *frame.y_grid("number"), frame.box()]
    for n, a, b in zip(count, edges, edges[1:], strict=False):
        x0, x1, y = float(frame.at_x(a)), float(frame.at_x(b)), float(frame.at_y(n))
        if n:
            out.append(
                tag("rect", x=x0 + 0.5, y=y, width=x1 - x0 - 1.0, height=frame.bottom - y, fill=COLOURS[0])
            )
    beyond = int((seen > ticks[-1]).sum())
    if beyond:
        words = f"last bin holds {beyond} beyond {ticks[-1]:g}, largest {seen.max():.3g}"
        out.append(text(frame.right, 20, words, text_anchor="end", class_="faint"))
    if mark is not None and ticks[0] <= mark[1] <= ticks[-1]:
        at = float(frame.at_x(mark[1]))
        line = {"x1": at, "x2": at, "y1": frame.top - 8, "y2": frame.bottom}
        out.append(tag("line", None, **line, stroke=COLOURS[1], stroke_width=2, stroke_dasharray="6 3"))
        out.append(text(at, frame.top - 13, mark[0], text_anchor="middle"))
    return document(width, height, out, label)
