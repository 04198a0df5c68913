"""What frames may give of a mosaic's cells, and how they show it, before the first pixel is composed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bools, Floats, Floats32, Ints
from geomosaic.composition.frame_cells import frame_cells
from geomosaic.composition.ownership import Ownership, finest_pixels
from geomosaic.composition.scene import Scene, bounds_window, distances_m
from geomosaic.composition.tones import GREYS, Tones, evened
from geomosaic.composition.views import FrameView
from geomosaic.constants import tuned
from geomosaic.projection.resample import resample
from geomosaic.survey.model import Frame
from geomosaic.survey.pixels import read_pixels
from geomosaic.survey.small import Spare

_BAND = tuned(0.5, "share", "of a frame's part around seams: less leaves no way; more lets houses lean")
_LEAST_BAND_CELLS = tuned(6.0, "cells", "with high overlap: narrower leaves a seam no choice")
EDGE_PX = tuned(16.0, "frame px", "rim left out, darkest and least sharp: less uses it; more loses overlap")
HIGH_M = tuned(2.0, "m", "least height of an object: cars lean too little; a storey is 2.5")
_WIDEST_M = tuned(60.0, "m", "widest object: less misses halls; more takes hills for objects")
_FINE_M = tuned(2.0, "m", "coarsest node spacing that shows houses: coarser surfaces show ridges")
_SOME = tuned(4, "cells", "between samples of brightness: all would take longer than the cut")


@dataclass(frozen=True)
class SeamBand:
    """The mosaic's cells from `row` and `col` on that a frame may give by where its nadir point is, (h, w)
    each.

    own: the cells that are nearest to it. near: those that are not much farther from it than from the nearest
    one. finest: see `finest_pixels`.
    """

    view: FrameView
    row: int
    col: int
    own: Bools
    near: Bools
    finest: Floats32 | None = None


@dataclass(frozen=True)
class Glimpse:
    """What is to be looked at, by how much the frame's pixels are reduced for it, and where they may lie."""

    frame: Frame
    reduction: int
    band: SeamBand
    spare: Spare | None = None


@dataclass(frozen=True)
class SeamPart:
    """What one frame may give, by the mosaic's cells from `row` and `col` on.

    frame: its index in the survey. nadir_m: easting and northing below it. values (h, w, 1 or 3): its first
    bands, their tones evened; in half precision where the image has 8 bits. may (h, w): where it may own the
    cell: it sees it, no mask is in the way, and it looks down steeply enough. standing (h, w): where
    something stands on the ground, None if that is unknown.
    """

    frame: int
    nadir_m: Floats
    row: int
    col: int
    values: NDArray[np.floating[Any]]
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


def giving(scene: Scene, nearest: Ownership) -> list[FrameView]:
    """The frames that give a part."""
    areas = _areas(nearest, scene)
    return [view for view in scene.views if areas[view.frame + 1]]


