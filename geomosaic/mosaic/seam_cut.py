"""Seams where frames agree: cuts of least difference in colour, near the lines halfway between nadirs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.mosaic.ownership import FrameCells, Ownership, frame_cells
from geomosaic.mosaic.plugins import SEAMS_GROUP, Named
from geomosaic.mosaic.scene import Scene
from geomosaic.projection.resample import resample
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels

Floats32 = NDArray[np.float32]
Bools = NDArray[np.bool_]
_cv2: Any = cv2  # its stubs leave the stitching module out
_BAND: Final = 0.5
"""Of the side of a frame's own part: how much farther from its nadir point than from the nearest a frame
may still give the ground. So seams stay in the inner half between nadirs, where frames look down most
steeply."""
_LEAST_BAND_CELLS: Final = 6.0
_EDGE_PX: Final = 16.0
"""Of a frame: seams keep off its outermost pixels, the darkest and least sharp."""
_LEAST_WHITE: Final = 1e-6
_WHITE: Final = 255.0


@dataclass(frozen=True)
class Glimpse:
    """A frame, and where it is looked at: cols_px and rows_px (h, w), and how much brighter than others it
    shows the ground there, as a natural logarithm (h, w, b)."""

    frame: Frame
    reduction: int
    cols_px: Floats32
    rows_px: Floats32
    brighter: Floats32


@dataclass(frozen=True)
class Glimpsed:
    """Values (h, w, b) of a frame at its cells, evened, and where they are valid (h, w)."""

    values: Floats32
    valid: Bools


@dataclass(frozen=True)
class SeamFigures:
    """Along seams: their length in m, and the mean and nine tenths of how far both frames differ there, in
    grey levels of 8 bits."""

    length_m: float
    difference_mean: float
    difference_90: float


def glimpsed(job: Glimpse) -> Glimpsed:
    """Decodes a frame once, reduced, and takes it at the mosaic's cells."""
    pixels, valid = read_pixels(job.frame, job.reduction)
    cols, rows = (
        np.ascontiguousarray(a / job.reduction, dtype=np.float32) for a in (job.cols_px, job.rows_px)
    )
    values = resample(pixels, cols, rows, "bilinear").astype(np.float32)
    values *= np.exp(-job.brighter)
    seen = (job.cols_px > 0) & (job.cols_px < job.frame.width_px)
    seen &= (job.rows_px > 0) & (job.rows_px < job.frame.height_px)
    if valid is not None:
        seen &= resample(valid[..., None], cols, rows, "bilinear")[..., 0] == 255
    return Glimpsed(values, seen)


def bands(scene: Scene, nearest: Ownership, distance_m: Floats32) -> list[FrameCells]:
    """Of each frame that gives a part, the cells that it may give: its own, and those about them that are not
    much farther from its nadir point than from the nearest one."""
    cell_m = nearest.cell_px * nearest.grid.gsd_m
    areas = np.bincount(nearest.owner.ravel())
    found = []
    for view in scene.views:
        if view.frame + 1 >= len(areas) or not areas[view.frame + 1]:
            continue
        cells = frame_cells(scene, view, nearest.cell_px)
        band_m = cell_m * max(_BAND * float(np.sqrt(areas[view.frame + 1])), _LEAST_BAND_CELLS)
        may = (cells.margin_px > _EDGE_PX) & (cells.distance_m < distance_m[cells.of_all] + band_m)
        may |= nearest.owner[cells.of_all] == view.frame + 1
        found.append(_cropped(replace(cells, margin_px=np.where(may, cells.margin_px, np.float32(-1.0)))))
    return found


def _cropped(cells: FrameCells) -> FrameCells:
    may = cells.margin_px > 0.0
    rows, cols = np.flatnonzero(may.any(axis=1)), np.flatnonzero(may.any(axis=0))
    at = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
    return FrameCells(
        cells.view,
        cells.row + int(rows[0]),
        cells.col + int(cols[0]),
        *(a[at] for a in (cells.cols_px, cells.rows_px, cells.margin_px, cells.distance_m)),
    )


Seam = Callable[[Ownership, Sequence[FrameCells], Sequence[Glimpsed]], Ownership]
"""Who owns what, by the ownership of the nearest nadir points, and of each frame that may give something its
`bands` and what it shows there. What may go to a frame is where its margin is above 0 and it is valid."""


