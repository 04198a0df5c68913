"""Images of a scene of CCD strips: the whole at reduced size, and its seams at 100 %."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.windows import Window

from geomosaic.ccd.model import MEASURED, Floats, PairOffsets
from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.quality.strip_figures import LIMIT_PX, SEGMENT_LINES, common_lines
from geomosaic.quality.strips import BLOCK_LINES, PairQuality, StripQuality
from geomosaic.report.glance import Glance, drawn_over, glance, stretched, webp
from geomosaic.report.svg import COLOURS, number, tag
from geomosaic.survey.strips import StripGeometry

CROP_PX = (300, 220)
_TICK_PX = 9


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


def scene_overview(image: Glance, geometry: StripGeometry, quality: StripQuality, first_line: float) -> str:
    """An inline SVG of the scene with its seams; segments above the limit are marked on them.

    Groups carry the classes `seams` and `names`, so that the page can switch them.
    """
    wide, high = image.width_px, image.height_px
    unit = max(wide, high) / 1000.0
    to_px = np.abs(np.diag(image.px_from_map[:, :2]))
    seams, names = [], []
    for pair in quality.pairs:
        x = seam_col(geometry, pair.pair) * to_px[0]
        seams.append(tag("line", x1=x, x2=x, y1=0.0, y2=float(high)))
        for k, value in enumerate(pair.segments_px):
            if value > LIMIT_PX:
                ends = k * SEGMENT_LINES, min((k + 1) * SEGMENT_LINES, pair.lines)
                y0, y1 = (scene_row(geometry, pair.pair, end, first_line) * to_px[1] for end in ends)
                title = tag("title", f"{value:.1f} px")
                place = {"x": x - 3 * unit, "y": y0, "width": 6 * unit, "height": y1 - y0}
                seams.append(tag("rect", title, **place, class_="odd"))
    step = geometry.width_px - geometry.overlap_px
    for k, lines in enumerate(geometry.lines):
        x = (k * step + geometry.width_px / 2) * to_px[0]
        title = tag("title", f"CCD {k + 1}" if lines else f"CCD {k + 1}, dead")
        size, odd = min(20.0 * unit, 0.5 * step * to_px[0]), "" if lines else "odd"
        head = {"x": float(x), "y": float(26 * unit), "font_size": float(size), "text_anchor": "middle"}
        names.append(tag("text", title + str(k + 1), **head, class_=odd))
    style = (
        f".over .seams line{{stroke:{COLOURS[5]};stroke-width:{number(1.2 * unit)};stroke-dasharray:"
        f"{number(6 * unit)} {number(5 * unit)}}}.over .seams .odd{{fill:{COLOURS[1]};fill-opacity:.8}}"
        f".over .names text{{fill:#fff;stroke:#000;stroke-width:{number(3 * unit)};paint-order:stroke}}"
        f".over .names .odd{{fill:{COLOURS[1]}}}"
    )
    groups, label = {"seams": seams, "names": names}, "the scene with the seams of its strips"
    return drawn_over(image, groups, style=style, box=f"0 0 {wide} {high}", label=label)


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


def _longest(flags: NDArray[np.bool_]) -> tuple[int, int] | None:
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
    with open_raster(path, OWN) as scene, reading(path, OWN.problem, OWN.mend):
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


def _crop(values: Floats, valid: NDArray[np.bool_], seam_px: float, place: Place) -> str:
    uri = webp(np.dstack([stretched(values, valid)] * 3), valid, 92)
    rows, cols = values.shape
    total = rows + 2 * _TICK_PX
    mark = f"M{number(seam_px)},0v{_TICK_PX - 2}M{number(seam_px)},{total}v{2 - _TICK_PX}"
    content = tag("image", href=uri, x=0, y=_TICK_PX, width=cols, height=rows)
    content += tag("path", d=mark, stroke=COLOURS[1], stroke_width=2)
    label = f"the seam, {place.why}"
    size = {"viewBox": f"0 0 {cols} {total}", "width": cols, "height": total, "class_": "seam"}
    return tag("svg", content, xmlns="http://www.w3.org/2000/svg", role="img", aria_label=label, **size)
