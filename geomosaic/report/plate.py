"""The map on paper: the mosaic with control and check points, their arrows, names and a scale, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from geomosaic.arrays import Floats
from geomosaic.report.control import MappedPoints
from geomosaic.report.control_layers import MARKS, ArrowScale
from geomosaic.report.glance import Glance
from geomosaic.report.layers import arrows
from geomosaic.report.numbers import short, whole
from geomosaic.report.svg import document, points, tag, text

Box = tuple[float, float, float, float]
IMAGE: Final = "plate-image"
"""Id of the image, which the page's script fills with the mosaic that the page has already."""
_SIDE: Final = 1000.0
_NARROWEST: Final = 720.0
_TEXT: Final = 15.0
_MARK: Final = 9.0
_NAME: Final = 12.5
_MOST_NAMES: Final = 60
_OFF: Final = (14.0, 28.0, -28.0, 42.0, -42.0)
"""How far below its point a name may stand; beyond the first, names of blunders alone."""
_HALO: Final = {"stroke": "#fff", "stroke_linejoin": "round", "stroke_linecap": "round"}


def plate(image: Glance, kinds: Sequence[MappedPoints], scale: ArrowScale, on_earth: bool) -> str:
    """The mosaic, 1000 units long, with points and legend; the image itself is left to the page's script.
    on_earth: whether its lengths are metres, and north is up."""
    shrink = _SIDE / max(image.width_px, image.height_px)
    wide, high = image.width_px * shrink, image.height_px * shrink
    left = max(0.0, (_NARROWEST - wide) / 2.0)
    unit_m = float(1.0 / (np.sqrt(abs(np.linalg.det(image.px_from_map[:, :2]))) * shrink))

    def at(map_m: Floats) -> Floats:
        return np.asarray(image.at(map_m) * shrink + [left, 0.0])

    out = [tag("image", None, id=IMAGE, x=left, y=0.0, width=wide, height=high)]
    shafts = []
    for kind in kinds:
        lines = [at(np.reshape(line, (-1, 2))) for line in _lines(kind, scale)]
        out += [_arrow(line, MARKS[kind.layer][1]) for line in lines]
        shafts += [np.linspace(line[0], line[1], 12) for line in lines]
    for kind in kinds:
        places = at(kind.at_m)
        out += [mark(kind.layer, x, y, wrong) for (x, y), wrong in zip(places, kind.blunders, strict=True)]
    out += _names(kinds, [at(kind.at_m) for kind in kinds], shafts, (left, 0.0, left + wide, high))
    measures = _measures(scale if kinds else None, unit_m, high) if on_earth else []
    foot = [*measures, *_legend(kinds, high)]
    height = high + 40.0 + 30.0 * bool(kinds)
    return document(max(wide, _NARROWEST), height, [*out, *foot], "the mosaic with its control points")


def mark(layer: str, x: float, y: float, wrong: bool = False) -> str:
    """A point's symbol: triangle or square, crossed out where it is a blunder."""
    kind, colour = MARKS[layer]
    r = _MARK
    triangle = [[x, y - r], [x + r, y + 0.8 * r], [x - r, y + 0.8 * r]]
    square = [[x - 0.8 * r, y - 0.8 * r], [x + 0.8 * r, y - 0.8 * r], [x + 0.8 * r, y + 0.8 * r]]
    square.append([x - 0.8 * r, y + 0.8 * r])
    shape = points(triangle if kind == "triangle" else square)
    out = tag("polygon", None, points=shape, fill=colour, stroke="#fff", stroke_width=1.6)
    if wrong:
        cross = f"M{x - 1.3 * r:.1f},{y - 1.3 * r:.1f}l{2.6 * r:.1f},{2.6 * r:.1f}"
        cross += f"M{x + 1.3 * r:.1f},{y - 1.3 * r:.1f}l{-2.6 * r:.1f},{2.6 * r:.1f}"
        out += tag("path", None, d=cross, fill="none", **{**_HALO, "stroke_width": 4})
        out += tag("path", None, d=cross, fill="none", **{**_HALO, "stroke": "#111", "stroke_width": 1.8})
    return out


