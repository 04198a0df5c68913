"""Maps as SVG text: vectors with their scale, and the graph of tied frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from geomosaic.report.svg import COLOURS, document, nice_ticks, number, points, tag, text

Floats = NDArray[np.float64]

_MARGIN, _FOOT = 40.0, 34.0


class MapArea:
    """Map metres to image: one scale for both axes, north up."""

    def __init__(self, at_m: Floats, width: float) -> None:
        seen = at_m[np.isfinite(at_m).all(axis=1)]
        low, high = (seen.min(axis=0), seen.max(axis=0)) if len(seen) else (np.zeros(2), np.ones(2))
        span = np.maximum(high - low, 1e-3)
        inner = width - 2 * _MARGIN
        self.px_per_m = float(min(inner / span[0], 560.0 / span[1]))
        drawn = np.maximum(span * self.px_per_m, [0.0, 60.0])
        self.width, self.height = width, float(drawn[1]) + 2 * _MARGIN + _FOOT
        self._west = float(low[0] - (inner / self.px_per_m - span[0]) / 2)
        self._north = float(high[1] + (drawn[1] / self.px_per_m - span[1]) / 2)

    def at(self, m: Floats) -> Floats:
        """(..., 2) east and north to x and y."""
        return np.asarray(_MARGIN + (m - [self._west, self._north]) * [self.px_per_m, -self.px_per_m])

    def foot(self) -> list[str]:
        """A scale bar with its length, and north."""
        longest = 170.0 / self.px_per_m
        metres = max(t for t in nice_ticks(0.0, longest, 4) if t <= longest)
        x, y = _MARGIN, self.height - 24
        words = f"{metres / 1000:g} km" if metres >= 1000 else f"{metres:g} m"
        return [
            tag(
                "path", d=f"M{number(x)},{number(y - 5)}v5h{number(metres * self.px_per_m)}v-5", class_="axis"
            ),
            text(x, y + 17, f"map: {words}"),
            tag("path", d=f"M{number(x + 190)},{number(y - 12)}l-5,14h10z", fill="currentColor"),
            text(x + 190, y + 17, "N", text_anchor="middle"),
        ]


def vector_map(
    at_m: Floats,
    vector_m: Floats,
    *,
    unit: str = "m",
    unit_per_m: float = 1.0,
    label: str,
    outlines_m: Sequence[Floats] = (),
    weak: NDArray[np.bool_] | None = None,
    width: float = 720,
    most: int = 1500,
) -> str:
    """Arrows on a map, drawn larger than life by the factor the legend's arrow stands for.

    Args: at_m (n, 2) easting and northing, vector_m (n, 2); unit and unit_per_m of the legend (`px` and
    1 / gsd for pixels); outlines_m polygons (k, 2) drawn below; weak (n,) arrows in the second colour.
    More than `most` vectors are thinned evenly; the label in the image says so.
    """
    good = np.isfinite(at_m).all(axis=1) & np.isfinite(vector_m).all(axis=1)
    second = (np.zeros(len(at_m), dtype=bool) if weak is None else weak)[good]
    at, vector = at_m[good], vector_m[good]
    area = MapArea(np.concatenate([at, *outlines_m]) if len(at) or outlines_m else np.zeros((1, 2)), width)
    keep = np.arange(len(at))[:: max(1, -(-len(at) // most))]
    length = np.linalg.norm(vector, axis=1)
    typical = float(np.quantile(length, 0.95)) * unit_per_m if len(at) else 0.0
    px_per_unit = arrow_px(area.at(at[keep])) / typical if typical > 0.0 else 1.0
    legend = max((t for t in nice_ticks(0.0, typical, 4) if t <= typical), default=0.0) or 1.0
    out = [
        tag("polygon", points=points(area.at(o)), fill="none", stroke="currentColor", stroke_opacity=0.25)
        for o in outlines_m
    ]
    tips = vector * [unit_per_m * px_per_unit, -unit_per_m * px_per_unit]
    for i in keep:
        out.append(arrow(area.at(at[i]), tips[i], COLOURS[1] if second[i] else COLOURS[0]))
    x, y = width / 2, area.height - 24
    factor = px_per_unit * unit_per_m / area.px_per_m
    words = f"arrow: {legend:g} {unit} (drawn {factor:,.0f} times larger)"
    if len(keep) < len(at):
        words += f", {len(keep)} of {len(at)} shown"
    out += [arrow(np.array([x, y - 3.0]), np.array([legend * px_per_unit, 0.0]), COLOURS[0])]
    out.append(text(x, y + 17, words))
    return document(width, area.height, [*out, *area.foot()], label)


def arrow_px(at: Floats) -> float:
    """How long a long arrow may be: the usual distance to the next one, within bounds."""
    if len(at) < 2:
        return 48.0
    return float(np.clip(np.median(cKDTree(at).query(at, k=2)[0][:, 1]), 14.0, 48.0))


def arrow(start: Floats, vector: Floats, colour: str) -> str:
    """From a dot at `start` (2,) along `vector` (2,), both in the image; a mere dot if too short to see."""
    length = float(np.hypot(*vector))
    if length < 1.0:
        return tag("circle", cx=float(start[0]), cy=float(start[1]), r=1.5, fill=colour)
    end, along = start + vector, vector / length
    head = min(6.0, 0.45 * length)
    side = np.array([-along[1], along[0]]) * head * 0.5
    a, b = end - along * head + side, end - along * head - side
    path = f"M{points([start])}L{points([end])}M{points([a])}L{points([end])}L{points([b])}"
    dot = tag("circle", cx=float(start[0]), cy=float(start[1]), r=1.6, fill=colour)
    return dot + tag("path", d=path, fill="none", stroke=colour, stroke_width=1.4)


def network_map(
    at_m: Floats,
    edges: NDArray[np.int64],
    weights: Floats,
    *,
    label: str,
    what: str,
    dashed: NDArray[np.int64] | None = None,
    names: Sequence[str] = (),
    marked: NDArray[np.bool_] | None = None,
    width: float = 720,
    most: int = 4000,
) -> str:
    """Frames as dots on a map, tied pairs as lines that thicken with their weight.

    Args: at_m (n, 2); edges (k, 2) indices; weights (k,) of which `what` says what it is; dashed (m, 2)
    pairs tried in vain; names beside the dots where there are at most 40; marked (n,) dots to stand out.
    """
    area = MapArea(at_m, width)
    at = area.at(at_m)
    heavy = float(np.max(weights)) if len(weights) else 1.0
    order = np.argsort(weights)[max(0, len(weights) - most) :]
    out = []
    for a, b in () if dashed is None else dashed[:most]:
        path = f"M{points([at[a]])}L{points([at[b]])}"
        out.append(
            tag("path", d=path, stroke=COLOURS[1], stroke_width=1, stroke_dasharray="3 4", fill="none")
        )
    for i in order:
        a, b = edges[i]
        path = f"M{points([at[a]])}L{points([at[b]])}"
        thick = 0.8 + 4.0 * float(np.sqrt(weights[i] / heavy))
        out.append(
            tag("path", d=path, stroke=COLOURS[0], stroke_width=thick, stroke_opacity=0.55, fill="none")
        )
    radius = 4.5 if len(at) <= 150 else 2.5
    for i, (x, y) in enumerate(at):
        special = marked is not None and marked[i]
        fill = COLOURS[1] if special else "currentColor"
        out.append(tag("circle", cx=float(x), cy=float(y), r=radius * (1.4 if special else 1.0), fill=fill))
    if len(names) <= 40:
        shown = _ends(names)
        out += [text(x + 7, y - 6, n, font_size=11) for (x, y), n in zip(at, shown, strict=False)]
    words = f"thickest line: {heavy:,.0f} {what}" if len(weights) else f"no {what}"
    if dashed is not None and len(dashed):
        words += "; dashed: tried in vain"
    out.append(text(width / 2, area.height - 7, words))
    return document(width, area.height, [*out, *area.foot()], label)


def _ends(names: Sequence[str]) -> list[str]:
    """The part of each name that sets it apart: without suffix and common beginning, 12 letters at most."""
    stems = [n.rsplit(".", 1)[0] for n in names]
    common = 0
    while len(stems) > 1 and all(len(s) > common + 1 and s[common] == stems[0][common] for s in stems):
        common += 1
    return [s[common:][-12:] for s in stems]
