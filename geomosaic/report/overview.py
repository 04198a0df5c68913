"""The mosaic at a glance: a reduced image with footprints, flight lines and nadir points over it."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import NDArray

from geomosaic.report.glance import Glance, drawn_over
from geomosaic.report.svg import COLOURS, number, points, tag, text

Floats = NDArray[np.float64]


def overview(
    image: Glance,
    footprints_m: list[Floats],
    nadir_m: Floats,
    lines: tuple[int, ...],
    sequence: tuple[int, ...],
    status: tuple[str, ...],
    names: tuple[str, ...],
) -> str:
    """An inline SVG of the image with one group each of footprints, flight lines, nadir points, names.

    Args: footprints_m outlines (k, 2) on the map; nadir_m (n, 2) adjusted nadir points; frames whose
    status is not `tied` are drawn in the warning colour. Groups carry the classes `footprints`, `lines`,
    `nadirs`, `names`, so that the page can switch them.
    """
    at = image.at(nadir_m)
    outlines = [
        tag("polygon", points=points(image.at(o)), class_="odd" if s != "tied" else "")
        for o, s in zip(footprints_m, status, strict=True)
        if len(o) > 2 and np.isfinite(o).all()
    ]
    flown = []
    for line in sorted(set(lines)):
        part = at[[i for i in sequence if lines[i] == line]]
        flown.append(tag("polyline", points=points(part[np.isfinite(part).all(axis=1)])))
    unit = max(image.width_px, image.height_px) / 1000.0
    dots, words = [], []
    for i, (x, y) in enumerate(at):
        if np.isfinite(at[i]).all():
            odd = "odd" if status[i] != "tied" else ""
            title = tag("title", escape(names[i], quote=False))
            dots.append(tag("circle", title, cx=float(x), cy=float(y), r=4.0 * unit, class_=odd))
            words.append(text(x + 6 * unit, y - 5 * unit, names[i], font_size=11.0 * unit))
    style = (
        f".over .footprints{{fill:none;stroke:#fff;stroke-width:{number(1.2 * unit)};stroke-opacity:.75}}"
        f".over .lines{{fill:none;stroke:{COLOURS[5]};stroke-width:{number(2.2 * unit)}}}"
        f".over .nadirs{{fill:#fff;stroke:#000;stroke-width:{number(0.8 * unit)}}}"
        f".over .nadirs .odd{{fill:{COLOURS[1]}}}.over .footprints .odd{{stroke:{COLOURS[1]}}}"
        f".over .names text{{fill:#fff;stroke:#000;stroke-width:{number(2.5 * unit)};paint-order:stroke}}"
    )
    low = np.min([[0.0, 0.0], *(image.at(o).min(axis=0) for o in footprints_m if len(o))], axis=0)
    size = [float(image.width_px), float(image.height_px)]
    high = np.max([size, *(image.at(o).max(axis=0) for o in footprints_m if len(o))], axis=0)
    low = np.maximum(np.where(np.isfinite(low), low, 0.0), -0.25 * np.array(size))
    high = np.minimum(np.where(np.isfinite(high), high, size), 1.25 * np.array(size))
    box = " ".join(number(float(v)) for v in (*low, *(high - low)))
    groups = {"footprints": outlines, "lines": flown, "nadirs": dots, "names": words}
    label = "the mosaic with footprints, flight lines and nadir points"
    return drawn_over(image, groups, style=style, box=box, label=label)