def _lines(kind: MappedPoints, scale: ArrowScale) -> list[list[float]]:
    return arrows(kind.at_m, scale.drawn(kind.residual_m), scale.factor, np.zeros(2), scale.head_m)


def _arrow(line: Floats, colour: str) -> str:
    """A line (k, 2) with a light border, to be seen on any ground."""
    shape = points(line)
    wide = tag("polyline", None, points=shape, fill="none", stroke_width=6, **_HALO)
    return wide + tag(
        "polyline", None, points=shape, fill="none", **{**_HALO, "stroke": colour, "stroke_width": 2.6}
    )


def _names(
    kinds: Sequence[MappedPoints], drawn: Sequence[Floats], shafts: Sequence[Floats], within: Box
) -> list[str]:
    """Names next to their points where there is room for them: the table has all.

    Args: drawn: places of each kind's points (n, 2); shafts: places along arrows (k, 2).
    """
    taken = [_about(x, y, _MARK) for of_kind in drawn for x, y in of_kind]
    taken += [_about(x, y, 3.0) for shaft in shafts for x, y in shaft]
    out: list[str] = []
    named: list[tuple[str, Floats, bool]] = []
    for kind, places in zip(kinds, drawn, strict=True):
        named += zip(kind.names, places, kind.blunders.tolist(), strict=True)
    for name, (x, y), wrong in sorted(named, key=lambda each: not each[2])[:_MOST_NAMES]:
        wide = 0.68 * _NAME * len(name)
        right, left, middle = x + 12.0, x - 12.0 - wide, x - wide / 2.0
        starts = [(right, y), (left, y), (middle, y + 18.0), (middle, y - 18.0)]
        starts += [(side, y + off) for off in _OFF[: None if wrong else 1] for side in (right, left)]
        for x0, y0 in starts:
            box = (x0, y0 - 0.6 * _NAME, x0 + wide, y0 + 0.6 * _NAME)
            inside = box[0] > within[0] and box[2] < within[2] and box[1] > within[1] and box[3] < within[3]
            if inside and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                halo = "paint-order:stroke;stroke:#fff;stroke-width:3.5px;fill:#111"
                out.append(text(x0, y0 + 0.35 * _NAME, name, font_size=_NAME, font_weight=600, style=halo))
                break
    return out


def _about(x: float, y: float, half: float) -> Box:
    return x - half, y - half, x + half, y + half


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _measures(scale: ArrowScale | None, unit_m: float, top: float) -> list[str]:
    """A bar of the map's scale, and an arrow of the residuals'."""
    y = top + 24.0
    bar_m = _round_below(180.0 * unit_m)
    long = bar_m / unit_m
    out = [
        tag("path", None, d=f"M1,{y - 6:.1f}v6h{long:.1f}v-6", fill="none", stroke="#111", stroke_width=2),
        text(long + 10.0, y + 2.0, f"{short(bar_m, 'm')}, north is up", font_size=_TEXT),
    ]
    if scale is not None:
        residual_m = _round_below(120.0 * unit_m / scale.factor)
        long, x = residual_m * scale.factor / unit_m, _NARROWEST / 2.0
        line = np.array(arrows(np.array([[x, y - 4.0]]), np.array([[long, 0.0]]), 1.0, np.zeros(2), 22.0)[0])
        larger = f"{100.0 * residual_m:g} cm: residuals are drawn {whole(scale.factor)} times larger"
        out += [_arrow(line.reshape(-1, 2), "#111"), text(x + long + 10.0, y + 2.0, larger, font_size=_TEXT)]
    return out


def _legend(kinds: Sequence[MappedPoints], top: float) -> list[str]:
    y, x, out = top + 54.0, 10.0, []
    for kind in kinds:
        out += [mark(kind.layer, x, y - 5.0), text(x + 18.0, y, kind.title.lower(), font_size=_TEXT)]
        x += 160.0
    if any(kind.blunders.any() for kind in kinds):
        out += [mark(kinds[0].layer, x, y - 5.0, True), text(x + 20.0, y, "blunder", font_size=_TEXT)]
        x += 120.0
    return (
        [*out, text(x, y, "arrow: from the map to where it was surveyed", font_size=_TEXT)] if kinds else out
    )


def _round_below(value: float) -> float:
    """1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= value * 1.0001))