def bands(
    scene: Scene, nearest: Ownership, distance_m: Floats32, views: Sequence[FrameView]
) -> Iterator[SeamBand]:
    """Of each of these frames, which own a part."""
    side = nearest.cell_px
    cell_m = side * nearest.grid.gsd_m
    areas, finest = _areas(nearest, scene), finest_pixels(scene, side)
    for view in views:
        window = bounds_window(scene.grid, view, side)
        rows, cols = (
            slice(first // side, (first + length) // side)
            for first, length in ((window.row, window.height), (window.col, window.width))
        )
        band_m = cell_m * max(_BAND * float(np.sqrt(areas[view.frame + 1])), _LEAST_BAND_CELLS)
        own = nearest.owner[rows, cols] == view.frame + 1
        near = distances_m(scene.grid, window, view, side) < distance_m[rows, cols] + band_m
        down, across = (np.flatnonzero((own | near).any(axis=axis)) for axis in (1, 0))
        at = slice(down[0], down[-1] + 1), slice(across[0], across[-1] + 1)
        row, col = rows.start + int(down[0]), cols.start + int(across[0])
        of = None if finest is None else finest[rows, cols][at]
        yield SeamBand(view, row, col, own[at], near[at], of)


def glimpses(
    scene: Scene,
    nearest: Ownership,
    distance_m: Floats32,
    frames: Sequence[Frame],
    spare: Callable[[str], Spare],
) -> Iterator[Glimpse]:
    """What is to be looked at of each frame that gives a part, at about the cells' size. spare: where a
    file's frame may lie reduced."""
    for band in bands(scene, nearest, distance_m, giving(scene, nearest)):
        finer = nearest.cell_px * scene.grid.gsd_m / band.view.gsd_m
        reduction = next((r for r in (8, 4, 2) if r <= finer), 1)
        frame = frames[band.view.frame]
        yield Glimpse(frame, reduction, band, spare(frame.path))


def glimpsed(scene: Scene, cell_px: int, tones: Tones | None, job: Glimpse) -> SeamPart:
    """Decodes a frame once, reduced, and samples it at the cells that it may give. It sees these, and no mask
    is in the way. Its outermost pixels count for its own cells alone. The views of the scene are not used."""
    frame, band, view = job.frame, job.band, job.band.view
    fine = scene.ground.kind != "flat" and scene.ground.spacing_m <= _FINE_M
    cells = frame_cells(scene, view, cell_px, smooth=not fine)
    high = None
    if fine and cells.relief_m is not None:
        high = standing(cells.relief_m, cell_px * scene.grid.gsd_m)
    top, left = band.row - cells.row, band.col - cells.col
    at = slice(top, top + band.own.shape[0]), slice(left, left + band.own.shape[1])
    near = band.near & (cells.margin_px[at] > EDGE_PX)
    if (well := cells.seen_well) is not None:
        near &= well[at]
    if band.finest is not None:
        near &= cells.as_fine(band.finest, at)
    may = band.own | near
    if (hidden := cells.hidden(cell_px)) is not None:
        may &= ~hidden[at]
    down, across = (np.flatnonzero(may.any(axis=axis)) for axis in (1, 0))
    inner = slice(down[0], down[-1] + 1), slice(across[0], across[-1] + 1)
    at = slice(top + down[0], top + down[-1] + 1), slice(left + across[0], left + across[-1] + 1)
    cols, rows, may = cells.cols_px[at], cells.rows_px[at], may[inner]
    may &= (cols > 0) & (cols < frame.width_px) & (rows > 0) & (rows < frame.height_px)
    pixels, valid = read_pixels(frame, job.reduction, spare=job.spare)
    pixels = pixels[..., : 3 if pixels.shape[-1] >= 3 else 1]
    col, row = (np.ascontiguousarray(a / job.reduction, dtype=np.float32) for a in (cols, rows))
    values = resample(np.ascontiguousarray(pixels), col, row, "bilinear").astype(np.float32)
    if tones is not None:
        darker = np.exp(-tones.brighter(view.frame, view.camera, cols, rows)[..., : values.shape[-1]])
        values = evened(values, darker, tones.white, "float32")
    if valid is not None:
        may &= resample(valid[..., None], col, row, "bilinear")[..., 0] == 255
    return SeamPart(
        view.frame,
        view.nadir_m,
        cells.row + at[0].start,
        cells.col + at[1].start,
        values.astype(np.float16 if pixels.dtype == np.uint8 else np.float32),
        may,
        None if high is None else high[at],
    )


def standing(heights_m: Floats32, cell_m: float) -> Bools:
    """Where something stands on the ground, by its heights (h, w): where a square wider than houses doesn't
    fit under. This is a top-hat transform (Serra 1982, Image analysis and mathematical morphology, ch.
    XII)."""
    across = 2 * int(_WIDEST_M / cell_m / 2.0) + 1
    over_m = cv2.morphologyEx(heights_m, cv2.MORPH_TOPHAT, np.ones((across, across), np.uint8))
    return np.asarray(over_m > HIGH_M)


def to_8_bits(parts: Sequence[SeamPart]) -> np.float32:
    """What takes values to a scale of 8 bits, by how bright frames are in the median."""
    if all(part.values.dtype == np.float16 for part in parts):
        return np.float32(1.0)
    every = slice(None, None, _SOME)
    some = [p.values[every, every][p.may[every, every]] for p in parts]
    bright = [float(np.quantile(of, 0.99)) for of in some if of.size]
    white = float(np.median(bright)) if bright else 0.0
    return np.float32(GREYS / white if white > 0.0 else 1.0)


def _areas(nearest: Ownership, scene: Scene) -> Ints:
    """Cells of each frame, by its owner's number."""
    most = max((view.frame + 1 for view in scene.views), default=0)
    return np.bincount(nearest.owner.ravel(), minlength=most + 1)
