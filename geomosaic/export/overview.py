"""The mosaic at a glance: a reduced picture with footprints, flight lines and nadir points over it."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Resampling

from geomosaic.doors.raster import OWN, open_raster, reading
from geomosaic.export.svg import COLOURS, number, points, tag, text

Floats = NDArray[np.float64]

_LONGER_SIDE_PX = 1400


@dataclass(frozen=True)
class Glance:
    """A reduced mosaic: a data URI, its size, and what of the full mosaic is covered.

    px_from_map: (2, 3) takes easting, northing, 1 to col and row of the reduced picture.
    """

    uri: str
    width_px: int
    height_px: int
    px_from_map: Floats
    covered_m2: float

    def at(self, map_m: Floats) -> Floats:
        """Col and row (n, 2) of map coordinates (n, 2)."""
        return np.asarray(map_m @ self.px_from_map[:, :2].T + self.px_from_map[:, 2])


def glance(path: Path) -> Glance:
    """A reduced read of mosaic.tif as a WebP picture whose invalid pixels are transparent.

    Values of other than 8 bits are stretched between their 1st and 99th percentile.
    """
    with open_raster(path, OWN) as dataset, reading(path, OWN.problem, OWN.mend):
        scale = max(1.0, max(dataset.shape) / _LONGER_SIDE_PX)
        shape = max(1, round(dataset.height / scale)), max(1, round(dataset.width / scale))
        colours = [
            i for i, c in zip(dataset.indexes, dataset.colorinterp, strict=True) if c != ColorInterp.alpha
        ]
        colours = colours[:3] if len(colours) >= 3 else colours[:1] * 3
        bands = dataset.read(colours, out_shape=(3, *shape), resampling=Resampling.average)
        valid = dataset.dataset_mask(out_shape=shape) > 127
        t = dataset.transform
        full = np.array([[t.a, t.b, t.c], [t.d, t.e, t.f], [0.0, 0.0, 1.0]])
        size = dataset.width, dataset.height
    picture = np.moveaxis(_eight_bits(bands, valid), 0, -1)
    drawn = np.dstack([picture[..., ::-1], np.where(valid, 255, 0).astype(np.uint8)])
    data = cv2.imencode(".webp", drawn, [cv2.IMWRITE_WEBP_QUALITY, 82])[1]
    reduce = np.diag([shape[1] / size[0], shape[0] / size[1], 1.0])
    pixel_m2 = abs(np.linalg.det(full[:2, :2])) * size[0] * size[1] / (shape[0] * shape[1])
    return Glance(
        "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode("ascii"),
        shape[1],
        shape[0],
        (reduce @ np.linalg.inv(full))[:2],
        float(valid.sum() * pixel_m2),
    )


def _eight_bits(bands: NDArray[np.generic], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    if bands.dtype == np.uint8:
        return bands.astype(np.uint8)
    values = bands.astype(np.float64)
    if valid.any():
        low, high = np.nanpercentile(values[:, valid], [1.0, 99.0])
        values = (values - low) * (255.0 / max(high - low, 1e-9))
    return np.nan_to_num(np.clip(values, 0.0, 255.0)).astype(np.uint8)


def overview(
    picture: Glance,
    footprints_m: list[Floats],
    nadir_m: Floats,
    lines: tuple[int, ...],
    sequence: tuple[int, ...],
    status: tuple[str, ...],
    names: tuple[str, ...],
) -> str:
    """An inline SVG of the picture with one group each of footprints, flight lines, nadir points, names.

    Args: footprints_m outlines (k, 2) on the map; nadir_m (n, 2) adjusted nadir points; frames whose
    status is not `tied` are drawn in the warning colour. Groups carry the classes `footprints`, `lines`,
    `nadirs`, `names`, so that the page can switch them.
    """
    at = picture.at(nadir_m)
    outlines = [
        tag("polygon", points=points(picture.at(o)), class_="odd" if s != "tied" else "")
        for o, s in zip(footprints_m, status, strict=True)
        if len(o) > 2 and np.isfinite(o).all()
    ]
    flown = []
    for line in sorted(set(lines)):
        part = at[[i for i in sequence if lines[i] == line]]
        flown.append(tag("polyline", points=points(part[np.isfinite(part).all(axis=1)])))
    unit = max(picture.width_px, picture.height_px) / 1000.0
    dots, words = [], []
    for i, (x, y) in enumerate(at):
        if np.isfinite(at[i]).all():
            odd = "odd" if status[i] != "tied" else ""
            told = tag("title", escape(names[i], quote=False))
            dots.append(tag("circle", told, cx=float(x), cy=float(y), r=4.0 * unit, class_=odd))
            words.append(text(x + 6 * unit, y - 5 * unit, names[i], font_size=11.0 * unit))
    style = (
        f".over .footprints{{fill:none;stroke:#fff;stroke-width:{number(1.2 * unit)};stroke-opacity:.75}}"
        f".over .lines{{fill:none;stroke:{COLOURS[5]};stroke-width:{number(2.2 * unit)}}}"
        f".over .nadirs{{fill:#fff;stroke:#000;stroke-width:{number(0.8 * unit)}}}"
        f".over .nadirs .odd{{fill:{COLOURS[1]}}}.over .footprints .odd{{stroke:{COLOURS[1]}}}"
        f".over .names text{{fill:#fff;stroke:#000;stroke-width:{number(2.5 * unit)};paint-order:stroke}}"
    )
    image = tag("image", href=picture.uri, width=picture.width_px, height=picture.height_px)
    low = np.min([[0.0, 0.0], *(picture.at(o).min(axis=0) for o in footprints_m if len(o))], axis=0)
    size = [float(picture.width_px), float(picture.height_px)]
    high = np.max([size, *(picture.at(o).max(axis=0) for o in footprints_m if len(o))], axis=0)
    low = np.maximum(np.where(np.isfinite(low), low, 0.0), -0.25 * np.array(size))
    high = np.minimum(np.where(np.isfinite(high), high, size), 1.25 * np.array(size))
    box = " ".join(number(float(v)) for v in (*low, *(high - low)))
    groups = (("footprints", outlines), ("lines", flown), ("nadirs", dots), ("names", words))
    layers = "".join(tag("g", "".join(content), class_=name) for name, content in groups)
    return tag(
        "svg",
        tag("style", style) + image + layers,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=box,
        class_="over",
        role="img",
        aria_label="the mosaic with footprints, flight lines and nadir points",
    )
