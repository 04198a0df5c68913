"""What the report's map shows, as the page's script takes it: images, layers of areas, lines and points."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from geomosaic.arrays import Floats, Ints64
from geomosaic.report.glance import Glance
from geomosaic.report.numbers import whole

_HEAD: Final = 0.3
"""An arrow head's length, of its arrow's."""


@dataclass(frozen=True)
class MapImage:
    """An image in a box (west, south, east, north) of the map. use: `layer`, switched like others, or
    `compare`, swiped over the mosaic."""

    name: str
    title: str
    uri: str
    box: tuple[float, float, float, float]
    use: str = "layer"
    note: str = ""
    opacity: float = 1.0
    shown: bool = False


@dataclass(frozen=True)
class MapLayer:
    """What can be switched: areas (outer rings), lines, points; flat lists x, y, x, y from the map's origin.

    rows: for each area, or for each point where there are no areas, the table's row that it belongs to, or
    none at all. odd: places in that list which stand out. labels: of the points, or of the areas. fill: how
    opaque areas are. note: what a reader has to know, such as the scale of arrows. mark: `triangle` or
    `square`, the points' symbol, crossed out where they are odd; lines are then arrows, factor times larger.
    """

    name: str
    title: str
    colour: str
    areas: list[list[float]] = field(default_factory=list)
    lines: list[list[float]] = field(default_factory=list)
    points: list[list[float]] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)
    odd: list[int] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    weight: float = 1.5
    fill: float = 0.0
    dash: str = ""
    shown: bool = False
    permanent: bool = False
    note: str = ""
    mark: str = ""
    factor: float = 1.0


@dataclass(frozen=True)
class MapView:
    """The whole map. origin: what coordinates are counted from; axes: their names; down: the second one grows
    downwards, as lines do; unit; metres: whether a scale bar makes sense; box: of the mosaic.
    """

    origin: tuple[float, float]
    axes: tuple[str, str]
    down: bool
    unit: str
    metres: bool
    box: tuple[float, float, float, float]
    images: list[MapImage]
    layers: list[MapLayer]

    def plain(self) -> dict[str, Any]:
        """As JSON takes it; layers with nothing in them are left out."""
        layers = [vars(one) for one in self.layers if one.areas or one.lines or one.points]
        return {**vars(self), "images": [vars(one) for one in self.images], "layers": layers}


def box_of(image: Glance, origin: Floats) -> tuple[float, float, float, float]:
    """Of a reduced image, from the map's origin."""
    into = np.vstack([image.px_from_map, [0.0, 0.0, 1.0]])
    ends = np.array([[0.0, image.height_px, 1.0], [image.width_px, 0.0, 1.0]]) @ np.linalg.inv(into).T
    (west, south), (east, north) = ends[:, :2] - origin
    return float(west), float(south), float(east), float(north)


def flat(at_m: Floats, origin: Floats, decimals: int = 2) -> list[float]:
    """Places (k, 2) as x, y, x, y from the origin."""
    return [float(v) for v in np.round(np.asarray(at_m) - origin, decimals).ravel()]


def arrows(
    at_m: Floats, vectors_m: Floats, factor: float, origin: Floats, head_m: float = np.inf
) -> list[list[float]]:
    """Arrows from places (n, 2) along vectors (n, 2), larger than life by a factor: one line each, head and
    all, which is head_m long at most. Those of which something isn't known are left out."""
    known = np.isfinite(at_m).all(axis=1) & np.isfinite(vectors_m).all(axis=1)
    start, along = at_m[known], vectors_m[known] * factor
    end = start + along
    length_m = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    back = along * np.minimum(_HEAD, head_m / length_m)
    across = np.stack([-back[:, 1], back[:, 0]], axis=-1) / 2.0
    heads = [end - back + side for side in (across, -across)]
    lines = np.stack([start, end, heads[0], end, heads[1]], axis=1)
    return [flat(line, origin) for line in lines]


def thinned(number: int, most: int) -> Ints64:
    """Indices of so many at most, spread evenly."""
    return np.arange(0, number, max(1, -(-number // most)))


def thinning_note(shown: int, number: int) -> str:
    """Words for a layer that shows fewer than there are."""
    return "" if shown >= number else f", {whole(shown)} of {whole(number)}"


def outlines(polygons: Iterable[Floats], origin: Floats) -> list[list[float]]:
    """Rings (k, 2); an empty list where a ring isn't known, so that places stay those of the frames."""
    return [flat(p, origin) if len(p) > 2 and np.isfinite(p).all() else [] for p in polygons]


def labels_of(names: Sequence[str], notes: Sequence[str]) -> list[str]:
    """`name: note`."""
    return [f"{name}: {note}" if note else name for name, note in zip(names, notes, strict=True)]
