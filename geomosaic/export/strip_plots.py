"""Plots of a scene of CCD strips as SVG text: offsets along the lines, misplacement, spectra."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from geomosaic.ccd.model import MEASURED, UNRELIABLE, Floats, PairOffsets
from geomosaic.export.svg import COLOURS, DASHES, document, nice_ticks, number, points, tag, text, tick_texts
from geomosaic.quality.jitter import Spectrum
from geomosaic.quality.strip_figures import LIMIT_PX
from geomosaic.quality.strips import StripQuality

_MOST_POINTS = 2000
_INTERVAL_90 = 1.6449
_LEFT, _RIGHT, _TOP, _PANEL, _GAP, _BOTTOM = 66.0, 16.0, 30.0, 112.0, 14.0, 62.0
_LABEL_COLOURS = {1: COLOURS[4], 2: COLOURS[1]}
_PAIR_COLOURS = (COLOURS[0], COLOURS[2], COLOURS[3], COLOURS[4], COLOURS[5], COLOURS[6])
_LEAST_HZ = 0.2
_SPECTRUM_BINS = 300


def offsets_plot(pair: PairOffsets, *, label: str, width: float = 720) -> str:
    """dcol and dline over the lines, each with its 90 % interval; a bar tells what wasn't measured."""
    line, values, reach, worst = _thinned(pair)
    height = _TOP + 2 * _PANEL + _GAP + _BOTTOM
    ticks = nice_ticks(0.0, float(max(len(pair.label), 1)))
    x = _Scale(ticks[0], ticks[-1], _LEFT, width - _RIGHT)
    foot = _TOP + 2 * _PANEL + _GAP
    out = []
    for value, words in zip(ticks, tick_texts(ticks), strict=True):
        at = x.at(value)
        out.append(tag("line", x1=at, x2=at, y1=_TOP, y2=foot, class_="grid"))
        out.append(text(at, foot + 34, words, text_anchor="middle"))
    out.append(text((_LEFT + width - _RIGHT) / 2, height - 8, "line of the left strip", text_anchor="middle"))
    for k, name in enumerate(("across (dcol) [px]", "along (dline) [px]")):
        out += _panel(x, _TOP + k * (_PANEL + _GAP), line, values[:, k], reach[:, k], COLOURS[2 * k], name)
    out += _label_bar(x, foot + 6, line, worst)
    out += _label_legend(width)
    return document(width, height, out, label)


_Curve = tuple[str, Floats, Floats, dict[str, str]]


class _Scale:
    """Places of values between two ends of an axis."""

    def __init__(self, low: float, high: float, start: float, end: float) -> None:
        self.low, self.high, self.start, self.end = low, high, start, end

    def at(self, value: float) -> float:
        return float(self.all(np.array([value]))[0])

    def all(self, values: Floats) -> Floats:
        share = (values - self.low) / (self.high - self.low)
        return np.asarray(self.start + share * (self.end - self.start))


def _panel(
    x: _Scale, top: float, line: Floats, value: Floats, reach: Floats, colour: str, name: str
) -> list[str]:
    known = np.isfinite(value) & np.isfinite(reach)
    line, value, reach = line[known], value[known], reach[known]
    if not line.size:
        return [text(x.start + 8, top + 20, f"{name}: nothing known")]
    # An interval far beyond the curve is cut off: the curve is what is to be seen.
    spread = max(float(np.ptp(value)), 0.5)
    low = max(float((value - reach).min()), float(value.min()) - spread)
    high = min(float((value + reach).max()), float(value.max()) + spread)
    ticks = nice_ticks(low, high, about=4)
    y = _Scale(ticks[0], ticks[-1], top + _PANEL, top)
    out = []
    for tick, words in zip(ticks, tick_texts(ticks), strict=True):
        at = y.at(tick)
        out.append(tag("line", x1=x.start, x2=x.end, y1=at, y2=at, class_="grid"))
        out.append(text(x.start - 7, at + 4.5, words, text_anchor="end"))
    middle = top + _PANEL / 2
    turn = f"rotate(-90 15 {number(middle)})"
    out.append(text(15, middle, name, text_anchor="middle", transform=turn, font_size=12))
    px = x.all(line)
    ends = [np.clip(value + sign * reach, ticks[0], ticks[-1]) for sign in (1.0, -1.0)]
    upper, lower = (np.stack([px, y.all(end)], axis=1) for end in ends)
    band = points(np.concatenate([upper, lower[::-1]]))
    out.append(tag("polygon", points=band, fill=colour, fill_opacity=0.22, stroke="none"))
    curve = points(np.stack([px, y.all(value)], axis=1))
    out.append(tag("polyline", points=curve, fill="none", stroke=colour, stroke_width=1.5))
    frame = f"M{number(x.start)},{number(top)}V{number(top + _PANEL)}H{number(x.end)}"
    return [*out, tag("path", d=frame, class_="axis")]


