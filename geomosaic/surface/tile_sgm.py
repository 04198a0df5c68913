"""The heights of one tile's cells, matched between the frames that see it best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from geomosaic.arrays import Bytes, Floats32
from geomosaic.constants import tuned
from geomosaic.projection.ground import GroundSurface
from geomosaic.surface.aggregation import aggregated, cheapest, distinctness, ring
from geomosaic.surface.agreement import agreeing
from geomosaic.surface.cells import Cells
from geomosaic.surface.census import Bits, census
from geomosaic.surface.costs import SweepHeights, census_costs
from geomosaic.surface.edge_refinement import REFINED_CELLS, refine_edges
from geomosaic.surface.plane_sweep import PlaneSweep, SweepView
from geomosaic.surface.refinement import UNSEEN, likeness, refined
from geomosaic.surface.squares import SweptPictures
from geomosaic.surface.visibility import REACH_CELLS, Asked, asked_frames, hidden_from
from geomosaic.surface.void_fill import NEAR_CELLS
from geomosaic.survey.small import means, padded

Steps = NDArray[np.int16]
MARGIN_CELLS: Final = REACH_CELLS
"""Run-in of the paths, and of what hides cells."""
_HEIGHTS = tuned(32, "heights", "searched about the coarse one: fewer lose masts and crowns; more take time")
PAST_HEIGHTS = tuned(8, "heights", "search past the coarse range: fewer cut off what that level missed")
_BLOCK_CELLS = tuned(32, "cells", "square with one choice of frames: larger fits worse; smaller is slow")
_FRAMES = tuned(5, "frames", "for a cell's height: three give a third larger errors; seven worse edges")
_CANDIDATES = tuned(6, "frames", "asked for agreement: with fewer, a group that agrees may be missed")
_AGREED_HEIGHTS = tuned(5, "heights", "tested about the coarse height, good to two: more takes longer")


@dataclass(frozen=True)
class CensusImage:
    """A frame as a level looks at it: grey (rows, cols), and its census."""

    grey: Bytes
    census: Bits


def census_image(grey: Bytes, valid: Bytes | None, turn_rad: float, by: int = 1) -> CensusImage:
    """The mean of by x by pixels each. valid (rows, cols): 0 where a pixel is not, None where all are;
    turn_rad: see `census`."""
    if by > 1:
        grey = np.asarray(means(grey[..., None], by)[..., 0], dtype=np.uint8)
        if valid is not None:
            least = cv2.erode(padded(valid, by), np.ones((by, by), np.uint8), anchor=(0, 0))
            valid = np.ascontiguousarray(least[::by, ::by])
    return CensusImage(grey, census(grey, valid, turn_rad))


@dataclass(frozen=True)
class HeightSearch:
    """Where heights over the base are looked for: in steps of step_m from lowest_m to highest_m, or where
    `about_m` (rows, cols), heights in the work frame, is given, near those. fine: between the
    steps as well."""

    cells: Cells
    step_m: float
    lowest_m: float
    highest_m: float
    about_m: Floats32 | None
    fine: bool


@dataclass(frozen=True)
class TileHeights:
    """Heights of a tile's cells, (rows, cols) each.

    up_m: in the work frame. alike: how alike the frames are there, from -1 to 1. views: how many agree.
    seeing: how many see a cell. distinct: by how many bits heights in and around a cell cost less than
    others.
    """

    up_m: Floats32
    alike: Floats32
    views: Bytes
    seeing: Bytes
    distinct: Floats32


def unmatched(up_m: Floats32) -> TileHeights:
    """Heights that no frames were compared at."""
    nothing = np.zeros(up_m.shape, dtype=np.uint8)
    return TileHeights(up_m, np.full_like(up_m, UNSEEN), nothing, nothing.copy(), np.zeros_like(up_m))


def match_tile(
    search: HeightSearch, base: GroundSurface, frames: Sequence[SweepView], pictures: Sequence[CensusImage]
) -> TileHeights:
    """Heights of cells, by the frames that see them, two at least."""
    sweep = PlaneSweep(search.cells, base, frames, search.lowest_m, search.highest_m)
    seen = [p.census for p in pictures]
    unrefined = MARGIN_CELLS - REFINED_CELLS
    shapes = [p.grey.shape for p in pictures]
    asked: Asked = asked_frames(sweep, shapes, _BLOCK_CELLS, unrefined, _CANDIDATES)
    hidden: dict[int, Floats32] = {}
    if search.about_m is None:
        steps = _all_steps(search, sweep.base_m.shape)
        asked = agreeing(sweep, seen, SweepHeights(steps, search.step_m), asked, _FRAMES)
    else:
        about_m = search.about_m - sweep.base_m
        about = np.asarray(about_m / np.float32(search.step_m), dtype=np.float32)
        steps = search_steps(about)
        near = ring(np.round(about).astype(np.int16) - np.int16(_AGREED_HEIGHTS // 2), _AGREED_HEIGHTS)
        asked = agreeing(sweep, seen, SweepHeights(near, search.step_m), asked, _FRAMES)
        hidden = hidden_from(sweep, asked, about_m, search.cells.cell_m)
    costs = census_costs(sweep, seen, SweepHeights(steps, search.step_m), asked, hidden)
    total = aggregated(costs, steps)
    height_m = _smoothed(cheapest(total, steps) * np.float32(search.step_m))
    inner = slice(MARGIN_CELLS, -MARGIN_CELLS), slice(MARGIN_CELLS, -MARGIN_CELLS)
    if not search.fine:
        return unmatched((sweep.base_m + height_m)[inner])
    swept = SweptPictures(sweep, [p.grey for p in pictures])
    asked = _within(asked, unrefined, search.cells)
    height_m, alike = refined(swept, height_m, search.step_m, asked, hidden)
    height_m = refine_edges(swept, _smoothed(height_m), alike, asked)
    alike, views, seeing = likeness(swept, height_m, asked)
    distinct = distinctness(costs, total)
    up_m = sweep.base_m + height_m
    return TileHeights(up_m[inner], alike[inner], views[inner], seeing[inner], distinct[inner])


def _within(asked: Asked, margin: int, cells: Cells) -> Asked:
    """What is asked of cells that lie further from the tile's edge than a margin."""
    found = []
    for at, frames in asked:
        rows, cols = (
            slice(max(s.start, margin), min(s.stop, n - margin))
            for s, n in zip(at, (cells.rows, cells.cols), strict=True)
        )
        if rows.start < rows.stop and cols.start < cols.stop:
            found.append(((rows, cols), frames))
    return found


