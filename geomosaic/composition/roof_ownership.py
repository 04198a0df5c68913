"""Who gives the mosaic's cells about raised roofs: one frame a roof, another one what that hides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from geomosaic.arrays import Bools, Floats, Ints32
from geomosaic.composition.hidden import Hidden
from geomosaic.composition.occlusion import occluded_scene
from geomosaic.composition.ownership import Ownership
from geomosaic.composition.roof_views import OFF_EDGES
from geomosaic.composition.roofs import RaisedRoof
from geomosaic.composition.scene import Scene, ground_of
from geomosaic.composition.seam_parts import EDGE_PX
from geomosaic.composition.window import Window
from geomosaic.constants import tuned
from geomosaic.projection.ground import WALLED, GroundSurface
from geomosaic.spread import Spread

_HIDDEN = tuned(0.25, "share", "of a cell that its owner may not see: more leaves doubled edges to chance")


def with_roofs(
    ownership: Ownership, scene: Scene, nodes: GroundSurface, roofs: Sequence[RaisedRoof], spread: Spread
) -> Ownership:
    """The ownership on ground with roofs. A roof and the cells about it go to the steepest frame that sees
    all of it. What is hidden from that goes to the nearest frame that sees it. All other cells stay.

    scene: on the ground without them. nodes: of a surface, whose nodes carry the roofs for what they hide.
    """
    side, (rows, cols) = ownership.cell_px, ownership.owner.shape
    whole = Window(0, 0, cols * side, rows * side)
    places = ground_of(scene, whole, side).points_m()
    owner, of_roof = ownership.owner.copy(), np.zeros((rows, cols), np.int32)
    for number, raised in enumerate(roofs, start=1):
        cells = _cells(raised, places, side * ownership.grid.gsd_m)
        of_roof[cells] = number
        owner[cells] = raised.frame + 1
    hidden = _hidden(scene, _with_walls(scene.ground, nodes, roofs), of_roof > 0, side, spread)
    shares = {one.frame: one.share(whole, side) for one in hidden}
    unseen = np.zeros((rows, cols), dtype=bool)
    for frame, share in shares.items():
        unseen |= (owner == frame + 1) & (share > _HIDDEN)
    owner[unseen] = _nearest(
        scene, places[unseen], {f: s[unseen] > 0.0 for f, s in shares.items()}, owner[unseen]
    )
    return replace(ownership, owner=owner, hidden=hidden)


def _cells(raised: RaisedRoof, places: Floats, cell_m: float) -> Bools:
    """The cells whose middles, places (rows, cols, 3), lie in a roof or less than a cell off it."""
    roof, reach = raised.roof, int(np.ceil(cell_m / raised.roof.pixel_m))
    around = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    wide = cv2.dilate(np.pad(raised.mask, reach).view(np.uint8), around) > 0
    col = np.rint((places[..., 0] - roof.west_m) / roof.pixel_m).astype(np.intp) + reach
    row = np.rint((places[..., 1] - roof.south_m) / roof.pixel_m).astype(np.intp) + reach
    inside = (row >= 0) & (row < wide.shape[0]) & (col >= 0) & (col < wide.shape[1])
    inside[inside] = wide[row[inside], col[inside]]
    return np.asarray(inside)


def _with_walls(ground: GroundSurface, nodes: GroundSurface, roofs: Sequence[RaisedRoof]) -> GroundSurface:
    """The ground with roofs on the nodes of a surface."""
    at = nodes.nodes_m()
    up_m = ground.up_at(at[..., 0], at[..., 1])
    for one in roofs:
        one.on_ground.put(at[..., 0], at[..., 1], up_m)
    return replace(nodes, kind=WALLED, up_m=up_m.astype(np.float32), sd_m=None)


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


def _nearest(scene: Scene, places: Floats, hidden: dict[int, Bools], owner: Ints32) -> Ints32:
    """Of places (n, 3) the nearest frame, plus 1, of those that see them; the owner where none does."""
    found, nearest = owner.copy(), np.full(len(places), np.inf)
    for view in scene.views:
        px = view.pose.image_from_ground(view.camera, places)
        size = np.array([view.camera.width_px, view.camera.height_px])
        with np.errstate(invalid="ignore"):
            sees = ((px > EDGE_PX) & (px < size - EDGE_PX)).all(axis=-1)
        if view.frame in hidden:
            sees &= ~hidden[view.frame]
        away = np.hypot(*(places[:, :2] - view.pose.position_m[:2]).T)
        nearer = sees & (away < nearest)
        nearest[nearer], found[nearer] = away[nearer], view.frame + 1
    return found