def _label_bar(x: _Scale, top: float, line: Floats, worst: NDArray[np.int64]) -> list[str]:
    out = []
    breaks = np.flatnonzero(np.diff(worst)) + 1
    half = (line[1] - line[0]) / 2 if len(line) > 1 else 0.5
    for part in np.split(np.arange(len(worst)), breaks):
        if part.size and worst[part[0]] != MEASURED:
            start, end = x.at(line[part[0]] - half), x.at(line[part[-1]] + half)
            place = {"x": start, "y": top, "width": max(end - start, 0.6), "height": 10.0}
            out.append(tag("rect", None, **place, fill=_LABEL_COLOURS[int(worst[part[0]])]))
    frame = {"x": x.start, "y": top, "width": x.end - x.start, "height": 10.0}
    return [*out, tag("rect", None, **frame, class_="axis", stroke_width=0.5)]


def _label_legend(width: float) -> list[str]:
    out, at = [], _LEFT
    shown = (("90 % interval", COLOURS[0], 0.3), ("bridged", _LABEL_COLOURS[1], 1.0))
    for words, colour, opacity in (*shown, ("unreliable", _LABEL_COLOURS[UNRELIABLE], 1.0)):
        out.append(tag("rect", x=at, y=10.0, width=22.0, height=10.0, fill=colour, fill_opacity=opacity))
        out.append(text(at + 28, 19.5, words))
        at += 48 + 7.4 * len(words)
    return [
        *out,
        text(width - _RIGHT, 19.5, "bar below: how the lines were found", text_anchor="end", class_="faint"),
    ]