def _all_steps(search: HeightSearch, shape: tuple[int, ...]) -> Steps:
    """(heights, rows, cols) that are looked at where nothing is known: the base's and those next to it at
    least."""
    lowest, highest = (round(end / search.step_m) for end in (search.lowest_m, search.highest_m))
    found = np.arange(min(lowest, -1), max(highest, 2), dtype=np.int16)
    return np.broadcast_to(found[:, None, None], (len(found), *shape))


def search_steps(about: Floats32) -> Steps:
    """The heights (heights, rows, cols) that are looked at, in steps over the base. They go from the lowest
    to the highest of the level above around a cell, and past them. Where these are too many, they lie about
    the cell's own."""
    window = np.ones((NEAR_CELLS, NEAR_CELLS), dtype=np.uint8)
    highest, lowest = cv2.dilate(about, window), cv2.erode(about, window)
    middle, to_end = (highest + lowest) / 2.0, np.float32(_HEIGHTS - PAST_HEIGHTS) / 2.0
    own = about.clip(np.minimum(lowest + to_end, middle), np.maximum(highest - to_end, middle))
    return ring(np.round(own).astype(np.int16) - np.int16(_HEIGHTS // 2), _HEIGHTS)


def _smoothed(height_m: Floats32) -> Floats32:
    """Without single cells that leap off."""
    return np.asarray(cv2.medianBlur(height_m, 3), dtype=np.float32)
