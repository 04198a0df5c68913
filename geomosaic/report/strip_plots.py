"""Plots of a scene of CCD strips as SVG text: offsets along the lines, misplacement, spectra."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from geomosaic.arrays import Floats, Ints64
from geomosaic.ccd.model import MEASURED, UNRELIABLE, PairOffsets
from geomosaic.quality.figures import interval_of
from geomosaic.quality.jitter import Spectrum
from geomosaic.quality.strip_figures import LIMIT_PX, SEGMENT_LINES
from geomosaic.quality.strips import StripQuality
from geomosaic.report.plots import LEFT, RIGHT, Axis, PlotFrame, Scale, Series, line_plot
from geomosaic.report.svg import COLOURS, DASHES, document, nice_ticks, points, tag, text

_MOST_POINTS = 2000
_TOP, _PANEL, _GAP, _BOTTOM = 30.0, 112.0, 14.0, 62.0
_LABEL_COLOURS = {1: COLOURS[4], 2: COLOURS[1]}
_PAIR_COLOURS = (COLOURS[0], COLOURS[2], COLOURS[3], COLOURS[4], COLOURS[5], COLOURS[6])
_LEAST_HZ = 0.2
_SPECTRUM_BINS = 300


def offsets_plot(pair: PairOffsets, *, label: str, width: float = 720) -> str:
    """dcol and dline over the lines, each with its 90 % interval; a bar shows what wasn't measured."""
    line, values, reach, worst = _thinned(pair)
    height = _TOP + 2 * _PANEL + _GAP + _BOTTOM
    ticks = nice_ticks(0.0, float(max(len(pair.label), 1)))
    x = Scale(ticks, LEFT, width - RIGHT)
    foot = _TOP + 2 * _PANEL + _GAP
    out = PlotFrame(x, Scale([0.0, 1.0], foot, _TOP)).x_grid("line of the left strip", height - 8, below=34.0)
    for k, name in enumerate(("across (dcol) [px]", "along (dline) [px]")):
        curve = Series(name, line, values[:, k], colour=COLOURS[2 * k])
        out += _panel(x, _TOP + k * (_PANEL + _GAP), curve, reach[:, k])
    out += _label_bar(x, foot + 6, line, worst)
    out += _label_legend(width)
    return document(width, height, out, label)


def _panel(x: Scale, top: float, series: Series, reach: Floats) -> list[str]:
    name, colour = series.name, series.colour
    line, value = np.asarray(series.x), np.asarray(series.y)
    known = np.isfinite(value) & np.isfinite(reach)
    line, value, reach = line[known], value[known], reach[known]
    if not line.size:
        return [text(x.start + 8, top + 20, f"{name}: nothing known")]
    # An interval far beyond the curve is cut off: the curve is what is to be seen.
    spread = max(float(np.ptp(value)), 0.5)
    low = max(float((value - reach).min()), float(value.min()) - spread)
    high = min(float((value + reach).max()), float(value.max()) + spread)
    ticks = nice_ticks(low, high, about=4)
    frame = PlotFrame(x, Scale(ticks, top + _PANEL, top))
    out = frame.y_grid(name, font_size=12)
    ends = [np.clip(value + sign * reach, ticks[0], ticks[-1]) for sign in (1.0, -1.0)]
    upper, lower = (frame.at(line, end) for end in ends)
    band = points(np.concatenate([upper, lower[::-1]]))
    out.append(tag("polygon", points=band, fill=colour, fill_opacity=0.22, stroke="none"))
    curve = points(frame.at(line, value))
    out.append(tag("polyline", points=curve, fill="none", stroke=colour, stroke_width=1.5))
    return [*out, frame.box()]


def _label_bar(x: Scale, top: float, line: Floats, worst: Ints64) -> list[str]:
    out = []
    breaks = np.flatnonzero(np.diff(worst)) + 1
    half = (line[1] - line[0]) / 2 if len(line) > 1 else 0.5
    for part in np.split(np.arange(len(worst)), breaks):
        if part.size and worst[part[0]] != MEASURED:
            start, end = x.at([line[part[0]] - half, line[part[-1]] + half]).tolist()
            place = {"x": start, "y": top, "width": max(end - start, 0.6), "height": 10.0}
            out.append(tag("rect", None, **place, fill=_LABEL_COLOURS[int(worst[part[0]])]))
    frame = {"x": x.start, "y": top, "width": x.end - x.start, "height": 10.0}
    return [*out, tag("rect", None, **frame, class_="axis", stroke_width=0.5)]