def _thinned(pair: PairOffsets) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    """At most 2000 middles of lines, offsets, half intervals (n, 2): means, largest; and the worst label."""
    n = len(pair.label)
    starts = np.arange(0, n, max(1, -(-n // _MOST_POINTS)))
    if not starts.size:
        return np.empty(0), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.int64)
    count = np.diff(starts, append=n)
    values = np.stack([pair.dcol_px, pair.dline_px], axis=1)
    reach = _INTERVAL_90 * np.stack([pair.sd_col_px, pair.sd_line_px], axis=1)
    return (
        starts + count / 2.0,
        np.add.reduceat(values, starts, axis=0) / count[:, None],
        np.maximum.reduceat(reach, starts, axis=0),
        np.maximum.reduceat(pair.label.astype(np.int64), starts),
    )


def misplacement_plot(quality: StripQuality, names: Sequence[str], *, label: str) -> str | None:
    """Root mean square of every segment of every pair, and the limit; None where nothing was measured."""
    curves: list[_Curve] = []
    for k, (name, pair) in enumerate(zip(names, quality.pairs, strict=True)):
        segment: Floats = np.arange(1.0, len(pair.segments_px) + 1.0)
        stroke = {
            "stroke": _PAIR_COLOURS[k % len(_PAIR_COLOURS)],
            "stroke_dasharray": DASHES[k % len(DASHES)],
        }
        curves.append((name, segment, pair.segments_px, stroke))
    if not any(np.isfinite(y).any() for _, _, y, _ in curves):
        return None
    ticks = nice_ticks(0.0, max(float(len(p.segments_px)) for p in quality.pairs), least_step=1.0)
    limit = np.array([LIMIT_PX, LIMIT_PX])
    stroke = {"stroke": COLOURS[1], "stroke_width": "2.5"}
    curves.append((f"limit, {LIMIT_PX:g} px", np.array([ticks[0], ticks[-1]]), limit, stroke))
    x = list(zip(ticks, tick_texts(ticks), strict=True))
    return _powers_plot(curves, x, ("segment of 512 lines", "misplacement [px]"), label, marks=True)


def spectrum_plot(found: Spectrum, left: Spectrum, *, label: str) -> str | None:
    """Amplitudes over frequency, both logarithmic; None where there are none."""
    curves: list[_Curve] = []
    for k, (name, spectrum) in enumerate((("found", found), ("left", left))):
        for dash, (way, amplitude) in enumerate(
            (("along", spectrum.along_px), ("across", spectrum.across_px))
        ):
            hz, peaks = _peaks(spectrum.frequency_hz, amplitude)
            stroke = {"stroke": COLOURS[k], "stroke_dasharray": DASHES[2 * dash]}
            curves.append((f"{name}, {way}", np.asarray(np.log10(hz)), peaks, stroke))
    highest = max((float(x.max()) for _, x, _, _ in curves if x.size), default=None)
    if highest is None:
        return None
    hertz = (_LEAST_HZ, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
    # To the first tick at or beyond the highest frequency.
    below = [v for v in hertz if np.log10(v) < highest - 1e-3]
    x = [(float(np.log10(v)), f"{v:g}") for v in hertz[: len(below) + 1]]
    return _powers_plot(curves, x, ("frequency [Hz]", "amplitude [px]"), label)


def _powers_plot(
    curves: Sequence[_Curve],
    x_ticks: Sequence[tuple[float, str]],
    axes: tuple[str, str],
    label: str,
    marks: bool = False,
) -> str:
    """Curves (name, x, y, stroke) over an axis of powers of ten, four decades at most; NaN breaks a curve."""
    width, height, top, foot = 720.0, 340.0, 34.0, 294.0
    values = np.concatenate([y for _, _, y, _ in curves])
    values = values[np.isfinite(values) & (values > 0.0)]
    high = int(np.ceil(np.log10(values.max(initial=1e-3)) - 1e-9))
    low = max(high - 4, min(high - 1, int(np.floor(np.log10(values.min(initial=10.0**high))))))
    x = _Scale(x_ticks[0][0], x_ticks[-1][0], _LEFT, width - _RIGHT)
    y = _Scale(float(low), float(high), foot, top)
    out = []
    for value, words in x_ticks:
        at = x.at(value)
        out.append(tag("line", x1=at, x2=at, y1=top, y2=foot, class_="grid"))
        out.append(text(at, foot + 17, words, text_anchor="middle"))
    for power in range(low, high + 1):
        at = y.at(float(power))
        out.append(tag("line", x1=_LEFT, x2=width - _RIGHT, y1=at, y2=at, class_="grid"))
        out.append(text(_LEFT - 7, at + 4.5, f"{10.0**power:g}", text_anchor="end"))
    middle = (top + foot) / 2
    turn = f"rotate(-90 15 {number(middle)})"
    out.append(text((x.start + x.end) / 2, height - 8, axes[0], text_anchor="middle"))
    out.append(text(15, middle, axes[1], text_anchor="middle", transform=turn))
    at = _LEFT
    for name, across, up, given in curves:
        stroke = {"stroke_width": "1.6"} | given
        if at < width - 60:
            out.append(tag("line", None, x1=at, x2=at + 24, y1=16.0, y2=16.0, **stroke))
            out.append(text(at + 30, 20.5, name))
            at += 44 + 7.0 * len(name)
        known = np.isfinite(up)
        placed = np.stack(
            [x.all(across), y.all(np.clip(np.log10(np.where(known, np.maximum(up, 1e-12), 1.0)), low, high))]
        )
        breaks = np.flatnonzero(np.diff(known.astype(np.int8))) + 1
        for part in np.split(np.arange(len(known)), breaks):
            if part.size and known[part[0]]:
                line = points(placed[:, part].T)
                out.append(tag("polyline", None, points=line, fill="none", **stroke))
        if marks and len(known) > 2 and known.sum() <= 400:
            dots = placed[:, known].T
            out += [tag("circle", cx=float(a), cy=float(b), r=2.0, fill=given["stroke"]) for a, b in dots]
    frame = f"M{number(_LEFT)},{number(top)}V{number(foot)}H{number(width - _RIGHT)}"
    return document(width, height, [*out, tag("path", d=frame, class_="axis")], label)


def _peaks(frequency_hz: Floats, amplitude_px: Floats) -> tuple[Floats, Floats]:
    """The largest amplitude within each of 300 equal steps of the logarithm of frequency."""
    kept = frequency_hz >= _LEAST_HZ
    frequency_hz, amplitude_px = frequency_hz[kept], amplitude_px[kept]
    if not frequency_hz.size:
        return frequency_hz, amplitude_px
    step = np.log(frequency_hz[-1] / _LEAST_HZ) / _SPECTRUM_BINS + 1e-12
    bins = np.floor(np.log(frequency_hz / _LEAST_HZ) / step).astype(np.int64)
    starts = np.flatnonzero(np.diff(bins, prepend=-1))
    groups = zip(starts, [*starts[1:], len(bins)], strict=True)
    best = [start + int(np.argmax(amplitude_px[start:end])) for start, end in groups]
    return frequency_hz[best], amplitude_px[best]
