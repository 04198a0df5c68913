"""Occlusion: which frames see a place, and which frame fills what none of them sees."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import cv2
import numpy as np

from geomosaic.arrays import Bools, Bytes, Floats32
from geomosaic.composition.grid import LEAST_CELL_PX
from geomosaic.composition.hidden import Hidden
from geomosaic.composition.model import OutputGrid
from geomosaic.composition.scene import CELL_PX, Scene, bounds_window, ground_of, margin_px
from geomosaic.composition.views import FrameView
from geomosaic.constants import tuned
from geomosaic.projection.horizon import hidden_m
from geomosaic.projection.warp import frame_from_map
from geomosaic.spread import Spread

_STEP_M = tuned(1.0, "m", "depth and width of an occlusion: less is kerbs and noise; more sees through sheds")
_EDGE_M = tuned(0.25, "m", "depth at its edge: less frays it by noise; more shows roof edges twice")
_PER_M = tuned(10.0, "steps per m", "of depth in a byte: fewer are coarse; more saturate at once")
_BEYOND: Final = int(np.iinfo(np.uint8).max)
"""Of a place that the frame does not show."""


@dataclass(frozen=True)
class OcclusionDepth:
    """How far below its lines of sight a frame's part of the mosaic lies, by cells from row and col on.
    packed: compressed bytes, 0 where it is seen, 255 where the frame ends or is about to."""

    frame: int
    row: int
    col: int
    shape: tuple[int, int]
    packed: bytes

    @property
    def depth(self) -> Bytes:
        """(h, w)."""
        return np.frombuffer(zlib.decompress(self.packed), dtype=np.uint8).reshape(self.shape)


@dataclass(frozen=True)
class UnseenGround:
    """What of the ground that frames show none of them sees: its share, and m2."""

    share: float
    area_m2: float


def occluded_scene(scene: Scene, spread: Spread) -> tuple[Scene, tuple[Hidden, ...], UnseenGround | None]:
    """The scene whose views exclude what is hidden from them, these hidden parts, and the ground that no
    frame sees. The last is None where nothing stands on the ground."""
    if not scene.ground.has_walls:
        return scene, (), None
    side_px = side_px_of(scene)
    look = partial(occlusion_depth, replace(scene, views=()), side_px)
    shadows = spread.map("occlusions", look, scene.views, keys=[v.frame for v in scene.views])
    hidden, unseen = occluded_parts(scene.grid, side_px, shadows)
    return replace(scene, views=with_occlusion(scene.views, hidden)), hidden, unseen


def side_px_of(scene: Scene) -> int:
    """The side of the cells of what is hidden: as the ground's nodes lie, and a part of a planning cell."""
    side_px = LEAST_CELL_PX
    while side_px > 1 and side_px * scene.grid.gsd_m > 1.5 * scene.ground.spacing_m:
        side_px //= 2
    return side_px


def occlusion_depth(scene: Scene, side_px: int, view: FrameView) -> OcclusionDepth:
    """What stands before what a frame shows. The scene's views are not used."""
    window = bounds_window(scene.grid, view.widened(), CELL_PX)
    ground = ground_of(scene, window, side_px)
    below_m = hidden_m(scene.ground, view.pose.position_m, ground.points_m())
    hidden = occluded(below_m, side_px * scene.grid.gsd_m)
    depth = np.where(hidden, np.clip(np.round(below_m * _PER_M), 1, _BEYOND - 1), 0).astype(np.uint8)
    inside_px = margin_px(*frame_from_map(ground, view.pose, view.camera), view.camera, None)
    depth[inside_px <= 1.5 * side_px * scene.grid.gsd_m / view.gsd_m] = _BEYOND
    at = window.row // side_px, window.col // side_px
    return OcclusionDepth(
        view.frame, *at, (depth.shape[0], depth.shape[1]), zlib.compress(depth.tobytes(), 1)
    )


def occluded(below_m: Floats32, cell_m: float) -> Bools:
    """Cells that are hidden: connected ones below a line of sight, somewhere by more than a step. Islands in
    them or of them that are less than a step wide are removed. Adjacent cells are added, where edges would be
    doubled."""
    low = (below_m > _EDGE_M).view(np.uint8)
    number, parts = cv2.connectedComponents(low, connectivity=4)
    deep = np.zeros(number, dtype=bool)
    deep[parts[below_m > _STEP_M]] = True
    hidden, least = deep[parts] & (low > 0), max(round((_STEP_M / cell_m) ** 2), 1)
    hidden = ~_without_islands(~_without_islands(hidden, least), least)
    return np.asarray(cv2.dilate(hidden.view(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _without_islands(flags: Bools, least: int) -> Bools:
    _, parts, stats, _ = cv2.connectedComponentsWithStats(flags.view(np.uint8), connectivity=4)
    return np.asarray(flags & (stats[:, cv2.CC_STAT_AREA] >= least)[parts])


def occluded_parts(
    grid: OutputGrid, side_px: int, shadows: Sequence[OcclusionDepth]
) -> tuple[tuple[Hidden, ...], UnseenGround]:
    """What each frame doesn't give, and how much none sees: that is given by the frame that comes nearest to
    seeing it, the first of several."""
    shape = tuple(-(-n // CELL_PX) * CELL_PX // side_px for n in (grid.height_px, grid.width_px))
    least = np.full(shape, _BEYOND, dtype=np.uint8)
    for one in shadows:
        depth, at = one.depth, _part(one)
        np.minimum(least[at], depth, out=least[at])
    unseen = (least > 0) & (least < _BEYOND)
    cells, shown = int(np.count_nonzero(unseen)), int(np.count_nonzero(least < _BEYOND))
    found = []
    for one in shadows:
        depth, at = one.depth, _part(one)
        gives = unseen[at] & (depth == least[at])
        unseen[at][gives] = False
        flags = (depth > 0) & (depth < _BEYOND) & ~gives
        if flags.any():
            found.append(Hidden.of(one.frame, side_px, one.row, one.col, flags))
    cell_m2 = (side_px * grid.gsd_m) ** 2
    return tuple(found), UnseenGround(cells / max(shown, 1), cells * cell_m2)


def _part(one: OcclusionDepth) -> tuple[slice, slice]:
    return slice(one.row, one.row + one.shape[0]), slice(one.col, one.col + one.shape[1])


def with_occlusion(views: Iterable[FrameView], hidden: Sequence[Hidden]) -> tuple[FrameView, ...]:
    """Views with what they can't see."""
    of = {one.frame: one for one in hidden}
    return tuple(replace(view, hidden=of.get(view.frame)) for view in views)