def _label_legend(width: float) -> list[str]:
    out, at = [], LEFT
    shown = (("90 % interval", COLOURS[0], 0.3), ("bridged", _LABEL_COLOURS[1], 1.0))
    for words, colour, opacity in (*shown, ("unreliable", _LABEL_COLOURS[UNRELIABLE], 1.0)):
        out.append(tag("rect", x=at, y=10.0, width=22.0, height=10.0, fill=colour, fill_opacity=opacity))
        out.append(text(at + 28, 19.5, words))
        at += 48 + 7.4 * len(words)
    return [
        *out,
        text(width - RIGHT, 19.5, "bar below: how the lines were found", text_anchor="end", class_="faint"),
    ]


def _thinned(pair: PairOffsets) -> tuple[Floats, Floats, Floats, Ints64]:
    """At most 2000 middles of lines, offsets, half intervals (n, 2): means, largest; and the worst label."""
    n = len(pair.label)
    starts = np.arange(0, n, max(1, -(-n // _MOST_POINTS)))
    if not starts.size:
        return np.empty(0), np.empty((0, 2)), np.empty((0, 2)), np.empty(0, dtype=np.int64)
    count = np.diff(starts, append=n)
    values = np.stack([pair.dcol_px, pair.dline_px], axis=1)
    reach = interval_of(0.9) * np.stack([pair.sd_col_px, pair.sd_line_px], axis=1)
    return (
        starts + count / 2.0,
        np.add.reduceat(values, starts, axis=0) / count[:, None],
        np.maximum.reduceat(reach, starts, axis=0),
        np.maximum.reduceat(pair.label.astype(np.int64), starts),
    )


def misplacement_plot(quality: StripQuality, names: Sequence[str], *, label: str) -> str | None:
    """Root mean square of every segment of every pair, and the limit; None where nothing was measured."""
    if not any(np.isfinite(p.segments_px).any() for p in quality.pairs):
        return None
    curves = [
        Series(
            name,
            np.arange(1.0, len(pair.segments_px) + 1.0),
            pair.segments_px,
            marks=len(pair.segments_px) > 2,
            colour=_PAIR_COLOURS[k % len(_PAIR_COLOURS)],
            dash=DASHES[k % len(DASHES)],
            thick=1.6,
        )
        for k, (name, pair) in enumerate(zip(names, quality.pairs, strict=True))
    ]
    last = float(max(len(p.segments_px) for p in quality.pairs))
    limit = Series(
        f"limit, {LIMIT_PX:g} px", [0.0, last], [LIMIT_PX] * 2, marks=False, colour=COLOURS[1], dash=""
    )
    x = Axis(f"segment of {SEGMENT_LINES} lines", low=0.0, high=last, whole=True)
    return line_plot([*curves, limit], x, Axis("misplacement", "px", powers=True), label=label)


def spectrum_plot(found: Spectrum, left: Spectrum, *, label: str) -> str | None:
    """Amplitudes over frequency, both logarithmic; None where there are none."""
    curves = [
        Series(
            f"{name}, {way}",
            *_peaks(spectrum.frequency_hz, amplitude),
            marks=False,
            colour=COLOURS[k],
            dash=dash,
            thick=1.6,
        )
        for k, (name, spectrum) in enumerate((("found", found), ("left", left)))
        for dash, way, amplitude in (
            ("", "along", spectrum.along_px),
            (DASHES[2], "across", spectrum.across_px),
        )
    ]
    if not any(np.size(c.x) for c in curves):
        return None
    x = Axis("frequency", "Hz", low=_LEAST_HZ, powers=True)
    return line_plot(curves, x, Axis("amplitude", "px", powers=True), label=label)


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
