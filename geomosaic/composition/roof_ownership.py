"""Who gives the mosaic's cells about raised roofs: one frame a roof, another one what that hides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats, Floats32, Ints, Ints32
from geomosaic.composition.hidden import Hidden
from geomosaic.composition.occlusion import occluded_scene
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.roof_views import OFF_EDGES
from geomosaic.composition.roofs import RaisedRoof
from geomosaic.composition.scene import Scene, ground_of
from geomosaic.composition.seam_parts import EDGE_PX
from geomosaic.composition.window import Window
from geomosaic.constants import tuned
from geomosaic.geodesy.mapcrs import MapProjection
from geomosaic.projection.ground import WALLED, GroundSurface, RaisedObject
from geomosaic.spread import Spread

_HIDDEN = tuned(0.25, "share", "of a cell that its owner may not see: more leaves doubled edges to chance")


def with_roofs(
    ownership: Ownership, scene: Scene, nodes: GroundSurface, roofs: Sequence[RaisedRoof], spread: Spread
) -> Ownership:
    """The ownership on ground with roofs. A roof and the cells about it go to the steepest frame that sees
    all of it. What is hidden from that goes to the nearest frame that sees it. All other cells stay.

    scene: on the ground without them. nodes: of a surface, whose nodes carry the roofs for what they hide.
    """
    side, shape = ownership.cell_px, ownership.owner.shape
    owner, of_roof = ownership.owner.copy(), np.zeros(shape, dtype=bool)
    for raised in roofs:
        window = _window_about(scene, raised.on_ground, side)
        cells = _cells(raised, ground_of(scene, window, side).points_m(), side * ownership.grid.gsd_m)
        at = _of_window(window, side)
        of_roof[at] |= cells
        owner[at][cells] = raised.frame + 1
    hidden = _hidden(scene, _with_walls(scene.ground, nodes, roofs), of_roof, side, spread)
    unseen, places_m = _unseen(scene, hidden, owner, side)
    found = _nearest(scene, {one.frame: one for one in hidden}, unseen, places_m, side)
    rows, cols = unseen[found > 0].T
    owner[rows, cols] = found[found > 0]
    return replace(ownership, owner=owner, hidden=hidden)


def _window_about(scene: Scene, one: RaisedObject, cell_px: int) -> Window:
    """The whole cells of the grid about an object, with those next to it; one cell at least."""
    grid, cell_m = scene.grid, cell_px * scene.grid.gsd_m
    about_m = np.array([-1.0, 1.0])[:, None] * (cell_m + one.spacing_m)
    corners_m = np.stack(np.meshgrid(*(one.ends_m + about_m).T, np.nanmean(one.up_m)), axis=-1)
    geodetic = scene.work_frame.geodetic_from_enu(corners_m)
    on_map = MapProjection(grid.crs).map_from_geodetic(geodetic[..., 0], geodetic[..., 1])
    spans = []
    for away_m, size_px in (
        (grid.north_m - on_map[..., 1], grid.height_px), (on_map[..., 0] - grid.west_m, grid.width_px),
    ):  # fmt: skip
        cells = -(-size_px // cell_px)
        first = int(np.clip(np.floor(away_m.min() / cell_m) - 1, 0, cells - 1))
        last = int(np.clip(np.ceil(away_m.max() / cell_m) + 1, first + 1, cells))
        spans.append((first * cell_px, (last - first) * cell_px))
    (row, height), (col, width) = spans
    return Window(col, row, width, height)


def _of_window(window: Window, cell_px: int) -> tuple[slice, slice]:
    """Rows and cols of a window's cells; beyond the grid there are none."""
    row, col = window.row // cell_px, window.col // cell_px
    return slice(row, row + window.height // cell_px), slice(col, col + window.width // cell_px)


def _cells(raised: RaisedRoof, places: Floats, cell_m: float) -> Bools:
    """The cells whose middles, places (rows, cols, 3), lie in a roof or less than a cell off it."""
    roof = raised.on_ground
    reach = int(np.ceil(cell_m / roof.spacing_m))
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    wide = cv2.dilate(np.pad(raised.mask, reach).view(np.uint8), around) > 0
    col = np.rint((places[..., 0] - roof.east_0_m) / roof.spacing_m).astype(np.intp) + reach
    row = np.rint((places[..., 1] - roof.north_0_m) / roof.spacing_m).astype(np.intp) + reach
    inside = (row >= 0) & (row < wide.shape[0]) & (col >= 0) & (col < wide.shape[1])
    inside[inside] = wide[row[inside], col[inside]]
    return np.asarray(inside)


def _with_walls(ground: GroundSurface, nodes: GroundSurface, roofs: Sequence[RaisedRoof]) -> GroundSurface:
    """The ground with roofs on the nodes of a surface."""
    at = nodes.nodes_m()
    up_m = ground.up_at(at[..., 0], at[..., 1]).astype(np.float32)
    walled = replace(nodes, kind=WALLED, up_m=up_m, sd_m=None)
    for one in roofs:
        part = walled.about(one.on_ground.ends_m, 1)
        at = part.nodes_m()
        one.on_ground.put(at[..., 0], at[..., 1], part.up_m)
    return walled


def _hidden(
    scene: Scene, ground: GroundSurface, of_roof: Bools, cell_px: int, spread: Spread
) -> tuple[Hidden, ...]:
    """What frames do not see for the roofs: what is hidden and touches the cells about one of them, and a
    cell more, since walls are ramps of a node."""
    _, hidden, _ = occluded_scene(replace(scene, ground=ground), spread)
    near, found = cv2.dilate(of_roof.view(np.uint8), OFF_EDGES), []
    for one in hidden:
        flags, by = one.flags, cell_px // one.side_px
        rows, cols = (
            np.minimum((first + np.arange(size)) // by, most - 1)
            for first, size, most in zip((one.row, one.col), flags.shape, of_roof.shape, strict=True)
        )
        number, parts = cv2.connectedComponents(flags.view(np.uint8), connectivity=8)
        touch = np.zeros(number, dtype=bool)
        touch[parts[near[np.ix_(rows, cols)] > 0]] = True
        touch[0] = False
        if touch.any():
            found.append(Hidden.of(one.frame, one.side_px, one.row, one.col, touch[parts]).widened(1))
    return tuple(found)


def _share(hidden: Hidden, cell_px: int) -> tuple[Window, Floats32]:
    """The window of whole cells about what a frame does not see, and how much of each is hidden, (h, w)."""
    by = cell_px // hidden.side_px
    row, col = hidden.row // by, hidden.col // by
    down = -(-(hidden.row + hidden.height) // by) - row
    across = -(-(hidden.col + hidden.width) // by) - col
    window = Window(col * cell_px, row * cell_px, across * cell_px, down * cell_px)
    return window, hidden.share(window, cell_px)


def _unseen(scene: Scene, hidden: Sequence[Hidden], owner: Ints32, cell_px: int) -> tuple[Ints, Floats]:
    """The cells that are hidden from their owner: row and col (n, 2), and their ground points (n, 3) in m."""
    cells, places_m = [np.zeros((0, 2), np.intp)], [np.zeros((0, 3))]
    for one in hidden:
        window, share = _share(one, cell_px)
        rows, cols = _of_window(window, cell_px)
        mine = owner[rows, cols] == one.frame + 1
        own = np.argwhere(mine & (share[: mine.shape[0], : mine.shape[1]] > _HIDDEN))
        if len(own):
            cells.append(own + np.array([rows.start, cols.start]))
            places_m.append(ground_of(scene, window, cell_px).points_m()[tuple(own.T)])
    return np.concatenate(cells), np.concatenate(places_m)


def _nearest(
    scene: Scene, hidden: Mapping[int, Hidden], cells: Ints, places_m: Floats, cell_px: int
) -> Ints32:
    """The nearest frame, plus 1, that sees each of some cells, (n,); 0 where none does. See `_unseen`."""
    found, nearest = np.zeros(len(cells), np.int32), np.full(len(cells), np.inf)
    for view in scene.views:
        away = np.hypot(*(places_m[:, :2] - view.pose.position_m[:2]).T)
        some = np.flatnonzero(away < nearest)
        px = view.pose.image_from_ground(view.camera, places_m[some])
        size = np.array([view.camera.width_px, view.camera.height_px])
        with np.errstate(invalid="ignore"):
            some = some[((px > EDGE_PX) & (px < size - EDGE_PX)).all(axis=-1)]
        if view.frame in hidden:
            window, share = _share(hidden[view.frame], cell_px)
            at = cells[some] - [window.row // cell_px, window.col // cell_px]
            behind = np.asarray(((at >= 0) & (at < share.shape)).all(axis=1))
            behind[behind] = share[tuple(at[behind].T)] > 0.0
            some = some[~behind]
        nearest[some], found[some] = away[some], view.frame + 1
    return found
