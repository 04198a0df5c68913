"""Seams where frames agree: cuts of least difference in colour, near the lines halfway between nadirs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from geomosaic.constants import CHOSEN, Because
from geomosaic.mosaic.ownership import FrameCells, Ownership, frame_cells
from geomosaic.mosaic.plugins import SEAMS_GROUP, Named
from geomosaic.mosaic.scene import Scene
from geomosaic.mosaic.views import FrameView
from geomosaic.projection.resample import resample
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
_cv2: Any = cv2  # its stubs leave the stitching module out
_BAND: Annotated[
    float,
    Because(
        "share of the side of a frame's own part",
        "how much farther from its nadir point than from the nearest a frame may give the ground:"
        " with more, frames look aside there and houses lean; with less, no way is left around "
        "them",
        CHOSEN,
    ),
] = 0.5
_LEAST_BAND_CELLS: Annotated[
    float,
    Because(
        "cells",
        "of frames that overlap much: narrower bands leave a seam no choice",
        CHOSEN,
    ),
] = 6.0
_EDGE_PX: Annotated[
    float,
    Because(
        "px of a frame",
        "its outermost ones are the darkest and least sharp",
        CHOSEN,
    ),
] = 16.0
_HIGH_M: Annotated[
    float,
    Because(
        "m over the ground",
        "what stands is higher: cars and hedges lean too little to matter, a storey is 2.5",
        CHOSEN,
    ),
] = 2.0
_WIDEST_M: Annotated[
    float,
    Because(
        "m",
        "houses are narrower; hills are wider, so that they are no objects",
        CHOSEN,
    ),
] = 60.0
_FINE_M: Annotated[
    float,
    Because(
        "m between a surface's nodes",
        "coarser surfaces show no houses, but ridges between their nodes",
        CHOSEN,
    ),
] = 2.0
_ON_OBJECTS: Annotated[
    np.float32,
    Because(
        "grey levels of 8 bits in each band",
        "a seam on an object counts as one along which frames differ by so much; a path through a"
        " whole image of grass differs by 10",
        CHOSEN,
    ),
] = np.float32(40.0)
_LEAST_WHITE: Annotated[
    float,
    Because(
        "the values' own",
        "so that black images divide nothing by zero",
        CHOSEN,
    ),
] = 1e-6
_WHITE: Annotated[
    float,
    Because(
        "grey levels",
        "of 8 bits: what all values are brought to before they are compared",
        "definition",
    ),
] = 255.0


@dataclass(frozen=True)
class Glimpse:
    """What is to be looked at: the cells that a frame may give (`may`), where something stands on the
    ground, if that is known (both (h, w)), and how much brighter than others it shows the ground, as a
    natural logarithm (h, w, b) or what is broadcast to it."""

    frame: Frame
    reduction: int
    cells: FrameCells
    may: Bools
    standing: Bools | None
    brighter: Floats32


@dataclass(frozen=True)
class Part:
    """What one frame may give, by the mosaic's cells from `row` and `col` on.

    frame: its index in the survey. nadir_m: easting and northing below it. values (h, w, 1 or 3): its first
    bands, their tones evened. may (h, w): where it may own the cell: it sees it, no mask is in the way, and
    it looks down steeply enough. standing (h, w): where something stands on the ground, if that is known.
    """

    frame: int
    nadir_m: Floats
    row: int
    col: int
    values: Floats32
    may: Bools
    standing: Bools | None = None

    @property
    def of_all(self) -> tuple[slice, slice]:
        """Its place among all cells."""
        height, width = self.may.shape
        return slice(self.row, self.row + height), slice(self.col, self.col + width)

    def at(self, rows: slice, cols: slice) -> tuple[slice, slice]:
        """The place within this part of some of all cells, which lie in it."""
        return (
            slice(rows.start - self.row, rows.stop - self.row),
            slice(cols.start - self.col, cols.stop - self.col),
        )


@dataclass(frozen=True)
class SeamFigures:
    """Along seams: their length in m, the mean and nine tenths of how far both frames differ there, in grey
    levels of 8 bits, and their share on what stands on the ground, if that is known."""

    length_m: float
    difference_mean: float
    difference_90: float
    on_objects: float | None


def glimpsed(job: Glimpse) -> Part:
    """Decodes a frame once, reduced, and takes it at the mosaic's cells."""
    cells, frame = job.cells, job.frame
    pixels, valid = read_pixels(frame, job.reduction)
    cols, rows = (
        np.ascontiguousarray(a / job.reduction, dtype=np.float32) for a in (cells.cols_px, cells.rows_px)
    )
    pixels = pixels[..., : 3 if pixels.shape[-1] >= 3 else 1]
    values = resample(np.ascontiguousarray(pixels), cols, rows, "bilinear").astype(np.float32)
    values *= np.exp(-job.brighter[..., : values.shape[-1]])
    may = job.may & (cells.cols_px > 0) & (cells.cols_px < frame.width_px)
    may &= (cells.rows_px > 0) & (cells.rows_px < frame.height_px)
    if valid is not None:
        may &= resample(valid[..., None], cols, rows, "bilinear")[..., 0] == 255
    return Part(cells.view.frame, cells.view.nadir_m, cells.row, cells.col, values, may, job.standing)