def cut_seams(nearest: Ownership, parts: Sequence[FrameCells], seen: Sequence[Glimpsed]) -> Ownership:
    """Pair by pair, what both frames may give is cut where they differ least: Kwatra et al. 2003, Graphcut
    textures, section 3, by OpenCV's GraphCutSeamFinder.

    Args: parts, seen: of each frame its `bands` and what it shows there.
    """
    masks = [(c.margin_px > 0.0) & s.valid for c, s in zip(parts, seen, strict=True)]
    pictures = _pictures(seen)
    corners = [(c.col, c.row) for c in parts]
    finder = _cv2.detail_GraphCutSeamFinder("COST_COLOR")
    for i, j in _meeting(parts):
        if not _both_may(parts, masks, i, j):
            continue
        pair: list[Any] = [masks[k].astype(np.uint8) * np.uint8(255) for k in (i, j)]
        shown: list[Any] = [pictures[k] for k in (i, j)]
        left = finder.find(shown, [corners[i], corners[j]], pair)
        masks[i], masks[j] = (np.asarray(mask.get() > 0) for mask in left)
    owner = nearest.owner.copy()
    for cells, mask in zip(parts, masks, strict=True):
        owner[cells.of_all][mask] = cells.view.frame + 1
    return replace(nearest, owner=owner)


def _pictures(seen: Sequence[Glimpsed]) -> list[Floats32]:
    """Colours on a scale of 8 bits."""
    white = max((float(np.quantile(s.values[s.valid], 0.99)) for s in seen if s.valid.any()), default=_WHITE)
    scale = 1.0 if white <= _WHITE and white > 1.0 else _WHITE / max(white, _LEAST_WHITE)
    return [_colours(s.values * np.float32(scale)) for s in seen]


def _colours(values: Floats32) -> Floats32:
    """Three bands: the first three, or the first three times."""
    bands = values[..., [0, 1, 2]] if values.shape[-1] >= 3 else values[..., [0, 0, 0]]
    return np.ascontiguousarray(bands)


def _meeting(parts: Sequence[FrameCells]) -> list[tuple[int, int]]:
    """Pairs of frames that have cells in common, by their bounds; the nearest by nadir points first, so
    that little is left to others."""
    bounds = np.array([[c.row, c.of_all[0].stop, c.col, c.of_all[1].stop] for c in parts]).reshape(-1, 4)
    nadir_m = np.array([c.view.nadir_m for c in parts]).reshape(-1, 2)
    found = []
    for i, (row, end_row, col, end_col) in enumerate(bounds):
        later = bounds[i + 1 :]
        meets = (later[:, 0] < end_row) & (later[:, 1] > row) & (later[:, 2] < end_col) & (later[:, 3] > col)
        others = i + 1 + np.flatnonzero(meets)
        away_m = np.linalg.norm(nadir_m[others] - nadir_m[i], axis=1)
        found += [(float(d), i, int(j)) for d, j in zip(away_m, others, strict=True)]
    return [(i, j) for _, i, j in sorted(found)]


def _both_may(parts: Sequence[FrameCells], masks: Sequence[Bools], i: int, j: int) -> bool:
    """Whether a cell is left that two frames may give."""
    (a_rows, a_cols), (b_rows, b_cols) = parts[i].of_all, parts[j].of_all
    top, bottom = max(a_rows.start, b_rows.start), min(a_rows.stop, b_rows.stop)
    left, right = max(a_cols.start, b_cols.start), min(a_cols.stop, b_cols.stop)
    a, b = (
        masks[k][top - c.row : bottom - c.row, left - c.col : right - c.col]
        for k, c in ((i, parts[i]), (j, parts[j]))
    )
    return bool((a & b).any())


def seam_figures(of: Ownership, parts: Sequence[FrameCells], seen: Sequence[Glimpsed]) -> SeamFigures:
    """Both cells of every step from one frame's to another's, as both frames show them."""
    pictures = _pictures(seen)
    number = {c.view.frame + 1: k for k, c in enumerate(parts)}
    differences, steps = [], 0
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
                values = [_at(parts[number[p]], pictures[number[p]], row, col) for p in pair if p in number]
                if len(values) == 2:
                    differences.append(np.abs(values[0] - values[1]).mean(axis=-1))
    every = np.concatenate(differences) if differences else np.zeros(0)
    every = every[np.isfinite(every)]
    length_m = steps * of.cell_px * of.grid.gsd_m
    if not len(every):
        return SeamFigures(length_m, float("nan"), float("nan"))
    return SeamFigures(length_m, float(every.mean()), float(np.quantile(every, 0.9)))


def _at(cells: FrameCells, picture: Floats32, row: NDArray[Any], col: NDArray[Any]) -> Floats32:
    """Colours (n, 3) at cells of the mosaic, NaN beyond what the frame may give."""
    height, width = cells.margin_px.shape
    row, col = row - cells.row, col - cells.col
    there = (row >= 0) & (row < height) & (col >= 0) & (col < width)
    row, col = np.where(there, row, 0), np.where(there, col, 0)
    there &= cells.margin_px[row, col] > 0.0
    return np.where(there[:, None], picture[row, col], np.float32(np.nan))


NEAREST_NADIR: Final = "nearest_nadir"
SEAMS: Final[Mapping[str, Seam]] = Named(
    {"least_difference": cut_seams, NEAREST_NADIR: lambda nearest, parts, seen: nearest},
    SEAMS_GROUP,
    callable,
)
"""And what other distributions bring, see `plugins`."""
