"""Images of what was solved as SVG text: correlations, residuals over an image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from geomosaic.arrays import Floats
from geomosaic.report.numbers import short
from geomosaic.report.svg import COLOURS, document, nice_ticks, number, points, tag, text

_MOST_UNKNOWNS = 40


def correlation_map(names: Sequence[str], correlation: Floats, *, label: str, width: float = 720) -> str:
    """A square of cells: blue for negative, orange for positive, the fuller the stronger.

    Of more than 40 names the first 40, as the image says.
    """
    n = min(len(names), _MOST_UNKNOWNS)
    left = 50.0 + 7.0 * max((len(name) for name in names[:n]), default=0)
    cell = float(np.clip((width - left - 20.0) / max(n, 1), 12.0, 38.0))
    out = []
    for i in range(n):
        y = 24.0 + cell * i
        out.append(text(left - 34, y + cell / 2 + 4.5, names[i], text_anchor="end"))
        out.append(text(left - 8, y + cell / 2 + 4.5, str(i + 1), text_anchor="end"))
        out.append(text(left + cell * (i + 0.5), 16, str(i + 1), text_anchor="middle"))
        for j in range(n):
            r = float(np.nan_to_num(correlation[i, j]))
            x = left + cell * j
            title = tag("title", f"{i + 1}, {j + 1}: {r:+.2f}")
            fill = COLOURS[1] if r > 0.0 else COLOURS[0]
            place = {"x": x + 0.5, "y": y + 0.5, "width": cell - 1.0, "height": cell - 1.0}
            out.append(tag("rect", None, **place, fill="currentColor", fill_opacity=0.05))
            out.append(tag("rect", title, **place, fill=fill, fill_opacity=round(abs(r), 3)))
            if cell >= 30.0 and i != j and abs(r) >= 0.005:
                ink = "fill:#fff" if abs(r) > 0.6 else None
                digits = f"{r:.2f}".replace("0.", ".")
                out.append(
                    text(
                        x + cell / 2,
                        y + cell / 2 + 4.0,
                        digits,
                        text_anchor="middle",
                        font_size=11,
                        style=ink,
                    )
                )
    words = "blue: negative, orange: positive; full colour: 1"
    if n < len(names):
        words += f"; the first {n} of {len(names)}"
    height = 24.0 + cell * n + 26.0
    return document(width, height, [*out, text(left, height - 8, words)], label)


def image_vectors(
    size_px: tuple[int, int],
    arrows_px: Floats,
    *,
    label: str,
    principal_px: tuple[float, float] | None = None,
    scatter_px: float = np.nan,
) -> str:
    """Arrows over an image, its top up, with the principal point as a cross.

    Args: size_px width and height; arrows_px (k, 4): cols and rows, and the vectors there; scatter_px: the
    usual length of an arrow by chance, drawn as a bar.
    """
    width, at_px, vector_px = 720, arrows_px[:, :2], arrows_px[:, 2:]
    cols, rows = size_px
    scale = min((width - 40.0) / cols, 480.0 / rows)
    left, top = (width - scale * cols) / 2, 22.0
    foot = top + scale * rows + 34.0
    start = at_px * scale + [left, top]
    length = np.linalg.norm(vector_px, axis=1)
    typical = float(np.quantile(length, 0.95)) if len(length) else 0.0
    longest = max(typical, scatter_px if np.isfinite(scatter_px) else 0.0)
    px_per_unit = arrow_px(start) / longest if longest > 0.0 else 1.0
    legend = max((t for t in nice_ticks(0.0, longest, 4) if t <= longest), default=0.0) or 1.0
    frame = {"x": left, "y": top, "width": scale * cols, "height": scale * rows}
    out = [tag("rect", None, **frame, class_="axis")]
    out += [arrow(a, v * px_per_unit, COLOURS[0]) for a, v in zip(start, vector_px, strict=True)]
    out.append(arrow(np.array([left, foot]), np.array([legend * px_per_unit, 0.0]), COLOURS[0]))
    factor = px_per_unit / scale
    words = f"arrow: {legend:g} px (drawn {short(factor)} times larger)"
    if principal_px is not None:
        col, row = principal_px[0] * scale + left, principal_px[1] * scale + top
        cross = f"M{number(col - 7)},{number(row)}h14M{number(col)},{number(row - 7)}v14"
        out.append(tag("path", d=cross, class_="axis"))
        words += "; cross: principal point"
    out.append(text(left, foot + 20, words))
    if np.isfinite(scatter_px):
        long, right = scatter_px * px_per_unit, left + scale * cols
        bar = f"M{number(right - long)},{number(foot - 4)}v8m0,-4h{number(long)}m0,-4v8"
        out.append(tag("path", d=bar, class_="axis"))
        out.append(text(right, foot + 20, f"by chance: {short(scatter_px, 'px')}", text_anchor="end"))
    return document(width, foot + 30.0, out, label)


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
