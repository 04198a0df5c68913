"""Images of a scene of CCD strips: the whole at reduced size, and its seams at 100 %."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from geomosaic.arrays import Bools, Floats
from geomosaic.ccd.model import MEASURED, PairOffsets
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.quality.strip_figures import LIMIT_PX, SEGMENT_LINES, common_lines
from geomosaic.quality.strips import BLOCK_LINES, PairQuality, StripQuality
from geomosaic.report.glance import Glance, glance, stretched, webp
from geomosaic.report.layers import MapLayer
from geomosaic.report.numbers import short
from geomosaic.report.svg import COLOURS, number, tag
from geomosaic.survey.strips import StripGeometry

CROP_PX = (300, 220)
_TICK_PX = 9
_LEAST_HALF_PX = 4.0
"""Of an overlap on the map, so that it can be clicked."""


@dataclass(frozen=True)
class Place:
    """A place on a seam: why it is shown, the left strip's line, what is left there (NaN: not measured)."""

    why: str
    line: int
    left_px: float


def scene_glance(path: Path) -> Glance:
    """The reduced scene; that it has no map coordinates of its own is no cause for a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        return glance(path)


def scene_row(geometry: StripGeometry, pair: int, line: float, first_line: float) -> float:
    """The raster's row where a line of the pair's left strip lies, nominally."""
    return line + geometry.side(pair) * geometry.row_separation_lines / 2.0 - first_line


def seam_col(geometry: StripGeometry, pair: int) -> float:
    """The raster's col of a pair's seam, the middle of the overlap."""
    return (pair + 1) * (geometry.width_px - geometry.overlap_px) + 0.5 * geometry.overlap_px


def scene_layers(
    geometry: StripGeometry, quality: StripQuality, high_px: int, first_line: float
) -> list[MapLayer]:
    """The map's layers: overlaps by pair, seams, segments above the limit, and the CCDs' numbers.

    Places are in cols and, upwards, minus rows of the scene. high_px: its lines.
    """
    half = max(geometry.overlap_px / 2.0, _LEAST_HALF_PX)
    overlaps, seams, odd, misplacements, of = [], [], [], [], []
    for k, pair in enumerate(quality.pairs):
        col = seam_col(geometry, pair.pair)
        overlaps.append(_rectangle(col - half, 0.0, col + half, float(high_px)))
        seams.append([col, 0.0, col, -float(high_px)])
        for segment, value in enumerate(pair.segments_px):
            if value > LIMIT_PX:
                ends = segment * SEGMENT_LINES, min((segment + 1) * SEGMENT_LINES, pair.lines)
                top, bottom = (scene_row(geometry, pair.pair, end, first_line) for end in ends)
                odd.append(_rectangle(col - half, top, col + half, bottom))
                misplacements.append(f"lines {ends[0]} to {ends[1] - 1}: {short(float(value), 'px', 2)}")
                of.append(k)
    step = geometry.width_px - geometry.overlap_px
    middles = [k * step + geometry.width_px / 2 for k in range(len(geometry.lines))]
    dead = [k for k, lines in enumerate(geometry.lines) if not lines]
    return [
        MapLayer(
            "overlaps", "Overlaps", "#00b4d8", areas=overlaps, rows=list(range(len(overlaps))), weight=1.0,
            fill=0.08,
        ),
        MapLayer("seams", "Seams", "#ffe100", lines=seams, weight=1.2, dash="6 5", shown=True),
        MapLayer(
            "misplaced", "Misplaced segments", "#ff7a1a", areas=odd, rows=of, labels=misplacements, fill=0.5,
            shown=True,
            note=f"off by more than {LIMIT_PX:g} px",
        ),
        MapLayer(
            "ccds", "CCDs", "#ffffff", points=[[x, -0.02 * high_px] for x in middles], odd=dead,
            permanent=True,
            labels=[str(k + 1) for k in range(len(middles))], shown=True, note="orange: dead",
        ),
    ]  # fmt: skip


def _rectangle(left: float, top: float, right: float, bottom: float) -> list[float]:
    return [left, -top, right, -top, right, -bottom, left, -bottom]


def seam_places(geometry: StripGeometry, quality: PairQuality, offsets: PairOffsets) -> list[Place]:
    """Where to look at a seam: the worst block, a typical one, and the longest stretch not measured."""
    length = np.hypot(*quality.residual_px.T)
    known = np.flatnonzero(np.isfinite(length) & (quality.counts > 0.5 * BLOCK_LINES))
    out = []
    if known.size:
        order = known[np.argsort(length[known], kind="stable")]
        for why, block in (("worst", order[-1]), ("typical", order[len(order) // 2])):
            out.append(Place(why, int(quality.centre_lines[block]), float(length[block])))
    hidden = _longest(common_lines(geometry, offsets.pair, offsets.dline_px) & (offsets.label != MEASURED))
    if hidden is not None and hidden[1] - hidden[0] >= BLOCK_LINES:
        out.append(Place("not measured", sum(hidden) // 2, float("nan")))
    return out


def _longest(flags: Bools) -> tuple[int, int] | None:
    """First and one beyond the last of the longest run of True."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    if not edges.size:
        return None
    starts, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - starts))
    return int(starts[k]), int(ends[k])


def seam_crops(
    path: Path, geometry: StripGeometry, pair: int, places: list[Place], first_line: float
) -> list[tuple[Place, str]]:
    """Each place as an SVG of one image pixel a pixel, ticks above and below at the seam.

    Greys are stretched between the crop's 1st and 99th percentile. Raises: `FileError`.
    """
    out = []
    with open_raster(path, OWN) as scene, reading(path, OWN.problem, OWN.fix):
        for place in places:
            row = scene_row(geometry, pair, place.line, first_line)
            wide, high = min(CROP_PX[0], scene.width), min(CROP_PX[1], scene.height)
            left = int(np.clip(seam_col(geometry, pair) - wide / 2, 0, scene.width - wide))
            top = int(np.clip(row - high / 2, 0, scene.height - high))
            window = Window(left, top, wide, high)
            values = scene.read(1, window=window).astype(np.float64)
            valid = scene.dataset_mask(window=window) > 127
            out.append((place, _crop(values, valid, seam_col(geometry, pair) - left, place)))
    return out


def _crop(values: Floats, valid: Bools, seam_px: float, place: Place) -> str:
    uri = webp(np.dstack([stretched(values, valid)] * 3), valid, 92)
    rows, cols = values.shape
    total = rows + 2 * _TICK_PX
    mark = f"M{number(seam_px)},0v{_TICK_PX - 2}M{number(seam_px)},{total}v{2 - _TICK_PX}"
    content = tag("image", href=uri, x=0, y=_TICK_PX, width=cols, height=rows)
    content += tag("path", d=mark, stroke=COLOURS[1], stroke_width=2)
    label = f"the seam, {place.why}"
    size = {"viewBox": f"0 0 {cols} {total}", "width": cols, "height": total, "class_": "seam"}
    return tag("svg", content, xmlns="http://www.w3.org/2000/svg", role="img", aria_label=label, **size)