def bands(
    scene: Scene, nearest: Ownership, distance_m: Floats32, views: Sequence[FrameView]
) -> Iterator[tuple[FrameCells, Bools, Bools | None]]:
    """Of each of these frames, which give a part, the cells that it may give: its own, and those about them
    that are not much farther from its nadir point than from the nearest one. And where something stands on
    the ground, if that is known."""
    cell_m = nearest.cell_px * nearest.grid.gsd_m
    areas = _areas(nearest, scene)
    for view in views:
        cells = frame_cells(scene, view, nearest.cell_px)
        band_m = cell_m * max(_BAND * float(np.sqrt(areas[view.frame + 1])), _LEAST_BAND_CELLS)
        may = (cells.margin_px > _EDGE_PX) & (cells.distance_m < distance_m[cells.of_all] + band_m)
        may |= nearest.owner[cells.of_all] == view.frame + 1
        rows, cols = np.flatnonzero(may.any(axis=1)), np.flatnonzero(may.any(axis=0))
        at = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
        high = None
        if cells.relief_m is not None and scene.ground.spacing_m <= _FINE_M:
            high = standing(cells.relief_m, cell_m)[at]
        yield cells.cropped(*at), may[at], high


def standing(heights_m: Floats32, cell_m: float) -> Bools:
    """Where something stands on the ground, by its heights (h, w): what a square wider than houses doesn't
    fit under, a top-hat transform (Serra 1982, Image analysis and mathematical morphology, ch. XII)."""
    across = 2 * int(_WIDEST_M / cell_m / 2.0) + 1
    over_m = cv2.morphologyEx(heights_m, cv2.MORPH_TOPHAT, np.ones((across, across), np.uint8))
    return np.asarray(over_m > _HIGH_M)


def giving(scene: Scene, nearest: Ownership) -> list[FrameView]:
    """The frames that give a part."""
    areas = _areas(nearest, scene)
    return [view for view in scene.views if areas[view.frame + 1]]


def _areas(nearest: Ownership, scene: Scene) -> NDArray[np.intp]:
    """Cells of each frame, by its owner's number."""
    most = max((view.frame + 1 for view in scene.views), default=0)
    return np.bincount(nearest.owner.ravel(), minlength=most + 1)


Seam = Callable[[Ownership, Sequence[Part]], Ownership]
"""Who owns what, by the ownership of the nearest nadir points, and what each frame may give."""


def cut_seams(nearest: Ownership, parts: Sequence[Part]) -> Ownership:
    """Pair by pair, what both frames may give is cut where they differ least: Kwatra et al. 2003, Graphcut
    textures, section 3, by OpenCV's GraphCutSeamFinder. It is shown no more of both frames than what they
    share and the cells about it: what is farther off is decided, but would take most of its time. Seams keep
    off what stands on the ground, as if both differed the more there.
    """
    may = [p.may.copy() for p in parts]
    scale = _to_8_bits(parts)
    finder = _cv2.detail_GraphCutSeamFinder("COST_COLOR")
    for i, j in _meeting(parts):
        window = _window(parts, may, i, j)
        if window is None:
            continue
        rows, cols = window
        here = {k: parts[k].at(rows, cols) for k in (i, j)}
        shown = [_colours(parts[k].values[at], scale) for k, at in here.items()]
        if (high := parts[i].standing) is not None:
            shown[0] += np.where(high[here[i]], _ON_OBJECTS, np.float32(0.0))[..., None]
        masks = [may[k][at].astype(np.uint8) * np.uint8(255) for k, at in here.items()]
        both = may[i][here[i]] & may[j][here[j]]
        corner = cols.start, rows.start
        for (k, at), left in zip(here.items(), finder.find(shown, [corner, corner], masks), strict=True):
            may[k][at][both] = np.asarray(left.get())[both] > 0
    owner = nearest.owner.copy()
    for part, mine in zip(parts, may, strict=True):
        owner[part.of_all][mine] = part.frame + 1
    return replace(nearest, owner=owner)


def _to_8_bits(parts: Sequence[Part]) -> np.float32:
    """What takes values to a scale of 8 bits."""
    white = max((float(np.quantile(p.values[p.may], 0.99)) for p in parts if p.may.any()), default=_WHITE)
    return np.float32(1.0 if white <= _WHITE and white > 1.0 else _WHITE / max(white, _LEAST_WHITE))


def _colours(values: Floats32, scale: np.float32) -> Floats32:
    """Three bands: the three, or the one three times."""
    return np.broadcast_to(values * scale, (*values.shape[:2], 3)).copy()


def _meeting(parts: Sequence[Part]) -> list[tuple[int, int]]:
    """Pairs of frames that have cells in common, by their bounds; the nearest by nadir points first, so
    that little is left to others."""
    bounds = shapely.box(
        *np.array([[p.col, p.row, p.of_all[1].stop, p.of_all[0].stop] for p in parts]).reshape(-1, 4).T
    )
    one, other = shapely.STRtree(bounds).query(bounds, predicate="intersects")
    one, other = one[one < other], other[one < other]
    nadir_m = np.array([p.nadir_m for p in parts]).reshape(-1, 2)
    away_m = np.linalg.norm(nadir_m[one] - nadir_m[other], axis=1)
    return [(int(one[k]), int(other[k])) for k in np.lexsort((other, one, away_m))]


def _window(parts: Sequence[Part], may: Sequence[Bools], i: int, j: int) -> tuple[slice, slice] | None:
    """Rows and cols, of all cells, of what two frames may both give and, as far as both have them, of the
    cells about it."""
    rows, cols = (
        slice(max(a.start, b.start), min(a.stop, b.stop))
        for a, b in zip(parts[i].of_all, parts[j].of_all, strict=True)
    )
    both = may[i][parts[i].at(rows, cols)] & may[j][parts[j].at(rows, cols)]
    if not both.any():
        return None
    found = []
    for line, of in ((both.any(axis=1), rows), (both.any(axis=0), cols)):
        there = of.start + np.flatnonzero(line)
        found.append(slice(max(int(there[0]) - 1, of.start), min(int(there[-1]) + 2, of.stop)))
    return found[0], found[1]


def seam_figures(of: Ownership, parts: Sequence[Part]) -> SeamFigures:
    """Both cells of every step from one frame's to another's, as both frames show them."""
    scale = _to_8_bits(parts)
    number = {p.frame + 1: k for k, p in enumerate(parts)}
    differences, steps, high = [], 0, [np.zeros(0, dtype=bool)]
    for axis in (0, 1):
        one, other = (np.moveaxis(of.owner, axis, 0)[s] for s in (slice(None, -1), slice(1, None)))
        at = np.nonzero((one != other) & (one > 0) & (other > 0))
        if not len(at[0]):
            continue
        steps += len(at[0])
        rows, cols = at if axis == 0 else at[::-1]
        pairs = np.stack([one[at], other[at]], axis=1)
        for pair in np.unique(pairs, axis=0):
            mine = (pairs == pair).all(axis=1)
            for row, col in ((rows[mine], cols[mine]), (rows[mine] + (axis == 0), cols[mine] + (axis == 1))):
                values = [_at(parts[number[p]], row, col) * scale for p in pair if p in number]
                if len(values) == 2:
                    differences.append(np.abs(values[0] - values[1]).mean(axis=-1))
                part = parts[number[pair[0]]]
                if part.standing is not None:
                    at_part, there = _within(part, row, col)
                    high.append(part.standing[at_part][there])
    every = np.concatenate(differences) if differences else np.zeros(0)
    every = every[np.isfinite(every)]
    length_m = steps * of.cell_px * of.grid.gsd_m
    every_high = np.concatenate(high)
    on_objects = float(every_high.mean()) if len(every_high) else None
    if not len(every):
        return SeamFigures(length_m, float("nan"), float("nan"), on_objects)
    return SeamFigures(length_m, float(every.mean()), float(np.quantile(every, 0.9)), on_objects)


def _within(part: Part, row: Ints, col: Ints) -> tuple[tuple[Ints, Ints], Bools]:
    """Where cells of the mosaic lie in a part, and which of them do; the others are its first cell."""
    height, width = part.may.shape
    row, col = row - part.row, col - part.col
    there = (row >= 0) & (row < height) & (col >= 0) & (col < width)
    return (np.where(there, row, 0), np.where(there, col, 0)), there


def _at(part: Part, row: Ints, col: Ints) -> Floats32:
    """Values (n, b) at cells of the mosaic, NaN beyond what the frame may give."""
    at, there = _within(part, row, col)
    there &= part.may[at]
    return np.where(there[:, None], part.values[at], np.float32(np.nan))


NEAREST_NADIR: Final = "nearest_nadir"
SEAMS: Final[Mapping[str, Seam]] = Named(
    {"least_difference": cut_seams, NEAREST_NADIR: lambda nearest, parts: nearest},
    SEAMS_GROUP,
    callable,
)
"""And what other distributions bring, see `plugins`."""
